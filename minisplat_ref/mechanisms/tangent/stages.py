"""The stage of the gradient check of a representation on tangent planes: its renderer with its own thresholds."""

import numpy as np

from minisplat_ref.mechanisms.tangent.renderer import RESPONSE, check_buffer_size, prepare
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
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
    response = RESPONSE._replace(buffer_size=check_buffer_size(buffer_size))

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        moved = setting.camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        gaussians = Gaussians(*(named[name] for name in Gaussians._fields))
        prepared = prepare(Model(gaussians), moved, Request(conventions=setting.conventions, backend=REFERENCE), None)
        bins = prepared.listed()
        tiles = list(tile_hits(prepared.footprints, bins, setting.conventions, response))
        sides = [np.concatenate([np.ravel(tile.alphas > 0) for tile in tiles])]
        sides += [np.concatenate([np.ravel(tile.is_clamped) for tile in tiles])]
        sides += [np.concatenate([_select_blended(tile.order, tile.alphas) for tile in tiles])]
        return Point(point.outputs, (*point.sides, bins.gaussian_ids, *sides))

    return stage._replace(function=function)


def _select_blended(order: Ints | None, alphas: Floats) -> Ints:
    """Return the order [G * P] of the blended hits; the place of the others does not matter."""
    if order is None:
        return np.zeros(0, int)
    return np.where(np.take_along_axis(alphas, order, axis=0) > 0, order, -1).ravel()
