"""The stages of the gradient check: the rendered flow to another view, at a later time and by another camera."""

import numpy as np

from minisplat_ref.extensions.lucas_kanade.losses import SHAPE, rendered_flow, rendered_flow_vjp
from minisplat_ref.extensions.lucas_kanade.method import WARPED
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import TIME, noisy_model, training_view
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage, watch
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats, Model


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the flow as a function of the Gaussians and the warp."""
    view = training_view(setting.camera)
    camera = view.camera._replace(cam_from_world_t=view.camera.cam_from_world_t + np.array([0.1, -0.05, 0.1]))
    other = view._replace(camera=camera, time=TIME + 0.4)
    model, _ = noisy_model(setting, view, WARPED, rng)
    fields = model.gaussians._asdict()
    inputs = {**{name: fields[name] for name in SHAPE}, **model.shared}

    def draw(args: tuple[Floats, ...], used: Backend) -> tuple[Floats, Floats, object]:
        given = {**fields, **dict(zip(inputs, args, strict=True))}
        moving = Model(model.gaussians._make(given[name] for name in fields), {n: given[n] for n in model.shared})
        return rendered_flow(moving, view, other, Request(conventions=setting.conventions, backend=used))

    def function(*args: Floats) -> Point:
        on_watch, sides = watch(backend)
        flow, alpha, _ = draw(args, on_watch)
        return Point((flow, alpha), tuple(sides))

    def vjp(v_flow: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        gaussians, shared = rendered_flow_vjp(draw(tuple(inputs.values()), backend)[2], v_flow, v_alpha)  # type: ignore[arg-type]
        by_name = {**gaussians._asdict(), **shared}
        return tuple(by_name[name] for name in inputs)

    return (Stage("rendered_flow", inputs, ("flow", "alpha"), function, vjp),)
