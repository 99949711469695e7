"""The recipe of reflective surfels."""

from minisplat_ref.mechanisms.gbuffer.population import ReflectiveSurfels, first_light, with_materials
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE
from minisplat_ref.mechanisms.gbuffer.training import NORMALS, SHADING_EVENTS, SHADING_RATES
from minisplat_ref.mechanisms.surfels.discs import DISC_EVENTS
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.training.representation import Representation

SHADED = Representation(
    "reflective surfels",
    population=ReflectiveSurfels,
    extend=with_materials,
    shared=first_light,
    renderer=REFLECTIVE,
    rates=SHADING_RATES,
)

RECIPE = GS_ACCEL._replace(
    name="reflective", losses=(*GS_ACCEL.losses, NORMALS), events=(*DISC_EVENTS, *SHADING_EVENTS)
)
"""``reflective``: surfels shaded one by one up to iteration 18,000, then pixel by pixel, in the end with occlusion."""
