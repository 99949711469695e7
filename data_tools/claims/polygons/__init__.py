"""Claims of ``polygons`` (REdiSplats, arXiv 2503.12284), measured."""

from data_tools.claims.kit.claim import OUT, declare, number, seeds
from data_tools.claims.polygons import cost, edits

CLAIMS = (
    declare("edits", "polygons to Gaussians and back, affine edits, a bent sheet", edits.run, *(OUT, seeds(3))),
    declare(
        "cost",
        "a pixel of polygons beside one of ellipsoids on rays and of splats",
        cost.run,
        *(number("--gaussians", 10_000, "number"), number("--repeats", 5, "timings; the least counts")),
    ),
)
