"""What photographs bring with them that is no property of the scene: an exposure and an error of the pose, for each.

Both are shared parameters of the model with one row per training view, and renderers that wrap another renderer. A view
that is not trained on (``view_id`` -1) has neither, and is rendered as if there were no calibration. Both are off
unless a recipe or ``--set exposure=true``, ``--set pose=true`` asks for them.

*Exposure*, of 3DGS's update of 2024: the colours of view v pass through an affine map, ``c' = A_v c + b_v``, stored as
E_v = [A_v | b_v], 3 x 4, the identity at first. Optimised by Adam with the rate 0.01, which falls to 0.001. Left out:
the clamp to [0, 1] that the released code applies to the result, and so to every gradient. The maps and the colours of
the scene are known up to one map that all have in common.

*Pose*, as in gsplat and others: the pose of view v is corrected on its left, ``R' = Q R, t' = Q t + u`` with
``Q = exp([w]_x)`` for a rotation vector w (radians, camera frame) and a shift u (world units, camera frame). The
corrections and the scene are known up to a motion that all have in common.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minisplat_ref.rendering import Renderer, RenderGradient, Request
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.types import Floats, Model, RenderOutput, View

EXPOSURES, ROTATIONS, SHIFTS = "exposures", "pose_rotations", "pose_shifts"  # names of the shared parameters
LEAST_ANGLE = 1e-4  # radians; below it the series of the left Jacobian is exact to 1e-17


class Calibration(NamedTuple):
    """Parameters of each photograph, and how they enter its rendering."""

    name: str
    """By which ``--set NAME=true`` switches it on."""
    initial: Callable[[int], dict[str, Floats]]
    """``initial(n_views)``: the shared parameters before training, which change nothing."""
    wrap: Callable[[Renderer], Renderer]
    rates: Rates
    """Learning rates of the shared parameters."""
    is_on: bool = False


class _Tape(NamedTuple):
    """What a wrapped renderer was given, and the tape inside."""

    inner: Any
    model: Model
    view: View  # as it was given
    colors: Floats  # [H, W, 3] as they came from inside
    rgb: slice  # where the image has them


# --- exposure ---


def no_exposures(n_views: int) -> dict[str, Floats]:
    """Return the identity [V, 3, 4] for every view."""
    return {EXPOSURES: np.tile(np.eye(3, 4, dtype=np.float32), (n_views, 1, 1))}


def expose(colors: Floats, exposure: Floats) -> Floats:
    """Map colours: ``c' = A c + b``.

    Parameters
    ----------
    colors : ndarray of shape (H, W, 3)
    exposure : ndarray of shape (3, 4)
        [A | b].
    """
    return colors @ exposure[:, :3].T + exposure[:, 3]


def expose_vjp(colors: Floats, exposure: Floats, v_exposed: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`expose` with respect to colours [H, W, 3] and exposure [3, 4].

    ::

        v_c = A^T v',   v_A = sum v' c^T,   v_b = sum v'        the sums over the pixels
    """
    v_A = np.einsum("yxi,yxj->ij", v_exposed, colors)  # [3, 3]
    return v_exposed @ exposure[:, :3], np.column_stack([v_A, v_exposed.sum(axis=(0, 1))])


def with_exposures(inner: Renderer) -> Renderer:
    """Return a renderer that passes the colours of a training view through its exposure."""

    def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
        output, tape = inner.render(model, view, request)
        rgb = inner.channels(request.wants)["rgb"]
        colors = output.image[..., rgb]
        if _is_calibrated(model, view, EXPOSURES):
            image = output.image.copy()  # the tape inside keeps the other one
            image[..., rgb] = expose(colors, model.shared[EXPOSURES][view.view_id])
            output = output._replace(image=image)
        return output, _Tape(tape, model, view, colors, rgb)

    def render_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        if not _is_calibrated(tape.model, tape.view, EXPOSURES):
            return inner.render_vjp(tape.inner, v_image, v_alpha)
        exposures, index = tape.model.shared[EXPOSURES], tape.view.view_id
        v_inner, v_exposures = v_image.copy(), np.zeros_like(exposures)
        v_inner[..., tape.rgb], v_exposures[index] = expose_vjp(tape.colors, exposures[index], v_image[..., tape.rgb])
        v = inner.render_vjp(tape.inner, v_inner, v_alpha)
        return v._replace(shared={**v.shared, EXPOSURES: v_exposures})

    return Renderer(f"{inner.name} with exposures", render, render_vjp, inner.channels)


# --- pose ---


