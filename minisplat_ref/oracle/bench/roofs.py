"""How far the processor would let it go: the blending kernels against straight-line loops.

The straight-line loops do the arithmetic of one hit, 128 pixels at a time as in a tile, over and over on the same
numbers: no lists, no sorting, nothing fetched from memory. A kernel that took no longer per pair would be perfect. One
thread; the kernels' times are multiplied by their threads. A *listed* pair is a pixel of a tile's rows that the visible
ellipse of a Gaussian of its list reaches; those that a finished tile leaves out are counted too.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.backends import CPU, REFERENCE
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.cpu.exponential import exp_fast
from minisplat_ref.cpu.records import ROW_END, ROW_FIRST, records_of
from minisplat_ref.cpu.tile_state import BEHIND, CHANNELS, PIXELS, T, X, Y, frame_of, start_tile
from minisplat_ref.cpu.tiling import TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.oracle.bench.limits import least_seconds
from minisplat_ref.oracle.bench.workloads import Workload
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.oracle.tolerances import BENCH_FLOAT32_GRADIENT, BENCH_FLOAT32_IMAGE
from minisplat_ref.render import render
from minisplat_ref.scalar._jit import add_in_any_order, kernel, n_threads
from minisplat_ref.scalar.compositing import alpha_vjp, blend, conic_vjp_of_moments, factors, mahalanobis
from minisplat_ref.scalar.literals import ZERO
from minisplat_ref.types import CompositeGradient, Gaussians, Projection, TileGrid

N_HITS = 100  # of opacity 0.005: transmittance 0.6 is left, so that none of them stops
N_PASSES = 200
N_SUMS = 9


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


@kernel(parallel=False)
def _forward_line(state, n_pixels, hit, frame, n_hits, n_passes):  # type: ignore[no-untyped-def]
    for _ in range(n_passes):
        start_tile(state, 0, frame)
        state[CHANNELS:] = ZERO
        for _ in range(n_hits):
            for i in range(n_pixels):
                dy = hit.y - state[Y + i]
                sigma = mahalanobis(hit.x - state[X + i] + hit.slope * dy, dy, hit.half_a, hit.half_pivot)
                state[T + i], weight = blend(state[T + i], sigma, hit.opacity * exp_fast(-sigma), frame)
                state[CHANNELS + i] += weight * hit.red
                state[CHANNELS + PIXELS + i] += weight * hit.green
                state[CHANNELS + 2 * PIXELS + i] += weight * hit.blue


@kernel(parallel=False)
def _backward_line(state, n_pixels, hit, frame, behind, sums, n_hits, n_passes):  # type: ignore[no-untyped-def]
    for _ in range(n_passes):
        start_tile(state, 0, frame)
        state[BEHIND : BEHIND + PIXELS] = behind
        sums[:] = ZERO
        for _ in range(n_hits):
            q_sum = qe = qy = qee = qey = qyy = v_red = v_green = v_blue = ZERO * hit.half_a
            for i in range(n_pixels):
                dy = hit.y - state[Y + i]
                e = hit.x - state[X + i] + hit.slope * dy
                sigma = mahalanobis(e, dy, hit.half_a, hit.half_pivot)
                unclamped = hit.opacity * exp_fast(-sigma)
                transmittance = state[T + i]
                state[T + i], weight = blend(transmittance, sigma, unclamped, frame)
                v_0 = state[CHANNELS + i]
                v_1 = state[CHANNELS + PIXELS + i]
                v_2 = state[CHANNELS + 2 * PIXELS + i]
                shade = v_0 * hit.red + v_1 * hit.green + v_2 * hit.blue
                state[BEHIND + i] -= weight * shade
                q = -unclamped * alpha_vjp(transmittance, weight, unclamped, state[BEHIND + i], shade, frame)
                q_mean = q if unclamped <= frame.mean_gradient_max else ZERO
                q_shape = q if unclamped <= frame.shape_gradient_max else ZERO
                q_sum = add_in_any_order(q_sum, q_shape)  # type: ignore[no-untyped-call]
                qe = add_in_any_order(qe, q_mean * e)  # type: ignore[no-untyped-call]
                qy = add_in_any_order(qy, q_mean * dy)  # type: ignore[no-untyped-call]
                qee = add_in_any_order(qee, q_shape * e * e)  # type: ignore[no-untyped-call]
                qey = add_in_any_order(qey, q_shape * e * dy)  # type: ignore[no-untyped-call]
                qyy = add_in_any_order(qyy, q_shape * dy * dy)  # type: ignore[no-untyped-call]
                v_red = add_in_any_order(v_red, weight * v_0)  # type: ignore[no-untyped-call]
                v_green = add_in_any_order(v_green, weight * v_1)  # type: ignore[no-untyped-call]
                v_blue = add_in_any_order(v_blue, weight * v_2)  # type: ignore[no-untyped-call]
            parts = (q_sum, qe, qy, qee, qey, qyy, v_red, v_green, v_blue)
            for j in range(N_SUMS):
                sums[j] += parts[j]


def blending_cases(workload: Workload, repeats: int) -> list[Case]:
    """Time the blending kernels in float32 on a workload against the straight-line loops, taking turns.

    Returns
    -------
    list of Case
        Forward and backward. A case fails if its straight-line loop does not give what the reference gives.
    """
    gaussians = Gaussians._make(field.astype(np.float32) for field in workload.gaussians)
    output, tape = render(gaussians, workload.camera, with_stats=True)
    splats = tape.splats
    inputs = (splats.projection, splats.channels, splats.background, splats.bins, GSPLAT_MAIN)
    v_image, v_alpha = workload.v_image.astype(np.float32), np.zeros(output.alpha.shape, np.float32)
    loops = StraightLines()
    least = least_seconds(
        (
            lambda: CPU.composite(*inputs),
            loops.forward,
            lambda: CPU.composite_vjp(*inputs, output, v_image, v_alpha),
            loops.backward,
        ),
        repeats,
    )
    records = records_of(splats.projection, splats.channels, GSPLAT_MAIN)
    tile_tops = np.repeat(np.arange(len(splats.bins.tile_offsets) - 1), np.diff(splats.bins.tile_offsets))
    tile_tops = tile_tops // splats.bins.grid.n_tiles_x * TILE_HEIGHT
    rows = records[splats.bins.gaussian_ids][:, [ROW_FIRST, ROW_END]].astype(np.int64) - tile_tops[:, None]
    n_listed = TILE_WIDTH * int(np.clip(rows, 0, TILE_HEIGHT) @ [-1, 1] @ np.ones(len(rows), np.int64))
    assert output.stats is not None
    n_hits = int(output.stats.hit_count.sum())
    cases = []
    for name, seconds, line, error, bound in (
        ("forward", least[0], least[1], loops.image_error(), BENCH_FLOAT32_IMAGE),
        ("backward", least[2], least[3], loops.gradient_error(), BENCH_FLOAT32_GRADIENT),
    ):
        pair, roof = 1e9 * seconds * n_threads() / n_listed, 1e9 * line / (N_HITS * N_PASSES * PIXELS)
        figures: dict[str, Figure] = {
            "ms": 1e3 * seconds,
            "million hits": n_hits / 1e6,
            "million hits/s": n_hits / seconds / 1e6,
            "ns a listed pair and core": pair,
            "straight line ns": roof,
            "x straight line": pair / roof,
        }
        note = "" if error <= bound else f"the straight-line loop is off by {error:.1e}"
        cases.append(Case(f"roof/{workload.name} {name}", not note, figures, note))
    return cases


class StraightLines:
    """The loops on one tile, and the same hits for the reference."""

    def __init__(self) -> None:
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
        self.frame = frame_of(self.bins, GSPLAT_MAIN, np.dtype(f32))
        self.expected = REFERENCE.composite(self.projection, self.colors, self.background, self.bins, GSPLAT_MAIN)
        self.v_image = np.random.default_rng(2).normal(size=self.expected.image.shape).astype(f32)
        self.drawn = np.zeros(CHANNELS + 3 * PIXELS, f32)
        self.differentiated = np.zeros_like(self.drawn)
        self.differentiated[CHANNELS:] = np.moveaxis(self.v_image, 2, 0).ravel()
        self.behind = (self.v_image * self.expected.image).sum(axis=2, dtype=np.float64).astype(f32).ravel()
        self.sums = np.zeros(N_SUMS, np.float64)

    def forward(self) -> None:
        """Draw the tile, many times."""
        _forward_line(self.drawn, PIXELS, self.hit, self.frame, N_HITS, N_PASSES)

    def backward(self) -> None:
        """Differentiate it, many times."""
        _backward_line(self.differentiated, PIXELS, self.hit, self.frame, self.behind, self.sums, N_HITS, N_PASSES)

    def image_error(self) -> float:
        """Return the largest error of what was drawn."""
        image = np.moveaxis(self.drawn[CHANNELS:].reshape(3, TILE_HEIGHT, TILE_WIDTH), 0, 2)
        return float(np.abs(image - self.expected.image).max())

    def gradient_error(self) -> float:
        """Return the largest relative L2 error of a gradient, summed over the equal hits."""
        v_alpha = np.zeros(self.expected.alpha.shape)
        v: CompositeGradient = REFERENCE.composite_vjp(
            self.projection, self.colors, self.background, self.bins, GSPLAT_MAIN, self.expected, self.v_image, v_alpha
        )
        q, qe, qy, *second = self.sums[:6]
        a, slope, pivot = 2 * self.hit.half_a, self.hit.slope, 2 * self.hit.half_pivot
        found = (
            (a * qe, slope * a * qe + pivot * qy),
            conic_vjp_of_moments(slope, *second),
            (-q / self.hit.opacity,),
            self.sums[6:],
        )
        expected = [np.sum(part.reshape(N_HITS, -1), axis=0) for part in v[:4]]
        pairs = zip(found, expected, strict=True)
        return max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs)
