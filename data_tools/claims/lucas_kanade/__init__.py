"""Claims of ``lucas-kanade`` (Gaussian Splatting Lucas-Kanade, arXiv 2407.11309), measured."""

from data_tools.claims.kit.claim import CONTINUES, RESUMED_OUT, SEEDS, declare, iterations, seeds
from data_tools.claims.lucas_kanade import trainings

CLAIMS = (
    declare("forms", "three forms of a velocity, and its integral, beside each other", trainings.run_forms, seeds(3)),
    declare(
        "body",
        "a turning, growing body with and without the flow loss",
        trainings.run_body,
        *(RESUMED_OUT, iterations(2000), SEEDS),
        description=f"A body that turns and grows, with and without the flow loss. {CONTINUES}",
    ),
)
