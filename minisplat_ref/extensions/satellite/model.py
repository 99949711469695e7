"""The renderer of satellite photographs: splatting by an affine camera, the sun's shadow map, and radiometry (EOGS).

A pixel (u, v) whose rendered altitude is h lies in the sun's image at ``(u, v) - g h``: g is the shift, in pixels per
unit of altitude, along the sun's rays: the paper's ``M = [[1, 0, -g_u], [0, 1, -g_v], [0, 0, 1]]``. It is ``A_xy d``,
d the world direction towards the sun that gains a metre. There the sun sees altitude h_s. Higher than h, something is
between::

    s = exp(0.4 min(h - h_s, 0))
    I = (s + (1 - s) k) (C a + c)

a is the albedo that splatting renders, C [3, 3] and c [3] the radiometry of the photograph, and k [3] the light of the
sky in the shadow.

A camera with ``affine`` optics knows its metres and the sun. One without optics, or ``orthographic``, has parallel
rays, too, and focal lengths in pixels per world unit; its depth counts as the negative altitude, and there is no sun.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.cameras.affine import (
    AffineCamera,
    downward,
    downward_vjp,
    orthographic,
    sun_slopes,
    with_affine,
)
from minisplat_ref.rendering import Renderer, RenderGradient, Request, activate, parameters_vjp
from minisplat_ref.rendering.splatting import SplatGradient, SplatTape, splat, splat_vjp
from minisplat_ref.types import Bools, Camera, Floats, Ints, Model, RenderOutput, SHGradient, View

DARKENING = 0.4  # per unit of altitude, a metre
MIN_ALPHA = 0.05  # fainter pixels have no altitude; they count as if they were as opaque
RADIOMETRY, IN_SHADOW = "radiometry", "in_shadow"  # shared: [V, 3, 4] and [V, 3]
HAS_SHADOWS = "has_shadows"  # shared: [1], 0 in the first part of a training; a model without it has shadows
REFERENCE_VIEW = 0  # whose radiometry views have that are not trained on
CHANNELS = {"depth": 1, "albedo": 3, "altitude": 1, "shadow": 1}  # besides rgb, in this order
WANTS = frozenset({*CHANNELS, "stats", "median_depth"})


class AltitudeGradient(NamedTuple):
    """Gradient of :func:`altitudes`."""

    sums: Floats  # [H, W]
    alpha: Floats  # [H, W]


def altitudes(sums: Floats, alpha: Floats) -> Floats:
    """Return the altitude of each pixel, ``h = -D / max(alpha, 0.05)``; a depth is a negative altitude.

    Parameters
    ----------
    sums : ndarray of shape (H, W)
        D, ``sum w z``.
    alpha : ndarray of shape (H, W)
    """
    return -sums / np.maximum(alpha, alpha.dtype.type(MIN_ALPHA))


def altitudes_vjp(sums: Floats, alpha: Floats, v_altitudes: Floats) -> AltitudeGradient:
    """Gradient of :func:`altitudes`: ``v_D = -v_h / a``, ``v_a = -v_h h / a`` where a is above its minimum."""
    a = np.maximum(alpha, alpha.dtype.type(MIN_ALPHA))
    v_sums = -v_altitudes / a
    return AltitudeGradient(v_sums, np.where(alpha > MIN_ALPHA, v_sums * altitudes(sums, alpha), 0))


class Sample(NamedTuple):
    """The places between the pixels of an image that are read, with the values there."""

    values: Floats  # [H, W, D]
    corners: Ints  # [4, H, W] flat indices
    weights: Floats  # [4, H, W]
    slopes: Floats  # [2, H, W, D] d values / d x and / d y; 0 beyond the border


def sample(image: Floats, x: Floats, y: Floats) -> Sample:
    """Return an image [H', W', D] at places x, y [H, W], bilinear between pixel centres at 0.5, constant outside."""
    height, width, _ = image.shape
    places, lows, inside = [], [], []
    for place, size in ((x, width), (y, height)):
        at = place - 0.5
        kept = np.clip(at, 0, size - 1)
        low = np.clip(np.floor(kept).astype(np.int64), 0, max(size - 2, 0))
        places.append(kept - low)
        lows.append(low)
        inside.append((at > 0) & (at < size - 1))
    (fx, fy), (x0, y0) = places, lows
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    corners = np.stack([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1])
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]).astype(image.dtype)
    at = image.reshape(-1, image.shape[2])[corners]  # [4, H, W, D]
    fx, fy = fx[..., None], fy[..., None]
    by_x = ((at[1] - at[0]) * (1 - fy) + (at[3] - at[2]) * fy) * inside[0][..., None]
    by_y = ((at[2] - at[0]) * (1 - fx) + (at[3] - at[1]) * fx) * inside[1][..., None]
    values = np.einsum("khw,khwd->hwd", weights, at)
    return Sample(values, corners, weights, np.stack([by_x, by_y]).astype(image.dtype))


def sample_vjp(sampled: Sample, shape: tuple[int, ...], v_values: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`sample`: of the image, to whose corners ``v`` goes by their weights, and [2, H, W] of x and y.

    Parameters
    ----------
    sampled : Sample
    shape : (H', W', D)
        Of the image.
    v_values : ndarray of shape (H, W, D)
    """
    parts = sampled.weights[..., None] * v_values  # [4, H, W, D]
    size = shape[0] * shape[1]
    flat = [np.bincount(sampled.corners.ravel(), parts[..., d].ravel(), size) for d in range(shape[2])]
    v_image = np.stack(flat, axis=-1).reshape(shape).astype(v_values.dtype)
    return v_image, np.sum(sampled.slopes * v_values, axis=3)


