"""Front-to-back blending of all tiles, forward and backward: the functions around the kernels.

float32 data use the polynomial exponential, which vectorises; ``exact`` uses libm's. float64 always does.
"""

from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.backward import backward_kernel
from minisplat_ref.cpu.compositing.exponential import choose_exponential
from minisplat_ref.cpu.compositing.forward import HitStats, forward_kernel
from minisplat_ref.cpu.compositing.pair_sums import N_PAIR_STATS, slot_size, sum_pair_stats, sum_slots
from minisplat_ref.cpu.compositing.records import records_of
from minisplat_ref.cpu.compositing.tile_state import Pixels, pack_frame, pack_lists
from minisplat_ref.cpu.memory import large_empty
from minisplat_ref.jit.compile import n_threads
from minisplat_ref.types import BlendStats, CompositeGradient, Floats, Projection, RenderOutput, TileBins


def composite(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Blend every tile's Gaussians front to back; see ``reference.compositing.composite``."""
    exp = choose_exponential(colors.dtype)
    return composite_with(exp, projection, colors, background, bins, conventions, with_stats, with_median_depth)


def composite_vjp(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_image: Floats,
    v_alpha: Floats,
) -> CompositeGradient:
    """Chain the gradient of the image to its inputs; see ``reference.compositing.composite_vjp``."""
    exp = choose_exponential(colors.dtype)
    return composite_vjp_with(exp, projection, colors, bins, conventions, output, v_image, v_alpha)


def composite_with(
    exp: Callable,
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    with_stats: bool,
    with_median_depth: bool,
) -> RenderOutput:
    """Blend with one of the exponentials of :mod:`minisplat_ref.cpu.compositing.exponential`."""
    height, width, dtype = bins.grid.height, bins.grid.width, colors.dtype
    image = np.empty((height, width, colors.shape[1]), dtype)
    alpha = np.empty((height, width), dtype)
    collects = with_stats or with_median_depth
    shape, n_pairs = ((height, width), len(bins.gaussian_ids)) if collects else ((0, 0), 0)
    median_depth, dominant_ids = np.empty(shape, dtype), np.empty(shape, np.int32)
    slots = np.zeros((n_pairs, N_PAIR_STATS), dtype)  # remain zero behind the hit that finishes a tile
    records = records_of(projection, colors, conventions)
    forward_kernel(exp, colors.shape[1], collects)(
        records,
        projection.depths,
        background,
        pack_lists(bins),
        n_threads(),
        pack_frame(bins.grid, conventions, dtype),
        Pixels(image.reshape(height * width, image.shape[2]), alpha.reshape(-1)),
        HitStats(slots, median_depth, dominant_ids),
    )
    stats = None
    if with_stats:
        n = len(colors)
        dominant_count = np.bincount(dominant_ids[dominant_ids >= 0], minlength=n).astype(np.int32)
        stats = BlendStats(np.empty(n, dtype), np.empty(n, dtype), np.empty(n, np.int32), dominant_count, dominant_ids)
        sum_pair_stats(slots, bins.gaussian_offsets, stats)
    return RenderOutput(image, alpha, median_depth if with_median_depth else None, stats, records)


def composite_vjp_with(
    exp: Callable,
    projection: Projection,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_image: Floats,
    v_alpha: Floats,
) -> CompositeGradient:
    """Chain gradients with the exponential that the forward pass used."""
    dtype, n_channels, n_pixels = colors.dtype, colors.shape[1], output.alpha.size
    v_image, v_alpha = np.ascontiguousarray(v_image, dtype), np.ascontiguousarray(v_alpha, dtype)
    width = slot_size(n_channels)
    slots = large_empty((len(bins.gaussian_ids) * width,), dtype)
    v_backgrounds = np.empty((len(bins.tile_offsets) - 1, n_channels))  # by tiles
    backward_kernel(exp, n_channels)(
        output.saved if output.saved is not None else records_of(projection, colors, conventions),
        pack_lists(bins),
        n_threads(),
        pack_frame(bins.grid, conventions, dtype),
        Pixels(output.image.reshape(n_pixels, n_channels), output.alpha.ravel()),
        Pixels(v_image.reshape(n_pixels, n_channels), v_alpha.ravel()),
        slots,
        v_backgrounds,
    )
    out = CompositeGradient(
        np.empty(projection.means2d.shape, projection.means2d.dtype),
        np.empty(projection.conics.shape, projection.conics.dtype),
        np.empty(projection.opacities.shape, projection.opacities.dtype),
        np.empty(colors.shape, dtype),
        v_backgrounds.sum(axis=0).astype(dtype),
    )
    sum_slots(slots, width, bins.gaussian_offsets, projection, out)
    return out
