"""Rendering speed of models, measured alternately in one process, so that the machine's state is the same for all."""

import statistics
import time
from collections.abc import Sequence

from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.types import Scene

ROUNDS = 9  # that are timed; an untimed one before them compiles and fills the caches


def render_rates(models: Sequence[Trained], scene: Scene) -> list[float]:
    """Return the test views that are rendered in a second, per model.

    Each round renders all views with one model after the other; the median of the rounds counts.
    """
    times: list[list[float]] = [[] for _ in models]
    for _ in range(ROUNDS + 1):
        for model, own_times in zip(models, times, strict=True):
            start = time.perf_counter()
            for view in scene.test_views:
                model.render(view)
            own_times.append(time.perf_counter() - start)
    return [len(scene.test_views) / statistics.median(own_times[1:]) for own_times in times]
