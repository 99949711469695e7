"""Claims of ``omg`` (Optimized Minimal Gaussians, arXiv 2503.16924), measured."""

from pathlib import Path

from data_tools.claims.kit.claim import (
    CONTINUES,
    OUT,
    PLY,
    RESUMED_OUT,
    RESUMED_SCENE,
    SEEDS,
    argument,
    declare,
    downscale,
    fine_tune,
    iterations,
    recipe,
    scene,
    seeds,
)
from data_tools.claims.omg import distinctiveness, files, networks

CLAIMS = (
    declare(
        "distinctiveness",
        "which 50, 25 and 12.5 % of the Gaussians to keep",
        distinctiveness.run,
        *(scene(), RESUMED_OUT, downscale(), recipe("mini-splatting2"), iterations(1000), PLY, SEEDS, fine_tune(200)),
        description=f"Which 50, 25 and 12.5 % of the Gaussians to keep. {CONTINUES}",
    ),
    declare(
        "files",
        "bytes and quality of the codes and networks, beside other files",
        files.run,
        *(scene(), OUT, downscale(), iterations(2000), seeds(3)),
        argument(
            "--checkpoints",
            type=lambda text: [Path(part) for part in text.split(",")],
            default=(),
            metavar="A,B",
            help="take these trainings of the recipe omg instead of training",
        ),
    ),
    declare(
        "networks",
        "quality without networks and codes, with networks, and with both",
        networks.run,
        *RESUMED_SCENE,
        iterations(2000),
        SEEDS,
        description=f"Train the recipe omg without networks and codes, and with them. {CONTINUES}",
    ),
)
