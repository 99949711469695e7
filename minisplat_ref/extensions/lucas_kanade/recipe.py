"""The two losses, flow against that of the photographs and the order of depths; their gradient check; the recipe.

The flow of a view needs the camera and the time of the next photograph, which renderers do not have; so the term blends
it itself, with the compositor of the backend, and returns derivatives with respect to the Gaussians and the warp.
"""

from functools import lru_cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.lucas_kanade.model import CENTERS, LOG_WIDTH, SHIFTS, WARPED, Moved, moved, moved_vjp
from minisplat_ref.extensions.lucas_kanade.pyramid import Flow, optical_flow
from minisplat_ref.mechanisms.motion.field import field, field_vjp
from minisplat_ref.mechanisms.motion.velocity import power_steps
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import TIME, noisy_model, training_view
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage, watch
from minisplat_ref.reference.pinhole import pinhole, pinhole_vjp, pose, project_into_image, with_principal_point
from minisplat_ref.rendering import Request, activate, parameters_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.rendering.splatting import SplatTape, splat, splat_vjp
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Ints, Model, Scene, SHGradient, View

SOFT = 0.1  # pixels: accuracy of the flow of photographs
SHAPE = ("means", "quats", "log_scales", "opacity_logits")  # of a Gaussian: a flow does not depend on its colours
NEAR = 0.01  # world units: points nearer to the second camera have no place in its image
LONE_STEP = 1.0  # unit of time after which a scene of one photograph is taken to look the same
ALPHA_MIN = 0.5  # of a pixel that has a depth
N_SAMPLES = 1_024  # pixels of a depth map that are compared, in pairs
GAP = 0.02  # of the range of the given depths: pairs that differ by less have no order


# --- flow ---


class Step(NamedTuple):
    """Places before and after a step of time, each in the frame of the camera that sees it."""

    before: Floats
    """[N, 3]."""
    after: Floats
    """[N, 3]."""
    cameras: tuple[Camera, Camera]


def image_steps(before: Floats, after: Floats, cameras: tuple[Camera, Camera]) -> tuple[Floats, Step]:
    """Return the motion of places in the image: ``pi'(R' x' + t') - pi(R x + t)``, [N, 2] in pixels.

    Parameters
    ----------
    before, after : ndarray of shape (N, 3)
        x and x', world frame, in front of their cameras.
    cameras : pair of Camera
        The cameras at both times.
    """
    poses = [pose(camera, before.dtype) for camera in cameras]
    seen = [places @ R.T + t for places, (R, t) in zip((before, after), poses, strict=True)]
    return pinhole(seen[1], cameras[1]) - pinhole(seen[0], cameras[0]), Step(seen[0], seen[1], cameras)


