"""Propose a size at which to train large photographs, with the time of an iteration at both sizes.

The work of an iteration grows with the pixels that the Gaussians cover, and so does the useful number of Gaussians.
Full-size photographs therefore take hours, where a quarter of their width and height takes minutes and shows most of
the scene. Both iterations are timed here, on this machine, with the Gaussians from which training starts. Later ones
are more numerous, so the ratio is a lower bound.
"""

import math
import statistics
import time

import numpy as np

from minisplat_ref.io.images import downscaled_size
from minisplat_ref.io.scene import rescale_camera
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.types import Model, Scene, View

COMFORTABLE = 640  # pixels of the longer side, at which a training takes minutes
LARGE = 960  # from which a smaller size is proposed
REPEATS = 3


def comfortable_factor(width: int, height: int) -> int:
    """Return the factor by which photographs of this size, in pixels, are made smaller for a training of minutes."""
    side = max(width, height)
    return 1 if side < LARGE else math.ceil(side / COMFORTABLE)


def propose(scene: Scene, model: Model, settings: RenderSettings, downscale: int) -> str | None:
    """Return a line that proposes a size, or None if the photographs are small enough or the backend is not compiled.

    Parameters
    ----------
    scene : Scene
        As it was loaded; at least one training view.
    model : Model
        Before the first iteration.
    settings : RenderSettings
        Of the training.
    downscale : int
        Factor by which the photographs have been made smaller.
    """
    if not settings.backend.is_compiled:
        return None  # NumPy takes minutes for the timed work
    view = max(scene.train_views, key=lambda view: view.camera.width * view.camera.height)
    width, height = view.camera.width, view.camera.height
    factor = comfortable_factor(width, height)
    if factor == 1:
        return None
    small = view._replace(camera=rescale_camera(view.camera, *downscaled_size(width, height, factor)))
    large_seconds, small_seconds = (_iteration_seconds(model, each, settings) for each in (view, small))
    return (
        f"photographs of {width} x {height} take long: with --downscale {factor * downscale} they are"
        f" {small.camera.width} x {small.camera.height}, and an iteration takes {small_seconds:.2g} s instead of"
        f" {large_seconds:.2g} s as training starts"
    )


def _iteration_seconds(model: Model, view: View, settings: RenderSettings) -> float:
    """Return the median time to render and differentiate a view, over a few runs after a first one."""
    renderer, request = settings.renderer, settings.request()
    v_image = np.ones((view.camera.height, view.camera.width, 3), np.float32)  # [H, W, 3]
    seconds = []
    for _ in range(1 + REPEATS):
        start = time.perf_counter()
        _, tape = renderer.render(model, view, request)
        renderer.render_vjp(tape, v_image, None)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])
