"""Both passes over one view of Gaussians that stay on the device, in few launches, without an allocation or a copy.

One kernel activates a Gaussian, projects it, evaluates its colour, and writes its record and the number of its tiles;
one chains the gradient of its footprint and colour to its parameters. They call the functions of the stages. The
stages themselves (:mod:`minisplat_ref.rendering.stages`) do one thing each, with arrays that can be looked at between
them; :class:`Passes` is for a training, where nobody looks.

Nobody reads gradients with respect to the camera's pose there, so they are not computed, and the number of pairs is
only counted when somebody asks for it: see :meth:`Passes.count_pairs`.
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.tile_state import pack_frame
from minisplat_ref.cpu.projection import pack_constants
from minisplat_ref.cuda import tiling
from minisplat_ref.cuda.adam import list_on_device
from minisplat_ref.cuda.arrays import empty, to_device, write_zeros
from minisplat_ref.cuda.compositing import blend, collect_stats
from minisplat_ref.cuda.compositing.backward import backward_kernel
from minisplat_ref.cuda.compositing.pair_sums import N_MOMENTS, N_PAIR_STATS, footprint_vjp, slots_of_row, sum_column
from minisplat_ref.cuda.compositing.records import COLOR, store_record
from minisplat_ref.cuda.compositing.tiles import BLOCK, Pixels, pass_background
from minisplat_ref.cuda.footprints import TILE, reached_tiles
from minisplat_ref.cuda.loss import Comparison, Photograph, compare
from minisplat_ref.cuda.projection import (
    pack_extent,
    pass_pose,
    project_one,
    project_one_vjp,
    store_triple,
    wide_quaternion,
    wide_triple,
)
from minisplat_ref.cuda.scanning import take_block
from minisplat_ref.cuda.spherical_harmonics import Viewpoint, clear_color, degree_of, pass_viewpoint, shading
from minisplat_ref.cuda.target import ROW_THREADS, GpuKernel, cuda, device_function, gpu_kernel, launch, launch_rows
from minisplat_ref.cuda.workspace import GROWTH, Workspace
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.activation import activate_opacity, activate_opacity_vjp, activate_scale, activate_scale_vjp
from minisplat_ref.scalar.compositing import Frame
from minisplat_ref.scalar.extent import Extent
from minisplat_ref.scalar.projection import Pose, ProjectionConstants
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Ints, RenderOutput, TileGrid

N_CHANNELS = 3
ALL = 1 << 20  # numbers of a row to update: more than any row has


class Options(NamedTuple):
    """How a view is rendered."""

    background: Floats
    """[3] on the host, in the dtype of the Gaussians."""
    degree: int | Ints
    """Active degree of the spherical harmonics, of all Gaussians or [N] of each."""
    conventions: Conventions
    is_visible: Bools | None = None
    """[N] Gaussians to render; all by default."""
    with_stats: bool = False
    """Whether blend statistics are collected, which are on the host."""


class Eye(NamedTuple):
    """What a Gaussian's footprint and colour depend on besides itself: numbers, and one array of degrees."""

    pose: Pose
    constants: ProjectionConstants
    extent: Extent
    viewpoint: Viewpoint


class Footprints(NamedTuple):
    """What blending, lists and density control read of each Gaussian."""

    radii: Ints
    """[N, 2] 0 where culled."""
    boxes: Ints
    """[N, 4]; undefined where culled."""
    depths: Floats
    """[N]."""
    records: Floats
    """[N, 10 + 3]; undefined where culled."""


class Tape(NamedTuple):
    """A rendered view, for the gradient; its arrays are those of the workspace, until the next view is rendered."""

    gaussians: Gaussians
    eye: Eye
    frame: Frame
    footprints: Footprints
    survey: tiling.Survey
    lists: tiling.TileLists
    output: RenderOutput
    capacity: int
    """Pairs that there was room for; with more, nothing was rendered but the background."""


