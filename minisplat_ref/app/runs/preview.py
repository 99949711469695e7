"""``train --preview``: one image of the present training, replaced every few seconds."""

import math
import time
from collections.abc import Callable
from pathlib import Path

from minisplat_ref.app.reports.images import error_image, side_by_side, to_8_bits
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.app.runs.scoring import Trained, choose_renderer
from minisplat_ref.io import write_image
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Scene

SECONDS = 3.0  # between images; a viewer that follows the file shows the newest
FILE = "preview.png"


def make_preview(folder: Path, scene: Scene, settings: Settings, progress: Progress) -> Callable[[StepReport], None]:
    """Return a callback of the training loop that writes truth, render and error of a view side by side.

    The view is the first test view, or where there are none the first training view. The clock of the training stops
    still meanwhile, and the training ends with the same bytes as without.

    Parameters
    ----------
    folder : Path
        Of the run, which gets ``preview.png``.
    scene : Scene
    settings : Settings
    progress : Progress
        Of the training.
    """
    view = (*scene.test_views, *scene.train_views)[0]
    last = -math.inf

    def on_step(report: StepReport) -> None:
        nonlocal last
        if time.perf_counter() - last < SECONDS and report.step != report.last_step:
            return
        with progress.paused():
            model = report.state.model
            renderer = choose_renderer(settings, model)
            trained = Trained(model, renderer, scene.background, settings.profile, settings.backend)
            render = to_8_bits(trained.render(view).image[..., :3])
            write_image(folder / FILE, side_by_side([view.image, render, error_image(view.image, render)]))
        last = time.perf_counter()

    return on_step
