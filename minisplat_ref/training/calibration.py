"""Parameters that may be trained besides the Gaussians: exposures, poses, a sky, compensated opacities.

Each is a set of shared parameters of the model, and a renderer that wraps another one and applies them. Each is off
unless a recipe switches it on, or the user does with ``--set NAME=true``, or with one of :data:`EXPOSURE_SOURCES`:

================  =======================================================================================
``exposure``      colours of each photograph
``pose``          place and direction of each camera
``sky``           light from behind the scene: :mod:`minisplat_ref.training.sky`
``antialiasing``  opacities for photographs of several sizes: :mod:`minisplat_ref.training.compensation`
================  =======================================================================================

The first two have a row for each training view. A view that is not trained on (``view_id`` -1) has none, and is
rendered as if nothing were calibrated. The others belong to the scene and affect every view.

*Exposure*, from the 2024 update of 3DGS: the colours of view v pass through an affine map, ``c' = A_v c + b_v``, stored
as E_v = [A_v | b_v], 3 x 4, which starts as the identity. The released code multiplies from the other side, so it
stores the transpose of A_v. It also clamps c' to [0, 1], which stops the gradient where the result is too bright; here
nothing is clamped. The scene's colours and the maps are determined up to one map that all views share. With
``exposure=learned`` the maps are trained. With ``exposure=tracks`` they are the gains that the tracks of structure from
motion show before any training (:mod:`minisplat_ref.strategy.track_gains`), and stay as they are; with
``exposure=refined`` they begin there and are trained. Where the tracks show no difference there are none.

*Pose*: the pose of view v is corrected on its left, ``R' = Q_v R, t' = Q_v t + u_v`` with ``Q_v = exp([w_v]_x)``, for a
rotation vector w (radians, camera frame) and a shift u (world units, camera frame). The scene and the poses are
determined up to a similarity transform that all views share: align held-out poses before comparing them.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minisplat_ref.rendering import Inputs, Renderer, RenderGradient, Request, wrap
from minisplat_ref.training.compensation import COMPENSATION, compensation, with_compensation
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.sky import SKY, clear_sky, with_sky
from minisplat_ref.types import Floats, Model, RenderOutput, View

EXPOSURES, ROTATIONS, SHIFTS = "exposures", "pose_rotations", "pose_shifts"  # names of the shared parameters
ANGLE_MIN = 1e-4  # radians; below it a series replaces (a - sin a) / a^3, which would cancel


class Calibration(NamedTuple):
    """Shared parameters, and the renderer that applies them."""

    name: str
    """``--set NAME=true`` switches the calibration on; of exposures, one of :data:`EXPOSURE_SOURCES` says whence."""
    initial: Callable[[int], dict[str, Floats]]
    """``initial(n_views)`` returns the initial shared parameters by name."""
    wrap: Callable[[Renderer], Renderer]
    """Wraps the given renderer in one that applies them."""
    rates: Rates
    """Learning rates of the shared parameters."""
    short_run_exponent: float = 0.0
    """p of the factor ``(published / iterations)^p`` by which the rates of shorter runs are raised."""
    is_on: bool = False


# --- exposure ---

NONE, TRACKS, REFINED, LEARNED = EXPOSURE_SOURCES = ("none", "tracks", "refined", "learned")
"""What ``--set exposure=`` takes: no exposures, those that the tracks show, the same with training, or training
alone."""


def identity_exposures(n_views: int) -> dict[str, Floats]:
    """Return the identity map [I | 0] for every view, [V, 3, 4] float32."""
    return {EXPOSURES: np.tile(np.eye(3, 4, dtype=np.float32), (n_views, 1, 1))}


def exposures_of_gains(views: Sequence[View]) -> dict[str, Floats]:
    """Return the maps ``c' = exp(g) c`` [V, 3, 4] float32 of views with log gains g; the identity for the others."""
    exposures = identity_exposures(len(views))
    for index, view in enumerate(views):
        if view.log_gain is not None:
            exposures[EXPOSURES][index, :, :3] = np.diag(np.exp(view.log_gain))
    return exposures


def expose(colors: Floats, exposure: Floats) -> Floats:
    """Return mapped colours: ``c' = A c + b``.

    Parameters
    ----------
    colors : ndarray of shape (H, W, 3)
        In the colour space in which photographs are compared, linear or not.
    exposure : ndarray of shape (3, 4)
        E = [A | b].

    Returns
    -------
    ndarray of shape (H, W, 3)
        Not clamped.
    """
    A, b = exposure[:, :3], exposure[:, 3]
    return colors @ A.T + b


