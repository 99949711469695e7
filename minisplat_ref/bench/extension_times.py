"""The time of an extension's renderer, forward and backward on both backends, with its error.

The truth is its own result on the reference in float64. Beside it are the renderer of 3DGS by the plain kernels, which
an extension's response runs in, by the tuned ones and by the textbook loop, on the same Gaussians, with errors against
3DGS's own reference.

In float32 a hit may fall on the other side of a threshold, and two hits of nearly one depth change places. A user's
renderer does not report its thresholds, so such pixels cannot be set aside one by one: judged are the fraction of
pixels that are off, and the root mean square error over the others.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.bench.interleaving import Times, measure_seconds, time_interleaved
from minisplat_ref.bench.textbook import TEXTBOOK
from minisplat_ref.bench.workloads import Workload
from minisplat_ref.extensions.extension import CORE, Extension
from minisplat_ref.oracle.cases import Case
from minisplat_ref.oracle.tolerances import BENCH_FLOAT32_IMAGE, BENCH_FLOAT64, BENCH_OFF_PIXELS
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, PLAIN, REFERENCE, Backend
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View

MILLI = 1e3
BASELINE = "3DGS, textbook float32"


class Row(NamedTuple):
    """A renderer in one precision."""

    name: str
    extension: Extension
    backend: Backend
    dtype: type[np.floating]


class Answer(NamedTuple):
    """The forward and backward pass that a row times."""

    image: Floats
    gradient: dict[str, Floats]
    """By the fields of the population and the shared parameters."""


def extension_cases(
    extension: Extension, workload: Workload, repeats: int, report: Callable[[str], None] = lambda _: None
) -> list[Case]:
    """Time a renderer and measure its errors.

    Parameters
    ----------
    extension : Extension
    workload : Workload
        Its Gaussians become the extension's population.
    repeats : int
        Turns of each row; the references, which give the answers, take one.
    report : callable
        Called with a line about the current step.

    Returns
    -------
    list of Case
        One per row.
    """
    f32, f64, name = np.float32, np.float64, extension.name
    kernels = [
        Row(f"{name}, cpu float64", extension, CPU, f64),
        Row(f"{name}, cpu float32", extension, CPU, f32),
        Row("3DGS, plain float32", CORE, PLAIN, f32),
        Row("3DGS, cpu float32", CORE, CPU, f32),
        Row(BASELINE, CORE, TEXTBOOK, f32),
    ]
    references = [
        Row(f"{owner}, reference float64", e, REFERENCE, f64) for owner, e in ((name, extension), ("3DGS", CORE))
    ]
    answers, own_times = {}, {}
    for row in references:
        report(f"{workload.name}: {row.name}")
        steps: _Steps = _Steps(row, workload)
        own_times[row.name] = (
            Times(*[measure_seconds(steps.forward)] * 2),
            Times(*[measure_seconds(steps.backward)] * 2),
        )
        answers[row.extension.name] = steps.answer()
    report(f"{workload.name}: {len(kernels)} renderers, interleaved")
    tasks = [_Steps(row, workload) for row in kernels]
    times = time_interleaved([[s.forward for s in tasks], [s.backward for s in tasks]], repeats, 1)
    of = {row.name: pair for row, *pair in zip(kernels, *times, strict=True)}
    baseline = sum(time.minimum for time in of[BASELINE])
    cases = [_case(workload, row, own_times[row.name], None, baseline) for row in references]
    for row, steps in zip(kernels, tasks, strict=True):
        errors = _errors(steps.answer(), answers[row.extension.name])
        cases.append(_case(workload, row, of[row.name], errors, baseline))
    return cases


class _Steps:
    """A row on a workload: its forward pass, and the backward pass of the latest forward pass."""

    def __init__(self, row: Row, workload: Workload) -> None:
        gaussians = Gaussians._make(field.astype(row.dtype) for field in workload.gaussians)
        representation, rng = row.extension.representation, np.random.default_rng(0)
        camera, gray = workload.camera, np.full((len(gaussians.means), 3), 128, np.uint8)
        photograph = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._view = View("bench", camera, photograph, None, view_id=0)
        scene = Scene("bench", (self._view,), (), workload.gaussians.means, gray, np.zeros(3), extent=1.0)
        shared = {name: np.asarray(array, row.dtype) for name, array in representation.shared(scene, rng).items()}
        populate = row.extension.sample or representation.extend
        self._model = Model(populate(gaussians, rng), shared)
        self._renderer, self._v_image = representation.renderer, workload.v_image.astype(row.dtype)
        self._request = Request(np.zeros(3, row.dtype), backend=row.backend)
        self._drawn: Any = None

    def forward(self) -> None:
        self._drawn = self._renderer.render(self._model, self._view, self._request)

    def backward(self) -> Any:
        return self._renderer.render_vjp(self._drawn[1], self._v_image, None)

    def answer(self) -> Answer:
        v = self.backward()
        return Answer(self._drawn[0].image[..., :3], {**v.gaussians._asdict(), **v.shared})


class _Errors(NamedTuple):
    image_max: float
    off: float  # part of the pixels beyond float32's error
    image_rms: float  # of the others
    gradient: float  # relative L2, of the worst parameter


def _errors(found: Answer, expected: Answer) -> _Errors:
    error = np.nan_to_num(np.abs(found.image - expected.image).max(axis=2), nan=np.inf)  # [H, W]
    is_off = error > BENCH_FLOAT32_IMAGE
    gradients = [
        float(np.linalg.norm(found.gradient[name] - v) / np.linalg.norm(v))
        for name, v in expected.gradient.items()
        if np.any(v)
    ]
    rms = float(np.sqrt(np.mean(error[~is_off] ** 2))) if not is_off.all() else np.inf
    return _Errors(float(error.max()), float(is_off.mean()), rms, max(gradients, default=0.0))


def _case(workload: Workload, row: Row, times: Sequence[Times], errors: _Errors | None, baseline: float) -> Case:
    forward, backward = times
    wrong = ""
    if errors is not None and row.dtype == np.float64:
        worst = max(errors.image_max, errors.gradient)
        wrong = "" if worst <= BENCH_FLOAT64 else f"off by {worst:.1e}, more than {BENCH_FLOAT64:.1e}"
    elif errors is not None and errors.off > BENCH_OFF_PIXELS:
        wrong = f"{errors.off:.1%} of the pixels are off by more than {BENCH_FLOAT32_IMAGE:.1e}"
    figures = {
        "forward (ms)": MILLI * forward.median,
        "backward (ms)": MILLI * backward.median,
        "least of both (ms)": MILLI * (forward.minimum + backward.minimum),
        "x textbook": baseline / (forward.minimum + backward.minimum),
        "image max": errors.image_max if errors else None,
        "pixels off (%)": 100 * errors.off if errors else None,
        "RMS of the others": errors.image_rms if errors else None,
        "gradient": errors.gradient if errors else None,
    }
    return Case(f"{workload.name}: {row.name}", not wrong, dict(figures), wrong)
