"""Discretised SDF: opacity from a signed distance that each surfel stores.

This follows Discretized SDF Gaussian Splatting (2025), arXiv 2507.15629, on the surfels, materials and shading of
Ref-Gaussian (:mod:`minisplat_ref.mechanisms.gbuffer`). A surfel with the centre mu and the normal n stores s, the
signed distance of mu from the surface. With one gamma > 0 for all, which is trained, too, its opacity is

    o = 4 exp(-gamma s) / (1 + exp(-gamma s))^2 = sech^2(gamma s / 2),   do/ds = -gamma tanh(gamma s / 2) o

so 1 on the surface, and one half at |s| = ln(3 + 2 sqrt 2) / gamma. The point x_0 = mu - s n should be on the surface:

    projection   |z(x_0) - D| of the rendered depth D at its pixel, where that is below 0.1; D is held constant
    median       100 max(0, gamma_ref - gamma) from iteration 1,000: the opacity of median |s| is at most one half
    further      normal_consistency 0.2, distortion 100, silhouette 0.001 (cross entropy of alpha and the mask)

Training begins with the foreground on a sphere; its stages of shading are those of ``reflective``.

    minisplat-ref train SCENE --recipe discretized-sdf --set foreground=1 --out runs/sdf
    minisplat-ref render runs/sdf --map normal
    minisplat-ref render runs/sdf --environment studio.png
    python -m data_tools.claims discretized-sdf/sphere --out DIR
    python -m data_tools.claims discretized-sdf/relight --out DIR
    minisplat-ref oracle gradients --extension discretized-sdf

``docs/FAMILY.md`` has the measured figures.

The PLY has the distances, and as ``opacity`` the opacities that follow from them, for other viewers; gamma is in
``shared.npz`` beside it, as ln(1 / gamma), the environment likewise. Clones and children of a split inherit s, which a
tangent plane does not change; faint surfels are pruned by their opacity, and a reset of opacities raises |s|.

This deviates from the paper as follows. The foreground is the half of the points that is nearest to their median, and
its radius, the weight of the projection, the first gamma and all rates are ours. The inverse of D is interpolated.
Dates of normals and distortion are those of 2D Gaussian Splatting. A mask of the scene is taken for the object's: where
it hides something else, train with ``--set silhouette=0``. With another recipe, density control sees the first
opacities.
"""

from minisplat_ref.extensions.discretized_sdf.model import DISTANCED, stages
from minisplat_ref.extensions.discretized_sdf.recipe import RECIPE
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("discretized-sdf", recipes=(RECIPE,), representation=DISTANCED, stages=stages)
"""Surfels with signed distances, the recipe that trains them."""