class Differentiated(NamedTuple):
    """The gradient of a view, in arrays of the workspace."""

    gaussians: Gaussians
    means2d: Floats
    """[N, 2] per pixel: input of density control."""


@functools.cache
def activation(dtype: np.dtype) -> Any:
    """Return the function ``activated(gaussians, n)`` of kernels: mean, quaternion and scales of a row, float64."""
    largest = dtype.type(np.finfo(np.float32).max)

    @device_function
    def activated(gaussians, n):
        logs = gaussians.log_scales
        scale = (
            np.float64(activate_scale(logs[n, 0], largest)),
            np.float64(activate_scale(logs[n, 1], largest)),
            np.float64(activate_scale(logs[n, 2], largest)),
        )
        return wide_triple(gaussians.means, n), wide_quaternion(gaussians.quats, n), scale

    return activated


@functools.cache
def prepare_kernel(dtype: np.dtype) -> GpuKernel:
    """Return the kernel that prepares Gaussians of a dtype for blending."""
    real, activated, color = dtype.type, activation(dtype), shading(dtype).color

    @gpu_kernel
    def prepare_rows(
        gaussians,  # Gaussians
        is_visible,  # [N] uint8, or [0] for all
        eye,  # Eye
        out,  # Footprints
        survey,  # Survey
        limits,  # Limits
    ):
        """Write footprint and record of one Gaussian, and survey it."""
        n = take_block(survey.counters, limits.chain.ticket) * ROW_THREADS + cuda.threadIdx.x
        tiles, n_tiles, depth = np.int64(0), 0, real(0)
        if n < gaussians.means.shape[0]:
            mean, quat, scale = activated(gaussians, n)
            opacity = np.float64(activate_opacity(gaussians.opacity_logits[n]))
            seen, z, footprint, abc, dimmed, reach = project_one(
                mean, quat, scale, opacity, eye.pose, eye.constants, eye.extent
            )
            if seen and (is_visible.shape[0] == 0 or is_visible[n] != 0):
                depth = real(z)
                box = int(reach[2]), int(reach[3]), int(reach[4]), int(reach[5])
                out.radii[n, 0], out.radii[n, 1] = int(reach[0]), int(reach[1])
                for i in range(4):
                    out.boxes[n, i] = box[i]
                center, alpha_min = (footprint.x, footprint.y), np.float64(eye.extent.alpha_min)
                rgb = color(gaussians, n, degree_of(eye.viewpoint, n), eye.viewpoint.centre)
                store_record(out.records, n, center, abc, dimmed, box, rgb)
                tiles, n_tiles = reached_tiles(box, center, abc, dimmed, alpha_min)
            else:
                out.radii[n, 0], out.radii[n, 1] = 0, 0
            out.depths[n] = depth
        tiling.survey_row(n, tiles, n_tiles, depth, survey, limits)

    return prepare_rows


