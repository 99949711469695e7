"""``train --view``: a training in the browser while it runs."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.app.runs.scoring import Trained, choose_renderer
from minisplat_ref.app.runs.settings import scene_up
from minisplat_ref.app.viewer.browser import Content, Viewer
from minisplat_ref.app.viewer.photographs import thumbnails
from minisplat_ref.io.viewpoints import scene_viewpoints
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Scene

SECONDS = 3.0  # between frames of the same view, which take time from the training


def make_live_view(server: Any) -> Callable[[Path, Scene, Settings, Progress], Callable[[StepReport], None]]:
    """Return the arguments with which :func:`minisplat_ref.app.runs.run.run_training` shows a training in browsers.

    Frames are rendered between two iterations: at once while a camera moves, every few seconds while it rests. The
    clock of the training stops still meanwhile, and the training ends with the same bytes as without.
    """

    def watch(folder: Path, scene: Scene, settings: Settings, progress: Progress) -> Callable[[StepReport], None]:
        viewer: Viewer | None = None
        last = -math.inf

        def on_step(report: StepReport) -> None:
            nonlocal viewer, last
            with progress.paused():
                if viewer is None or time.perf_counter() - last >= SECONDS or report.step == report.last_step:
                    model = report.state.model
                    renderer = choose_renderer(settings, model)
                    trained = Trained(model, renderer, scene.background, settings.profile, settings.backend)
                    if viewer is None:
                        up = scene_up(settings, scene).direction
                        content = Content(trained, scene_viewpoints(scene), lambda: thumbnails(scene), None, up)
                        viewer = Viewer(server, content)
                    viewer.show(trained)
                    n_gaussians = len(model.gaussians.means)
                    viewer.show_status(f"iteration {report.step:,}, {n_gaussians:,} Gaussians")
                    last = time.perf_counter()
                viewer.render_next()

        return on_step

    return watch
