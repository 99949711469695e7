"""Ray tracing of Gaussians: lists of tiles, a tree of boxes, shadows, mirrors, glass, meshes.

This follows RaySplats, Byrski et al. 2025, arXiv 2501.19196. Nothing is projected. A Gaussian is evaluated at the point
of the pixel's ray ``O + t d`` where its density is greatest:

    p = M (mu - O),  v = M d,  M = diag(1/s) R^T
    t = (v . p) / (v . v),   alpha = min(alpha_max, o exp(-|p - t v|^2 / 2))

Each ray blends its own hits in the order of t, with the weights of 3DGS. So ellipsoids are exact at any angle, no
Gaussian pops in front of another when the camera turns, and rays may start anywhere: shadows, mirrors, glass and
triangles need no new formula (:mod:`.lights`). The rays of an image test the Gaussians of their tile's list
(``mechanisms.rays.tile_lists``). For all others a bounding volume hierarchy skips Gaussians that a ray does not come
near (``mechanisms.rays.bvh``).

This deviates from the paper as follows. A Gaussian ends where alpha falls below ``alpha_min`` = 1/255, as in 3DGS, and
not at the ellipsoid of 99 %, which is nearly the same for an opaque one. A ray has any number of hits, where the
released code stops at 512. The loss uses L1, as that of 3DGS, and not L2, so that trainings differ by the renderer
alone. Colours are those towards the camera's centre, and behind a mirror or glass towards the apparent position of the
eye. Density control, which needs gradients in the image, gets them from those in the world
(``mechanisms.rays.renderer``). Under all conventions a clamped alpha has no gradient, though INRIA's rasteriser has
one.

There is no low-pass: Gaussians thinner than a pixel fall between rays, and images smaller than those of the training
alias. Shadows, mirrors and glass have no gradient. ``docs/family/rays.md`` has the measured figures.

    minisplat-ref train SCENE --recipe rays
    minisplat-ref rays render runs/fox --scene lamp_and_mirror.json --out DIR
    python -m data_tools.claims rays/claims --out DIR
    python -m data_tools.claims rays/speed
    minisplat-ref oracle gradients --extension rays
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.rays import render
from minisplat_ref.extensions.rays.model import RAYS, TRACED, stages

EXTENSION = Extension("rays", recipes=(RAYS,), representation=TRACED, commands=(render,), stages=stages)
"""Ray-traced Gaussians, the recipe that trains them, a command that lights them."""
