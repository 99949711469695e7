"""The stage of the gradient check of a representation on tangent planes: its renderer with its own thresholds."""

import numpy as np

from minisplat_ref.mechanisms.orders import Sorted, sort_by, sort_hits
from minisplat_ref.mechanisms.tangent.renderer import RESPONSE, check_buffer_size, prepare
from minisplat_ref.oracle.models import Drawn, hit_sides, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Gaussians, Ints, Model


def renderer_stage(
    backend: Backend,
    setting: Setting,
    representation: Representation,
    buffer_size: int | None,
    rng: np.random.Generator,
) -> Stage:
    """Return the renderer as a stage whose points record the hits that are listed, blended and clamped, in their order.

    The reference computes these records again, so that the check notices a step across a threshold.
    """
    by = Sorted(RESPONSE, check_buffer_size(buffer_size))

    def sides(drawn: Drawn) -> list[np.ndarray]:
        g = Model(Gaussians(*(getattr(drawn.model.gaussians, name) for name in Gaussians._fields)))
        request = Request(conventions=setting.conventions, backend=REFERENCE)
        prepared = prepare(g, drawn.view.camera, request, None)
        bins = prepared.listed()
        tiles = list(sort_hits(prepared.footprints, bins, setting.conventions, by))
        orders = np.concatenate([_select_blended(order, tile.alphas) for tile, order in tiles])
        return [bins.gaussian_ids, *hit_sides(tile for tile, _ in tiles), orders]

    return model_stage(backend, setting, representation, rng, sides_of=sides)


def _select_blended(order: Ints, alphas: Floats) -> Ints:
    """Return the order [G * P] of the blended hits; the place of the others does not matter."""
    return np.where(sort_by(order, alphas) > 0, order, -1).ravel()
