"""Front-to-back blending of all tiles, forward and backward: the functions around the kernels."""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.cuda.arrays import beside, empty, to_device, to_host, zeros
from minisplat_ref.cuda.compositing.backward import backward_kernel
from minisplat_ref.cuda.compositing.forward import forward_kernel
from minisplat_ref.cuda.compositing.pair_sums import N_MOMENTS, N_PAIR_STATS, sum_pair_stats, sum_slots
from minisplat_ref.cuda.compositing.records import COLOR, records_of
from minisplat_ref.cuda.compositing.tiles import BLOCK, Pixels, pack_lists, pass_background
from minisplat_ref.cuda.target import launch, launch_rows
from minisplat_ref.cuda.tiling import TileLists
from minisplat_ref.cuda.workspace import Workspace
from minisplat_ref.scalar.compositing import Frame
from minisplat_ref.types import BlendStats, CompositeGradient, Floats, Ints, Projection, RenderOutput, TileBins


class Blended(NamedTuple):
    """A blended image, and what was collected; all arrays are on the device."""

    pixels: Pixels
    slots: Floats
    """[M, 3] statistics of each pair, or [0, 3]."""
    median_depth: Floats
    """[H, W], or [0, 0] where nothing was collected; likewise below."""
    dominant_ids: Ints
    """[H, W]."""


def blend(
    workspace: Workspace,
    records: Any,
    depths: Any,
    background: tuple[Any, ...],
    lists: TileLists,
    frame: Frame,
    collects: bool,
) -> Blended:
    """Blend every tile's Gaussians, with statistics or without, into arrays of a workspace.

    Parameters
    ----------
    workspace : Workspace
    records : device array of shape (N, 10 + D)
    depths : device array of shape (N,)
    background : tuple of D numbers
    lists : TileLists
    frame : Frame
    collects : bool
        Whether statistics are collected.
    """
    dtype, n_channels = records.dtype, records.shape[1] - COLOR
    shape, n_tiles = (frame.height, frame.width), len(lists.offsets) - 1
    stats_shape, n_slots = (shape, len(lists.ids)) if collects else ((0, 0), 0)
    blended = Blended(
        Pixels(workspace.array("image", (*shape, n_channels), dtype), workspace.array("alpha", shape, dtype)),
        workspace.array("pair_stats", (n_slots, N_PAIR_STATS), dtype, growth=1),
        workspace.array("median_depth", stats_shape, dtype),
        workspace.array("dominant_ids", stats_shape, np.int32),
    )
    kernel = forward_kernel(dtype, n_channels, collects)
    launch(kernel, n_tiles, BLOCK, records, depths, background, lists, frame, *blended[:1], blended[1:])
    return blended


def collect_stats(workspace: Workspace, blended: Blended, offsets: Any) -> BlendStats:
    """Return the statistics of every Gaussian on the host; ``offsets`` [N + 1] are those of its slots."""
    n, dtype = len(offsets) - 1, blended.slots.dtype
    sums = workspace.array("weight_sums", (n,), dtype), workspace.array("weight_maxima", (n,), dtype)
    hits = workspace.array("hit_counts", (n,), np.int32)
    launch_rows(sum_pair_stats, n, blended.slots, offsets, *sums, hits)
    ids = to_host(blended.dominant_ids)
    dominant_count = np.bincount(ids[ids >= 0], minlength=n).astype(np.int32)
    weight_sum, weight_max, hit_count = map(to_host, (*sums, hits))
    return BlendStats(weight_sum, weight_max, hit_count, dominant_count, ids)


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
    blended = blend(
        workspace := Workspace(),
        records_of(projection, colors),
        to_device(projection.depths),
        pass_background(background),
        pack_lists(bins),
        pack_frame(bins.grid, conventions, colors.dtype),
        with_stats or with_median_depth,
    )
    stats = collect_stats(workspace, blended, to_device(bins.gaussian_offsets)) if with_stats else None
    image, alpha = beside(colors, blended.pixels)
    return RenderOutput(image, alpha, beside(colors, blended.median_depth) if with_median_depth else None, stats)


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
    n_sums = N_MOMENTS + n_channels
    slots = zeros((n, n_sums), dtype) if is_atomic else empty((len(bins.gaussian_ids), n_sums), dtype)
    n_tiles = len(bins.tile_offsets) - 1
    v_backgrounds = empty((n_tiles, n_channels), dtype)
    launch(
        backward_kernel(dtype, n_channels, is_atomic),
        n_tiles,
        BLOCK,
        records_of(projection, colors),
        pack_lists(bins),
        pack_frame(bins.grid, conventions, dtype),
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