class ShadowTape(NamedTuple):
    """The values that :func:`shadows` keeps."""

    shadows: Floats  # [H, W] s
    is_shaded: Bools  # [H, W] whether h < h_s
    sampled: Sample
    shift: Floats  # [2]
    shape: tuple[int, ...]  # of the sun's image
    altitude: Floats  # [H, W] h


class ShadowGradient(NamedTuple):
    """Gradient of :func:`shadows`."""

    altitude: Floats  # [H, W]
    of_sun: Floats  # [H', W']
    shift: Floats  # [2]


def shadows(altitude: Floats, of_sun: Floats, shift: Floats, margin: tuple[int, int]) -> ShadowTape:
    """Return s of each pixel.

    Parameters
    ----------
    altitude : ndarray of shape (H, W)
        h.
    of_sun : ndarray of shape (H', W')
        h_s, in the sun's image.
    shift : ndarray of shape (2,)
        g, pixels per unit of altitude.
    margin : (m_u, m_v)
        By how many pixels the sun's image is larger at each side.
    """
    dtype = altitude.dtype
    height, width = altitude.shape
    x = np.arange(width) + 0.5 + margin[0] - shift[0] * altitude
    y = np.arange(height)[:, None] + 0.5 + margin[1] - shift[1] * altitude
    sampled = sample(of_sun[..., None], x, y)
    below = altitude - sampled.values[..., 0]
    s = np.exp(DARKENING * np.minimum(below, 0)).astype(dtype)
    return ShadowTape(s, below < 0, sampled, shift, (*of_sun.shape, 1), altitude)


def shadows_vjp(tape: ShadowTape, v_shadows: Floats) -> ShadowGradient:
    """Gradient of :func:`shadows`.

    With ``v = 0.4 s v_s`` where ``h < h_s``, and ``p = (u, v) - g h``::

        v_hs = -v at the corners of p,   v_h = v + g . v dh_s/dp,   v_g = sum h v dh_s/dp
    """
    v = np.where(tape.is_shaded, DARKENING * tape.shadows * v_shadows, 0).astype(v_shadows.dtype)
    v_of_sun, v_places = sample_vjp(tape.sampled, tape.shape, -v[..., None])
    v_altitude = v - (tape.shift[0] * v_places[0] + tape.shift[1] * v_places[1]).astype(v.dtype)
    return ShadowGradient(v_altitude, v_of_sun[..., 0], -np.sum(tape.altitude * v_places, axis=(1, 2)))


class LightGradient(NamedTuple):
    """Gradient of :func:`light`."""

    albedo: Floats  # [H, W, 3]
    shadows: Floats  # [H, W]
    radiometry: Floats  # [3, 4]
    in_shadow: Floats  # [3]


