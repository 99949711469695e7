"""Discretised SDF: opacity from a signed distance that each surfel stores.

This follows Discretized SDF Gaussian Splatting (2025), arXiv 2507.15629, on the surfels, materials and shading of
Ref-Gaussian (:mod:`minisplat_ref.mechanisms.gbuffer`). A surfel with the centre mu and the normal n stores s, the
signed distance of mu from the surface. With one gamma > 0 for all, which is trained, too, its opacity is

    o = 4 exp(-gamma s) / (1 + exp(-gamma s))^2 = sech^2(gamma s / 2),   do/ds = -gamma tanh(gamma s / 2) o

so 1 on the surface, and one half at |s| = ln(3 + 2 sqrt 2) / gamma. The point x_0 = mu - s n should be on the surface:

    projection   5 |z(x_0) - D| of the rendered depth D at its pixel, where that is below 0.1; D is held constant
    median       max(0, gamma_ref - gamma): the opacity of median |s| is at most one half, unless that is below 0.1
    distortion   100, as these two from iteration 1,000
    further      normal_consistency 0.2, silhouette 0.2 (cross entropy of alpha and the mask),
                 base_smoothness 0.02 (slopes of the maps of materials), neutral_light 0.001 (grey environments)

Pixels are shaded from the start, without occlusion and light from around; what a surface scatters is its albedo in the
environment's light, so that all of it can be lit anew. The background is random.

    minisplat-ref train SCENE --recipe discretized-sdf --out runs/sdf
    minisplat-ref train OBJECT --recipe discretized-sdf --set foreground=1 --out runs/sdf
    minisplat-ref render runs/sdf --map normal
    minisplat-ref render runs/sdf --environment studio.png
    python -m data_tools.claims discretized-sdf/sphere --out DIR
    python -m data_tools.claims discretized-sdf/relight --out DIR
    minisplat-ref oracle gradients --extension discretized-sdf

``docs/family/discretized-sdf.md`` has the measured figures.

The PLY has the distances, and as ``opacity`` the opacities that follow from them, for other viewers; gamma is in
``shared.npz`` beside it, as ln(1 / gamma), the environment likewise. Clones and children of a split inherit s, which a
tangent plane does not change; faint surfels are pruned by their opacity, and a reset of opacities raises |s|.

Dates, rates and the start are those of the released code, weights those of its script for shiny objects. Lengths are in
world units, and meant for an object of about one. This deviates from the code as follows. The distortion has the
default of the code, 100, where its scripts have 2,000 for objects before nothing; in a room even 100 costs much
(``docs/family/discretized-sdf.md``). Its sphere, which is an option there, too, is around the points and in their size,
instead of the origin; ``foreground`` is the share of the points that it takes the place of. gamma is trained as its
logarithm. A reset raises |s| on both sides of the surface, there on one. Surfels face at random, and the albedo begins
with their colours. The inverse of D is interpolated. A mask of the scene is taken for the object's: where it hides
something else, train with ``--set silhouette=0``. With another recipe, density control sees the first opacities.
"""

from minisplat_ref.extensions.discretized_sdf.model import DISTANCED, stages
from minisplat_ref.extensions.discretized_sdf.recipe import RECIPE
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("discretized-sdf", recipes=(RECIPE,), representation=DISTANCED, stages=stages)
"""Surfels with signed distances, the recipe that trains them."""
