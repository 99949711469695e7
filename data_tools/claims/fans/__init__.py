"""Claims of ``fans`` (MeshSplats, arXiv 2502.07754), measured."""

from data_tools.claims.fans import refit
from data_tools.claims.kit.claim import OUT, declare, fine_tune, trainings

CLAIMS = (
    declare("profile", "which fan approximates a Gaussian best, from any side", refit.run_profile, OUT),
    declare(
        "refit",
        "what a scene loses as a mesh, and what refitting gives back",
        refit.run,
        *trainings(1000, "mini-splatting"),
        fine_tune(500),
    ),
)
