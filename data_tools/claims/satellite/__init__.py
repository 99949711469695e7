"""Claims of ``satellite`` (EOGS, arXiv 2412.13047), measured."""

from data_tools.claims.kit.claim import OUT, RESUMED_OUT, declare, iterations, seeds
from data_tools.claims.satellite import measures

CLAIMS = (
    declare(
        "boxes",
        "heights, shadows and colours of boxes without each part",
        measures.run_boxes,
        *(RESUMED_OUT, seeds(3), iterations(2_000)),
    ),
    declare("distance", "from where affine cameras fit perspective ones", measures.run_distance, OUT),
)
