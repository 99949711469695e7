"""Claims of ``satellite``, measured."""

from data_tools.claims.kit.claim import OUT, RESUMED_OUT, declare, iterations, seeds
from data_tools.claims.satellite import measures

BOXES = declare(
    "boxes",
    "heights, shadows and colours of boxes without each part",
    measures.run_boxes,
    *(RESUMED_OUT, seeds(3), iterations(2_000)),
)
DISTANCE = declare("distance", "from where affine cameras fit perspective ones", measures.run_distance, OUT)
CLAIMS = (
    BOXES,
    DISTANCE,
)
