"""Textured: colour and opacity that vary over each Gaussian, as spherical harmonics.

Textured-GS, Huang & Gong 2024, arXiv 2407.09733. In 3DGS a Gaussian has one colour for each direction that it is seen
from. Here a ray finds a point n on the Gaussian's ellipsoid of one deviation
(:mod:`minisplat_ref.extensions.textured.reference`), and opacity and colour are spherical harmonics of n
(:mod:`minisplat_ref.extensions.textured.response`):

    opacity(n) = sigmoid(l + sum_k h_k Y_k(n)),   color(n) = max(0, c + sum_k k_k Y_k(n)),   k = 1 ... 15

Textures are learnt for the Gaussians of a finished Mini-Splatting run, whose number, places and shapes stay. Textures
of degree 0 are 3DGS, to the last byte.

    minisplat-ref train SCENE --recipe mini-splatting --out runs/few
    minisplat-ref textured fine-tune SCENE runs/few/point_cloud.ply --out textured.ply
    minisplat-ref render textured.ply --extension textured --cameras runs/few/cameras.json
    minisplat-ref study textured/counts SCENE --out DIR
    minisplat-ref study textured/limb
    minisplat-ref oracle gradients --extension textured

Measured on the fox at 135 x 240 (``study textured/counts fox --downscale 2 --fine-tune 300 --seeds 1``), 4,422
Gaussians after 1,000 iterations of Mini-Splatting, fine-tuned for 300 more: textures on top of view-dependent colour
gain 0.62 dB and 0.018 of SSIM on the test views. In its place they lose 0.49 dB and gain 0.006 of SSIM; of degree 1 and
2, 1.06 and 0.76 dB are lost. With as many floats as the plain Gaussians have, 3,525 that have textures instead of view
dependence lose 1.2 dB, and 2,192 that have both lose 3.2 dB: here a Gaussian more is worth more than its texture.

Where this deviates: the ellipsoid is that of one deviation, exactly; the released kernel divides by deviations where
their squares belong. Rays that miss it, most of those that a footprint reaches, take in the paper the colour of degree
0, which jumps at the limb; here n points to the ray's nearest point, which does not. In the paper textures replace
view-dependent colour, which ``--replace`` does; else they are added to it, after it has been cut at zero. The recipe
``textured`` trains textures and shapes together from the first iteration on, which the paper does not.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.textured import fine_tune
from minisplat_ref.extensions.textured.method import TEXTURED, TEXTURED_GAUSSIANS
from minisplat_ref.extensions.textured.stages import stages
from minisplat_ref.extensions.textured.study import COUNTS, LIMB

EXTENSION = Extension(
    "textured",
    recipes=(TEXTURED,),
    representation=TEXTURED_GAUSSIANS,
    commands=(fine_tune,),
    stages=stages,
    studies=(COUNTS, LIMB),
)
