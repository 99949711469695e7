"""How ellipses, lines and triangles are drawn, and the recipe that trains them."""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.mixed.kernels import response_for
from minisplat_ref.extensions.mixed.kinds import promoted, simplified
from minisplat_ref.extensions.mixed.population import MixedGaussians, counts, grouped
from minisplat_ref.extensions.mixed.projection import Hulls, footprints_of, footprints_vjp
from minisplat_ref.extensions.mixed.response import RESPONSE, Footprints
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, RenderTape, Request
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import Every
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import (
    Bools,
    Camera,
    Floats,
    Model,
    Primitives,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
    View,
)

BY_REFERENCE = frozenset({"stats", "median_depth"})  # what the plain kernels do not collect

BOUNDLESS = np.array([1e-12, 0.0, 1e-12])  # px^-2: a million pixels


class _Tape(NamedTuple):
    """What :func:`render` did."""

    gaussians: MixedGaussians
    request: Request
    camera: Camera
    sh_degree: int  # active
    hulls: Hulls
    blended: tuple[Footprints, Floats, Floats, TileBins]  # footprints, colours, background, tile lists
    output: RenderOutput


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Draw the view; of ellipses alone as 3DGS does.

    Raises
    ------
    InputError
        Something is wanted that is not collected here.
    """
    g: MixedGaussians = model.gaussians
    n_vertices = counts(g)
    if np.all(n_vertices == 1):
        return SPLATTING.render(model, view, request)
    backend, conventions, dtype, camera = request.backend, request.conventions, g.means.dtype, view.camera
    missing = request.wants - {"depth"} - (frozenset() if backend.is_compiled else BY_REFERENCE)
    if missing:
        way_out = "use --backend reference" if missing <= BY_REFERENCE else "train a recipe that does without"
        raise InputError(f"lines and triangles are drawn without {', '.join(sorted(missing))}: {way_out}")
    stored_degree = math.isqrt(g.sh_rest.shape[1] + 1) - 1
    sh_degree = stored_degree if request.sh_degree is None else min(request.sh_degree, stored_degree)
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)

    with np.errstate(over="ignore"):
        scales = np.minimum(np.exp(g.log_scales), np.finfo(dtype).max)
        opacities = 1 / (1 + np.exp(-g.opacity_logits))
    if request.is_visible is not None:
        opacities = np.where(request.is_visible, opacities, opacities.dtype.type(0))
    primitives = Primitives(g.means, g.quats, scales, opacities)
    hulls = Hulls(primitives, g.vertices, n_vertices)
    footprints = footprints_of(hulls, backend.project(*primitives, camera, conventions), camera, conventions)
    projection = footprints.projection
    colors = backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, sh_degree, projection.radii)  # [N, 3]
    if "depth" in request.wants:
        colors = np.column_stack([colors, projection.depths])
        background = np.append(background, background.dtype.type(0))
    bins = tile_lists(footprints, camera, conventions, backend)
    blended = footprints, colors, background, bins
    if backend.is_compiled:
        output = kernel_hits.composite_hits(response_for(dtype), *blended, conventions)
    else:
        with_stats, with_median_depth = "stats" in request.wants, "median_depth" in request.wants
        output = composite_hits(
            RESPONSE, *blended, conventions, with_stats=with_stats, with_median_depth=with_median_depth
        )
    visible_ids = np.flatnonzero(projection.radii[:, 0] > 0)
    output = output._replace(visible_ids=visible_ids, n_pairs=len(bins.gaussian_ids))
    return output, _Tape(g, request, camera, sh_degree, hulls, blended, output)


def render_vjp(tape: _Tape | RenderTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`: of ellipses, of colours and of vertices, added up."""
    if isinstance(tape, RenderTape):
        return SPLATTING.render_vjp(tape, v_image, v_alpha)
    g, backend, conventions, camera = tape.gaussians, tape.request.backend, tape.request.conventions, tape.camera
    v_alpha = np.zeros_like(tape.output.alpha) if v_alpha is None else v_alpha
    arguments = *tape.blended, conventions, tape.output, (v_image, v_alpha)
    if backend.is_compiled:
        v = kernel_hits.composite_hits_vjp(response_for(g.means.dtype), *arguments)
    else:
        v = composite_hits_vjp(RESPONSE, *arguments)
    v_means2d, v_conics, v_opacities, v_vertices = v.primitives

    hulls, footprints = tape.hulls, tape.blended[0]
    primitives, projection = hulls.primitives, footprints.projection
    v_depths = np.ascontiguousarray(v.colors[:, 3]) if v_image.shape[2] > 3 else np.zeros_like(projection.depths)
    v_projection = ProjectionGradient(v_means2d, v_depths, v_conics, v_opacities)
    v_flat = backend.project_vjp(*primitives, camera, conventions, projection, v_projection)
    v_rgb = np.ascontiguousarray(v.colors[:, :3])
    v_sh = backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, tape.sh_degree, projection.radii, v_rgb)
    v_hulls = footprints_vjp(hulls, footprints, camera, conventions, v_vertices)
    with np.errstate(over="ignore"):
        transparencies = 1 / (1 + np.exp(g.opacity_logits))
    return RenderGradient(
        gaussians=MixedGaussians(
            means=v_flat.means + v_sh.means + v_hulls.means,
            quats=v_flat.quats + v_hulls.quats,
            log_scales=primitives.scales * v_flat.scales,
            opacity_logits=primitives.opacities * transparencies * v_flat.opacities,
            sh_dc=v_sh.sh_dc,
            sh_rest=v_sh.sh_rest,
            vertices=v_hulls.vertices,
            n_vertices=np.zeros_like(g.n_vertices),
        ),
        background=v.background[:3],
        cam_from_world_R=v_flat.cam_from_world_R + v_sh.cam_from_world_R + v_hulls.cam_from_world_R,
        cam_from_world_t=v_flat.cam_from_world_t + v_sh.cam_from_world_t + v_hulls.cam_from_world_t,
        means2d=v_means2d,
    )