@functools.cache
def gradient_kernel(dtype: np.dtype, is_atomic: bool) -> GpuKernel:
    """Return the kernel that chains the gradients of footprints and colours to parameters of a dtype."""
    real, activated, color_vjp = dtype.type, activation(dtype), shading(dtype).color_vjp

    @gpu_kernel
    def chain_rows(
        gaussians,  # Gaussians
        eye,  # Eye
        radii,  # [N, 2]
        slots,  # [M, 6 + 3] moments and sums of colours, of pairs; if atomic [N, 6 + 3] of Gaussians
        offsets,  # [N + 1] of the slots
        v,  # Gaussians of the gradient
        v_means2d,  # [N, 2]
    ):
        """Write the gradient of one Gaussian."""
        n = cuda.grid(1)
        if n >= v_means2d.shape[0]:
            return
        if radii[n, 0] == 0:
            v_means2d[n, 0], v_means2d[n, 1], v.opacity_logits[n] = ZERO, ZERO, ZERO
            store_triple(v.means, n, (ZERO, ZERO, ZERO))
            store_triple(v.log_scales, n, (ZERO, ZERO, ZERO))
            store_triple(v.quats, n, (ZERO, ZERO, ZERO))
            v.quats[n, 3] = ZERO
            clear_color(v, n)
            return
        if is_atomic:
            first, end = np.int64(n), np.int64(n + 1)
        else:
            first, end = slots_of_row(offsets, n, slots)
        mean, quat, scale = activated(gaussians, n)
        activated_opacity, logit = activate_opacity(gaussians.opacity_logits[n]), gaussians.opacity_logits[n]
        opacity = np.float64(activated_opacity)
        _, _, _, abc, dimmed, _ = project_one(mean, quat, scale, opacity, eye.pose, eye.constants, eye.extent)
        v_center, v_conic, v_dimmed = footprint_vjp(slots, first, end, abc, np.float64(real(dimmed)))
        v_means2d[n, 0], v_means2d[n, 1] = v_center
        v_footprint = v_center, np.float64(0), v_conic, v_dimmed
        v_mean, v_quat, v_scale, v_opacity, _, _, _ = project_one_vjp(
            mean, quat, scale, opacity, eye.pose, eye.constants, v_footprint
        )
        v_color = (
            real(sum_column(slots, N_MOMENTS, first, end)),
            real(sum_column(slots, N_MOMENTS + 1, first, end)),
            real(sum_column(slots, N_MOMENTS + 2, first, end)),
        )
        v_shaded = color_vjp(gaussians, n, degree_of(eye.viewpoint, n), eye.viewpoint.centre, v_color, v)
        for k in range(3):
            v.means[n, k] = v_mean[k] + v_shaded[k]
            v.log_scales[n, k] = activate_scale_vjp(scale[k], v_scale[k])
        store_triple(v.quats, n, v_quat)
        v.quats[n, 3] = v_quat[3]
        v.opacity_logits[n] = activate_opacity_vjp(activated_opacity, logit, v_opacity)

    return chain_rows


@gpu_kernel
def write_widths(radii, limits, everything, widths):
    """Write how many numbers of one row Adam updates: none if the view does not see it."""
    n = cuda.grid(1)
    if n >= radii.shape[0]:
        return
    if radii[n, 0] == 0:
        widths[n] = 0
    elif limits.shape[0] > 0:
        widths[n] = limits[n]
    else:
        widths[n] = everything


