"""Claims of ``fans``, measured."""

from data_tools.claims.fans import refit
from data_tools.claims.kit import claim as study

PROFILE = study.declare(
    "profile", "which fan approximates a Gaussian best, from any side", refit.run_profile, study.OUT
)
REFIT = study.declare(
    "refit",
    "what a scene loses as a mesh, and what refitting gives back",
    refit.run,
    *study.trainings(1000, "mini-splatting"),
    study.fine_tune(500),
)
CLAIMS = (
    PROFILE,
    REFIT,
)
