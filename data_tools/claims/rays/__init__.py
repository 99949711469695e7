"""Claims of ``rays`` (RaySplats, arXiv 2501.19196), measured."""

from data_tools.claims.kit.claim import OUT, declare, number, seed
from data_tools.claims.rays import measures

CLAIMS = (
    declare(
        "claims",
        "tracing against exact order, mirrors, shadows and splatting",
        measures.run_claims,
        *(OUT, number("--gaussians", 300, "Gaussians per scene"), seed("of the scenes")),
    ),
    declare(
        "speed",
        "time of a ray and of a rasterised pixel",
        measures.run_speed,
        *(number("--gaussians", 10_000, "number"), number("--repeats", 5, "timings; the least counts")),
    ),
)
