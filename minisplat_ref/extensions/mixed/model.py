"""The renderer of ellipses, lines and triangles, the recipe that trains them, and the gradient check.

Colours alone are those of :mod:`.response`, and with one vertex each 3DGS renders them. With further channels the
colours are the same, and depths and normals come from planes. The channels are those of surfels, so that the losses of
:mod:`minisplat_ref.mechanisms.surfels.losses` and meshes take them as they are: ``depth``, ``sum w z`` with the depths
at the pixels; ``normal``, ``sum w n``; ``spread``, ``sum w q`` and ``sum w q^2`` of inverse depths. Left out is the
channel ``median``: the median depth has no gradient here.
"""

import functools
from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.extensions.mixed.kernels import make_response, make_surface_response
from minisplat_ref.extensions.mixed.population import (
    MixedGaussians,
    counts,
    group_gaussians,
    make_ellipses,
    promote_kinds,
    simplify_kinds,
)
from minisplat_ref.extensions.mixed.projection import (
    Hulls,
    Planes,
    fit_planes,
    footprints_vjp,
    planes_vjp,
    project_hulls,
)
from minisplat_ref.extensions.mixed.response import (
    INSIDE,
    RESPONSE,
    HullFootprints,
    SurfaceFootprints,
    SurfacePlace,
    surface_response,
)
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.payload.gradient_checks import renderer_stage
from minisplat_ref.mechanisms.payload.renderer import (
    Carried,
    Payload,
    PayloadGradient,
    Projected,
    render_payload,
    render_payload_vjp,
)
from minisplat_ref.mechanisms.surfels import renderer as discs
from minisplat_ref.mechanisms.surfels.losses import DISTORTION, NORMAL_CONSISTENCY
from minisplat_ref.mechanisms.surfels.projection import choose_pivot
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.rendering.box_lists import BOUNDLESS
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import Every
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Bools, Floats, Gaussians, Ints, Model, Projection, RenderOutput, View

PLURAL = "lines and triangles"
DEPTHS = frozenset({"depth", "normal", "spread", "median_depth"})
"""The channels that only surfaces have."""

SPAN = 1.0  # of the vertices from the first, in the Gaussians' own deviations
N_EDGES = 3


def channels(wants: frozenset[str]) -> dict[str, slice]:
    """Return the image's channels by name."""
    return discs.channels(wants - {"median"})


def _is_plain(g: MixedGaussians) -> bool:
    return bool(np.all(counts(g) == 1))


def _hulls(projected: Projected) -> Hulls:
    g: MixedGaussians = projected.gaussians
    return Hulls(projected.primitives, g.vertices, counts(g))


def _footprints(projected: Projected) -> HullFootprints:
    return project_hulls(_hulls(projected), projected.projection, projected.camera, projected.conventions)


def _footprints_vjp(projected: Projected, v: tuple[Floats, ...]) -> PayloadGradient:
    """Gradient of :func:`_footprints` for that with respect to the vertices in the image."""
    (v_vertices,) = v
    found = footprints_vjp(_hulls(projected), projected.camera, projected.conventions, v_vertices)
    fields = {"vertices": found.vertices, "n_vertices": np.zeros_like(projected.gaussians.n_vertices)}
    v_scales = np.zeros_like(projected.primitives.scales)
    return PayloadGradient(fields, found.means, found.quats, v_scales, found.cam_from_world_R, found.cam_from_world_t)


def _list_boxes(footprints: HullFootprints) -> Projection:
    """Return the projection with ellipses that reach all tiles under the boxes of lines and triangles."""
    projection = footprints.projection
    conics = np.where((footprints.n_vertices > 1)[:, None], BOUNDLESS, projection.conics)
    return projection._replace(conics=conics)


def _surfaces(projected: Projected) -> SurfaceFootprints:
    seen, camera, dtype = _footprints(projected), projected.camera, projected.gaussians.means.dtype
    rows = np.flatnonzero(seen.projection.radii[:, 0] > 0)
    found = fit_planes(_hulls(projected), rows, camera, projected.conventions)
    pivot = choose_pivot(seen.projection.depths[rows])
    planes, normals = found.planes.astype(dtype), found.normals.astype(dtype)
    return SurfaceFootprints(seen.projection, seen.vertices, seen.n_vertices, planes, normals, pivot)


def _surfaces_vjp(projected: Projected, v: tuple[Floats, ...]) -> PayloadGradient:
    """Gradient of :func:`_surfaces` for that with respect to vertices in the image, planes and normals."""
    v_vertices, v_planes, v_normals = v
    flat = _footprints_vjp(projected, (v_vertices,))
    rows = np.flatnonzero(v_planes.any(axis=1) | v_normals.any(axis=1))  # only visible hulls have derivatives
    through = planes_vjp(_hulls(projected), rows, projected.camera, projected.conventions, Planes(v_planes, v_normals))
    return PayloadGradient(
        {**flat.fields, "vertices": flat.fields["vertices"] + through.vertices},
        flat.means + through.means,
        flat.quats + through.quats,
        flat.scales + through.scales,
        flat.cam_from_world_R + through.cam_from_world_R,
        flat.cam_from_world_t + through.cam_from_world_t,
    )


def _carry(footprints: SurfaceFootprints, wants: frozenset[str]) -> Floats:
    """Return zeros, to which depths and inverse depths are added, and normals."""
    slices = channels(wants)
    carried = np.zeros((len(footprints.n_vertices), max(part.stop for part in slices.values())))
    if "normal" in slices:
        carried[:, slices["normal"]] = footprints.normals
    return carried[:, 3:]


