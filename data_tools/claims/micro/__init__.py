"""Claims of ``micro`` (Micro-splatting, arXiv 2504.05740), measured."""

from data_tools.claims.kit.claim import OUT, RESUMED_OUT, argument, declare, downscale, iterations, scene, seeds
from data_tools.claims.micro import checker, counts

CLAIMS = (
    declare(
        "checker",
        "small Gaussians and detail at equal count, on edges and on a ramp",
        checker.run,
        *(OUT, iterations(1500, minimum=100), seeds(3)),
        argument("--beta", type=float, default=1.0, metavar="B", help="weight of the detail (default 1)"),
        argument("--trace", type=float, default=0.001, metavar="L", help="weight of the penalty (default 0.001)"),
    ),
    declare(
        "counts",
        "quality against the number of Gaussians, with the second stage and without",
        counts.run,
        *(scene(), RESUMED_OUT, downscale(), iterations(2000), seeds(3)),
    ),
)
