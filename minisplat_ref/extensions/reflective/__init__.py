"""Surfels with a material, shaded after they are blended: mirrors and gloss.

This follows Reflective Gaussian Splatting (Ref-Gaussian), Yao et al. 2024, arXiv 2412.19282. Each surfel of 2D
Gaussian Splatting has an albedo a, a metallic share m and a roughness. Blended per pixel, with the normal n, they are
shaded once by an environment in latitude and longitude, whose texels are learned
(:mod:`minisplat_ref.mechanisms.gbuffer`):

    c = a (1 - m) E(n) + (F_0 S + B) L,   F_0 = 0.04 (1 - m) + a m,   L = V L_env(r, roughness) + (1 - V) L_around

r is the reflected ray, V the fraction of the environment that it sees past the surfels, and L_around the light that
each surfel receives from around instead, its spherical harmonics in the direction r. Training has three stages:

    1        each surfel is shaded by itself and then blended, which is more forgiving while normals are wrong
    18,000   shading per pixel
    20,000   and with occlusion

Every 1,000 iterations of the first, surfels that mirror grow by half, and others are disturbed, so that the normals of
mirrors spread (:mod:`minisplat_ref.mechanisms.gbuffer.training`). The loss on normals is that of 2D Gaussian Splatting.

    minisplat-ref train SCENE --recipe reflective --out runs/reflective
    minisplat-ref render runs/reflective --map normal
    minisplat-ref render runs/reflective --environment studio.png
    python -m data_tools.claims reflective/mirrors --out DIR
    minisplat-ref oracle gradients --extension reflective

``docs/FAMILY.md`` has the measured figures.

This deviates from the paper as follows. Reflected rays meet the surfels, not a mesh that is extracted now and then, and
V is their transmittance. The environment has 32 x 64 texels; its averages are exact matrices instead of samples, and
nine harmonics hold the light on a matte surface. The date of occlusion, the strength of the disturbance and what counts
as a mirror are ours. Light is linear and shown as sRGB. Left out are light that is reflected twice, and the environment
as the background of the image.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.reflective.model import RECIPE, SHADED, stages

EXTENSION = Extension("reflective", recipes=(RECIPE,), representation=SHADED, stages=stages)
"""Surfels with materials, the recipe that trains them."""
