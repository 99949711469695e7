"""The pixels of a photograph that show a block, by the Gaussian of a coarse model that weighs most in each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.blocks.grid import Block
from minisplat_ref.app.runs.scene_part import Plane
from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import return_points
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.types import Bools, Floats, Frame, Ints, Model, Scene, View

SHARE_MIN = 0.25  # of the pixels, from which on a photograph belongs to a block: VastGaussian's
REST_MAX = 0.02  # of the pixels that show the scene, which a photograph may leave without a block; ours
TRAIN_VIEWS_MIN = 2  # photographs without which nothing can be trained


class Coverage(NamedTuple):
    """The pixels of the training views that show the blocks."""

    masks: list[dict[str, Bools]]
    """For each block, by the name of the photograph: mask [H, W] of the pixels that it is trained on."""
    trained: float
    """Part of the pixels that show the scene, of all photographs, which at least one block learns from."""


class Coarse(NamedTuple):
    """The coarse model, and its renderer."""

    model: Model
    render_settings: RenderSettings
    frame: Frame

    @property
    def means(self) -> Floats:
        """[N, 3] centres, in the frame of the files, float64."""
        return return_points(self.model.gaussians.means, self.frame)


def cover(coarse: Coarse, scene: Scene, plane: Plane, blocks: Sequence[Block]) -> Coverage:
    """Assign photographs to blocks.

    A pixel without any Gaussian belongs to all blocks that have the photograph: where the coarse model sees nothing,
    no block may put anything.

    Parameters
    ----------
    coarse : Coarse
        Trained on the scene.
    scene : Scene
        In the coarse model's frame; the pixels of its photographs are not read.
    plane : Plane
    blocks : sequence of Block

    Raises
    ------
    InputError
        Fewer than two photographs belong to a block.
    """
    coordinates = plane.coordinates(coarse.means)  # [N, 2]
    in_region = np.stack([block.region.contains(coordinates) for block in blocks])  # [B, N]
    masks: list[dict[str, Bools]] = [{} for _ in blocks]
    n_trained = n_shown = 0
    for view in scene.train_views:
        ids = _dominant(coarse, view)  # [H, W]
        is_shown = ids >= 0
        shown = np.stack([shows(ids, inside) for inside in in_region])  # [B, H, W]
        chosen = choose_blocks(shown)
        for b in chosen:
            masks[b][view.name] = shown[b] | ~is_shown
        n_trained, n_shown = n_trained + int(shown[chosen].any(axis=0).sum()), n_shown + int(is_shown.sum())
    for block, own in zip(blocks, masks, strict=True):
        if len(own) < TRAIN_VIEWS_MIN:
            raise InputError(
                f"block {block.name} has {len(own)} photographs that show it, and training needs {TRAIN_VIEWS_MIN}:"
                " give fewer blocks, or more photographs there"
            )
    return Coverage(masks, n_trained / max(n_shown, 1))


def choose_blocks(shown: Bools) -> list[int]:
    """Return the blocks to which a photograph belongs: those that a quarter of its pixels show, and others as needed.

    Of many small blocks few fill a quarter of a photograph. The others follow, each time the one that most of the
    pixels without a block show, until these are a fiftieth of those that show any.

    Parameters
    ----------
    shown : ndarray of shape (B, H, W), bool
        Whether a pixel shows a block's region.
    """
    n_pixels = shown[0].size
    chosen = [int(b) for b in np.flatnonzero(shown.sum(axis=(1, 2)) >= SHARE_MIN * n_pixels)]
    rest = shown.any(axis=0)
    rest_max = REST_MAX * rest.sum()
    rest &= ~shown[chosen].any(axis=0)
    while rest.sum() > rest_max:
        chosen.append(int((shown & rest).sum(axis=(1, 2)).argmax()))
        rest &= ~shown[chosen[-1]]
    return chosen


def shows(ids: Ints, inside: Floats | Bools) -> Bools:
    """Return [H, W]: where the dominant Gaussian ``ids`` is one of ``inside`` [N]; nowhere where there is none."""
    return np.append(inside, False)[ids]  # -1 is the last


def _dominant(coarse: Coarse, view: View) -> Ints:
    output, _ = coarse.render_settings.render_view(coarse.model, view, frozenset({"stats"}))
    assert output.stats is not None
    return output.stats.dominant_ids
