"""Claims of ``proxies``, measured."""

from data_tools.claims.kit.claim import OUT, declare, seed, seeds
from data_tools.claims.proxies import affine, sheet

AFFINE = declare("affine", "edits against affine maps, and a rolled sheet", affine.run, OUT, seeds(3))
SHEET = declare(
    "sheet",
    "shape and energy of a sheet that falls, hangs and swings",
    sheet.run,
    *(OUT, seed("of the carpet's Gaussians")),
)
CLAIMS = (
    AFFINE,
    SHEET,
)
