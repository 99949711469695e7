"""The kernels of :mod:`.ray_measures`: the loop of the plain kernels with other sums, over eight pixels of a line.

::

    state of a row, eight numbers each      T | M so far | distortion | median | its rank | hits so far
    backward                                T | M so far | behind

As in the plain kernels, the backward pass runs from the front once more. ``behind`` is the sum of ``w_j v_w_j`` over
the hits from the current one on; over all of them it is ``2 v distortion``, because the distortion is quadratic in the
weights.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE, Conventions
from minisplat_ref.cpu.compositing.hits import pack_lists, sum_slots
from minisplat_ref.cpu.compositing.pixel_rows import (
    KernelPrimitives,
    full_transmittance,
    hit_row,
    list_rows,
    load_field,
    row_of_tile,
    row_pixels,
)
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    accumulate,
    broadcast,
    gather,
    load,
    reduce_any,
    reduce_sum,
    scatter,
    select,
    store,
)
from minisplat_ref.jit.literals import ONE, TWO, ZERO
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.mechanisms.surfels.kernels import response_for
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.mechanisms.surfels.ray_measures import RayMeasures
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.scalar.compositing import blend, blend_vjp
from minisplat_ref.types import Floats, TileBins

_HALF = np.float32(MEDIAN_TRANSMITTANCE)
M, DISTORTION, MEDIAN, RANK, COUNT, N_STATE = range(1, 7)  # of a state, in units of eight, after the transmittance
BEHIND, N_STATE_VJP = 2, 3
OUT_MEDIAN, OUT_DISTORTION, OUT_RANK, OUT_M, OUT_ALPHA, N_OUT = range(6)  # columns of a pixel
V_MEDIAN, V_DISTORTION = 0, 1


@functools.cache
def forward_kernel(response: KernelResponse) -> Callable:
    """Compile the forward kernel for a response."""
    hit = response.hit

    @scalar
    def measure_row(state, primitives, row, frame):
        T, one = load(state, 0), broadcast(state.dtype.type(1))
        for m in row.members:
            unclamped, z, _ = hit_row(hit, primitives, row.ids[m], row)
            before = T
            T, w = blend(T, unclamped, frame)
            sum_before = load(state, M * WIDTH)
            accumulate(state, DISTORTION * WIDTH, TWO * w * (z * (ONE - abs(before)) - sum_before))
            accumulate(state, M * WIDTH, w * z)
            accumulate(state, COUNT * WIDTH, select(w > ZERO, one, ZERO))
            is_median = (w > ZERO) & (before > _HALF)
            store(state, MEDIAN * WIDTH, select(is_median, z, load(state, MEDIAN * WIDTH)))
            store(state, RANK * WIDTH, select(is_median, load(state, COUNT * WIDTH), load(state, RANK * WIDTH)))
            if not reduce_any(T > ZERO):
                break
        store(state, 0, T)

    @kernel()
    def measure_tiles(primitives, lists, frame, n_threads, out):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty(N_STATE * WIDTH, out.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x >= frame.width or row.y >= frame.height:
                        continue
                    state[:] = ZERO
                    store(state, 0, full_transmittance(row, frame, state.dtype.type))
                    measure_row(state, primitives, row, frame)
                    pixels = row_pixels(row, frame)
                    scatter(out, pixels, OUT_MEDIAN, load_field(state, MEDIAN, row, frame))
                    scatter(out, pixels, OUT_DISTORTION, load_field(state, DISTORTION, row, frame))
                    scatter(out, pixels, OUT_RANK, load_field(state, RANK, row, frame))
                    scatter(out, pixels, OUT_M, load_field(state, M, row, frame))
                    scatter(out, pixels, OUT_ALPHA, ONE - abs(load_field(state, 0, row, frame)))

    return measure_tiles


@functools.cache
def backward_kernel(response: KernelResponse) -> Callable:
    """Compile the backward kernel for a response."""
    hit, hit_vjp, n_gradients = response.hit, response.hit_vjp, response.n_gradients

    @scalar
    def chain_row(sums, v_place, state, primitives, row, frame, out, v_out):
        pixels, T = row_pixels(row, frame), full_transmittance(row, frame, state.dtype.type)
        v = select(T > ZERO, gather(v_out, pixels, V_DISTORTION), ZERO)
        v_median = select(T > ZERO, gather(v_out, pixels, V_MEDIAN), ZERO)
        rank, A_end, M_end = gather(out, pixels, OUT_RANK), gather(out, pixels, OUT_ALPHA), gather(out, pixels, OUT_M)
        one, count = broadcast(state.dtype.type(1)), broadcast(state.dtype.type(0))
        store(state, BEHIND * WIDTH, TWO * v * gather(out, pixels, OUT_DISTORTION))
        store(state, M * WIDTH, count)
        for m in row.members:
            n = row.ids[m]
            unclamped, z, place = hit_row(hit, primitives, n, row)
            before, M_before = T, load(state, M * WIDTH)
            T, w = blend(T, unclamped, frame)
            A_before = ONE - abs(before)
            count = count + select(w > ZERO, one, ZERO)
            v_w = TWO * v * ((z * A_before - M_before) + (M_end - M_before - w * z) - z * (A_end - A_before - w))
            v_z = TWO * v * w * (TWO * A_before + w - A_end)
            is_median = (w > ZERO) & (abs(count - rank) < _HALF)
            v_z = select(is_median, v_z + v_median, v_z)
            behind = load(state, BEHIND * WIDTH) - w * v_w
            store(state, BEHIND * WIDTH, behind)
            accumulate(state, M * WIDTH, w * z)
            v_alpha = blend_vjp(before, w, unclamped, behind, v_w, frame)
            v_mean = select(unclamped <= frame.mean_gradient_max, v_alpha, ZERO)
            v_shape = select(unclamped <= frame.shape_gradient_max, v_alpha, ZERO)
            store(v_place, 0, v_z)
            accumulate(sums, m * n_gradients * WIDTH, hit_vjp(primitives.records, n, place, v_mean, v_shape, v_place))
            if not reduce_any(T > ZERO):
                break

    @kernel()
    def measure_tiles_vjp(primitives, lists, frame, n_threads, out, v_out, slots):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state, v_place = np.empty(N_STATE_VJP * WIDTH, slots.dtype), np.empty(WIDTH, slots.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                first, n_listed = lists.offsets[tile], lists.offsets[tile + 1] - lists.offsets[tile]
                sums = np.zeros(n_listed * n_gradients * WIDTH, slots.dtype)
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x < frame.width and row.y < frame.height:
                        chain_row(sums, v_place, state, primitives, row, frame, out, v_out)
                for m in range(n_listed):
                    for j in range(n_gradients):
                        slots[lists.slots[first + m], j] = reduce_sum(load(sums, (m * n_gradients + j) * WIDTH))

    return measure_tiles_vjp


def measure_rays(surfels: Surfels, bins: TileBins, conventions: Conventions, dtype: np.dtype) -> RayMeasures:
    """Measure along the rays in a dtype; see :func:`minisplat_ref.mechanisms.surfels.ray_measures.measure_rays`."""
    response, shape = response_for(dtype, surfels, Layout()), (bins.grid.height, bins.grid.width)
    out = np.empty((shape[0] * shape[1], N_OUT), dtype)
    forward_kernel(response)(
        _primitives(response, surfels, dtype),
        pack_lists(bins, response),
        pack_frame(bins.grid, conventions, dtype),
        n_threads(),
        out,
    )
    median, distortion, ranks, depth_sums, alpha = (np.ascontiguousarray(column).reshape(shape) for column in out.T)
    return RayMeasures(median, distortion, ranks.astype(np.int32), depth_sums, alpha)


def measure_rays_vjp(
    surfels: Surfels,
    bins: TileBins,
    conventions: Conventions,
    measures: RayMeasures,
    v_median: Floats,
    v_distortion: Floats,
) -> tuple[Floats, ...]:
    """Gradient of :func:`measure_rays`, in the dtype of the measures; see the reference's."""
    dtype = measures.median.dtype
    response = response_for(dtype, surfels, Layout())
    columns = measures.median, measures.distortion, measures.median_ranks, measures.depth_sums, measures.alpha
    out = np.column_stack([np.ravel(column) for column in columns]).astype(dtype)
    slots = np.empty((len(bins.gaussian_ids), response.n_gradients), dtype)
    backward_kernel(response)(
        _primitives(response, surfels, dtype),
        pack_lists(bins, response),
        pack_frame(bins.grid, conventions, dtype),
        n_threads(),
        out,
        np.column_stack([np.ravel(v_median), np.ravel(v_distortion)]).astype(dtype),
        slots,
    )
    totals = np.zeros((len(surfels.depths), slots.shape[1]))
    sum_slots(slots, bins.gaussian_offsets, totals)
    return response.records_vjp(surfels, totals)


def _primitives(response: KernelResponse, surfels: Surfels, dtype: np.dtype) -> KernelPrimitives:
    no_colors = np.zeros((len(surfels.depths), 0), dtype)
    return KernelPrimitives(response.records(surfels, dtype), no_colors, response.boxes(surfels))
