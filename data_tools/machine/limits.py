"""Single stages on 200,000 Gaussians, and Adam against a copy."""

from collections.abc import Callable, Sequence

import numpy as np

from data_tools.machine.contests import Contest, in_ms
from minisplat_ref.bench.interleaving import Task, Times
from minisplat_ref.bench.workloads import synth
from minisplat_ref.constants import GSPLAT_MAIN, SH_DEGREE_MAX
from minisplat_ref.jit.compile import kernel, prange
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.oracle.tolerances import BENCH_FLOAT32_GRADIENT
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU, REFERENCE, Backend
from minisplat_ref.training.adam import AdamRule, adam_step, zero_moments
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Ints, Primitives, ProjectionGradient

N = 200_000
SH_COEFFICIENTS = 16  # degree 3
IMAGE_SHAPE = (270, 480, 3)
WIDTHS = (3, 4, 3, 1, 3, 45)  # numbers per Gaussian of degree 3, field by field
ADAM_ARRAYS = 7  # values, gradient and both moments are read, all but the gradient are written
COPY_TRANSFERS = 3  # a number is read and written, and the overwritten cache line is read first
COPY_CHUNKS = 64
VISIBLE_SHARE = 0.3


@kernel()
def _copy(  # type: ignore[no-untyped-def]
    source,  # [n]
    target,  # [n]
):
    for chunk in prange(COPY_CHUNKS):
        first, end = source.size * chunk // COPY_CHUNKS, source.size * (chunk + 1) // COPY_CHUNKS
        target[first:end] = source[first:end]


def stages() -> list[Contest]:
    """Return contests of projection with colours, tile lists and the loss in float32, each with its error.

    Returns
    -------
    list of Contest
        A case fails if its result differs from the reference's, in float64 on the same numbers.
    """
    return [_projection(), _lists(), _loss()]


def adams() -> list[Contest]:
    """Return contests of Adam on Gaussians of 59 numbers against a copy that moves as many bytes.

    One updates all of them, one a random part, like a view that sees few; only the rows of that part count as moved.
    """
    is_seen = np.random.default_rng(5).random(N) < VISIBLE_SHARE
    return [
        _adam(f"roof/adam {N:,}", np.ones(N, bool), False),
        _adam(f"roof/adam {VISIBLE_SHARE:.0%} of {N:,}", is_seen, True),
    ]