def expose_vjp(colors: Floats, exposure: Floats, v_exposed: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`expose` with respect to colours and exposure.

    ::

        v_c = A^T v_c',   v_A = sum v_c' c^T,   v_b = sum v_c'        sums over the pixels

    Parameters
    ----------
    colors : ndarray of shape (H, W, 3)
    exposure : ndarray of shape (3, 4)
        E = [A | b].
    v_exposed : ndarray of shape (H, W, 3)
        Derivative with respect to c'.

    Returns
    -------
    v_colors : ndarray of shape (H, W, 3)
    v_exposure : ndarray of shape (3, 4)
        float64, because it sums over millions of pixels.
    """
    A = exposure[:, :3]
    v_A = (v_exposed.swapaxes(1, 2) @ colors).sum(axis=0, dtype=np.float64)  # [3, 3] the rows of pixels one by one
    v_b = v_exposed.sum(axis=(0, 1), dtype=np.float64)  # [3]
    return v_exposed @ A, np.column_stack([v_A, v_b])


class _ExposureTape(NamedTuple):
    inner: Any  # tape of the wrapped renderer
    model: Model
    view: View
    colors: Floats  # [H, W, 3] before the map
    rgb: slice  # their channels in the image


def with_exposures(inner: Renderer) -> Renderer:
    """Return a renderer that applies each training view's exposure to its colours; other channels stay."""

    def render_exposed(model: Model, view: View, request: Request) -> tuple[RenderOutput, _ExposureTape]:
        output, tape = inner.render(model, view, request)
        rgb = inner.channels(request.wants)["rgb"]
        colors = output.image[..., rgb]
        if _has_row(model, view, EXPOSURES):
            image = output.image.copy()  # the inner tape may refer to the original
            image[..., rgb] = expose(colors, model.shared[EXPOSURES][view.view_id])
            output = output._replace(image=image)
        return output, _ExposureTape(tape, model, view, colors, rgb)

    def render_exposed_vjp(tape: _ExposureTape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        if not _has_row(tape.model, tape.view, EXPOSURES):
            return inner.render_vjp(tape.inner, v_image, v_alpha)
        exposures, index = tape.model.shared[EXPOSURES], tape.view.view_id
        v_inner, v_exposures = v_image.copy(), np.zeros_like(exposures)
        v_inner[..., tape.rgb], v_exposures[index] = expose_vjp(tape.colors, exposures[index], v_image[..., tape.rgb])
        v = inner.render_vjp(tape.inner, v_inner, v_alpha)
        return v._replace(shared={**v.shared, EXPOSURES: v_exposures})

    return Renderer(f"{inner.name} with exposures", render_exposed, render_exposed_vjp, inner.channels)


# --- pose ---


def zero_corrections(n_views: int) -> dict[str, Floats]:
    """Return zero rotation vectors and shifts for every view, [V, 3] each, float64 like poses."""
    return {ROTATIONS: np.zeros((n_views, 3)), SHIFTS: np.zeros((n_views, 3))}


def correct_pose(R: Floats, t: Floats, w: Floats, u: Floats) -> tuple[Floats, Floats]:
    """Return the corrected pose: ``R' = Q R, t' = Q t + u`` with ``Q = exp([w]_x)``.

    Parameters
    ----------
    R : ndarray of shape (3, 3)
        cam_from_world.
    t : ndarray of shape (3,)
        cam_from_world, world units.
    w : ndarray of shape (3,)
        Rotation vector: axis times angle, radians, camera frame.
    u : ndarray of shape (3,)
        Shift, world units, camera frame.

    Returns
    -------
    R, t : ndarray of shape (3, 3) and (3,)
    """
    Q = Rotation.from_rotvec(w).as_matrix()
    return Q @ R, Q @ t + u


def correct_pose_vjp(R: Floats, t: Floats, w: Floats, v_R: Floats, v_t: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`correct_pose` with respect to w and u.

    A small change dw of w rotates Q further by J dw, with the left Jacobian J: ``dQ = [J dw]_x Q``. Hence ::

        v_Q = v_R' R^T + v_t' t^T,   M = v_Q Q^T
        v_w = J^T (M_21 - M_12, M_02 - M_20, M_10 - M_01),   v_u = v_t'

    Parameters
    ----------
    R, t, w
        As for :func:`correct_pose`.
    v_R : ndarray of shape (3, 3)
        Derivative with respect to the nine entries of R'.
    v_t : ndarray of shape (3,)
        Derivative with respect to t'.

    Returns
    -------
    v_w, v_u : ndarray of shape (3,)
    """
    Q = Rotation.from_rotvec(w).as_matrix()
    M = (v_R @ R.T + np.outer(v_t, t)) @ Q.T
    v_turn = np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    return left_jacobian(w).T @ v_turn, v_t


def left_jacobian(w: Floats) -> Floats:
    """Return J with ``exp([w + dw]_x) = exp([J dw]_x) exp([w]_x)`` to first order in dw.

    ::

        J = I + (1 - cos a) / a^2 [w]_x + (a - sin a) / a^3 [w]_x^2,   a = |w|

    Parameters
    ----------
    w : ndarray of shape (3,)
        Rotation vector, radians, of any length.

    Returns
    -------
    J : ndarray of shape (3, 3)
    """
    a = float(np.linalg.norm(w))
    x, y, z = w
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first = 0.5 * np.sinc(a / (2 * np.pi)) ** 2  # 1 - cos a = 2 sin^2(a / 2); NumPy's sinc(x) is sin(pi x) / (pi x)
    second = 1 / 6 if a < ANGLE_MIN else (a - np.sin(a)) / a**3  # the next term of the series is -a^2 / 120
    return np.eye(3) + first * W + second * W @ W


def with_poses(inner: Renderer) -> Renderer:
    """Return a renderer that renders each training view from its corrected pose."""
    return wrap(inner, f"{inner.name} with poses", _correct_view, _correct_view_vjp)


def _correct_view(model: Model, view: View, request: Request) -> tuple[Inputs, tuple[Model, View]]:
    """Return the view with its corrected pose; record the given one."""
    corrected = view
    if _has_row(model, view, ROTATIONS):
        camera, w, u = view.camera, model.shared[ROTATIONS][view.view_id], model.shared[SHIFTS][view.view_id]
        R, t = correct_pose(camera.cam_from_world_R, camera.cam_from_world_t, w, u)
        corrected = view._replace(camera=camera._replace(cam_from_world_R=R, cam_from_world_t=t))
    return (model, corrected, request), (model, view)


def _correct_view_vjp(record: tuple[Model, View], v: RenderGradient) -> RenderGradient:
    model, view = record
    if not _has_row(model, view, ROTATIONS):
        return v
    v_rotations, v_shifts = (np.zeros_like(model.shared[name]) for name in (ROTATIONS, SHIFTS))
    v_rotations[view.view_id], v_shifts[view.view_id] = correct_pose_vjp(
        view.camera.cam_from_world_R,
        view.camera.cam_from_world_t,
        model.shared[ROTATIONS][view.view_id],
        v.cam_from_world_R,
        v.cam_from_world_t,
    )
    return v._replace(shared={**v.shared, ROTATIONS: v_rotations, SHIFTS: v_shifts})


def _has_row(model: Model, view: View, name: str) -> bool:
    """Return whether the shared parameter has a row for the view."""
    return view.view_id >= 0 and name in model.shared


EXPOSURE = Calibration(
    "exposure", identity_exposures, with_exposures, Rates({EXPOSURES: LogLinear(1e-2, 1e-3, 30_000)})
)
"""An affine map of the colours per photograph, with the rates of the 2024 update of 3DGS."""

HELD_EXPOSURE = EXPOSURE._replace(rates=Rates({EXPOSURES: 0.0}))
"""The same, as it begins."""

POSE = Calibration(
    "pose",
    zero_corrections,
    with_poses,
    # The rate of gsplat's trainer. In R iterations a parameter can move by 0.2 rate R, here 0.06 radians; a shorter run
    # keeps this path length, not the rate. Measured on 24 cameras turned by 0.52 degrees, as rate R: remaining degrees,
    # in 600 iterations 0.075: 0.35, 0.15: 0.31, 0.3: 0.31, 0.6: 0.32, 1.2: 0.35; in 2400 0.34, 0.27, 0.27, 0.31, 0.35.
    # A longer path spoils what has been found, a shorter one does not reach it.
    Rates({ROTATIONS: LogLinear(1e-5, 1e-7, 30_000), SHIFTS: LogLinear(1e-5, 1e-7, 30_000)}, frozenset({SHIFTS})),
    short_run_exponent=1.0,
)
"""A correction of the pose per photograph."""

BACKDROP = Calibration("sky", clear_sky, with_sky, Rates({SKY: 1e-3}))
"""A sky, which all views share."""

ANTIALIASING = Calibration("antialiasing", compensation, with_compensation, Rates({COMPENSATION: 0.0}))
"""Compensated opacities, in all views."""

# Each wraps those before it: a photograph's exposure changes its sky too.
CALIBRATIONS = (ANTIALIASING, BACKDROP, EXPOSURE, POSE)
