"""Claims of ``proxies`` (binding as in GaMeS, arXiv 2402.01459), measured."""

from data_tools.claims.kit.claim import OUT, declare, seed, seeds
from data_tools.claims.proxies import affine, sheet

CLAIMS = (
    declare("affine", "edits against affine maps, and a rolled sheet", affine.run, OUT, seeds(3)),
    declare(
        "sheet",
        "shape and energy of a sheet that falls, hangs and swings",
        sheet.run,
        *(OUT, seed("of the carpet's Gaussians")),
    ),
)