def _adam(name: str, is_seen: Bools, is_visible_only: bool) -> Contest:
    gaussians, gradient = (Gaussians._make(np.full((N, w), 0.5, np.float32) for w in WIDTHS) for _ in range(2))
    state, rule, rows = zero_moments(gaussians), AdamRule(is_visible_only, False), np.flatnonzero(is_seen)
    n_numbers = ADAM_ARRAYS * len(rows) * sum(WIDTHS)
    n_bytes = 4 * n_numbers
    source = np.ones(n_numbers // COPY_TRANSFERS, np.float32)
    target = np.empty_like(source)

    def judge(times: Sequence[Times]) -> list[Case]:
        step, copy = times
        figures: dict[str, Figure] = {
            **in_ms(step),
            "GB/s": n_bytes / step.minimum / 1e9,
            "copy GB/s": n_bytes / copy.minimum / 1e9,
            "x copy": step.minimum / copy.minimum,
        }
        has_moved = all(np.array_equal((field < 0.5).all(axis=1), is_seen) for field in gaussians)
        passed = has_moved and bool((target == 1).all())
        return [Case(name, passed, figures, "" if passed else "other rows were updated than should be")]

    def step() -> None:
        adam_step(gaussians, gradient, state, dict.fromkeys(Gaussians._fields, 1e-3), rule, rows)

    return Contest((step, lambda: _copy(source, target)), judge)


def _projection() -> Contest:
    workload = synth(N)
    rng = np.random.default_rng(3)
    sh_rest = (0.1 * rng.normal(size=(N, SH_COEFFICIENTS - 1, 3))).astype(np.float32).astype(np.float64)
    exact = workload.gaussians._replace(sh_rest=sh_rest)
    single = _float32(exact)
    weights = [rng.normal(size=(N, *shape)) for shape in ((2,), (), (3,), (), (3,))]
    camera = workload.camera
    reference, cpu = (_project_and_shade(*pair, camera, weights)() for pair in ((REFERENCE, exact), (CPU, single)))
    rows = (reference[0][:, 0] > 0) & (cpu[0][:, 0] > 0)  # those at the edge of being culled are not compared
    pairs = zip(reference[1:], cpu[1:], strict=True)
    error = max(float(np.linalg.norm(b[rows] - a[rows]) / np.linalg.norm(a[rows])) for a, b in pairs)
    task = _project_and_shade(CPU, single, camera, weights)
    return _contest("project and SH, both ways", (task,), error, BENCH_FLOAT32_GRADIENT)


def _project_and_shade(
    backend: Backend, g: Gaussians, camera: Camera, weights: Sequence[Floats]
) -> Callable[[], tuple[Ints, Floats, Floats, Floats, Floats, Floats]]:
    """Return a task; activations and its cotangents, ``weights`` on the visible Gaussians, are made beforehand.

    The task returns radii, then centres, colours and gradients with respect to means, scales and SH.
    """
    primitives = Primitives(g.means, g.quats, np.exp(g.log_scales), 1 / (1 + np.exp(-g.opacity_logits)))
    is_visible = backend.project(*primitives, camera, GSPLAT_MAIN).radii[:, 0] > 0
    v = [np.where(is_visible.reshape(-1, *[1] * (w.ndim - 1)), w, 0) for w in weights]
    # The kernels return and take conics in float64, whatever the data.
    dtypes = [g.means.dtype if backend is REFERENCE or k != 2 else np.float64 for k in range(len(v))]
    v = [array.astype(dtype) for array, dtype in zip(v, dtypes, strict=True)]

    def task() -> tuple[Ints, Floats, Floats, Floats, Floats, Floats]:
        projection = backend.project(*primitives, camera, GSPLAT_MAIN)
        sh = (g.means, g.sh_dc, g.sh_rest, camera, SH_DEGREE_MAX, projection.radii)
        colors = backend.sh_colors(*sh)
        v_sh = backend.sh_colors_vjp(*sh, v[4])
        v_primitives = backend.project_vjp(*primitives, camera, GSPLAT_MAIN, projection, ProjectionGradient(*v[:4]))
        return projection.radii, projection.means2d, colors, v_primitives.means, v_primitives.scales, v_sh.sh_rest

    return task


def _lists() -> Contest:
    workload = synth(N)
    tape = render(_float32(workload.gaussians), workload.camera)[1].splats
    projection, grid = tape.projection, tape.bins.grid
    # The reference lists more pairs; those that the kernels leave out must not change the image.
    longer = REFERENCE.bin_gaussians(projection, grid, GSPLAT_MAIN)
    image = CPU.composite(projection, tape.channels, tape.background, longer, GSPLAT_MAIN).image
    error = float(np.abs(image - tape.output.image).max())
    tasks = (
        lambda: CPU.bin_gaussians(projection, grid, GSPLAT_MAIN),
        lambda: np.argsort(projection.depths, kind="stable"),
    )
    return _contest("sort and bin", tasks, error, 0.0, "argsort alone")


def _loss() -> Contest:
    rng = np.random.default_rng(4)
    image, target = (rng.random(IMAGE_SHAPE).astype(np.float32) for _ in range(2))

    def gradient(backend: Backend, image: Floats, target: Floats) -> Floats:
        return backend.photometric_loss_vjp(backend.photometric_loss(image, target, 1.0)[1])

    exact = gradient(REFERENCE, image.astype(np.float64), target.astype(np.float64))
    error = float(np.linalg.norm(gradient(CPU, image, target) - exact) / np.linalg.norm(exact))
    return _contest("D-SSIM, both ways", (lambda: gradient(CPU, image, target),), error, BENCH_FLOAT32_GRADIENT)


def _contest(name: str, tasks: tuple[Task, ...], error: float, bound: float, other: str = "") -> Contest:
    """Return the contest of a stage whose error is known; ``other`` names what it is compared with, if anything."""
    note = "" if error <= bound else f"off by {error:.1e}, more than {bound:.1e}"

    def judge(times: Sequence[Times]) -> list[Case]:
        others: dict[str, Figure] = {f"{other} ms": 1e3 * own.minimum for own in times[1:]}
        return [Case(f"stage/{name}", not note, {**in_ms(times[0]), **others, "error": error}, note)]

    return Contest(tasks, judge)


def _float32(gaussians: Gaussians) -> Gaussians:
    return Gaussians._make(field.astype(np.float32) for field in gaussians)
