"""What a recipe can do to the training state besides a gradient step: see :mod:`minisplat_ref.events.state`.

The mathematics is in ``strategy/``; an action takes the arguments from the state and puts the result back.
"""

from minisplat_ref.events.density import (
    clone_and_split,
    collect_gradients,
    prune_faint,
    prune_large,
    reset_opacity,
    reset_opacity_on_white,
)
from minisplat_ref.events.mini_splatting import (
    collect_blur,
    prune_tail,
    reinitialise_from_depth,
    restart_adam,
    restart_from_means,
    simplify,
    store_sh,
)
from minisplat_ref.events.mini_splatting2 import aggressive_clone, stop_culling
from minisplat_ref.events.state import Iteration, StepReport, TrainState, apply_edit, n_pixels, start_anew

__all__ = [
    "Iteration",
    "StepReport",
    "TrainState",
    "aggressive_clone",
    "apply_edit",
    "clone_and_split",
    "collect_blur",
    "collect_gradients",
    "n_pixels",
    "prune_faint",
    "prune_large",
    "prune_tail",
    "reinitialise_from_depth",
    "reset_opacity",
    "reset_opacity_on_white",
    "restart_adam",
    "restart_from_means",
    "simplify",
    "start_anew",
    "stop_culling",
    "store_sh",
]
