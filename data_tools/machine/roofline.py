"""The processor's limit: compare the blending kernels with straight-line loops.

The straight-line loops do the arithmetic of one hit on all pixels of a tile, over and over on the same numbers: without
lists, sorting, memory accesses or branches. A kernel that took no longer per evaluation would be perfect. They run on
as many threads as the kernels, one copy on each, because cores that share a clock or execution units with each other,
or with other programs, slow down both. An *evaluation* is that of one Gaussian at one pixel, in one of the rows of
eight that a kernel computes: those that the visible ellipse reaches and that are not finished.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from data_tools.machine.contests import Contest, in_ms
from minisplat_ref.bench.interleaving import Times
from minisplat_ref.bench.worked_rows import count_worked_rows
from minisplat_ref.bench.workloads import Workload
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.cpu.compositing.exponential import exp_fast
from minisplat_ref.cpu.compositing.tile_rows import (
    ALPHAS,
    SCRATCH_SIZE,
    mean_offset_y,
    ridge_offsets,
    row_sigma,
    start_scratch,
    write_lines,
)
from minisplat_ref.cpu.compositing.tile_state import N_ROWS, pack_frame, start_tile
from minisplat_ref.cpu.tiling import TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, load, reduce_sum, select, store
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.oracle.tolerances import BENCH_FLOAT32_GRADIENT, BENCH_FLOAT32_IMAGE
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.scalar.compositing import blend, conic_vjp_of_moments, factors, sigma_vjp
from minisplat_ref.types import CompositeGradient, Floats, Gaussians, Projection, TileGrid

N_HITS = 100  # of opacity 0.005: they leave transmittance 0.6, so that no pixel is finished
N_PASSES = 50
N_SUMS = 9
SUMS_SIZE = 16  # so that no two copies write to the same cache line
N_COLORS = 3
DRAWN_FIELDS = 1 + N_COLORS  # of a pixel: transmittance, colours
SHADED_FIELDS = 2 + N_COLORS  # of a pixel: transmittance, part behind the hit, v


class Hit(NamedTuple):
    """The one Gaussian of the straight-line loops, float32."""

    x: np.float32
    y: np.float32
    half_a: np.float32
    slope: np.float32
    half_pivot: np.float32
    opacity: np.float32
    red: np.float32
    green: np.float32
    blue: np.float32


@scalar
def _forward_line(drawn, hit, frame, n_hits, n_passes):  # type: ignore[no-untyped-def]
    state, scratch = np.empty(drawn.size, drawn.dtype), np.empty(SCRATCH_SIZE, drawn.dtype)
    start_scratch(scratch)
    for _ in range(n_passes):
        start_tile(state, 0, 0, frame, DRAWN_FIELDS)
        for _ in range(n_hits):
            write_lines(scratch, hit.x, hit.y, hit.slope, hit.half_pivot)
            for row in range(N_ROWS):
                alpha = hit.opacity * exp_fast(-row_sigma(scratch, row, hit.half_a))
                store(scratch, ALPHAS + row * WIDTH, alpha)
            for row in range(N_ROWS):
                i = row * DRAWN_FIELDS * WIDTH
                after, weight = blend(load(state, i), load(scratch, ALPHAS + row * WIDTH), frame)
                store(state, i, after)
                store(state, i + WIDTH, load(state, i + WIDTH) + weight * hit.red)
                store(state, i + 2 * WIDTH, load(state, i + 2 * WIDTH) + weight * hit.green)
                store(state, i + 3 * WIDTH, load(state, i + 3 * WIDTH) + weight * hit.blue)
    drawn[:] = state


@kernel()
def _forward_lines(drawn, hit, frame, n_hits, n_passes):  # type: ignore[no-untyped-def]
    for copy in prange(len(drawn)):
        _forward_line(drawn[copy], hit, frame, n_hits, n_passes)


@scalar
def _backward_line(fresh, hit, frame, sums, n_hits, n_passes):  # type: ignore[no-untyped-def]
    state, scratch = np.empty(fresh.size, fresh.dtype), np.empty(SCRATCH_SIZE, fresh.dtype)
    start_scratch(scratch)
    zero = broadcast(ZERO * hit.x)
    for _ in range(n_passes):
        state[:] = fresh
        sums[:] = ZERO
        for _ in range(n_hits):
            write_lines(scratch, hit.x, hit.y, hit.slope, hit.half_pivot)
            for row in range(N_ROWS):
                alpha = hit.opacity * exp_fast(-row_sigma(scratch, row, hit.half_a))
                store(scratch, ALPHAS + row * WIDTH, alpha)
            q_sum = qe = qy = qee = qey = qyy = v_red = v_green = v_blue = zero
            for row in range(N_ROWS):
                i = row * SHADED_FIELDS * WIDTH
                e, dy = ridge_offsets(scratch, row), mean_offset_y(scratch, row)
                unclamped = load(scratch, ALPHAS + row * WIDTH)
                transmittance = load(state, i)
                after, weight = blend(transmittance, unclamped, frame)
                store(state, i, after)
                v_0, v_1, v_2 = load(state, i + 2 * WIDTH), load(state, i + 3 * WIDTH), load(state, i + 4 * WIDTH)
                v_red = v_red + weight * v_0
                v_green = v_green + weight * v_1
                v_blue = v_blue + weight * v_2
                shade = v_0 * hit.red + v_1 * hit.green + v_2 * hit.blue
                behind = load(state, i + WIDTH) - weight * shade
                store(state, i + WIDTH, behind)
                q = sigma_vjp(transmittance, weight, unclamped, behind, shade, frame)
                q_mean = select(unclamped <= frame.mean_gradient_max, q, ZERO)
                q_shape = select(unclamped <= frame.shape_gradient_max, q, ZERO)
                q_sum = q_sum + q_shape
                qe = qe + q_mean * e
                qy = qy + q_mean * dy
                qee = qee + q_shape * e * e
                qey = qey + q_shape * e * dy
                qyy = qyy + q_shape * dy * dy
            parts = (q_sum, qe, qy, qee, qey, qyy, v_red, v_green, v_blue)
            for j in range(N_SUMS):
                sums[j] += reduce_sum(parts[j])


@kernel()
def _backward_lines(fresh, hit, frame, sums, n_hits, n_passes):  # type: ignore[no-untyped-def]
    for copy in prange(len(sums)):
        _backward_line(fresh, hit, frame, sums[copy], n_hits, n_passes)


def blending(workload: Workload) -> Contest:
    """Return the contest between the blending kernels, in float32 on a workload, and the straight-line loops.

    Returns
    -------
    Contest
        Forward and backward. A case fails if its straight-line loop does not reproduce the reference.
    """
    gaussians = Gaussians._make(field.astype(np.float32) for field in workload.gaussians)
    output, tape = render(gaussians, workload.camera, with_stats=True)
    splats = tape.splats
    inputs = (splats.projection, splats.channels, splats.background, splats.bins, GSPLAT_MAIN)
    v_image, v_alpha = workload.v_image.astype(np.float32), np.zeros(output.alpha.shape, np.float32)
    lines = StraightLines(n_threads())
    n_evaluations = WIDTH * count_worked_rows(splats.projection, splats.channels, splats.bins)
    assert output.stats is not None
    n_hits = int(output.stats.hit_count.sum())

    def judge(times: Sequence[Times]) -> list[Case]:
        cases = []
        for name, own, line, error, bound in (
            ("forward", times[0], times[1], lines.image_error(), BENCH_FLOAT32_IMAGE),
            ("backward", times[2], times[3], lines.gradient_error(), BENCH_FLOAT32_GRADIENT),
        ):
            own_time, roof = own.minimum * n_threads() / n_evaluations, line.minimum * n_threads() / lines.n_evaluations
            figures: dict[str, Figure] = {
                **in_ms(own),
                "million hits": n_hits / 1e6,
                "million evaluations": n_evaluations / 1e6,
                "million evaluations/s": n_evaluations / own.minimum / 1e6,
                "ns per evaluation and core": 1e9 * own_time,
                "straight line ns": 1e9 * roof,
                "x straight line": own_time / roof,
            }
            note = "" if error <= bound else f"the straight-line loop is off by {error:.1e}"
            cases.append(Case(f"roof/{workload.name} {name}", not note, figures, note))
        return cases

    tasks = (
        lambda: CPU.composite(*inputs),
        lines.forward,
        lambda: CPU.composite_vjp(*inputs, output, v_image, v_alpha),
        lines.backward,
    )
    return Contest(tasks, judge)


class StraightLines:
    """The loops on copies of one tile, and the same hits for the reference."""

    def __init__(self, n_copies: int) -> None:
        f32 = np.float32
        grid = TileGrid(TILE_WIDTH, TILE_HEIGHT, TILE_WIDTH, TILE_HEIGHT)
        mean, conic, opacity, color = (3.5, 8.25), (4e-3, 1e-3, 3e-3), 5e-3, (0.9, 0.5, 0.2)  # alpha > 1/255 everywhere
        a, slope, pivot = factors(*conic)
        self.hit = Hit(*map(f32, (*mean, a / 2, slope, pivot / 2, opacity, *color)))
        n = N_HITS
        self.projection = Projection(
            means2d=np.tile(mean, (n, 1)),
            depths=np.arange(1.0, n + 1),
            conics=np.tile(conic, (n, 1)),
            opacities=np.full(n, opacity),
            radii=np.full((n, 2), 99, np.int32),
            boxes=np.tile(np.array([0, 0, TILE_WIDTH, TILE_HEIGHT], np.int32), (n, 1)),
        )
        self.colors, self.background = np.tile(color, (n, 1)), np.zeros(3)
        self.bins = REFERENCE.bin_gaussians(self.projection, grid, GSPLAT_MAIN)
        self.frame = pack_frame(self.bins.grid, GSPLAT_MAIN, np.dtype(f32))
        self.expected = REFERENCE.composite(self.projection, self.colors, self.background, self.bins, GSPLAT_MAIN)
        self.v_image = np.random.default_rng(2).normal(size=self.expected.image.shape).astype(f32)
        self.drawn = np.zeros((n_copies, N_ROWS, DRAWN_FIELDS, WIDTH), f32)
        self.fresh = np.zeros((N_ROWS, SHADED_FIELDS, WIDTH), f32)
        self.fresh[:, 0] = 1
        self.fresh[:, 1] = _by_rows((self.v_image * self.expected.image).sum(axis=2, keepdims=True))[:, 0]
        self.fresh[:, 2:] = _by_rows(self.v_image)
        self.sums = np.zeros((n_copies, SUMS_SIZE), np.float64)
        self.n_evaluations = n_copies * N_PASSES * N_HITS * N_ROWS * WIDTH

    def forward(self) -> None:
        """Draw the tile, many times."""
        _forward_lines(self.drawn.reshape(len(self.drawn), -1), self.hit, self.frame, N_HITS, N_PASSES)

    def backward(self) -> None:
        """Differentiate it, many times."""
        _backward_lines(self.fresh.ravel(), self.hit, self.frame, self.sums, N_HITS, N_PASSES)

    def image_error(self) -> float:
        """Return the largest error of what was drawn."""
        return float(np.abs(self.drawn[:, :, 1:] - _by_rows(self.expected.image)).max())

    def gradient_error(self) -> float:
        """Return the largest relative L2 error of a gradient, summed over the equal hits."""
        v_alpha = np.zeros(self.expected.alpha.shape)
        v: CompositeGradient = REFERENCE.composite_vjp(
            self.projection, self.colors, self.background, self.bins, GSPLAT_MAIN, self.expected, self.v_image, v_alpha
        )
        expected = [np.sum(part.reshape(N_HITS, -1), axis=0) for part in v[:4]]
        pairs = [pair for sums in self.sums for pair in zip(self._gradient(sums), expected, strict=True)]
        return max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs)

    def _gradient(self, sums: Floats) -> tuple[Any, ...]:
        """Return the gradient with respect to centre, conic, opacity and colour."""
        q, qe, qy, *second = sums[:6]
        a, slope, pivot = 2 * self.hit.half_a, self.hit.slope, 2 * self.hit.half_pivot
        return (
            (a * qe, slope * a * qe + pivot * qy),
            conic_vjp_of_moments(slope, *second),
            (-q / self.hit.opacity,),
            sums[6:N_SUMS],
        )


def _by_rows(image: Floats) -> Floats:
    """Rearrange one tile's image [TILE_HEIGHT, TILE_WIDTH, D] to its rows of eight pixels [N_ROWS, D, WIDTH]."""
    strips = image.reshape(TILE_HEIGHT, -1, WIDTH, image.shape[2])
    return np.ascontiguousarray(strips.transpose(1, 0, 3, 2).reshape(N_ROWS, image.shape[2], WIDTH))
