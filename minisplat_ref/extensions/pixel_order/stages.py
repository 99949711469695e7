"""What the gradient proof checks: the renderer, exactly sorted and with a small buffer, with thresholds of its own."""

from functools import partial

import numpy as np

from minisplat_ref.backends import REFERENCE, Backend
from minisplat_ref.constants import EXACT_ORDER
from minisplat_ref.extensions.pixel_order.method import ORDERED
from minisplat_ref.extensions.shared_tangent_renderer import RESPONSE, prepare
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering import Request
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Gaussians, Model

BUFFER = 4  # hits


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer in both orders; what is listed, blended, clamped and in which order the reference tells.

    The means have one gradient less to check than 3DGS's: the clamp of the Jacobian does not exist here.
    """
    draw = ORDERED.renderer.render
    buffered = ORDERED._replace(
        name=f"{ORDERED.name}, buffer of {BUFFER}",
        renderer=ORDERED.renderer._replace(render=partial(draw, buffer_size=BUFFER)),
    )
    return tuple(
        _watching(backend, setting, representation, buffer_size, rng)
        for representation, buffer_size in ((ORDERED, EXACT_ORDER), (buffered, BUFFER))
    )


def _watching(
    backend: Backend, setting: Setting, representation: Representation, buffer_size: int, rng: np.random.Generator
) -> Stage:
    stage = model_stage(backend, setting, representation, rng)
    response = RESPONSE._replace(buffer_size=buffer_size)

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
        sides += [np.concatenate([_blended_order(tile.order, tile.alphas) for tile in tiles])]
        return Point(point.outputs, (*point.sides, bins.gaussian_ids, *sides))

    return stage._replace(function=function)


def _blended_order(order: Floats | None, alphas: Floats) -> Floats:
    """Return the order [G * P] of what is blended; what is not may come anywhere."""
    assert order is not None
    return np.where(np.take_along_axis(alphas, order, axis=0) > 0, order, -1).ravel()
