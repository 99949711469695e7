"""The memory that a training needs for its first iterations and evaluations, estimated before it begins.

The pairs (tile, Gaussian) are estimated from a sample of the Gaussians in a few views. A convex shape of area A and
width and height w and h, wherever it lies, touches on average ``1 + w / W + h / H + A / (W H)`` tiles of size W x H;
here it is the ellipse in which alpha reaches ``alpha_min``.
"""

from typing import Any

import numpy as np

from minisplat_ref import memory
from minisplat_ref.constants import Conventions
from minisplat_ref.io.stored_views import StoredView, make_room
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Camera, Scene, some_of

N_VIEWS, N_SAMPLED = 4, 5000


def foresee(scene: Scene, state: TrainState, conventions: Conventions, backend: Backend) -> memory.Needs:
    """Return the memory that a training takes as it begins, besides that of the program and the photographs.

    Photographs that do not all fit give up, or get, the room that is left.

    Parameters
    ----------
    scene : Scene
    state : TrainState
        Before the first iteration, or as it was saved.
    conventions : Conventions
    backend : Backend
    """
    views = scene.train_views
    cameras = [view.camera for view in some_of(views, N_VIEWS)]
    n_pixels = max(view.camera.width * view.camera.height for view in views)
    files = [view.photograph.n_pixels for view in (*views, *scene.test_views) if isinstance(view, StoredView)]
    needs = memory.Needs(
        n_rows=len(state.gaussians.means),
        population_bytes=sum(field.nbytes for field in state.gaussians),
        n_pairs=max(_n_pairs(state.gaussians, camera, conventions, backend) for camera in cameras),
        n_pixels=n_pixels,
        reading_bytes=memory.reading_bytes(n_pixels, max(files)) if files else 0.0,
    )
    return needs._replace(kept_bytes=make_room(views, needs.to_come))


def _n_pairs(gaussians: Any, camera: Camera, conventions: Conventions, backend: Backend) -> float:
    """Estimate the pairs (tile, Gaussian) of a view."""
    n = len(gaussians.means)
    if n == 0 or not {"quats", "log_scales", "opacity_logits"} <= set(gaussians._fields):
        return memory.PAIRS_PER_GAUSSIAN * n  # a population of another kind
    every = slice(None, None, -(-n // N_SAMPLED))
    means, quats, log_scales, logits = (
        np.asarray(field[every], np.float64)
        for field in (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits)
    )
    opacities = 1 / (1 + np.exp(-logits))
    seen = REFERENCE.project(means, quats, np.exp(log_scales), opacities, camera, conventions)
    is_seen = (seen.radii > 0).all(axis=1)
    width, height = (seen.boxes[is_seen, 2:] - seen.boxes[is_seen, :2]).T  # [V] each
    a, b, c = seen.conics[is_seen].T  # [V] each
    area = 2 * np.pi * np.log(seen.opacities[is_seen] / conventions.alpha_min) / np.sqrt(a * c - b * b)
    area = np.minimum(area, width * height)  # parts outside the image have no tiles
    tile_width, tile_height = backend.tile_width, backend.tile_height
    n_tiles = 1 + width / tile_width + height / tile_height + area / (tile_width * tile_height)
    n_tiles = np.minimum(n_tiles, -(-camera.width // tile_width) * -(-camera.height // tile_height))
    return float(n_tiles.sum()) * n / len(means)
