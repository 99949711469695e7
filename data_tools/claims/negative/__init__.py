"""Claims of ``negative`` (NegGS, arXiv 2405.18163), measured."""

from data_tools.claims.kit.claim import OUT, declare, number, seed, seeds
from data_tools.claims.negative import backdrop, rings

STARTS = "per fit; the best counts"
CLAIMS = (
    declare(
        "rings",
        "one Gaussian minus another against 2 to 4 positive ones",
        rings.run,
        *(OUT, seeds(3), number("--starts", 16, STARTS)),
    ),
    declare(
        "backdrop",
        "the hole of a ring: negative colours do not open it",
        backdrop.run,
        *(OUT, seed("of the starts"), number("--starts", 4, STARTS)),
    ),
)
