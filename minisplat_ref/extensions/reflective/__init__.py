"""Surfels with a material, shaded after they are blended: mirrors and gloss.

This follows Reflective Gaussian Splatting (Ref-Gaussian), Yao et al. 2024, arXiv 2412.19282. Each surfel of 2D
Gaussian Splatting has an albedo a, a metallic share m and a roughness. Blended per pixel, with the normal n, they are
shaded once by an environment in latitude and longitude, whose texels are learned
(:mod:`minisplat_ref.mechanisms.gbuffer`):

    c = (1 - m) D + (F_0 S + B) L,   F_0 = 0.04 (1 - m) + a m,   L = V L_env(r, roughness) + (1 - V) L_around

r is the reflected ray, V the fraction of the environment that it sees past the surfels, and L_around the light that
each surfel receives from around instead, harmonics in the direction r. D is what a surfel scatters: shaded by itself
the albedo in the environment, a E(n), and per pixel, as in the released code, the surfel's own colour, harmonics of the
viewing direction as in 3DGS. So another environment changes what is reflected, and not what is scattered. Training has
three stages, of 50,000 iterations:

    1        each surfel is shaded by itself and then blended, which is more forgiving while normals are wrong
    18,000   shading per pixel; materials and light begin once more
    20,000   and with occlusion

Up to 25,000 surfels are densified every 500 iterations, and every 1,000 all become nearly opaque, those that mirror
grow by half, and once pixels are shaded the colours of others are disturbed, so that the normals of mirrors spread
(:mod:`minisplat_ref.mechanisms.gbuffer.training`). The loss on normals is that of 2D Gaussian Splatting.

    minisplat-ref train SCENE --recipe reflective --out runs/reflective
    minisplat-ref render runs/reflective --map normal
    minisplat-ref render runs/reflective --environment studio.png
    python -m data_tools.claims reflective/mirrors --out DIR
    minisplat-ref oracle gradients --extension reflective

``docs/family/reflective.md`` has the measured figures.

Dates, rates and thresholds are those of the released code. This deviates from it as follows. Reflected rays meet the
surfels, not a mesh that is extracted now and then, and V is their transmittance. The environment has 32 x 64 texels
without an upper limit; its averages are exact matrices instead of samples, and nine harmonics hold the light on a matte
surface. Light is linear and shown as sRGB, which is an option there. The albedo begins with the colours of the points
instead of grey. Shaded by themselves, surfels have shares S and B of their own; the code gives all of them those of the
first, which we take for a mistake. Opacities are trained right after they have been raised, not 200 iterations later,
and resets of opacities leave the metallic share as it is. Adam is that of ``3dgs-accel``. Left out are light that is
reflected twice, and the environment as the background of the image.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.reflective.model import RECIPE, SHADED, stages

EXTENSION = Extension("reflective", recipes=(RECIPE,), representation=SHADED, stages=stages)
"""Surfels with materials, the recipe that trains them."""
