"""Claims of ``vr`` (VRSplat, arXiv 2505.10144), measured."""

from pathlib import Path

from data_tools.claims.kit.claim import OUT, SCENE, argument, declare, downscale, number
from data_tools.claims.vr import foveation

PLY = argument("--ply", type=Path, required=True, metavar="FILE", help="point_cloud.ply of a run")


CLAIMS = (
    declare(
        "foveation",
        "work against PSNR with fewer rays away from the gaze",
        foveation.run_foveation,
        *(SCENE, PLY, downscale(), number("--repeats", 3, "timings per image"), OUT),
    ),
    declare(
        "yaw",
        "colours of fixed rays through a trained scene while the camera turns",
        foveation.run_yaw,
        *(PLY, number("--steps", 40, "steps of a yaw of +-10 degrees"), OUT),
    ),
    declare(
        "queues",
        "hits in the wrong order, and the work: lists, a hierarchy of queues, buffers, exact order",
        foveation.run_queues,
        *(PLY, OUT),
    ),
)
