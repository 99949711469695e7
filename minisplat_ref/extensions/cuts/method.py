"""The population of Gaussians with cuts, how it is drawn, and the recipe that trains it."""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cuts.curve import N_POINTS
from minisplat_ref.extensions.cuts.kernels import response_for
from minisplat_ref.extensions.cuts.response import RESPONSE, CutFootprints, image_points, image_points_vjp
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, RenderTape, Request
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import (
    Camera,
    Floats,
    Gaussians,
    Ints,
    Model,
    Primitives,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
    View,
)

START = 1.0  # deviations from the centre at which a curve begins: where nothing is drawn, it would learn nothing
REACH = 3.0  # deviations that it goes to either side there
WIDTH = 1.0  # px, of masks at the start of a training
BY_REFERENCE = frozenset({"stats", "median_depth"})  # what the plain kernels do not collect


class CutGaussians(NamedTuple):
    """Gaussians with cuts; the other fields are those of :class:`Gaussians`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    curves: Floats
    """[N, 8] control points of a cubic, in deviations along the Gaussian's first two axes, one after the other."""
    widths: Floats
    """[N] px, of the mask in the image: 0 is a hard edge. Set by events, not learnt."""


def with_cuts(gaussians: Gaussians, rng: np.random.Generator) -> CutGaussians:
    """Return Gaussians with a straight curve each, at the side, in a random direction."""
    n, dtype = len(gaussians.means), gaussians.means.dtype
    angles = rng.uniform(0, 2 * np.pi, n)
    outwards = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]  # [N, 1, 2]
    across = outwards[..., ::-1] * [-1, 1]
    curves = START * outwards + np.linspace(-REACH, REACH, N_POINTS)[:, None] * across  # [N, 4, 2]
    return CutGaussians(
        **{name: getattr(gaussians, name) for name in Gaussians._fields},
        curves=curves.reshape(n, 2 * N_POINTS).astype(dtype),
        widths=np.full(n, WIDTH, dtype),
    )


