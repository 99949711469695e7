"""A block continues the training of the whole: where in its schedule it begins, and in which state."""

from pathlib import Path

import numpy as np

from minisplat_ref.app.runs import checkpoints
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.scene_part import Region, keep_rows
from minisplat_ref.app.runs.scoring import choose_render_settings
from minisplat_ref.app.runs.settings import load
from minisplat_ref.errors import InputError
from minisplat_ref.strategy.mask_weights import collect_mask_weights
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Scene

WEIGHT_MIN = 1.0  # pixels of a part, over all photographs, that a Gaussian outside its region fills; ours


def find_beginning(iterations: int, whole_iterations: int, n_done: int) -> int:
    """Return the iterations of a part's schedule that the training of the whole has done.

    Parameters
    ----------
    iterations : int
        Of the part's schedule.
    whole_iterations : int
        Of the schedule of the whole.
    n_done : int
        Of these.
    """
    return min(round(iterations * n_done / whole_iterations), iterations - 1)


def continue_part(settings: Settings, region: Region, scene: Scene) -> TrainState:
    """Return the state in which a training of the whole is left, as that of a part which continues it.

    Its Gaussians are those of the region, and those outside that the part's pixels show, too, with their moments and
    statistics; the order of the photographs begins afresh.

    Parameters
    ----------
    settings : Settings
        Of the part.
    region : Region
    scene : Scene
        Of the part, with the masks of its pixels, in the frame of the whole.

    Raises
    ------
    InputError
        The run of the whole is not given, or has no checkpoint that is whole.
    """
    whole = settings.whole_iterations
    if settings.init is None or whole is None:
        raise InputError("a part that continues a training of the whole needs its run: give --init")
    folder = Path(settings.init)
    state = checkpoints.load(folder, load(folder))
    render_settings = choose_render_settings(settings, state.model, scene.background)
    weights, _ = collect_mask_weights(state.model, scene.train_views, render_settings)
    state = keep_rows(state, region.find_rows(state) | (weights >= WEIGHT_MIN))
    state.step = find_beginning(settings.schedule_iterations, whole, state.step)
    state.view_order, state.rng = [], np.random.default_rng(settings.seed)
    return state
