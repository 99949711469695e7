"""Surfels with textures of their normal and material, blended and then shaded.

This follows TextureSplat, Younes and Boukhayma 2025, arXiv 2506.13348. A surfel of Ref-Gaussian
(:mod:`minisplat_ref.mechanisms.gbuffer.renderer`) has one normal and one material, so that detail takes more surfels.
Here it has T x T texels over four standard deviations to each side of its disc, which a hit at (u, v) reads linearly:

    X(u, v) = sum_ji h(y - j) h(x - i) X_ji,   x = (u / 4 + 1) (T - 1) / 2,   h(t) = max(0, 1 - |t|)

X is a normal, from two numbers whose tanh is its tilt along the axes of the disc, with albedo, metallic share and
roughness (:mod:`.textures`). The texels that hits read are blended, and each pixel is shaded once, as in Ref-Gaussian.
With T = 1 this is Ref-Gaussian. Textures start as the constant values of each surfel of a finished run; then centres
and their number stay, and everything else is trained. With maps of normals and materials as targets, texels are also
the solution of a linear least-squares problem (:mod:`.baking`).

    minisplat-ref train SCENE --recipe reflective --out runs/reflective
    minisplat-ref train SCENE --recipe texture-splat --init runs/reflective --out runs/textured
    minisplat-ref render runs/textured --map normal
    python -m data_tools.claims texture-splat/bricks --out DIR
    minisplat-ref oracle gradients --extension texture-splat

``docs/family/texture-splat.md`` has the measured figures.

Dates, rates and the 4 x 4 texels are those of the released code, in which this is the fourth stage of a training of
60,000 iterations, from 30,000 on; here it is a training of its own. This deviates from the code as follows. Texels hold
normals and materials after their tanh and sigmoid, and are then interpolated, which makes the blend linear in them. A
disc seen from behind shows the relief of its front from below. What else deviates is that of ``reflective``.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.texture_splat.model import RECIPE, TEXTURED_SURFELS, load, stages

EXTENSION = Extension(
    "texture-splat",
    recipes=(RECIPE,),
    representation=TEXTURED_SURFELS,
    load=load,
    stages=stages,
)
"""Surfels with textures, the recipe that trains them after others."""