def no_corrections(n_views: int) -> dict[str, Floats]:
    """Return zero rotation vectors and shifts, [V, 3] each, float64 as poses are."""
    return {ROTATIONS: np.zeros((n_views, 3)), SHIFTS: np.zeros((n_views, 3))}


def correct_pose(R: Floats, t: Floats, w: Floats, u: Floats) -> tuple[Floats, Floats]:
    """Return the corrected pose ``R' = Q R, t' = Q t + u`` with ``Q = exp([w]_x)``.

    Parameters
    ----------
    R : ndarray of shape (3, 3)
        cam_from_world.
    t, w, u : ndarray of shape (3,)
        Translation, rotation vector (radians), shift (world units).
    """
    Q = Rotation.from_rotvec(w).as_matrix()
    return Q @ R, Q @ t + u


def correct_pose_vjp(R: Floats, t: Floats, w: Floats, v_R: Floats, v_t: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`correct_pose` with respect to w and u, [3] each.

    With J the left Jacobian of the rotation vector, ``dQ = [J dw]_x Q``; so ::

        v_Q = v_R' R^T + v_t' t^T,   M = v_Q Q^T
        v_w = J^T (M_21 - M_12, M_02 - M_20, M_10 - M_01),   v_u = v_t'
    """
    Q = Rotation.from_rotvec(w).as_matrix()
    M = (v_R @ R.T + np.outer(v_t, t)) @ Q.T
    v_turn = np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    return left_jacobian(w).T @ v_turn, v_t


def left_jacobian(w: Floats) -> Floats:
    """Return J [3, 3] with ``exp([w + dw]_x) = exp([J dw]_x) exp([w]_x)`` to first order.

    ``J = I + (1 - cos a) / a^2 [w]_x + (a - sin a) / a^3 [w]_x^2`` with the angle a = |w|.
    """
    angle = float(np.linalg.norm(w))
    x, y, z = w
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < LEAST_ANGLE:
        return np.eye(3) + W / 2 + W @ W / 6
    # 1 - cos a = 2 sin^2(a/2), without the difference of nearly equal numbers
    return (
        np.eye(3)
        + 2 * np.sin(angle / 2) ** 2 / angle**2 * W
        + (angle - np.sin(angle)) / angle**3 * W @ W  # six digits are left at the smallest angle, of a term of 1e-9
    )


def with_poses(inner: Renderer) -> Renderer:
    """Return a renderer that corrects the pose of a training view."""

    def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
        seen = view
        if _is_calibrated(model, view, ROTATIONS):
            R, t = correct_pose(
                view.camera.cam_from_world_R,
                view.camera.cam_from_world_t,
                model.shared[ROTATIONS][view.view_id],
                model.shared[SHIFTS][view.view_id],
            )
            seen = view._replace(camera=view.camera._replace(cam_from_world_R=R, cam_from_world_t=t))
        output, tape = inner.render(model, seen, request)
        rgb = inner.channels(request.wants)["rgb"]
        return output, _Tape(tape, model, view, output.image[..., rgb], rgb)

    def render_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        v = inner.render_vjp(tape.inner, v_image, v_alpha)
        if not _is_calibrated(tape.model, tape.view, ROTATIONS):
            return v
        camera, index = tape.view.camera, tape.view.view_id
        v_rotations, v_shifts = (np.zeros_like(tape.model.shared[name]) for name in (ROTATIONS, SHIFTS))
        v_rotations[index], v_shifts[index] = correct_pose_vjp(
            camera.cam_from_world_R,
            camera.cam_from_world_t,
            tape.model.shared[ROTATIONS][index],
            v.cam_from_world_R,
            v.cam_from_world_t,
        )
        return v._replace(shared={**v.shared, ROTATIONS: v_rotations, SHIFTS: v_shifts})

    return Renderer(f"{inner.name} with poses", render, render_vjp, inner.channels)


def _is_calibrated(model: Model, view: View, name: str) -> bool:
    """Whether the model has parameters of this name for the view."""
    return view.view_id >= 0 and name in model.shared


EXPOSURE = Calibration("exposure", no_exposures, with_exposures, Rates({EXPOSURES: LogLinear(1e-2, 1e-3, 30_000)}))
"""``exposure``."""

POSE = Calibration(
    "pose",
    no_corrections,
    with_poses,
    # A tenth of a pixel of 500 is 2e-4 radians; a shift of as much of the scene's extent moves the image about as far.
    Rates({ROTATIONS: LogLinear(5e-4, 5e-6, 30_000), SHIFTS: LogLinear(5e-4, 5e-6, 30_000)}, frozenset({SHIFTS})),
)
"""``pose``."""
