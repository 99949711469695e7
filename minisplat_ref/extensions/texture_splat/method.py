"""The recipe of textures, which trains them after a run of reflective surfels has ended."""

from functools import partial

from minisplat_ref.extensions.texture_splat.population import TexturedSurfels, first_light, with_textures
from minisplat_ref.extensions.texture_splat.renderer import TEXTURED
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import STAGE
from minisplat_ref.methods.gaussian_splatting import FINE_TUNING
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation

TEXELS = 2  # along each side of a texture, as published
RATES = Rates(
    {
        "normal_textures": 0.01,
        "albedo_logits": 0.01,
        "metallic_logits": 0.01,
        "roughness_logits": 0.01,
        ENVIRONMENT: 0.01,
        STAGE: 0.0,
    },
    frozenset(),
)

TEXTURED_SURFELS = Representation(
    "textured surfels",
    population=TexturedSurfels,
    extend=partial(with_textures, texels=TEXELS),
    shared=first_light,
    renderer=TEXTURED,
    rates=RATES,
    extends=frozenset({"reflective surfels", "textured surfels"}),
)

RECIPE = FINE_TUNING._replace(name="texture-splat", learning_rates=FINE_TUNING.learning_rates.change(means=0.0))
"""``texture-splat``: 30,000 iterations on a finished run; centres and their number stay, everything else is trained."""