class _Tape(NamedTuple):
    """What :func:`render` did."""

    gaussians: CutGaussians
    request: Request
    camera: Camera
    sh_degree: int | Ints  # active
    primitives: Primitives  # activated
    blended: tuple[CutFootprints, Floats, Floats, TileBins]  # footprints, colours, background, tile lists
    output: RenderOutput


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Draw the view; of Gaussians without control points as 3DGS does.

    Raises
    ------
    InputError
        Something is wanted that is not collected here.
    """
    g: CutGaussians = model.gaussians
    if g.curves.shape[1] == 0:
        return SPLATTING.render(model, view, request)
    backend, conventions, dtype, camera = request.backend, request.conventions, g.means.dtype, view.camera
    missing = request.wants - {"depth"} - (frozenset() if backend.is_compiled else BY_REFERENCE)
    if missing:
        way_out = "use --backend reference" if missing <= BY_REFERENCE else "train a recipe that does without"
        raise InputError(f"Gaussians with cuts are drawn without {', '.join(sorted(missing))}: {way_out}")
    stored_degree = math.isqrt(g.sh_rest.shape[1] + 1) - 1
    sh_degree = stored_degree if request.sh_degree is None else np.minimum(request.sh_degree, stored_degree)
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)

    with np.errstate(over="ignore"):
        scales = np.minimum(np.exp(g.log_scales), np.finfo(dtype).max)
        opacities = 1 / (1 + np.exp(-g.opacity_logits))
    if request.is_visible is not None:
        opacities = np.where(request.is_visible, opacities, opacities.dtype.type(0))
    primitives = Primitives(g.means, g.quats, scales, opacities)
    projection = backend.project(*primitives, camera, conventions)
    colors = backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, sh_degree, projection.radii)  # [N, 3]
    if "depth" in request.wants:
        colors = np.column_stack([colors, projection.depths])
        background = np.append(background, background.dtype.type(0))
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(projection, grid, conventions)
    visible_ids = np.flatnonzero(projection.radii[:, 0] > 0)
    points = np.zeros((len(colors), N_POINTS, 2), dtype)
    points[visible_ids] = image_points(g.curves[visible_ids], _of(primitives, visible_ids), camera, conventions)
    blended = CutFootprints(projection, points, g.widths), colors, background, bins
    if backend.is_compiled:
        output = kernel_hits.composite_hits(response_for(dtype), *blended, conventions)
    else:
        with_stats, with_median_depth = "stats" in request.wants, "median_depth" in request.wants
        output = composite_hits(
            RESPONSE, *blended, conventions, with_stats=with_stats, with_median_depth=with_median_depth
        )
    output = output._replace(visible_ids=visible_ids, n_pairs=len(bins.gaussian_ids))
    return output, _Tape(g, request, camera, sh_degree, primitives, blended, output)


def render_vjp(tape: _Tape | RenderTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`: of the projection, the colours and the curves, added up."""
    if isinstance(tape, RenderTape):
        return SPLATTING.render_vjp(tape, v_image, v_alpha)
    g, backend, conventions, camera = tape.gaussians, tape.request.backend, tape.request.conventions, tape.camera
    v_alpha = np.zeros_like(tape.output.alpha) if v_alpha is None else v_alpha
    arguments = *tape.blended, conventions, tape.output, (v_image, v_alpha)
    if backend.is_compiled:
        v = kernel_hits.composite_hits_vjp(response_for(g.means.dtype), *arguments)
    else:
        v = composite_hits_vjp(RESPONSE, *arguments)
    v_means2d, v_conics, v_opacities, v_points = v.primitives

    projection, primitives = tape.blended[0].projection, tape.primitives
    v_depths = np.ascontiguousarray(v.colors[:, 3]) if v_image.shape[2] > 3 else np.zeros_like(projection.depths)
    v_projection = ProjectionGradient(v_means2d, v_depths, v_conics, v_opacities)
    v_flat = backend.project_vjp(*primitives, camera, conventions, projection, v_projection)
    v_rgb = np.ascontiguousarray(v.colors[:, :3])
    v_sh = backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, tape.sh_degree, projection.radii, v_rgb)
    rows = np.flatnonzero(projection.radii[:, 0] > 0)
    v_cut = image_points_vjp(g.curves[rows], _of(primitives, rows), camera, conventions, v_points[rows])
    v_means, v_quats, v_scales = v_flat.means + v_sh.means, v_flat.quats.copy(), v_flat.scales.copy()
    v_means[rows] += v_cut.means
    v_quats[rows] += v_cut.quats
    v_scales[rows] += v_cut.scales
    v_curves = np.zeros_like(g.curves)
    v_curves[rows] = v_cut.curves
    with np.errstate(over="ignore"):
        transparencies = 1 / (1 + np.exp(g.opacity_logits))
    return RenderGradient(
        gaussians=CutGaussians(
            means=v_means,
            quats=v_quats,
            log_scales=primitives.scales * v_scales,
            opacity_logits=primitives.opacities * transparencies * v_flat.opacities,
            sh_dc=v_sh.sh_dc,
            sh_rest=v_sh.sh_rest,
            curves=v_curves,
            widths=np.zeros_like(g.widths),
        ),
        background=v.background[:3],
        cam_from_world_R=v_flat.cam_from_world_R + v_sh.cam_from_world_R + v_cut.cam_from_world_R,
        cam_from_world_t=v_flat.cam_from_world_t + v_sh.cam_from_world_t + v_cut.cam_from_world_t,
        means2d=v_means2d,
    )


def _of(primitives: Primitives, rows: Ints) -> Primitives:
    return Primitives(*(field[rows] for field in primitives))


def set_width(state: TrainState, iteration: Iteration, *, width: float) -> None:
    """Make all masks ``width`` pixels wide; 0 makes hard edges."""
    gaussians: Any = state.gaussians
    state.gaussians = gaussians._replace(widths=np.full_like(gaussians.widths, width))


CUT_GAUSSIANS = Representation(
    "Gaussians with cuts",
    population=CutGaussians,
    extend=with_cuts,
    renderer=Renderer("cuts", render, render_vjp, SPLATTING.channels),
    rates=Rates({"curves": 1e-2, "widths": 0.0}, frozenset()),
)

CUTS = GS_ACCEL._replace(
    name="cuts",
    events=(
        *GS_ACCEL.events,
        At(15_000, partial(set_width, width=0.5)),
        At(30_000, partial(set_width, width=0.0)),
    ),
)
"""``cuts``: 3DGS with a cut through each Gaussian: its edge is a pixel wide, then half of one, and hard in the end."""
