"""Claims of ``wave`` (Gaussian Wave Splatting, arXiv 2505.06582), measured."""

from pathlib import Path

from data_tools.claims.kit.claim import OUT, argument, declare, number
from data_tools.claims.wave import measures, scene

CLAIMS = (
    declare(
        "claims",
        "closed form, focus, occlusion and cost of waves",
        measures.run,
        *(OUT, number("--gaussians", 200, "whose cost is measured")),
    ),
    declare(
        "scene",
        "holograms of a trained scene against its rendering",
        scene.run,
        argument("ply", type=Path, metavar="PLY", help="point_cloud.ply of a run, which has test views"),
        OUT,
    ),
)
