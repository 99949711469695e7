"""Blend any primitives: the functions around the plain kernels, twins of those in ``reference.compositing``."""

from typing import Any

import numpy as np

from minisplat_ref.constants import LIST_ORDER, Conventions
from minisplat_ref.cpu.compositing.pixel_rows import KernelPrimitives, Lists, Pixels
from minisplat_ref.cpu.compositing.plain import backward_kernel, forward_kernel
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.cpu.compositing.tile_state import frame_of
from minisplat_ref.jit.compile import kernel, n_threads, prange
from minisplat_ref.types import BlendGradient, Floats, RenderOutput, TileBins

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
) -> RenderOutput:
    """Blend the primitives of every tile, front to back; see ``reference.compositing.composite_hits``."""
    height, width, dtype, n_channels = bins.grid.height, bins.grid.width, colors.dtype, len(background)
    image, alpha = np.empty((height, width, n_channels), dtype), np.empty((height, width), dtype)
    forward_kernel(_find_shared(response), n_channels)(
        KernelPrimitives(response.records(primitives, dtype), colors, response.boxes(primitives)),
        background,
        lists_of(bins, response),
        frame_of(bins, conventions, dtype),
        n_threads(),
        _pixels(image, alpha, dtype),
    )
    return RenderOutput(image, alpha, None, None)


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
        KernelPrimitives(response.records(primitives, dtype), colors, response.boxes(primitives)),
        lists_of(bins, response),
        frame_of(bins, conventions, dtype),
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


def lists_of(bins: TileBins, response: KernelResponse) -> Lists:
    """Return the lists of the tiles in the form that plain kernels take."""
    size = bins.grid.tile_width, bins.grid.tile_height
    return Lists(bins.tile_offsets, bins.gaussian_ids, bins.slots, *size, response.buffer_size)


def _find_shared(response: KernelResponse) -> KernelResponse:
    """Return the response whose kernel is shared by those that differ only in the size of their buffers."""
    return response._replace(buffer_size=min(response.buffer_size, LIST_ORDER + 1))


def _pixels(image: Floats, alpha: Floats, dtype: np.dtype) -> Pixels:
    image, alpha = np.ascontiguousarray(image, dtype), np.ascontiguousarray(alpha, dtype)
    return Pixels(image.reshape(alpha.size, image.shape[2]), alpha.reshape(-1, 1))
