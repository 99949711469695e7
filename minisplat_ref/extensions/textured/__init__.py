"""Textured: colour and opacity that vary over each Gaussian, as spherical harmonics.

This follows Textured-GS, Huang & Gong 2024, arXiv 2407.09733. In 3DGS a Gaussian has one colour for each viewing
direction. Here a ray hits a point n on the Gaussian's ellipsoid of one standard deviation (:mod:`.model`), and opacity
and colour are spherical harmonics of n:

    opacity(n) = sigmoid(l + sum_k h_k Y_k(n)),   color(n) = max(0, c + sum_k k_k Y_k(n)),   k = 1 ... 15

Textures are trained for the Gaussians of a finished Mini-Splatting run, whose number stays. Their positions and shapes
are trained, too, as by the released code; ``--frozen`` leaves them as they are, as the paper's text has it. With
textures of degree 0 the method is 3DGS, to the last byte.

    minisplat-ref train SCENE --recipe mini-splatting --out runs/few
    minisplat-ref textured fine-tune SCENE runs/few/point_cloud.ply --out textured.ply
    minisplat-ref render textured.ply --cameras runs/few/cameras.json
    python -m data_tools.claims textured/counts SCENE --out DIR
    python -m data_tools.claims textured/limb
    minisplat-ref oracle gradients --extension textured

``docs/family/textured.md`` has the measured figures.

This deviates from the paper as follows. The ellipsoid is exactly that of one standard deviation; the released kernel
divides by standard deviations where their squares belong. Most rays that a footprint reaches miss the ellipsoid. In the
paper these get the colour of degree 0, which jumps at the limb; here n points to the ray's nearest point, which does
not. In the paper textures replace view-dependent colour, which ``--replace`` does; otherwise they are added to it after
it has been clamped at zero, as colours of 3DGS are. The released code has a sigmoid there. The recipe ``textured``
trains textures and shapes together from the first iteration on, which the paper does not.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.textured import fine_tune
from minisplat_ref.extensions.textured.recipe import TEXTURED, TEXTURED_GAUSSIANS, stages

EXTENSION = Extension(
    "textured",
    recipes=(TEXTURED,),
    representation=TEXTURED_GAUSSIANS,
    commands=(fine_tune,),
    stages=stages,
)