class Passes:
    """Both passes, with the arrays that they use again and again.

    Parameters
    ----------
    is_deterministic : bool
        Whether every run gives the same bytes; otherwise the gradients of blending are added atomically.
    """

    def __init__(self, is_deterministic: bool) -> None:
        self.is_atomic = not is_deterministic
        self._workspace = Workspace()
        self._capacity = 0
        self._all_visible = empty(0, np.uint8)

    def render(self, gaussians: Gaussians, camera: Camera, options: Options) -> Tape:
        """Render a view of Gaussians on the device.

        The result is that of a view without Gaussians if there were more pairs than room for them: who uses it has to
        ask :meth:`count_pairs` before or afterwards.
        """
        workspace, n, dtype = self._workspace, len(gaussians.means), gaussians.means.dtype
        grid = TileGrid(camera.width, camera.height, TILE, TILE)
        self._capacity = self._capacity or tiling.FIRST_CAPACITY * n
        plan = tiling.plan_lists(n, self._capacity, grid.n_tiles_x * grid.n_tiles_y, 8 * dtype.itemsize)
        eye = Eye(
            pass_pose(camera),
            pack_constants(camera, options.conventions),
            pack_extent(camera, options.conventions, dtype),
            pass_viewpoint(camera, options.degree),
        )
        footprints = Footprints(
            workspace.array("radii", (n, 2), np.int32),
            workspace.array("boxes", (n, 4), np.int32),
            workspace.array("depths", (n,), dtype),
            workspace.array("records", (n, COLOR + N_CHANNELS), dtype),
        )
        visible = self._all_visible if options.is_visible is None else to_device(options.is_visible.astype(np.uint8))
        survey = tiling.start_survey(workspace, plan)
        launch_rows(prepare_kernel(dtype), n + 1, gaussians, visible, eye, footprints, survey, plan.survey)
        lists = tiling.list_pairs(workspace, plan, survey, footprints.boxes, grid)
        frame, background = pack_frame(grid, options.conventions, dtype), pass_background(options.background)
        records, depths = footprints.records, footprints.depths
        blended = blend(workspace, records, depths, background, lists, frame, options.with_stats)
        stats = collect_stats(workspace, blended, survey.offsets) if options.with_stats else None
        output = RenderOutput(*blended.pixels, None, stats)
        return Tape(gaussians, eye, frame, footprints, survey, lists, output, plan.capacity)

    def count_pairs(self, tape: Tape) -> int:
        """Return the number of pairs of a view, for which the host waits.

        Where it is more than ``tape.capacity``, the view has to be rendered again, for which there will be room.

        Raises
        ------
        InputError
            The device has no memory for them.
        """
        n_pairs = tiling.count_pairs(tape.survey)
        if n_pairs > self._capacity:
            self._capacity = tiling.capacity_for(n_pairs, self.pair_bytes(tape), tape.capacity)
        return n_pairs

    def pair_bytes(self, tape: Tape) -> int:
        """Return the bytes that a pair (tile, Gaussian) of such a view takes: lists, statistics, and sums."""
        size = tape.output.image.dtype.itemsize
        n_stats = 0 if tape.output.stats is None else N_PAIR_STATS
        n_sums = 0 if self.is_atomic else N_MOMENTS + N_CHANNELS
        return tiling.LIST_BYTES + size * (n_stats + n_sums)

    def render_vjp(self, tape: Tape, v_image: Floats, v_alpha: Floats) -> Differentiated:
        """Chain the gradient of the image [H, W, 3] and of its alpha [H, W], on the device, to the parameters."""
        workspace, g, dtype = self._workspace, tape.gaussians, tape.output.image.dtype
        n, n_tiles = len(g.means), len(tape.lists.offsets) - 1
        n_slots, growth = (n, GROWTH) if self.is_atomic else (tape.capacity, 1)
        slots = workspace.array("slot_sums", (n_slots, N_MOMENTS + N_CHANNELS), dtype, growth)
        if self.is_atomic:
            write_zeros(slots)
        launch(
            backward_kernel(dtype, N_CHANNELS, self.is_atomic),
            n_tiles,
            BLOCK,
            tape.footprints.records,
            tape.lists,
            tape.frame,
            Pixels(tape.output.image, tape.output.alpha),
            Pixels(v_image, v_alpha),
            slots,
            workspace.array("v_backgrounds", (n_tiles, N_CHANNELS), dtype),
        )
        fields = (workspace.array(f"v_{name}", field.shape, dtype) for name, field in zip(g._fields, g, strict=True))
        v = Differentiated(Gaussians._make(fields), workspace.array("v_means2d", (n, 2), dtype))
        kernel, radii = gradient_kernel(dtype, self.is_atomic), tape.footprints.radii
        launch_rows(kernel, n, g, tape.eye, radii, slots, tape.survey.offsets, *v)
        return v

    def compare(self, image: Floats, photograph: Photograph, dssim_weight: float) -> Comparison:
        """Compare an image on the device with a photograph; :func:`~minisplat_ref.cuda.loss.read_loss` has the loss."""
        return compare(self._workspace, image, photograph, dssim_weight)

    def visible_widths(self, radii: Ints, limits: Ints | None) -> Any:
        """Return how many numbers of each row a visible-only Adam updates.

        Parameters
        ----------
        radii : device array of shape (N, 2)
            0 where culled.
        limits : ndarray of shape (N,), optional
            Of the rows that are seen; all numbers by default.
        """
        name = "widths" if limits is None else "limited_widths"
        widths = self._workspace.array(name, (len(radii),), np.int32)
        launch_rows(write_widths, len(radii), radii, list_on_device(limits), np.int32(ALL), widths)
        return widths