def image_steps_vjp(step: Step, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`image_steps`: ``v_x = -R^T J^T v`` and ``v_x' = R'^T J'^T v``, J of the pinhole camera."""
    (R, _), (R_after, _) = (pose(camera, v.dtype) for camera in step.cameras)
    v_before, v_after = pinhole_vjp(step.before, step.cameras[0], v), pinhole_vjp(step.after, step.cameras[1], v)
    return -v_before @ R, v_after @ R_after


def flow_error(flow: Floats, alpha: Floats, target: Floats, is_known: Bools) -> float:
    """Return the distance of a rendered flow from the given one, in image widths.

    ::

        L = sum_p rho(F_p - A_p f_p) / (P W)      over the P pixels at which f is known
        rho(r) = sqrt(r_x^2 + e^2) + sqrt(r_y^2 + e^2) - 2 e

    F is the blend ``sum_i w_i f_i`` of the Gaussians' motions in the image, and A the accumulated opacity, so that each
    Gaussian contributes ``w_i (f_i - f)``: one that is faint is not compared with the whole motion. rho is the L1 norm
    but for the kink at zero, which is round within e = SOFT pixels.

    Parameters
    ----------
    flow : ndarray of shape (H, W, 2)
        F, pixels.
    alpha : ndarray of shape (H, W)
        A.
    target : ndarray of shape (H, W, 2)
        f, pixels.
    is_known : ndarray of shape (H, W) of booleans
    """
    residuals = (flow - alpha[..., None] * target)[is_known]
    total = float(np.sum(np.hypot(residuals, residuals.dtype.type(SOFT)) - residuals.dtype.type(SOFT)))
    return total / (max(len(residuals), 1) * flow.shape[1])


def flow_error_vjp(flow: Floats, alpha: Floats, target: Floats, is_known: Bools) -> tuple[Floats, Floats]:
    """Gradient of :func:`flow_error`: ``v_F = r / sqrt(r^2 + e^2) / (P W)``, r = F - A f, and ``v_A = -f . v_F``."""
    unit = flow.dtype.type(1 / (max(np.count_nonzero(is_known), 1) * flow.shape[1]))
    known = np.where(is_known[..., None], target, 0)
    residuals = flow - alpha[..., None] * known
    slopes = residuals / np.hypot(residuals, residuals.dtype.type(SOFT))
    v_flow = np.where(is_known[..., None], unit * slopes, 0).astype(flow.dtype)
    return v_flow, -np.sum(known * v_flow, axis=2)


class FlowTape(NamedTuple):
    """The values that :func:`rendered_flow` keeps for its gradient."""

    moved: Moved
    splats: SplatTape
    step: Step  # of the rows
    rows: Ints  # [R] that both cameras see
    tau: Floats  # [P] of the step of time


def next_view(scene: Scene, view: View) -> View | None:
    """Return the photograph of the next later time, the nearest camera's if there are several; None after the last."""
    later = [other for other in scene.train_views if other.time > view.time]
    if not later:
        return None

    def order(other: View) -> tuple[float, float]:
        return other.time, float(np.linalg.norm(other.camera.center - view.camera.center))

    return min(later, key=order)


def flow(rendered: Rendered, *, flows: str) -> tuple[float, Cotangents]:
    """Return the error of the flow to the next photograph, and its derivatives; 0 after the last.

    Parameters
    ----------
    rendered : Rendered
    flows : str
        Folder of given flows, ``NAME.npy`` of [H, W, 2] pixels to the next photograph, not a number where unknown; if
        empty, that of :mod:`~minisplat_ref.extensions.lucas_kanade.pyramid` is taken.

    Raises
    ------
    InputError
        A file is missing or has another size.
    """
    view, scene = rendered.view, rendered.scene
    target, other = next_view(scene, view), view._replace(time=view.time + LONE_STEP)
    if target is not None:
        other = target.load()
    elif len(scene.train_views) > 1:
        return 0.0, Cotangents()
    known = _given_flow(Path(flows), view) if flows else _photographed_flow(view, other)
    if known is None:
        return 0.0, Cotangents()
    is_known = known.is_known if view.mask is None else known.is_known & view.mask
    image, alpha, tape = rendered_flow(rendered.model, view, other, rendered.request)
    motion = known.motion.astype(image.dtype)
    v_flow, v_alpha = flow_error_vjp(image, alpha, motion, is_known)
    gaussians, shared = rendered_flow_vjp(tape, v_flow, v_alpha)
    return flow_error(image, alpha, motion, is_known), Cotangents(
        gaussians={name: getattr(gaussians, name) for name in SHAPE}, shared=shared
    )


def rendered_flow(model: Model, view: View, other: View, request: Request) -> tuple[Floats, Floats, FlowTape]:
    """Return the flow ``F = sum_i w_i f_i`` from a view to another, and the accumulated opacity.

    ``f_i`` is the motion of a Gaussian in the image, from its place in the view to where one step of Runge-Kutta leads
    it in the other (:func:`~minisplat_ref.mechanisms.motion.velocity.power_steps`); 0 where the other camera does not
    see it in front of itself.

    Parameters
    ----------
    model : Model
        With a warp.
    view, other : View
        Cameras and times.
    request : Request
        Backend, conventions and visible rows count.

    Returns
    -------
    flow : ndarray of shape (H, W, 2)
        Pixels.
    alpha : ndarray of shape (H, W)
    tape : FlowTape
        For :func:`rendered_flow_vjp`.
    """
    there = moved(model, view.time)
    tau = power_steps(view.time, other.time - view.time, len(there.tau))
    after = there.gaussians.means + field(there.phi, model.shared[SHIFTS], tau)
    splats, step, rows = blended_steps(there.gaussians, after, (view.camera, other.camera), request)
    return splats.output.image[..., :2], splats.output.alpha, FlowTape(there, splats, step, rows, tau)


def blended_steps(
    g: Gaussians, after: Floats, cameras: tuple[Camera, Camera], request: Request
) -> tuple[SplatTape, Step, Ints]:
    """Blend the motion of Gaussians in the image.

    Parameters
    ----------
    g : Gaussians
        At the time of the first camera, which shows them.
    after : ndarray of shape (N, 3)
        Where their centres are at the time of the second.
    cameras : pair of Camera
    request : Request

    Returns
    -------
    splats : SplatTape
        The image's first two channels are the flow, pixels; the third is 0.
    step : Step
        Of the rows.
    rows : ndarray of shape (R,)
        Gaussians that the first camera sees and the second has in front of itself; the others count as still.
    """
    dtype = g.means.dtype
    first, second = (with_principal_point(camera, request.conventions) for camera in cameras)
    R, t = pose(second, dtype)
    is_in_front = (after @ R.T + t)[:, 2] > NEAR
    found: list[tuple[Ints, Step]] = []

    def shade(radii: Ints) -> Floats:
        rows = np.flatnonzero((radii[:, 0] > 0) & is_in_front)
        steps, step = image_steps(g.means[rows], after[rows], (first, second))
        found.append((rows, step))
        colors = np.zeros((len(radii), 3), dtype)  # three channels, as colours have: no further kernel is compiled
        colors[rows, :2] = steps
        return colors

    black = np.zeros(3, dtype)
    splats = splat(activate(g, request.is_visible), shade, cameras[0], black, request.conventions, request.backend)
    ((rows, step),) = found
    return splats, step, rows


def rendered_flow_vjp(tape: FlowTape, v_flow: Floats, v_alpha: Floats) -> tuple[Gaussians, dict[str, Floats]]:
    """Gradient of :func:`rendered_flow` with respect to the Gaussians of time 0 and the warp.

    ::

        x = W(y, t), x' = x + sum_b phi_b(y) sum_p tau_p a_bp
        v_x = v_x (by its weights w) + v_x (by f) + v_x',   v_a, v_y, v_c, v_h by both fields
    """
    there = tape.moved
    g, dtype = there.gaussians, v_flow.dtype
    v_image = np.zeros((*v_flow.shape[:2], 3), dtype)
    v_image[..., :2] = v_flow
    v = splat_vjp(tape.splats, v_image, v_alpha)
    v_before, v_after = np.zeros_like(g.means), np.zeros_like(g.means)
    v_before[tape.rows], v_after[tape.rows] = image_steps_vjp(tape.step, v.colors[tape.rows, :2])
    by_steps = SHGradient(
        v_before + v_after,
        np.zeros_like(g.sh_dc),
        np.zeros_like(g.sh_rest),
        v.primitives.cam_from_world_R,
        v.primitives.cam_from_world_t,
    )
    v_there = parameters_vjp(g, tape.splats.primitives, v.primitives, by_steps)
    v_gaussians, v_shared = moved_vjp(there, v_there)
    shifts = there.coefficients[..., :3]
    by_time = field_vjp(there.canonical.means, there.centers, there.width, there.phi, shifts, tape.tau, v_after)
    v_shared[CENTERS] = v_shared[CENTERS] + by_time.centers
    v_shared[LOG_WIDTH] = v_shared[LOG_WIDTH] + dtype.type(by_time.log_width)
    v_shared[SHIFTS] = v_shared[SHIFTS] + by_time.coefficients
    return v_gaussians._replace(means=v_gaussians.means + by_time.places), v_shared


Image = NDArray[np.uint8]


class _Photographs:
    """Two images, equal to two others of the same pixels, as the key of a cache."""

    def __init__(self, first: Image, second: Image) -> None:
        self.images = (first, second)
        self.digest = b"".join(blake2b(image.tobytes()).digest() for image in self.images)

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Photographs) and self.digest == other.digest


