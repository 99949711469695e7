"""The stage ``background``: the light from behind the scene, a function of the direction alone, and its formulas.

It is a ball of Gaussians, a map of directions, or harmonics, put behind the image. Each alternative has one shared
parameter of the model, ``sky``, with an individual shape. There is no kernel: the ball is rendered by the renderer of
3DGS, and the rest is done once for each pixel.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.strategy.initialization import gaussians_from_means
from minisplat_ref.strategy.removal import CHANGES
from minisplat_ref.training.sky import SKY, clear_sky, unit_rays, with_sky
from minisplat_ref.types import NOTHING, Camera, Floats, Gaussians, Ints, Model, RenderOutput, View

N_BALL = 100**2
MAP_SIZE = (64, 128)  # latitudes and longitudes
WHITE = 1.0
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))  # radians
BALL_COLUMNS = 5  # of the ball's parameter: three of colour, the logit of the opacity, the logarithm of the size
NEAR_POLE = 1e-12  # of the sine of the polar angle, where longitude is not defined


# --- the ball ---


def fibonacci_directions(n: int) -> Floats:
    """Return n unit directions [n, 3], float64, evenly spread: a Fibonacci lattice.

    ::

        y_k = 1 - 2 k / (n - 1),   r_k = sqrt(1 - y_k^2),   theta_k = k pi (3 - sqrt 5)
        d_k = (r_k cos theta_k, y_k, r_k sin theta_k)        k = 0 ... n - 1
    """
    k = np.arange(n)
    y = 1 - 2 * k / max(n - 1, 1)
    r = np.sqrt(np.maximum(1 - y * y, 0))
    return np.column_stack([r * np.cos(k * GOLDEN_ANGLE), y, r * np.sin(k * GOLDEN_ANGLE)])


def ball_gaussians(ball: Floats) -> Gaussians:
    """Return the Gaussians of a ball of radius 1 around the origin: round, in the directions of the lattice.

    Parameters
    ----------
    ball : ndarray of shape (K, 5)
        Of each Gaussian the coefficients of its colour, the logit of its opacity, and the logarithm of its standard
        deviation, radians.

    Returns
    -------
    Gaussians
        In the dtype of ``ball``, without view-dependent colour.
    """
    n, dtype = len(ball), ball.dtype
    return Gaussians(
        means=fibonacci_directions(n).astype(dtype),
        quats=np.tile(np.array([1, 0, 0, 0], dtype), (n, 1)),
        log_scales=np.repeat(ball[:, 4:], 3, axis=1),
        opacity_logits=ball[:, 3].copy(),
        sh_dc=ball[:, :3].copy(),
        sh_rest=np.zeros((n, 0, 3), dtype),
    )


def ball_gaussians_vjp(v: Gaussians) -> Floats:
    """Gradient [K, 5] of :func:`ball_gaussians`: a size is that of three axes, so ``v_size = sum_j v_log_s_j``."""
    return np.column_stack([v.sh_dc, v.opacity_logits, v.log_scales.sum(axis=1)])


# --- the map ---


class Lookup(NamedTuple):
    """The places at which a map is read: four texels and two weights for each direction."""

    rows: tuple[Ints, Ints]
    """[P] the upper and the lower row."""
    columns: tuple[Ints, Ints]
    """[P] the left and the right column."""
    a: Floats
    """[P] weight of the right column."""
    b: Floats
    """[P] weight of the lower row."""


def find_texels(directions: Floats, shape: tuple[int, int]) -> Lookup:
    """Return the texels around unit directions [P, 3] in a map of latitudes and longitudes, ``shape`` rows and columns.

    ::

        phi = atan2(d_y, d_x),  theta = arccos d_z
        x = (phi / 2 pi + 1 / 2) W - 1 / 2,   y = theta / pi H - 1 / 2

    Columns continue around the circle; the first and the last row reach to the poles.
    """
    height, width = shape
    x = (np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5) * width - 0.5
    theta = np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2])
    y = np.clip(theta / np.pi * height - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(np.int64), np.minimum(np.floor(y).astype(np.int64), max(height - 2, 0))
    dtype = directions.dtype
    rows = top, np.minimum(top + 1, height - 1)
    return Lookup(rows, (left % width, (left + 1) % width), (x - left).astype(dtype), (y - top).astype(dtype))


def look_up(sky_map: Floats, found: Lookup) -> Floats:
    """Return the colours [P, 3] of a map [H, W, 3] at directions, interpolated.

    ::

        s = (1 - b) ((1 - a) m_00 + a m_01) + b ((1 - a) m_10 + a m_11)
    """
    (upper, lower), (left, right) = found.rows, found.columns
    a, b = found.a[:, None], found.b[:, None]
    above = (1 - a) * sky_map[upper, left] + a * sky_map[upper, right]
    return (1 - b) * above + b * ((1 - a) * sky_map[lower, left] + a * sky_map[lower, right])


def look_up_vjp(sky_map: Floats, directions: Floats, found: Lookup, v_colors: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`look_up` with respect to the map, and of it after :func:`find_texels` to the directions.

    ::

        v_m_ij = sum_p (weight of texel ij in p) v_s
        v_a = v_s . ((1 - b) (m_01 - m_00) + b (m_11 - m_10)),   v_b likewise,   v_x = v_a,  v_y = v_b
        v_d = v_x W / 2 pi dphi/dd + v_y H / pi dtheta/dd
        dphi/dd = (-d_y, d_x, 0) / r^2,   dtheta/dd = (d_x d_z / r, d_y d_z / r, -r),   r^2 = d_x^2 + d_y^2

    for unit d. Beyond the middle of the first and the last row the map does not change with theta, and v_y is 0.

    Parameters
    ----------
    sky_map : ndarray of shape (H, W, 3)
    directions : ndarray of shape (P, 3)
        Unit vectors, world frame.
    found : Lookup
        Of them.
    v_colors : ndarray of shape (P, 3)

    Returns
    -------
    v_map : ndarray of shape (H, W, 3)
        float64, because it sums over many pixels.
    v_directions : ndarray of shape (P, 3)
        float64.
    """
    height, width = sky_map.shape[:2]
    (upper, lower), (left, right) = found.rows, found.columns
    a, b = found.a[:, None].astype(np.float64), found.b[:, None].astype(np.float64)
    v = v_colors.astype(np.float64)
    v_map = np.zeros(sky_map.shape)
    corners = ((upper, left, (1 - a) * (1 - b)), (upper, right, a * (1 - b)), (lower, left, (1 - a) * b))
    for row, column, weight in (*corners, (lower, right, a * b)):
        np.add.at(v_map, (row, column), weight * v)
    m_00, m_01, m_10, m_11 = (sky_map[i, j].astype(np.float64) for i in found.rows for j in found.columns)
    v_x = np.sum(v * ((1 - b) * (m_01 - m_00) + b * (m_11 - m_10)), axis=1)
    v_y = np.sum(v * ((1 - a) * (m_10 - m_00) + a * (m_11 - m_01)), axis=1)
    d_x, d_y, d_z = directions.astype(np.float64).T
    r = np.maximum(np.hypot(d_x, d_y), NEAR_POLE)
    is_between = np.abs(np.arctan2(r, d_z) / np.pi * height - height / 2) < (height - 1) / 2
    v_phi, v_theta = v_x * width / (2 * np.pi), np.where(is_between, v_y * height / np.pi, 0)
    zero = np.zeros_like(d_x)
    v_directions = v_phi[:, None] * np.column_stack([-d_y, d_x, zero]) / (r * r)[:, None]
    return v_map, v_directions + v_theta[:, None] * np.column_stack([d_x * d_z / r, d_y * d_z / r, -r])