def light(albedo: Floats, shadow: Floats, radiometry: Floats, in_shadow: Floats) -> Floats:
    """Return the photograph [H, W, 3], ``I = (s + (1 - s) k) (C a + c)``.

    Parameters
    ----------
    albedo : ndarray of shape (H, W, 3)
        a.
    shadow : ndarray of shape (H, W)
        s.
    radiometry : ndarray of shape (3, 4)
        C, then c.
    in_shadow : ndarray of shape (3,)
        k.
    """
    s = shadow[..., None]
    return (s + (1 - s) * in_shadow) * (albedo @ radiometry[:, :3].T + radiometry[:, 3])


def light_vjp(albedo: Floats, shadow: Floats, radiometry: Floats, in_shadow: Floats, v_image: Floats) -> LightGradient:
    """Gradient of :func:`light`.

    With ``f = s + (1 - s) k`` and ``l = C a + c``::

        v_l = f v,   v_C = sum v_l a^T,   v_c = sum v_l,   v_a = C^T v_l
        v_f = l v,   v_s = sum (1 - k) v_f,   v_k = sum (1 - s) v_f
    """
    s, C = shadow[..., None], radiometry[:, :3]
    v_l = (s + (1 - s) * in_shadow) * v_image
    v_f = (albedo @ C.T + radiometry[:, 3]) * v_image
    v_C = np.einsum("hwi,hwj->ij", v_l, albedo)
    v_c = v_l.sum(axis=(0, 1))
    return LightGradient(
        v_l @ C, np.sum((1 - in_shadow) * v_f, axis=2), np.column_stack([v_C, v_c]), np.sum((1 - s) * v_f, axis=(0, 1))
    )


def choose_affine(camera: Camera, conventions: Conventions) -> AffineCamera:
    """Return the affine camera of a camera.

    Raises
    ------
    InputError
        It bends directions.
    """
    if camera.optics is None or camera.optics.model == "orthographic":
        return orthographic(camera, conventions)
    if camera.optics.model != "affine":
        raise InputError(f"satellite draws affine cameras, not {camera.optics.model} ones: train with --recipe lens")
    return downward(camera)