def tile_lists(footprints: Footprints, camera: Camera, conventions: Conventions, backend: Backend) -> TileBins:
    """Return the tiles' lists, nearest means first; a line or triangle is in the lists of all tiles under its box."""
    projection = footprints.projection
    # The backend leaves out tiles that an ellipse does not reach: one that is nearly without bounds reaches all.
    conics = np.where((footprints.n_vertices > 1)[:, None], BOUNDLESS, projection.conics)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    return backend.bin_gaussians(projection._replace(conics=conics), grid, conventions)


def simplify_hulls(state: TrainState, iteration: Iteration, *, least: float, least_height: float) -> str:
    """Take vertices away where they make no difference; see :func:`minisplat_ref.extensions.mixed.kinds.simplified`."""
    population, changed = simplified(state.gaussians, least=least, least_height=least_height)
    return _changed(state, population, changed)


def promote(state: TrainState, iteration: Iteration, *, ratio: float, size_fraction: float) -> str:
    """Make lines of needles and triangles of discs; see :func:`minisplat_ref.extensions.mixed.kinds.promoted`."""
    size_limit = size_fraction * iteration.scene.extent
    population, changed = promoted(state.gaussians, ratio=ratio, size_limit=size_limit)
    return _changed(state, population, changed)


def _changed(state: TrainState, population: MixedGaussians, changed: Bools) -> str:
    """Replace the population; what has changed its shape loses the moments of its shape."""
    state.gaussians = population
    for moment in (state.adam.first, state.adam.second):
        for name in ("means", "quats", "log_scales", "vertices"):
            getattr(moment, name)[changed] = 0
    n = np.bincount(counts(population), minlength=4)
    return f"{np.count_nonzero(changed)} changed: {n[1]} ellipses, {n[2]} lines, {n[3]} triangles"


MIXED_GAUSSIANS = Representation(
    "ellipses, lines and triangles",
    population=MixedGaussians,
    extend=grouped,
    renderer=Renderer("mixed", render, render_vjp, SPLATTING.channels),
    rates=Rates({"vertices": 2e-4, "n_vertices": 0.0}, frozenset({"vertices"})),
)

_changing = partial(Every, 500, stop=15_000, least_gap=100)

MIXED = GS_ACCEL._replace(
    name="mixed",
    events=(
        *GS_ACCEL.events,
        _changing(partial(simplify_hulls, least=0.5, least_height=0.5), start=1_000),
        _changing(partial(promote, ratio=6.0, size_fraction=0.01), start=1_000),
    ),
)
"""``mixed``: 3DGS with ellipses, lines and triangles."""
