"""Claims of ``gdgs`` (GDGS, arXiv 2507.00363), measured."""

from data_tools.claims.gdgs import counts, sphere
from data_tools.claims.kit.claim import RESUMED_OUT, declare, downscale, iterations, number, scene, seeds

CLAIMS = (
    declare(
        "sphere",
        "noisy points of a sphere: distance, normals and spacing",
        sphere.run,
        number("--steps", 100, "of gradient descent"),
        seeds(3),
    ),
    declare(
        "counts",
        "detail at an equal number of Gaussians, beside 3DGS",
        counts.run,
        *(scene(), RESUMED_OUT, downscale(), iterations(2000), seeds(3)),
    ),
)
