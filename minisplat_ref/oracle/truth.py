"""A truth more precise than float64: quantities whose formulas lose digits, from their definitions and in 50 digits.

Nothing here is one of our formulas. A rotation is the sandwich product q v q*; a projected covariance uses the
numerical derivative of the camera's map itself; an inverse is a linear solve; the densest point of a ray is a minimum;
transmittance is a product. This gives error figures for the float64 reference, for the kernels with float32 data, which
project in float64, and for the textbook's formulas in float32, which are the reference on float32 data:
``R mu + t``, ``A Sigma A^T``, ``a c - b^2``.

A relative error is divided by the condition number of the quantity, the factor by which any formula may enlarge
the rounding of its input: for positions the distance to the world's origin over the depth, for conics that times the
condition number of the projected covariance.
"""

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.tolerances import TRUTH_FLOAT32, TRUTH_FLOAT64
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering.backends import CPU, CPU_EXACT, REFERENCE, Backend
from minisplat_ref.types import Camera, Floats, Projection, TileGrid

DIGITS = 50
SEED = 20240229
N_GAUSSIANS = 24
N_LAYERS = 40

Matrix = Any
"""A matrix of mpmath."""


class View(NamedTuple):
    """Gaussians and a camera, in numbers that are exact in float32 except for the camera's t, which is float64."""

    name: str
    means: Floats
    quats: Floats
    scales: Floats
    camera: Camera


def check_truth() -> Report:
    """Compare reference and kernels with the truth.

    Returns
    -------
    Report
        For each quantity: the largest errors of the float64 reference, of the float32 kernels and of the textbook's
        formulas in float32; how many times the kernels are better; and their errors over the condition number, which
        are judged.

    Raises
    ------
    InputError
        If mpmath is not installed.
    """
    _mpmath()
    cases = [case for view in views() for case in _view_cases(view)]
    settings = {"digits": DIGITS, "gaussians": N_GAUSSIANS, "layers": N_LAYERS, "seed": SEED}
    return Report("relative errors against 50 digits", (*cases, *_transmittance_cases()), settings)


def views() -> tuple[View, ...]:
    """Return ordinary Gaussians, needles with an axis ratio of 3000, and the ordinary ones 1e6 units away."""
    rng = np.random.default_rng(SEED)
    z = rng.uniform(2, 4, size=N_GAUSSIANS)
    means = np.column_stack([rng.uniform(-0.25, 0.25, size=(N_GAUSSIANS, 2)) * z[:, None], z])
    quats = _round_to_float32(rng.normal(size=(N_GAUSSIANS, 4)))
    scales = _round_to_float32(np.exp(rng.uniform(np.log(0.03), np.log(0.3), size=(N_GAUSSIANS, 3))))
    needles = scales.copy()
    needles[:, 0], needles[:, 1:] = 3.0, 1e-3
    far = np.array([1e6, -5e5, 2.5e5])
    return (
        View("ordinary", _round_to_float32(means), quats, scales, _camera(np.zeros(3))),
        View("needles", _round_to_float32(means), quats, _round_to_float32(needles), _camera(np.zeros(3))),
        View("far world", _round_to_float32(means + far), quats, scales, _camera(far)),
    )


def true_rotation(quat: Floats) -> Matrix:
    """Return the matrix whose columns are the axes rotated by ``q v q* / |q|^2``, in the algebra of quaternions."""
    mp = _mpmath()
    q = [mp.mpf(float(x)) for x in quat]
    columns = [
        _product(_product(q, [0, *(int(i == k) for i in range(3))]), [q[0], -q[1], -q[2], -q[3]])[1:] for k in range(3)
    ]
    return mp.matrix(columns).T / sum(x * x for x in q)


def true_covariance(quat: Floats, scales: Floats) -> Matrix:
    """Return the second moment of ``sum_k s_k z_k r_k`` with independent unit normal z: ``sum_k s_k^2 r_k r_k^T``."""
    mp = _mpmath()
    R = true_rotation(quat)
    return sum((mp.mpf(float(s)) ** 2 * R[:, k] * R[:, k].T for k, s in enumerate(scales)), mp.zeros(3, 3))


