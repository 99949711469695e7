"""The stage of the gradient check of a representation on tangent planes: its renderer with its own thresholds."""

import numpy as np

from minisplat_ref.mechanisms.orders import Sorted, sort_by, sort_hits
from minisplat_ref.mechanisms.tangent.renderer import RESPONSE, check_buffer_size, prepare
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
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
    stage = model_stage(backend, setting, representation, rng)
    by = Sorted(RESPONSE, check_buffer_size(buffer_size))

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        moved = setting.camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        gaussians = Gaussians(*(named[name] for name in Gaussians._fields))
        prepared = prepare(Model(gaussians), moved, Request(conventions=setting.conventions, backend=REFERENCE), None)
        bins = prepared.listed()
        tiles = list(sort_hits(prepared.footprints, bins, setting.conventions, by))
        sides = [np.concatenate([np.ravel(tile.alphas > 0) for tile, _ in tiles])]
        sides += [np.concatenate([np.ravel(tile.is_clamped) for tile, _ in tiles])]
        sides += [np.concatenate([_select_blended(order, tile.alphas) for tile, order in tiles])]
        return Point(point.outputs, (*point.sides, bins.gaussian_ids, *sides))

    return stage._replace(function=function)


def _select_blended(order: Ints, alphas: Floats) -> Ints:
    """Return the order [G * P] of the blended hits; the place of the others does not matter."""
    return np.where(sort_by(order, alphas) > 0, order, -1).ravel()
