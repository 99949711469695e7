"""The stage ``background``: the light from behind the scene, a function of the direction alone.

Each alternative has one shared parameter of the model, ``sky``, with an individual shape.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.gaustudio.reference import (
    BALL_COLUMNS,
    ball_gaussians,
    ball_gaussians_vjp,
    fibonacci_directions,
    find_texels,
    look_up,
    look_up_vjp,
    put_behind,
    put_behind_vjp,
)
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.strategy.initialization import gaussians_from_means
from minisplat_ref.strategy.removal import CHANGES
from minisplat_ref.training.sky import SKY, clear_sky, unit_rays, with_sky
from minisplat_ref.types import NOTHING, Camera, Floats, Model, RenderOutput, View

N_BALL = 100**2
MAP_SIZE = (64, 128)  # latitudes and longitudes
WHITE = 1.0


class Background(NamedTuple):
    """An alternative of the stage."""

    initial: Callable[[], Mapping[str, Floats]]
    """Returns the shared parameter ``sky``, or nothing."""
    wrap: Callable[[Renderer], Renderer]
    """Wraps a renderer in one that renders it behind everything."""


class Light(NamedTuple):
    """The light behind a view, and its gradient."""

    draw: Callable[[Floats, Camera, Request], tuple[Floats, Any]]
    """``draw(sky, camera, request)`` returns the light [H, W, 3] and a tape."""
    draw_vjp: Callable[[Any, Floats], "LightGradient"]
    """``draw_vjp(tape, v_light)``."""


class LightGradient(NamedTuple):
    """Gradient with respect to the parameters of the light."""

    sky: Floats
    cam_from_world_R: Floats
    """[3, 3]."""
    background: Floats
    """[3] of the request."""


# --- the alternatives ---


def nothing() -> Background:
    """Only the colour of train --background."""
    return Background(lambda: NOTHING, lambda renderer: renderer)


def harmonics() -> Background:
    """Spherical harmonics of degree 3, the sky of other recipes."""
    return Background(lambda: clear_sky(0), with_sky)


def ball() -> Background:
    """A ball of 10,000 Gaussians around each camera, white at first."""
    return Background(lambda: {SKY: white_ball(N_BALL)}, lambda renderer: with_light(renderer, BALL))


def sky_map() -> Background:
    """A map of 64 latitudes and 128 longitudes, white at first."""
    return Background(lambda: {SKY: np.full((*MAP_SIZE, 3), WHITE, np.float32)}, lambda r: with_light(r, MAP))


def white_ball(n: int) -> Floats:
    """Return the parameter [n, 5] of a ball: white, with sizes and opacities as 3DGS gives them to points."""
    white = np.full((n, 3), (WHITE - 0.5) / SH_C0, np.float32)
    g = gaussians_from_means(fibonacci_directions(n), white, sh_degree=0)
    start = np.column_stack([g.sh_dc, g.opacity_logits, g.log_scales[:, 0]])
    assert start.shape[1] == BALL_COLUMNS
    return start


# --- light behind a renderer ---


class _Tape(NamedTuple):
    inner: Any  # tape of the wrapped renderer
    light: Any  # tape of the light
    sky_dtype: np.dtype
    alpha: Floats  # [H, W]
    colors: Floats  # [H, W, 3] of the light
    rgb: slice  # their channels in the image


def with_light(inner: Renderer, light: Light) -> Renderer:
    """Return a renderer that puts light behind another one's image, if the model has a sky; alpha and depths stay."""

    def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        if SKY not in model.shared:
            return inner.render(model, view, request)
        dtype, camera = model.gaussians.means.dtype, with_principal_point(view.camera, request.conventions)
        colors, light_tape = light.draw(model.shared[SKY].astype(dtype, copy=False), camera, request)
        over_black = request._replace(background=None, behind=colors if CHANGES in request.wants else None)
        output, tape = inner.render(model, view, over_black)
        rgb = inner.channels(request.wants)["rgb"]
        image = output.image.copy()  # the inner tape may refer to the original
        image[..., rgb] = put_behind(image[..., rgb], output.alpha, colors)
        own = _Tape(tape, light_tape, model.shared[SKY].dtype, output.alpha, colors, rgb)
        return output._replace(image=image), own

    def render_vjp(tape: Any, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        if not isinstance(tape, _Tape):
            return inner.render_vjp(tape, v_image, v_alpha)
        v_alpha_behind, v_light = put_behind_vjp(tape.alpha, tape.colors, v_image[..., tape.rgb])
        v = inner.render_vjp(tape.inner, v_image, v_alpha_behind if v_alpha is None else v_alpha + v_alpha_behind)
        own = light.draw_vjp(tape.light, np.ascontiguousarray(v_light))
        return v._replace(
            shared={**v.shared, SKY: own.sky.astype(tape.sky_dtype, copy=False)},
            cam_from_world_R=v.cam_from_world_R + own.cam_from_world_R.astype(v_image.dtype),
            background=own.background.astype(v_image.dtype),
        )

    return Renderer(f"{inner.name} before light", render, render_vjp, inner.channels)


def _draw_ball(sky: Floats, camera: Camera, request: Request) -> tuple[Floats, Any]:
    """Render the ball around the camera: without translation, no direction has a parallax."""
    centred = camera._replace(cam_from_world_t=np.zeros_like(camera.cam_from_world_t))
    of_ball = request._replace(sh_degree=0, is_visible=None, behind=None, wants=frozenset())
    output, tape = SPLATTING.render(Model(ball_gaussians(sky)), View("", centred, _NO_IMAGE, None), of_ball)
    return output.image, tape


def _draw_ball_vjp(tape: Any, v_light: Floats) -> LightGradient:
    v = SPLATTING.render_vjp(tape, v_light, None)
    return LightGradient(ball_gaussians_vjp(v.gaussians), v.cam_from_world_R, v.background)


class _MapTape(NamedTuple):
    sky_map: Floats
    rays: Floats  # [P, 3] camera frame
    directions: Floats  # [P, 3] world frame
    found: Any


def _draw_map(sky: Floats, camera: Camera, request: Request) -> tuple[Floats, _MapTape]:
    rays = unit_rays(camera, np.arange(camera.height * camera.width), sky.dtype)
    directions = rays @ camera.cam_from_world_R.astype(sky.dtype)
    found = find_texels(directions, sky.shape[:2])
    light = look_up(sky, found).reshape(camera.height, camera.width, 3)
    return light, _MapTape(sky, rays, directions, found)


def _draw_map_vjp(tape: _MapTape, v_light: Floats) -> LightGradient:
    v_map, v_directions = look_up_vjp(tape.sky_map, tape.directions, tape.found, v_light.reshape(-1, 3))
    v_R = np.einsum("pi,pj->ij", tape.rays.astype(np.float64), v_directions)  # d = R^T u
    return LightGradient(v_map, v_R, np.zeros(3))


_NO_IMAGE = np.zeros((0, 0, 3), np.uint8)
BALL, MAP = Light(_draw_ball, _draw_ball_vjp), Light(_draw_map, _draw_map_vjp)