def true_projection(mean: Floats, Sigma: Matrix, camera: Camera) -> tuple[Matrix, Matrix]:
    """Return the pixel [2] of a point, and the covariance [2, 2] with the low-pass, from the map's derivative."""
    mp = _mpmath()

    def pixel(*point: Any) -> Matrix:
        x, y, z = mp.matrix(camera.cam_from_world_R) * mp.matrix(point) + mp.matrix(camera.cam_from_world_t)
        return mp.matrix([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])

    at = [mp.mpf(float(x)) for x in mean]
    A = mp.matrix(2, 3)
    for row in range(2):
        for column in range(3):
            order = tuple(int(column == k) for k in range(3))
            A[row, column] = mp.diff(lambda *point, row=row: pixel(*point)[row], at, order)
    return pixel(*at), A * Sigma * A.T + mp.mpf(GSPLAT_MAIN.eps2d) * mp.eye(2)


def true_transmittance(means2d: Floats, conics: Floats, opacities: Floats, center: Floats) -> Any:
    """Return the product of ``1 - o exp(-d^T Q d / 2)`` over all Gaussians at one pixel centre."""
    mp = _mpmath()
    T = mp.mpf(1)
    for mean, (a, b, c), opacity in zip(means2d, conics, opacities, strict=True):
        d = mp.matrix([mp.mpf(float(m)) - mp.mpf(float(p)) for m, p in zip(mean, center, strict=True)])
        square = (d.T * mp.matrix([[a, b], [b, c]]) * d)[0]
        T *= 1 - mp.mpf(float(opacity)) * mp.exp(-square / 2)
    return T


def _view_cases(view: View) -> Iterator[Case]:
    mp = _mpmath()
    true_Sigmas = [true_covariance(q, s) for q, s in zip(view.quats, view.scales, strict=True)]
    if view.name != "far world":  # the same covariances as of the ordinary view
        errors = [
            _errors(Sigma, got) for Sigma, got in zip(true_Sigmas, covariances(view.quats, view.scales), strict=True)
        ]
        yield _case(f"covariance, {view.name}", np.ones(N_GAUSSIANS), np.array(errors))

    truths = [true_projection(mean, Sigma, view.camera) for mean, Sigma in zip(view.means, true_Sigmas, strict=True)]
    depths = (view.means @ view.camera.cam_from_world_R.T + view.camera.cam_from_world_t)[:, 2]
    reach = 1 + np.linalg.norm(view.means, axis=1) / depths
    stretch = reach * [float(mp.cond(B)) for _, B in truths]
    results = [_project(b, view, dtype) for b, dtype in ((REFERENCE, float), (CPU, "f4"), (REFERENCE, "f4"))]

    pixels = [[_errors(p, got) for (p, _), got in zip(truths, result.means2d, strict=True)] for result in results]
    yield _case(f"means2d, {view.name}", reach, *np.array(pixels))
    inverses = [mp.inverse(B) for _, B in truths]
    conics = [
        [_errors(Q, [[a, b], [b, c]]) for Q, (a, b, c) in zip(inverses, result.conics, strict=True)]
        for result in results
    ]
    yield _case(f"conics, {view.name}", stretch, *np.array(conics))