@lru_cache(maxsize=512)
def _flow_between(photographs: _Photographs) -> Flow:
    known = optical_flow(*photographs.images)
    return Flow(known.motion.astype(np.float32), known.is_known)


def _photographed_flow(view: View, other: View) -> Flow | None:
    """Return the flow between two photographs, kept for later iterations; None if their sizes differ."""
    if view.image.shape != other.image.shape:
        return None
    return _flow_between(_Photographs(view.image, other.image))


def _given_flow(folder: Path, view: View) -> Flow:
    motion = _read_map(folder / f"{view.name}.npy", (view.camera.height, view.camera.width, 2), "flows")
    return Flow(np.nan_to_num(motion, posinf=0, neginf=0), np.asarray(np.isfinite(motion).all(axis=2)))


@lru_cache(maxsize=512)
def _read_map(path: Path, shape: tuple[int, ...], name: str) -> Floats:
    """Return an array of a file.

    Raises
    ------
    InputError
        It is missing, no array, or of another shape.
    """
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} cannot be read as an array: give every photograph one in {name}=DIR") from error
    if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype.kind not in "fiu":
        found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else "several arrays"
        raise InputError(f"{path} is {found}, but its photograph needs numbers of shape {shape}")
    return array


# --- depth ---


class Pairs(NamedTuple):
    """Pairs of pixels, the first of each nearer."""

    near: Ints
    """[Q, 2] row and column."""
    far: Ints
    """[Q, 2]."""