def choose_affine_vjp(camera: Camera, v_A: Floats, v_b: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`choose_affine` with respect to the pose."""
    if camera.optics is not None and camera.optics.model == "affine":
        return downward_vjp(camera, v_A, v_b)
    per_unit = np.array([camera.fx, camera.fy, 1.0])
    return per_unit[:, None] * v_A, per_unit * v_b


def sheared(camera: AffineCamera, shift: Floats, margin: tuple[int, int]) -> AffineCamera:
    """Return M A and M b, larger by a margin: a point of altitude h moves by ``-g h``. The third row is ``-h``."""
    A, b = (np.asarray(field, np.float64) for field in camera[:2])
    M = np.eye(3)
    M[:2, 2] = shift
    return camera._replace(
        cam_from_world_R=M @ A,
        cam_from_world_t=M @ b + [*margin, 0],
        width=camera.width + 2 * margin[0],
        height=camera.height + 2 * margin[1],
    )


class Tape(NamedTuple):
    """The values that :func:`render_photograph` keeps for :func:`render_photograph_vjp`."""

    model: Model
    row: int  # of the shared parameters
    is_counted: bool  # whether there are any
    camera: Camera
    seen: SplatTape
    affine: AffineCamera
    of_sun: SplatTape | None
    shadow: ShadowTape | None
    shadow_map: Floats  # [H, W] s
    radiometry: Floats  # [3, 4]
    in_shadow: Floats  # [3]
    wants: frozenset[str]


def channels(wants: frozenset[str]) -> dict[str, slice]:
    """Return the image's channels: ``rgb``, then ``depth``, ``albedo``, ``altitude`` and ``shadow`` as wanted."""
    found, start = {"rgb": slice(0, 3)}, 3
    for name, size in CHANNELS.items():
        if name in wants:
            found[name] = slice(start, start + size)
            start += size
    return found


def splat_view(model: Any, camera: AffineCamera, request: Request, *, has_color: bool = True) -> SplatTape:
    """Return the splatting of a view: colours, which do not depend on the direction, and depths.

    Parameters
    ----------
    model : Model
    camera : AffineCamera
    request : Request
    has_color : bool
        Colours are 0 without.
    """
    g, dtype = model.gaussians, model.gaussians.means.dtype
    background = np.zeros(3, dtype) if request.background is None or not has_color else request.background.astype(dtype)

    def shade(radii: Ints) -> Floats:
        return np.maximum(SH_C0 * g.sh_dc + 0.5, 0).astype(dtype) if has_color else np.zeros_like(g.sh_dc)

    return splat(
        activate(g, request.is_visible),
        shade,
        camera,  # type: ignore[arg-type]  # the stages read its size, and the projection is affine
        background,
        request.conventions,
        with_affine(request.backend),
        with_depth=True,
        with_stats=has_color and "stats" in request.wants,
        with_median_depth=has_color and "median_depth" in request.wants,
    )


def splat_view_vjp(model: Model, tape: SplatTape, v_image: Floats, v_alpha: Floats) -> tuple[Any, SplatGradient]:
    """Gradient of :func:`splat_view` with respect to the population; the splats' own comes second."""
    g = model.gaussians
    v = splat_vjp(tape, v_image, v_alpha)
    is_lit = SH_C0 * g.sh_dc + 0.5 > 0
    v_dc = np.where(is_lit, SH_C0 * v.colors, 0).astype(g.sh_dc.dtype)
    nothing = np.zeros_like(g.means)
    v_sh = SHGradient(nothing, v_dc, np.zeros_like(g.sh_rest), np.zeros((3, 3)), np.zeros(3))
    return parameters_vjp(g, tape.primitives, v.primitives, v_sh), v


def depth_sums(tape: SplatTape) -> tuple[Floats, Floats]:
    """Return ``sum w z`` and alpha, [H, W] each."""
    return np.ascontiguousarray(tape.output.image[..., 3]), tape.output.alpha


def render_photograph(model: Model, view: View, request: Request) -> tuple[RenderOutput, Tape]:
    """Render a photograph with its light; return the image and a tape.

    Raises
    ------
    InputError
        Something is wanted that needs perspective, or the camera bends directions.
    """
    if request.wants - WANTS:
        names = ", ".join(sorted(request.wants - WANTS))
        raise InputError(f"satellite does not give {names}: use a recipe that does not ask for it, such as satellite")
    camera, dtype = choose_affine(view.camera, request.conventions), model.gaussians.means.dtype
    seen = splat_view(model, camera, request)
    sums, alpha = depth_sums(seen)
    h = altitudes(sums, alpha)
    of_sun = shadow = None
    shift = camera.cam_from_world_R[:2] @ sun_slopes(view.camera)
    s = np.ones_like(alpha)
    if shift.any() and model.shared.get(HAS_SHADOWS, (1.0,))[0] > 0:
        margin = camera.width // 2, camera.height // 2
        of_sun = splat_view(model, sheared(camera, shift, margin), request, has_color=False)
        shadow = shadows(h, altitudes(*depth_sums(of_sun)), shift, margin)
        s = shadow.shadows
    is_counted, row = RADIOMETRY in model.shared, max(view.view_id, REFERENCE_VIEW)
    radiometry = (model.shared[RADIOMETRY][row] if is_counted else np.eye(3, 4)).astype(dtype)
    in_shadow = (model.shared[IN_SHADOW][row] if is_counted else np.zeros(3)).astype(dtype)
    albedo = np.ascontiguousarray(seen.output.image[..., :3])
    parts = {"depth": sums[..., None], "albedo": albedo, "altitude": h[..., None], "shadow": s[..., None]}
    image = np.concatenate(
        [light(albedo, s, radiometry, in_shadow), *(parts[name] for name in CHANNELS if name in request.wants)], axis=2
    )
    visible_ids = np.flatnonzero(seen.projection.radii[:, 0] > 0)
    n_pairs = len(seen.bins.gaussian_ids) + (0 if of_sun is None else len(of_sun.bins.gaussian_ids))
    output = seen.output._replace(image=image, visible_ids=visible_ids, n_pairs=n_pairs)
    tape = Tape(
        model, row, is_counted, view.camera, seen, camera, of_sun, shadow, s, radiometry, in_shadow, request.wants
    )  # fmt: skip
    return output, tape


def render_photograph_vjp(tape: Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_photograph`: light, then shadows, then the two splattings.

    Altitudes have gradients from their channel, from the shadows as receivers and, in the sun's image, as casters. Both
    splattings add to the population and, through ``M A``, to the pose: ``v_A += M^T v_MA``. The shift depends on A,
    too: ``v_g = v_g of the shadows + v_MA A_z``, ``v_A_xy += v_g d^T``.
    """
    where = channels(tape.wants)
    v = {name: np.ascontiguousarray(v_image[..., part]) for name, part in where.items()}
    sums, alpha = depth_sums(tape.seen)
    v_alpha = np.zeros_like(alpha) if v_alpha is None else v_alpha
    albedo = np.ascontiguousarray(tape.seen.output.image[..., :3])
    of_light = light_vjp(albedo, tape.shadow_map, tape.radiometry, tape.in_shadow, v["rgb"])
    v_h = v["altitude"][..., 0] if "altitude" in v else np.zeros_like(alpha)
    v_albedo = of_light.albedo + (v["albedo"] if "albedo" in v else 0)
    sun = of_shadow = None
    if tape.shadow is not None and tape.of_sun is not None:
        of_shadow = shadows_vjp(tape.shadow, of_light.shadows + (v["shadow"][..., 0] if "shadow" in v else 0))
        v_h = v_h + of_shadow.altitude
        sun = _splat_vjp(tape.model, tape.of_sun, altitudes_vjp(*depth_sums(tape.of_sun), of_shadow.of_sun), None)
    of_h = altitudes_vjp(sums, alpha, v_h)
    of_h = AltitudeGradient(of_h.sums + (v["depth"][..., 0] if "depth" in v else 0), of_h.alpha + v_alpha)
    gaussians, of_splats = _splat_vjp(tape.model, tape.seen, of_h, v_albedo)
    v_A, v_b = of_splats.primitives.cam_from_world_R, of_splats.primitives.cam_from_world_t
    if tape.shadow is not None and sun is not None and of_shadow is not None:
        gaussians = type(gaussians)(*(a + b for a, b in zip(gaussians, sun[0], strict=True)))
        v_MA, v_Mb = sun[1].primitives.cam_from_world_R, sun[1].primitives.cam_from_world_t
        M = np.eye(3)
        M[:2, 2] = tape.shadow.shift
        v_A, v_b = v_A + M.T @ v_MA, v_b + M.T @ v_Mb
        v_g = of_shadow.shift + v_MA[:2] @ tape.affine.cam_from_world_R[2] + v_Mb[:2] * tape.affine.cam_from_world_t[2]
        v_A = v_A + np.outer([*v_g, 0], sun_slopes(tape.camera))
    v_R, v_t = choose_affine_vjp(tape.camera, v_A, v_b)
    shared = {}
    if tape.is_counted:
        shared = {name: np.zeros_like(tape.model.shared[name]) for name in (RADIOMETRY, IN_SHADOW)}
        shared[RADIOMETRY][tape.row], shared[IN_SHADOW][tape.row] = of_light.radiometry, of_light.in_shadow
    if HAS_SHADOWS in tape.model.shared:
        shared[HAS_SHADOWS] = np.zeros_like(tape.model.shared[HAS_SHADOWS])
    return RenderGradient(
        gaussians, of_splats.background, v_R.astype(alpha.dtype), v_t.astype(alpha.dtype), of_splats.means2d, shared
    )


def _splat_vjp(
    model: Model, tape: SplatTape, of_h: AltitudeGradient, v_color: Floats | None
) -> tuple[Any, SplatGradient]:
    """Return the gradient of a splatting from that of its depths and alpha and, if there is one, of its colours."""
    v_color = np.zeros((*of_h.alpha.shape, 3), of_h.alpha.dtype) if v_color is None else v_color
    v_image = np.ascontiguousarray(np.concatenate([v_color, of_h.sums[..., None]], axis=2))
    return splat_view_vjp(model, tape, v_image, np.ascontiguousarray(of_h.alpha))


SATELLITE = Renderer("satellite", render_photograph, render_photograph_vjp, channels)
"""It renders photographs with their light; without a sun and with identity radiometry, this is plain splatting."""
