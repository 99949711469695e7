"""Textured: colour and opacity that vary over each Gaussian, as spherical harmonics.

This follows Textured-GS, Huang & Gong 2024, arXiv 2407.09733. In 3DGS a Gaussian has one colour for each viewing
direction. Here a ray hits a point n on the Gaussian's ellipsoid of one standard deviation
(:mod:`minisplat_ref.extensions.textured.reference`), and opacity and colour are spherical harmonics of n
(:mod:`minisplat_ref.extensions.textured.response`):

    opacity(n) = sigmoid(l + sum_k h_k Y_k(n)),   color(n) = max(0, c + sum_k k_k Y_k(n)),   k = 1 ... 15

Textures are trained for the Gaussians of a finished Mini-Splatting run, whose number, positions and shapes stay. With
textures of degree 0 the method is 3DGS, to the last byte.

    minisplat-ref train SCENE --recipe mini-splatting --out runs/few
    minisplat-ref textured fine-tune SCENE runs/few/point_cloud.ply --out textured.ply
    minisplat-ref render textured.ply --extension textured --cameras runs/few/cameras.json
    minisplat-ref study textured/counts SCENE --out DIR
    minisplat-ref study textured/limb
    minisplat-ref oracle gradients --extension textured

Measured on the fox at 135 x 240 (``study textured/counts fox --downscale 2 --fine-tune 300 --seeds 1``), 4,422
Gaussians after 1,000 iterations of Mini-Splatting, fine-tuned for 300 more: textures in addition to view-dependent
colour gain 0.62 dB and 0.018 of SSIM on the test views. Instead of it they lose 0.49 dB and gain 0.006 of SSIM; those
of degree 1 and 2 lose 1.06 and 0.76 dB. At an equal number of floats, 3,525 Gaussians with textures instead of view
dependence lose 1.2 dB, and 2,192 with both lose 3.2 dB, so here one more Gaussian is worth more than a texture.

This deviates from the paper as follows. The ellipsoid is exactly that of one standard deviation; the released kernel
divides by standard deviations where their squares belong. Most rays that a footprint reaches miss the ellipsoid. In the
paper these get the colour of degree 0, which jumps at the limb; here n points to the ray's nearest point, which does
not. In the paper textures replace view-dependent colour, which ``--replace`` does; otherwise they are added to it after
it has been clamped at zero. The recipe ``textured`` trains textures and shapes together from the first iteration on,
which the paper does not.
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