def _carry_vjp(
    footprints: SurfaceFootprints, wants: frozenset[str], v_carried: Floats
) -> tuple[Floats, tuple[Floats, ...]]:
    """Gradient of :func:`_carry` with respect to the normals; that with respect to depths is the response's."""
    slices, v_normals = channels(wants), np.zeros_like(footprints.normals)
    if "normal" in slices:
        v_normals = v_carried[:, slices["normal"].start - 3 : slices["normal"].stop - 3]
    return np.zeros_like(footprints.projection.depths), (v_normals,)


FLAT_COLORS = Payload(
    PLURAL,
    RESPONSE,
    make_response,
    _is_plain,
    _footprints,
    _footprints_vjp,
    listed=_list_boxes,
    carried=Carried(channels),
)


@functools.cache
def make_payload(layout: Layout) -> Payload:
    """Return the payload for a layout's channels of depths; 3DGS has no such depths, so nothing is plain."""
    return FLAT_COLORS._replace(
        response=surface_response(layout),
        response_for=functools.partial(make_surface_response, layout),
        is_plain=lambda g: False,
        footprints=_surfaces,
        footprints_vjp=_surfaces_vjp,
        carried=Carried(channels, _carry, _carry_vjp),
    )


def render_mixed(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render a view; see :mod:`minisplat_ref.mechanisms.payload.renderer`.

    Raises
    ------
    InputError
        Something is wanted that this renderer does not collect.
    """
    slices, payload = channels(request.wants), FLAT_COLORS
    if request.wants & DEPTHS:
        payload = make_payload(
            Layout(*(slices[name].start if name in slices else None for name in ("depth", "spread")))
        )
    return render_payload(payload, model, view, request)


MIXED_RENDERER = Renderer("mixed", render_mixed, render_payload_vjp, channels)


def simplify_hulls(state: TrainState, iteration: Iteration, *, least: float, min_height: float) -> str:
    """Take vertices away where they make no difference, by :func:`.population.simplify_kinds`."""
    population, changed = simplify_kinds(state.gaussians, least=least, min_height=min_height)
    return _replace_population(state, population, changed)


def promote(state: TrainState, iteration: Iteration, *, ratio: float, size_fraction: float) -> str:
    """Make lines of needles and triangles of discs; see :func:`.population.promote_kinds`."""
    size_limit = size_fraction * iteration.scene.extent
    population, changed = promote_kinds(state.gaussians, ratio=ratio, size_limit=size_limit)
    return _replace_population(state, population, changed)


def _replace_population(state: TrainState, population: MixedGaussians, changed: Bools) -> str:
    """Replace the population; primitives that have changed shape lose the moments of their shape."""
    state.gaussians = population
    for moment in (state.adam.first, state.adam.second):
        for name in ("means", "quats", "log_scales", "vertices"):
            getattr(moment, name)[changed] = 0
    n = np.bincount(counts(population), minlength=4)
    return f"{np.count_nonzero(changed)} changed: {n[1]} ellipses, {n[2]} lines, {n[3]} triangles"


MIXED_GAUSSIANS = Representation(
    "ellipses, lines and triangles",
    population=MixedGaussians,
    units={**WORLD_UNITS, "vertices": Unit.LENGTH},
    extend=group_gaussians,
    renderer=MIXED_RENDERER,
    rates=Rates({"vertices": 2e-4, "n_vertices": 0.0}, frozenset({"vertices"})),
)

_changing = partial(Every, 500, stop=15_000, min_gap=100)

MIXED = GS_ACCEL._replace(
    name="mixed",
    losses=(*GS_ACCEL.losses, NORMAL_CONSISTENCY, DISTORTION),
    events=(
        *GS_ACCEL.events,
        _changing(partial(simplify_hulls, least=0.5, min_height=0.5), start=1_000),
        _changing(partial(promote, ratio=6.0, size_fraction=0.01), start=1_000),
    ),
)
"""``mixed``: 3DGS with ellipses, lines and triangles, and the losses of surfels."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer; the reference finds the hits, and the nearest points of hulls."""
    of_all = MIXED_GAUSSIANS._replace(extend=mix_kinds)
    return (renderer_stage(backend, setting, of_all, _sides, rng, frozenset({"depth", "normal", "spread"})),)


def mix_kinds(gaussians: Gaussians, rng: np.random.Generator) -> MixedGaussians:
    """Return the Gaussians themselves as alternating triangles, ellipses and lines, with random vertices."""
    population, n = make_ellipses(gaussians), len(gaussians.means)
    in_deviations = SPAN * rng.normal(size=(n, 2, 2))
    vertices = in_deviations * np.exp(gaussians.log_scales[:, None, :2])
    kinds = np.array([3, 1, 2])[np.arange(n) % 3].astype(gaussians.means.dtype)
    return population._replace(vertices=vertices.reshape(n, 4).astype(gaussians.means.dtype), n_vertices=kinds)


def _sides(tile: TileHits, colors: Floats) -> tuple[Bools | Ints, ...]:
    """Return which hits count, which are clamped, and on which edge or, numbered behind them, vertex they are.

    Squares of distances have no second derivative where the nearest point goes from an edge to a vertex.
    """
    place: SurfacePlace = tile.hit.place
    is_hit, found = tile.alphas > 0, place.hull.place.nearest
    vertex = np.argmax(found.weights, axis=2)
    is_vertex = (found.edges != INSIDE) & (found.weights.max(axis=2) == 1)
    return (
        is_hit,
        tile.is_clamped,
        place.is_bounded,
        np.where(is_hit, np.where(is_vertex, N_EDGES + vertex, found.edges), -2),
    )
