"""Hard cases of surfels: each has an answer that was worked out without the renderer's formulas.

A single disc in front of a simple camera, or a few, and one pixel to examine. Whatever the answer, all images and all
gradients have to be finite. Left out: rays that lie in the plane of a disc, of which rounding decides where they hit;
gsplat skips a hit whose p_2 is 0 exactly, and we leave the low-pass, which is the limit from both sides.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.mechanisms.surfels.gsplat_call import NAMES, rasterization_2dgs, rasterization_2dgs_vjp
from minisplat_ref.oracle import call_cases
from minisplat_ref.oracle.cases import Report
from minisplat_ref.types import Floats

SIZE = 32  # px
FOCAL = 32.0  # px; the principal point is (16.5, 16.5): the centre of pixel (16, 16) is on the axis
CENTER = SIZE // 2


class HardCase(NamedTuple):
    """Surfels, and the alpha and the median depth of some pixels."""

    name: str
    surfels: tuple[tuple[tuple[float, float, float], tuple[float, float, float, float], float, float], ...]
    """Mean, quaternion, scale and opacity of each."""
    alphas: Mapping[tuple[int, int], float]
    """By row and column."""
    medians: Mapping[tuple[int, int], float] = {}


FACING = (1.0, 0.0, 0.0, 0.0)
EDGE_ON = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # the normal is the world's x
GRAZING = (np.cos(0.775), 0.0, np.sin(0.775), 0.0)  # 88.8 degrees


def _low_pass(distance: float, opacity: float) -> float:
    """Return alpha at a distance, px, from the centre of a disc that no ray meets."""
    return opacity * float(np.exp(-(distance**2)))


def _meet_plane(opacity: float, scale: float, mean: Sequence[float], quat: Sequence[float], column: int) -> float:
    """Return alpha on the middle row where the ray meets the plane of a disc turned about y: one line of a triangle.

    The disc's first axis is (cos 2a, 0, -sin 2a). The ray x = z s meets it where ``m_x + t cos = s (m_z - t sin)``.
    """
    turn, s = 2 * np.arctan2(quat[2], quat[0]), (column - CENTER) / FOCAL
    t = (s * mean[2] - mean[0]) / (np.cos(turn) + s * np.sin(turn))
    return opacity * float(np.exp(-((t / scale) ** 2) / 2))


CASES = (
    HardCase("nothing to draw", (), {(CENTER, CENTER): 0.0}),
    HardCase(
        "a disc that faces the camera",
        (((0.0, 0.0, 4.0), FACING, 0.5, 0.8),),
        {(CENTER, CENTER): 0.8, (CENTER, CENTER + 4): 0.8 * float(np.exp(-0.5))},  # 4 px are one standard deviation
        {(CENTER, CENTER): 4.0},
    ),
    HardCase(
        "edge-on, the camera in its plane: p_2 = 0",
        (((0.0, 0.0, 4.0), EDGE_ON, 0.5, 0.8),),
        {(CENTER, CENTER): 0.8, (CENTER, CENTER + 1): _low_pass(1, 0.8), (CENTER + 1, CENTER - 1): 0.8 * np.exp(-2)},
        {(CENTER, CENTER): 4.0},
    ),
    HardCase(
        "at a grazing angle",
        (((0.5, 0.0, 4.0), GRAZING, 1.5, 0.9),),
        {(CENTER, CENTER + k): _meet_plane(0.9, 1.5, (0.5, 0, 4), GRAZING, CENTER + k) for k in (3, 6)},
    ),
    HardCase("behind the camera", (((0.0, 0.0, -4.0), FACING, 0.5, 0.8),), {(CENTER, CENTER): 0.0}),
    HardCase("before the near plane", (((0.0, 0.0, 0.005), FACING, 0.5, 0.8),), {(CENTER, CENTER): 0.0}),
    HardCase(
        "smaller than a pixel",
        (((0.0, 0.0, 4.0), FACING, 1e-9, 0.8),),
        {(CENTER, CENTER): 0.8, (CENTER, CENTER + 1): _low_pass(1, 0.8)},
    ),
    HardCase(
        "larger than the world",
        (((0.0, 0.0, 4.0), FACING, 1e6, 0.8),),
        {(0, 0): 0.8, (CENTER, CENTER): 0.8, (SIZE - 1, 3): 0.8},
    ),
    HardCase("an opaque disc is clamped", (((0.0, 0.0, 4.0), FACING, 5.0, 1.0),), {(CENTER, CENTER): 0.999}),
    HardCase(
        "the median where T is one half exactly",
        (((0.0, 0.0, 2.0), FACING, 1e6, 0.5), ((0.0, 0.0, 3.0), FACING, 1e6, 0.5)),
        {(CENTER, CENTER): 0.75},
        {(CENTER, CENTER): 2.0},  # T in front of the second is not above one half
    ),
    HardCase(
        "the median where T stays above one half",
        (((0.0, 0.0, 2.0), FACING, 1e6, 0.25), ((0.0, 0.0, 3.0), FACING, 1e6, 0.25)),
        {(CENTER, CENTER): 0.4375},
        {(CENTER, CENTER): 3.0},
    ),
    HardCase(
        "equal depths: the order of the rows",
        (((0.0, 0.0, 2.0), FACING, 1e6, 0.5), ((0.0, 0.0, 2.0), FACING, 1e6, 0.25)),
        {(CENTER, CENTER): 0.625},
        {(CENTER, CENTER): 2.0},
    ),
)


def select(pattern: str) -> tuple[HardCase, ...]:
    """Return the cases whose name holds a pattern; see :func:`minisplat_ref.oracle.call_cases.select`."""
    return call_cases.select(CASES, pattern)


def arguments_of(case: HardCase, dtype: str) -> dict[str, Any]:
    """Return the arguments of the call."""
    n = len(case.surfels)
    columns = [np.array([surfel[k] for surfel in case.surfels], dtype) for k in range(4)]
    K = np.array([[FOCAL, 0, CENTER + 0.5], [0, FOCAL, CENTER + 0.5], [0, 0, 1]], dtype)
    return {
        "means": columns[0].reshape(n, 3),
        "quats": columns[1].reshape(n, 4),
        "scales": np.repeat(columns[2].reshape(n, 1), 3, axis=1),
        "opacities": columns[3],
        "colors": np.linspace(0, 1, 3 * n, dtype=dtype).reshape(n, 3),
        "viewmats": np.eye(4, dtype=dtype)[None],
        "Ks": K[None],
        "width": SIZE,
        "height": SIZE,
        "render_mode": "RGB+ED",
        "distloss": True,
    }


def run_cases(cases: Sequence[HardCase] = CASES) -> Report:
    """Run cases; see :func:`minisplat_ref.oracle.call_cases.run_cases`."""
    return call_cases.run_cases("rasterization_2dgs", _run, cases)


def _run(case: HardCase, backend: str, dtype: str) -> tuple[float, bool]:
    arguments = arguments_of(case, dtype)
    images = dict(zip(NAMES, rasterization_2dgs(**arguments, backend=backend)[:6], strict=True))
    cotangents = {f"v_{name}": np.ones_like(image) for name, image in images.items()}
    gradients = rasterization_2dgs_vjp(**arguments, cotangents=cotangents, backend=backend)
    arrays: list[Floats] = [*images.values(), *gradients.values()]  # type: ignore[list-item]
    is_finite = all(np.isfinite(array).all() for array in arrays)
    errors = [
        *_errors(images["render_alphas"], case.alphas),
        *_errors(images["render_median"], case.medians),
    ]
    return max(errors), is_finite


def _errors(images: Any, known: Mapping[tuple[int, int], float]) -> list[float]:
    return [abs(float(images[0, row, column, 0]) - value) / max(value, 1) for (row, column), value in known.items()]
