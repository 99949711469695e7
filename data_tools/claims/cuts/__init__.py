"""Claims of ``cuts`` (DisC-GS, arXiv 2405.15196), measured."""

from data_tools.claims.cuts import edge, training
from data_tools.claims.kit.claim import OUT, SCENE, declare, downscale, iterations, seeds

CLAIMS = (
    declare(
        "card",
        "images with a sharp edge, by few Gaussians with and without cuts",
        training.run,
        *(OUT, iterations(300), seeds(4)),
    ),
    declare(
        "edge",
        "a real edge, in a window of a photograph, with no, one and two curves per Gaussian",
        edge.run,
        *(SCENE, downscale(), OUT, iterations(300), seeds(3)),
    ),
)