def _transmittance_cases() -> Iterator[Case]:
    rng = np.random.default_rng(SEED)
    n, center = N_LAYERS, np.array([4.5, 4.5])
    means2d = _round_to_float32(center + rng.uniform(-1, 1, size=(n, 2)))
    conics = _round_to_float32(
        np.column_stack([rng.uniform(0.1, 0.4, n), rng.uniform(-0.08, 0.08, n), rng.uniform(0.1, 0.4, n)])
    )
    opacities = _round_to_float32(rng.uniform(0.1, 0.6, size=n))
    truth = true_transmittance(means2d, conics, opacities, center)
    conventions = GSPLAT_MAIN._replace(transmittance_min=0.0)  # no pixel is finished

    def error(backend: Backend, dtype: Any) -> float:
        fields = (x.astype(dtype) for x in (means2d, np.arange(1.0, n + 1), conics, opacities))
        boxes = np.tile(np.array([0, 0, 9, 9], np.int32), (n, 1))
        projection = Projection._make([*fields, np.full((n, 2), 9, np.int32), boxes])
        bins = backend.bin_gaussians(projection, TileGrid(9, 9, backend.tile_width, backend.tile_height), conventions)
        # Only the background is not black: the image is the transmittance, without the rounding of 1 - alpha.
        output = backend.composite(projection, np.zeros((n, 1), dtype), np.ones(1, dtype), bins, conventions)
        return _errors([truth], output.image[4, 4])

    reference, *kernels = (error(b, dtype) for b, dtype in ((REFERENCE, float), (CPU, "f4"), (CPU_EXACT, "f4")))
    condition = np.array([float(n)])  # of a product of n factors
    for exponential, kernel in zip(("cpu's exp", "libm's exp"), kernels, strict=True):
        yield _case(f"transmittance, {exponential}", condition, np.array([reference]), np.array([kernel]))


def _case(
    name: str, condition: Floats, reference: Floats, kernel: Floats | None = None, textbook: Floats | None = None
) -> Case:
    """Judge errors [n] of the reference and, if there is one, of the float32 kernel, each divided by its condition."""
    judged = {"f64 / condition": (float((reference / condition).max()), TRUTH_FLOAT64)}
    if kernel is not None:
        judged["f32 / condition"] = float((kernel / condition).max()), TRUTH_FLOAT32
    figures: dict[str, Figure] = {
        "reference f64": float(reference.max()),
        "cpu f32": None if kernel is None else float(kernel.max()),
        "textbook f32": None if textbook is None else float(textbook.max()),
        "gain": None if kernel is None or textbook is None else float(textbook.max() / kernel.max()),
        "condition": float(condition.max()),
        **{heading: error for heading, (error, _) in judged.items()},
    }
    problems = [f"{heading} is above {limit:g}" for heading, (error, limit) in judged.items() if not error <= limit]
    return Case(name, not problems, figures, "; ".join(problems))


def _project(backend: Backend, view: View, dtype: Any) -> Projection:
    means, quats, scales = (x.astype(dtype) for x in (view.means, view.quats, view.scales))
    return backend.project(means, quats, scales, np.full(N_GAUSSIANS, 0.5, dtype), view.camera, GSPLAT_MAIN)


def _errors(truth: Any, got: Any) -> float:
    """Return the largest difference, relative to the largest true entry, computed in 50 digits."""
    mp = _mpmath()
    truth, got = list(truth), [mp.mpf(float(x)) for x in np.ravel(got)]
    return float(max(abs(t - g) for t, g in zip(truth, got, strict=True)) / max(map(abs, truth)))


def _product(p: list[Any], q: list[Any]) -> list[Any]:
    """Return the product of two quaternions wxyz, from ``i^2 = j^2 = k^2 = i j k = -1``."""
    a, b, c, d = p
    e, f, g, h = q
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]


def _camera(offset: Floats) -> Camera:
    """Return a rotated camera near ``offset``, whose centre float32 holds exactly."""
    R = np.array([[float(x) for x in row] for row in true_rotation(np.array([1, 0.1, -0.07, 0.05])).tolist()])
    center = offset + np.array([0.25, -0.125, 0.0625])
    return Camera(R, -R @ center, 500.0, 480.0, 530.0, 435.0, 1040, 880)


def _round_to_float32(array: Floats) -> Floats:
    return array.astype(np.float32).astype(np.float64)


@functools.cache
def _mpmath() -> Any:
    """Return a context of mpmath with its own precision."""
    try:
        from mpmath.ctx_mp import MPContext
    except ImportError as error:
        raise InputError("mpmath is not installed; install the extra: pip install 'minisplat_ref[peers]'") from error
    context = MPContext()
    context.dps = DIGITS
    return context
