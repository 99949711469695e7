"""Claims of ``cus`` (CUS-GS, arXiv 2511.17904), measured."""

from data_tools.claims.cus import floats, growth
from data_tools.claims.kit.claim import RESUMED_OUT, declare, iterations, seeds

CLAIMS = (
    declare(
        "floats",
        "features from anchors against a query for each Gaussian, over floats",
        floats.run,
        *(RESUMED_OUT, iterations(600), seeds(3)),
    ),
    declare(
        "growth",
        "trainings with and without the growing of anchors",
        growth.run,
        *(RESUMED_OUT, iterations(2_000), seeds(3)),
    ),
)
