"""Surfels: Gaussians on discs in space, with a depth and a normal at every pixel.

This follows 2D Gaussian Splatting, Huang et al. 2024, arXiv 2403.17888. A pixel's ray meets the disc of a surfel in
one point (u, v), in standard deviations from its centre, by equations (5) to (11):

    T (u, v, 1)^T = z (x, y, 1)^T,   alpha = o exp(-min(u^2 + v^2, 2 |c - x|^2) / 2)

The second form is a low-pass around the centre c, without which a disc would vanish from its edge. z is the depth of
the hit, and the disc's normal is that of the pixel. :mod:`minisplat_ref.mechanisms.surfels` has both statements of it,
the kernels, and gsplat's call ``rasterization_2dgs``. The recipe is 3DGS's with two losses, equations (13) and (14), at
the published dates (:mod:`minisplat_ref.mechanisms.surfels.losses`):

    normal_consistency          0.05, from iteration 7,000: each surfel faces as the surface through the depths does
    median_normal_consistency   0: the same with median depths, for bounded scenes
    distortion                  0, from 3,000: the hits of a ray lie at one depth; 10 to 1,000 in the paper's scenes

    minisplat-ref train SCENE --recipe surfels --out runs/surfels
    minisplat-ref mesh runs/surfels --out mesh.ply
    python -m data_tools.claims surfels/losses room --out DIR
    minisplat-ref oracle gradients --extension surfels
    minisplat-ref oracle compare my_module:rasterization_2dgs --call rasterization_2dgs

``docs/family/surfels.md`` has the measured figures.

This deviates from the released code as follows. A surfel reaches as far as its alpha can be 1/255 instead of three
standard deviations. Where the low-pass is hit, the depth is that of the centre, not that at which the ray meets the
plane, which has no bound for a disc seen from its edge. ``low_pass_cutoff`` is 3, as released; the paper's text has the
projected centre, 0, and gsplat 1. The loss on normals is the paper's sum over hits, whose derivative with respect to
the opacity counts; the code holds that constant. Distortion has the square of the code, not the paper's absolute value.
Rates are those of ``3dgs-accel``.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.surfels.model import RECIPE, stages
from minisplat_ref.mechanisms.surfels.discs import DISCS

EXTENSION = Extension("surfels", recipes=(RECIPE,), representation=DISCS, stages=stages)
