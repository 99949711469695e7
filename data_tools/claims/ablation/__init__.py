"""Ablation of each mechanism of Mini-Splatting (arXiv 2403.14166) and Mini-Splatting2 (arXiv 2411.12788)."""

from data_tools.claims.ablation import ablation
from data_tools.claims.kit.claim import (
    CONDITION,
    CONTINUES,
    RESUMED_SCENE,
    SEEDS,
    argument,
    declare,
    iterations,
    recipe,
)

CLAIMS = (
    declare(
        "ablation",
        "Mini-Splatting without each of its mechanisms",
        ablation.run,
        *RESUMED_SCENE,
        iterations(6000),
        recipe("mini-splatting2"),
        argument("--deviations", action="store_true", help="take back what deviates from the published method instead"),
        CONDITION,
        SEEDS,
        description=f"Train a scene by a recipe, and by the recipe without each of its mechanisms. {CONTINUES}",
    ),
)
