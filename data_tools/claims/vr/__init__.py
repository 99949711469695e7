"""Claims of ``vr``, measured."""

from pathlib import Path

from data_tools.claims.kit.claim import OUT, SCENE, argument, declare, downscale, number
from data_tools.claims.vr import foveation

PLY = argument("--ply", type=Path, required=True, metavar="FILE", help="point_cloud.ply of a run")
FOVEATION = declare(
    "foveation",
    "work against PSNR with fewer rays away from the gaze",
    foveation.run_foveation,
    *(SCENE, PLY, downscale(), number("--repeats", 3, "timings per image"), OUT),
)
YAW = declare(
    "yaw",
    "colours of fixed rays through a trained scene while the camera turns",
    foveation.run_yaw,
    *(PLY, number("--steps", 40, "steps of a yaw of +-10 degrees"), OUT),
)
QUEUES = declare(
    "queues",
    "hits in the wrong order, and the work: lists, a hierarchy of queues, buffers, exact order",
    foveation.run_queues,
    *(PLY, OUT),
)
CLAIMS = (
    FOVEATION,
    YAW,
    QUEUES,
)
