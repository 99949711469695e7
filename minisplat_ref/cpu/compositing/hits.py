"""Blend any primitives: the functions around the plain kernels, named as their counterparts in the reference."""

from typing import Any

import numpy as np

from minisplat_ref.constants import LIST_ORDER, Conventions
from minisplat_ref.cpu.compositing.pixel_rows import KernelPrimitives, Lists, Pixels
from minisplat_ref.cpu.compositing.plain import backward_kernel, forward_kernel
from minisplat_ref.cpu.compositing.plain_statistics import (
    HITS,
    N_NUMBERS,
    WEIGHT_MAX,
    WEIGHT_SUM,
    removal_kernel,
    statistics_kernel,
)
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.jit.compile import kernel, n_threads, prange
from minisplat_ref.types import BlendGradient, BlendStats, Floats, Ints, RenderOutput, TileBins

N_CHUNKS = 64  # of the primitives, when their slots are added up


@kernel()
def sum_slots(slots, offsets, totals):
    """Sum each Gaussian's slots of [M, G + S], which ``offsets`` [N + 1] delimit, in float64 to [N, G + S]."""
    for chunk in prange(N_CHUNKS):
        for n in range(totals.shape[0] * chunk // N_CHUNKS, totals.shape[0] * (chunk + 1) // N_CHUNKS):
            for slot in range(offsets[n], offsets[n + 1]):
                for j in range(slots.shape[1]):
                    totals[n, j] += slots[slot, j]


def composite_hits(
    response: KernelResponse,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Blend the primitives of every tile, front to back; see ``reference.compositing.composite_hits``."""
    height, width, dtype, n_channels = bins.grid.height, bins.grid.width, colors.dtype, len(background)
    image, alpha = np.empty((height, width, n_channels), dtype), np.empty((height, width), dtype)
    records = _bundle(response, primitives, colors)
    lists, frame = pack_lists(bins, response), pack_frame(bins.grid, conventions, dtype)
    forward_kernel(_find_shared(response), n_channels)(
        records, background, lists, frame, n_threads(), _pixels(image, alpha, dtype)
    )
    if not (with_stats or with_median_depth):
        return RenderOutput(image, alpha, None, None)
    pairs, median_depth = np.zeros((len(bins.gaussian_ids), N_NUMBERS), dtype), np.zeros((height, width), dtype)
    dominant_ids = np.full((height, width), -1, np.int32)
    statistics_kernel(_find_shared(response))(
        records, lists, frame, n_threads(), pairs, dominant_ids.reshape(-1), median_depth.reshape(-1, 1)
    )
    stats = _blend_stats(pairs, dominant_ids, bins.gaussian_ids, len(colors)) if with_stats else None
    return RenderOutput(image, alpha, median_depth if with_median_depth else None, stats)


def _blend_stats(pairs: Floats, dominant_ids: Ints, ids: Ints, n: int) -> BlendStats:
    """Return the statistics of n primitives from the numbers of pairs [M, 3], whose primitives are ``ids`` [M]."""
    largest = np.zeros(n, pairs.dtype)
    np.maximum.at(largest, ids, pairs[:, WEIGHT_MAX])
    return BlendStats(
        np.bincount(ids, pairs[:, WEIGHT_SUM], n).astype(pairs.dtype),
        largest,
        np.bincount(ids, pairs[:, HITS], n).astype(np.int32),
        np.bincount(dominant_ids[dominant_ids >= 0], minlength=n).astype(np.int32),
        dominant_ids,
    )


def composite_hits_vjp(
    response: KernelResponse,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_output: tuple[Floats, Floats],
) -> BlendGradient:
    """Chain the gradient of the image to its inputs; see ``reference.compositing.composite_hits_vjp``."""
    dtype, n_channels = colors.dtype, len(background)
    slots = np.empty((len(bins.gaussian_ids), response.n_gradients + n_channels * response.n_coefficients), dtype)
    v_backgrounds = np.zeros((len(bins.tile_offsets) - 1, n_channels))  # by tiles
    backward_kernel(_find_shared(response), n_channels)(
        _bundle(response, primitives, colors),
        pack_lists(bins, response),
        pack_frame(bins.grid, conventions, dtype),
        n_threads(),
        _pixels(output.image, output.alpha, dtype),
        _pixels(*v_output, dtype),
        slots,
        v_backgrounds,
    )
    totals = np.zeros((len(colors), slots.shape[1]))
    sum_slots(slots, bins.gaussian_offsets, totals)
    v_records, v_colors = totals[:, : response.n_gradients], totals[:, response.n_gradients :]
    v_background = v_backgrounds.sum(axis=0)
    return BlendGradient(
        response.records_vjp(primitives, v_records), v_colors.astype(dtype), v_background.astype(dtype)
    )


def removal_changes_of_hits(
    response: KernelResponse,
    primitives: Any,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
) -> Floats:
    """Return the squared change of the image without each primitive; see ``reference.removal``."""
    dtype, n_channels = colors.dtype, output.image.shape[2]
    changes = np.zeros(len(bins.gaussian_ids), dtype)
    removal_kernel(_find_shared(response), n_channels)(
        _bundle(response, primitives, colors),
        pack_lists(bins, response),
        pack_frame(bins.grid, conventions, dtype),
        n_threads(),
        np.ascontiguousarray(output.image, dtype).reshape(-1, n_channels),
        changes,
    )
    totals = np.zeros(len(colors))
    np.add.at(totals, bins.gaussian_ids, changes)
    return totals


def pack_lists(bins: TileBins, response: KernelResponse) -> Lists:
    """Return the lists of the tiles in the form that plain kernels take."""
    size = bins.grid.tile_width, bins.grid.tile_height
    return Lists(bins.tile_offsets, bins.gaussian_ids, bins.slots, *size, response.buffer_size)


def _bundle(response: KernelResponse, primitives: Any, colors: Floats) -> KernelPrimitives:
    """Return the primitives as the kernels read them."""
    records, boxes = response.records(primitives, colors.dtype), response.boxes(primitives)
    if response.rays is None:
        return KernelPrimitives(records, colors, boxes)
    return KernelPrimitives(records, colors, boxes, response.rays(primitives, colors.dtype))


def _find_shared(response: KernelResponse) -> KernelResponse:
    """Return the response whose kernel is shared by those that differ only in the size of their buffers."""
    return response._replace(buffer_size=min(response.buffer_size, LIST_ORDER + 1))


def _pixels(image: Floats, alpha: Floats, dtype: np.dtype) -> Pixels:
    image, alpha = np.ascontiguousarray(image, dtype), np.ascontiguousarray(alpha, dtype)
    return Pixels(image.reshape(alpha.size, image.shape[2]), alpha.reshape(-1, 1))