# --- behind the scene ---


def put_behind(image: Floats, alpha: Floats, light: Floats) -> Floats:
    """Return an image [H, W, 3] over black with light [H, W, 3] behind it: ``c' = c + (1 - alpha) s``."""
    return image + (1 - alpha[..., None]) * light


def put_behind_vjp(alpha: Floats, light: Floats, v_image: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`put_behind` with respect to alpha and the light; that of the image is v itself.

    ::

        v_alpha = -s . v_c',   v_s = (1 - alpha) v_c'
    """
    return -np.sum(light * v_image, axis=2), (1 - alpha[..., None]) * v_image


# --- a background, and its light ---


class Background(NamedTuple):
    """An alternative of the stage."""

    initial: Callable[[], Mapping[str, Floats]]
    """Returns the shared parameter ``sky``, or nothing."""
    wrap: Callable[[Renderer], Renderer]
    """Wraps a renderer in one that renders it behind everything."""


class Light(NamedTuple):
    """The light behind a view, and its gradient."""

    render: Callable[[Floats, Camera, Request], tuple[Floats, Any]]
    """``render(sky, camera, request)`` returns the light [H, W, 3] and a tape."""
    render_vjp: Callable[[Any, Floats], "LightGradient"]
    """``render_vjp(tape, v_light)``."""


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

    def render_before_light(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        if SKY not in model.shared:
            return inner.render(model, view, request)
        dtype, camera = model.gaussians.means.dtype, with_principal_point(view.camera, request.conventions)
        colors, light_tape = light.render(model.shared[SKY].astype(dtype, copy=False), camera, request)
        over_black = request._replace(background=None, behind=colors if CHANGES in request.wants else None)
        output, tape = inner.render(model, view, over_black)
        rgb = inner.channels(request.wants)["rgb"]
        image = output.image.copy()  # the inner tape may refer to the original
        image[..., rgb] = put_behind(image[..., rgb], output.alpha, colors)
        own = _Tape(tape, light_tape, model.shared[SKY].dtype, output.alpha, colors, rgb)
        return output._replace(image=image), own

    def render_before_light_vjp(tape: Any, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        if not isinstance(tape, _Tape):
            return inner.render_vjp(tape, v_image, v_alpha)
        v_alpha_behind, v_light = put_behind_vjp(tape.alpha, tape.colors, v_image[..., tape.rgb])
        v = inner.render_vjp(tape.inner, v_image, v_alpha_behind if v_alpha is None else v_alpha + v_alpha_behind)
        own = light.render_vjp(tape.light, np.ascontiguousarray(v_light))
        return v._replace(
            shared={**v.shared, SKY: own.sky.astype(tape.sky_dtype, copy=False)},
            cam_from_world_R=v.cam_from_world_R + own.cam_from_world_R.astype(v_image.dtype),
            background=own.background.astype(v_image.dtype),
        )

    return Renderer(f"{inner.name} before light", render_before_light, render_before_light_vjp, inner.channels)


def _render_ball(sky: Floats, camera: Camera, request: Request) -> tuple[Floats, Any]:
    """Render the ball around the camera: without translation, no direction has a parallax."""
    centred = camera._replace(cam_from_world_t=np.zeros_like(camera.cam_from_world_t))
    of_ball = request._replace(sh_degree=0, is_visible=None, behind=None, wants=frozenset())
    output, tape = SPLATTING.render(Model(ball_gaussians(sky)), View("", centred, _NO_IMAGE, None), of_ball)
    return output.image, tape


def _render_ball_vjp(tape: Any, v_light: Floats) -> LightGradient:
    v = SPLATTING.render_vjp(tape, v_light, None)
    return LightGradient(ball_gaussians_vjp(v.gaussians), v.cam_from_world_R, v.background)


class _MapTape(NamedTuple):
    sky_map: Floats
    rays: Floats  # [P, 3] camera frame
    directions: Floats  # [P, 3] world frame
    found: Any


def _render_map(sky: Floats, camera: Camera, request: Request) -> tuple[Floats, _MapTape]:
    rays = unit_rays(camera, np.arange(camera.height * camera.width), sky.dtype)
    directions = rays @ camera.cam_from_world_R.astype(sky.dtype)
    found = find_texels(directions, sky.shape[:2])
    light = look_up(sky, found).reshape(camera.height, camera.width, 3)
    return light, _MapTape(sky, rays, directions, found)


def _render_map_vjp(tape: _MapTape, v_light: Floats) -> LightGradient:
    v_map, v_directions = look_up_vjp(tape.sky_map, tape.directions, tape.found, v_light.reshape(-1, 3))
    v_R = np.einsum("pi,pj->ij", tape.rays.astype(np.float64), v_directions)  # d = R^T u
    return LightGradient(v_map, v_R, np.zeros(3))


_NO_IMAGE = np.zeros((0, 0, 3), np.uint8)
BALL, MAP = Light(_render_ball, _render_ball_vjp), Light(_render_map, _render_map_vjp)