def order_error(sums: Floats, alpha: Floats, pairs: Pairs, margin: float) -> float:
    """Return the violation of the order in depth by pairs of pixels.

    ::

        L = mean max(0, m + ln d_near - ln d_far),   d = D / A

    Only the order of the given depths counts, and only the ratio of the rendered ones: neither scale matters.

    Parameters
    ----------
    sums : ndarray of shape (H, W)
        D, the accumulated depth ``sum w z``.
    alpha : ndarray of shape (H, W)
        A, above 0 at these pixels.
    pairs : Pairs
    margin : float
        m.
    """
    return float(np.sum(np.maximum(_excess(sums, alpha, pairs, margin), 0))) / max(len(pairs.near), 1)


def order_error_vjp(sums: Floats, alpha: Floats, pairs: Pairs, margin: float) -> tuple[Floats, Floats]:
    """Gradient of :func:`order_error`: ``v_D = +-1 / (Q D)`` and ``v_A = -+1 / (Q A)``, + at near pixels."""
    v_sums, v_alpha = np.zeros_like(sums), np.zeros_like(alpha)
    counts = _excess(sums, alpha, pairs, margin) > 0
    for pixels, sign in ((pairs.near, 1), (pairs.far, -1)):
        rows, columns = pixels[counts].T
        weight = sums.dtype.type(sign / max(len(pairs.near), 1))
        np.add.at(v_sums, (rows, columns), weight / sums[rows, columns])
        np.add.at(v_alpha, (rows, columns), -weight / alpha[rows, columns])
    return v_sums, v_alpha


def _excess(sums: Floats, alpha: Floats, pairs: Pairs, margin: float) -> Floats:
    """Return ``m + ln d_near - ln d_far``, [Q]."""
    near, far = (np.log(sums[tuple(p.T)]) - np.log(alpha[tuple(p.T)]) for p in pairs)
    excess: Floats = sums.dtype.type(margin) + near - far
    return excess


def depth_order(rendered: Rendered, *, depths: str, margin: float) -> tuple[float, Cotangents]:
    """Return the loss of pairs of pixels in the wrong order of depth, and its derivatives.

    Parameters
    ----------
    rendered : Rendered
        With a depth channel.
    depths : str
        Folder of given depths, ``NAME.npy`` of [H, W], larger where farther, in any unit, not a number where unknown;
        if empty, the order is that of the sparse points that structure from motion found in the view.
    margin : float
        Logarithm of the ratio that the depths of a pair are to have at least.

    Raises
    ------
    InputError
        A file is missing or has another size, or there are neither files nor points.
    """
    view, sums, alpha = rendered.view, rendered.channel("depth")[..., 0], rendered.output.alpha
    rng = np.random.default_rng(rendered.step)
    pixels, given = _map_samples(Path(depths), view, rng) if depths else _point_samples(rendered)
    is_opaque = (rendered.constant.output.alpha >= ALPHA_MIN)[tuple(pixels.T)]
    if view.mask is not None:
        is_opaque &= view.mask[tuple(pixels.T)]
    pairs = ordered_pairs(pixels[is_opaque], given[is_opaque], rng)
    v_sums, v_alpha = order_error_vjp(sums, alpha, pairs, margin)
    return order_error(sums, alpha, pairs, margin), Cotangents({"depth": v_sums[..., None]}, v_alpha)


