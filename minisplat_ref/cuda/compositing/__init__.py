"""Front-to-back blending of all tiles, forward and backward: the functions around the kernels."""

from typing import Any

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.cuda.arrays import beside, empty, to_device, to_host, zeros
from minisplat_ref.cuda.compositing.backward import backward_kernel
from minisplat_ref.cuda.compositing.forward import forward_kernel
from minisplat_ref.cuda.compositing.pair_sums import N_MOMENTS, N_PAIR_STATS, sum_pair_stats, sum_slots
from minisplat_ref.cuda.compositing.records import records_of
from minisplat_ref.cuda.compositing.tiles import BLOCK, Pixels, pack_lists
from minisplat_ref.cuda.target import launch, launch_rows
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
    """Blend every tile's Gaussians front to back; see ``reference.compositing.composite``.

    Statistics are on the host wherever the data are: only density control and pruning read them.
    """
    grid, (n, n_channels), dtype = bins.grid, colors.shape, colors.dtype
    shape, collects = (grid.height, grid.width), with_stats or with_median_depth
    pixels = Pixels(empty((*shape, n_channels), dtype), empty(shape, dtype))
    stats_shape = shape if collects else (1, 1)
    slots = zeros((len(bins.gaussian_ids) if collects else 1, N_PAIR_STATS), dtype)  # zero behind a tile's last hit
    median_depth, dominant_ids = empty(stats_shape, dtype), empty(stats_shape, np.int32)
    launch(
        forward_kernel(dtype, n_channels, collects),
        grid.n_tiles_x * grid.n_tiles_y,
        BLOCK,
        records_of(projection, colors),
        to_device(projection.depths),
        to_device(background),
        pack_lists(bins),
        pack_frame(bins, conventions, dtype),
        pixels,
        (slots, median_depth, dominant_ids),
    )
    stats = None
    if with_stats:
        ids = to_host(dominant_ids)
        sums = empty(n, dtype), empty(n, dtype), empty(n, np.int32)
        launch_rows(sum_pair_stats, n, slots, to_device(bins.gaussian_offsets), *sums)
        dominant_count = np.bincount(ids[ids >= 0], minlength=n).astype(np.int32)
        weight_sum, weight_max, hit_count = map(to_host, sums)
        stats = BlendStats(weight_sum, weight_max, hit_count, dominant_count, ids)
    image, alpha = beside(colors, pixels)
    return RenderOutput(image, alpha, beside(colors, median_depth) if with_median_depth else None, stats)


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
    return _vjp((projection, colors, background), bins, conventions, output, Pixels(v_image, v_alpha), False)


def composite_vjp_atomic(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_image: Floats,
    v_alpha: Floats,
) -> CompositeGradient:
    """Do the same with atomic additions: faster, but every run rounds differently."""
    return _vjp((projection, colors, background), bins, conventions, output, Pixels(v_image, v_alpha), True)


def _vjp(
    inputs: tuple[Projection, Floats, Floats],
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v: Pixels,
    is_atomic: bool,
) -> CompositeGradient:
    projection, colors, _ = inputs
    (n, n_channels), dtype = colors.shape, colors.dtype
    n_slots = n if is_atomic else len(bins.gaussian_ids)
    slots = zeros((n_slots, N_MOMENTS + n_channels), dtype)  # zero behind a tile's last hit
    n_tiles = len(bins.tile_offsets) - 1
    v_backgrounds = empty((n_tiles, n_channels), dtype)
    launch(
        backward_kernel(dtype, n_channels, is_atomic),
        n_tiles,
        BLOCK,
        records_of(projection, colors),
        pack_lists(bins),
        pack_frame(bins, conventions, dtype),
        to_device(Pixels(output.image, output.alpha)),
        to_device(Pixels(_as_dtype(v.image, dtype), _as_dtype(v.alpha, dtype))),
        slots,
        v_backgrounds,
    )
    out = CompositeGradient(
        empty((n, 2), projection.means2d.dtype),
        empty((n, 3), projection.conics.dtype),
        empty(n, projection.opacities.dtype),
        empty((n, n_channels), dtype),
        to_host(v_backgrounds).sum(axis=0, dtype=np.float64).astype(dtype),
    )
    offsets = to_device(np.arange(n + 1) if is_atomic else bins.gaussian_offsets)
    conics, opacities = to_device(projection.conics), to_device(projection.opacities)
    launch_rows(sum_slots, n, slots, offsets, conics, opacities, tuple(out[:4]))
    return beside(colors, out)


def _as_dtype(array: Any, dtype: Any) -> Any:
    return array if array.dtype == dtype else array.astype(dtype)
