"""Claims of ``wave``, measured."""

from pathlib import Path

from data_tools.claims.kit.claim import OUT, argument, declare, number
from data_tools.claims.wave import measures, scene

HOLOGRAM = declare(
    "claims",
    "closed form, focus, occlusion and cost of waves",
    measures.run,
    *(OUT, number("--gaussians", 200, "whose cost is measured")),
)
SCENE = declare(
    "scene",
    "holograms of a trained scene against its rendering",
    scene.run,
    argument("ply", type=Path, metavar="PLY", help="point_cloud.ply of a run, which has test views"),
    OUT,
)
CLAIMS = (
    HOLOGRAM,
    SCENE,
)