def ordered_pairs(pixels: Ints, given: Floats, rng: np.random.Generator) -> Pairs:
    """Return each sample with another drawn at random, the nearer first.

    Those of nearly one depth, and those in one pixel, are left out.

    Parameters
    ----------
    pixels : ndarray of shape (M, 2)
        Rows and columns.
    given : ndarray of shape (M,)
        Depths in any unit.
    rng : numpy.random.Generator
    """
    other = rng.permutation(len(pixels))
    gap = GAP * np.ptp(given) if len(given) else 0.0
    is_ordered = (np.abs(given - given[other]) > gap) & (pixels != pixels[other]).any(axis=1)
    is_nearer = (given < given[other])[:, None]
    near, far = np.where(is_nearer, pixels, pixels[other]), np.where(is_nearer, pixels[other], pixels)
    return Pairs(near[is_ordered], far[is_ordered])


def _map_samples(folder: Path, view: View, rng: np.random.Generator) -> tuple[Ints, Floats]:
    depth = _read_map(folder / f"{view.name}.npy", (view.camera.height, view.camera.width), "depths")
    pixels = np.argwhere(np.isfinite(depth))
    pixels = pixels[rng.permutation(len(pixels))[:N_SAMPLES]]
    return pixels, depth[tuple(pixels.T)]


def _point_samples(rendered: Rendered) -> tuple[Ints, Floats]:
    view, scene = rendered.view, rendered.scene
    if view.point_ids is None:
        raise InputError(
            f"scene {scene.name} does not say which view sees which point, as COLMAP scenes do: give --set depths=DIR,"
            " or leave depth_order out of the loss"
        )
    camera = with_principal_point(view.camera, rendered.request.conventions)
    _, means2d, depths = project_into_image(scene.points[view.point_ids], camera)
    return np.floor(means2d[:, ::-1]).astype(np.int64), depths


# --- the gradient check, and the recipe ---


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the flow as a function of the Gaussians and the warp."""
    view = training_view(setting.camera)
    camera = view.camera._replace(cam_from_world_t=view.camera.cam_from_world_t + np.array([0.1, -0.05, 0.1]))
    other = view._replace(camera=camera, time=TIME + 0.4)
    model, _ = noisy_model(setting, view, WARPED, rng)
    fields = model.gaussians._asdict()
    inputs = {**{name: fields[name] for name in SHAPE}, **model.shared}

    def blend(args: tuple[Floats, ...], used: Backend) -> tuple[Floats, Floats, object]:
        given = {**fields, **dict(zip(inputs, args, strict=True))}
        moving = Model(model.gaussians._make(given[name] for name in fields), {n: given[n] for n in model.shared})
        return rendered_flow(moving, view, other, Request(conventions=setting.conventions, backend=used))

    def function(*args: Floats) -> Point:
        on_watch, sides = watch(backend)
        flow, alpha, _ = blend(args, on_watch)
        return Point((flow, alpha), tuple(sides))

    def vjp(v_flow: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        gaussians, shared = rendered_flow_vjp(blend(tuple(inputs.values()), backend)[2], v_flow, v_alpha)  # type: ignore[arg-type]
        by_name = {**gaussians._asdict(), **shared}
        return tuple(by_name[name] for name in inputs)

    return (Stage("rendered_flow", inputs, ("flow", "alpha"), function, vjp),)


LUCAS_KANADE = GS_ACCEL._replace(
    name="lucas-kanade",
    losses=(
        *GS_ACCEL.losses,
        LossTerm("flow", partial(flow, flows=""), 5.0),
        LossTerm("depth_order", partial(depth_order, depths="", margin=0.01), 0.0, frozenset({"depth"})),
    ),
)
"""``lucas-kanade``: 3DGS with a warp, and with a loss that compares its flow with that of the photographs."""
