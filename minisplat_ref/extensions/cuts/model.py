"""The population of Gaussians with cuts, its renderer, its gradient check, and the recipe that trains it."""

from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cuts.kernels import response_for
from minisplat_ref.extensions.cuts.response import (
    N_EDGES,
    N_PIECES,
    N_POINTS,
    RESPONSE,
    TOPS,
    CutFootprints,
    image_points,
    image_points_vjp,
)
from minisplat_ref.mechanisms.payload.gradient_checks import renderer_stage
from minisplat_ref.mechanisms.payload.renderer import Payload, PayloadGradient, Projected, payload_renderer
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, View

N_CURVES_MAX = 4  # of a Gaussian: kernels are compiled for each number
START = 1.0  # initial distance of a curve from the centre, in standard deviations; farther out it would learn nothing
REACH = 3.0  # initial half-length of a curve, in standard deviations
WIDTH = 1.0  # px, of masks at the start of a training


class CutGaussians(NamedTuple):
    """Gaussians with cuts; the other fields are those of :class:`Gaussians`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    curves: Floats
    """[N, 8 M] control points of M cubics, in standard deviations along the first two axes, point by point."""
    widths: Floats
    """[N] width of the mask in the image, px; 0 makes a hard edge. Events set it; it is not trained."""


def with_cuts(gaussians: Gaussians, rng: np.random.Generator, *, n_curves: int = 1) -> CutGaussians:
    """Return Gaussians, each with straight curves on sides of its centre: one in a random direction, others around it.

    Raises
    ------
    InputError
        The number of curves is not from 1 to ``N_CURVES_MAX``.
    """
    if not 1 <= n_curves <= N_CURVES_MAX:
        raise InputError(f"n_curves is {n_curves}: give 1 to {N_CURVES_MAX} curves per Gaussian")
    n, dtype = len(gaussians.means), gaussians.means.dtype
    angles = rng.uniform(0, 2 * np.pi, n)[:, None] + 2 * np.pi / n_curves * np.arange(n_curves)  # [N, M]
    outwards = np.stack([np.cos(angles), np.sin(angles)], axis=2)[:, :, None]  # [N, M, 1, 2]
    across = outwards[..., ::-1] * [-1, 1]
    curves = START * outwards + np.linspace(-REACH, REACH, N_POINTS)[:, None] * across  # [N, M, 4, 2]
    return CutGaussians(
        **{name: getattr(gaussians, name) for name in Gaussians._fields},
        curves=curves.reshape(n, 2 * N_POINTS * n_curves).astype(dtype),
        widths=np.full(n, WIDTH, dtype),
    )


def _is_plain(gaussians: CutGaussians) -> bool:
    return gaussians.curves.shape[1] == 0


def _footprints(projected: Projected) -> CutFootprints:
    g, rows = projected.gaussians, projected.rows
    points = np.zeros((len(g.curves), g.curves.shape[1] // 2, 2), g.means.dtype)
    points[rows] = image_points(g.curves[rows], projected.of(rows), projected.camera, projected.conventions)
    return CutFootprints(projected.projection, points, g.widths, projected.conventions.alpha_min)


def _footprints_vjp(projected: Projected, v: tuple[Floats, ...]) -> PayloadGradient:
    """Gradient of :func:`_footprints` for that with respect to the points; widths are not learnt."""
    (v_points,) = v
    g, rows = projected.gaussians, projected.rows
    of_rows = g.curves[rows], projected.of(rows), projected.camera, projected.conventions
    v_seen = image_points_vjp(*of_rows, v_points[rows])
    v_curves, v_means, v_quats, v_scales = (
        np.zeros_like(field) for field in (g.curves, g.means, g.quats, projected.primitives.scales)
    )
    v_curves[rows], v_means[rows] = v_seen.curves, v_seen.means
    v_quats[rows], v_scales[rows] = v_seen.quats, v_seen.scales
    fields = {"curves": v_curves, "widths": np.zeros_like(g.widths)}
    return PayloadGradient(fields, v_means, v_quats, v_scales, v_seen.cam_from_world_R, v_seen.cam_from_world_t)


@cache
def _renderer_of(n_curves: int) -> Renderer:
    response = partial(response_for, n_curves)
    payload = Payload("Gaussians with cuts", RESPONSE, response, _is_plain, _footprints, _footprints_vjp)
    return payload_renderer("cuts", payload)


def render_cuts(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Render a view with as many curves as the Gaussians have; see :mod:`minisplat_ref.mechanisms.payload.renderer`.

    Raises
    ------
    InputError
        The columns of the curves are not whole curves, or something is wanted that this renderer does not collect.
    """
    n_curves, rest = divmod(model.gaussians.curves.shape[1], 2 * N_POINTS)
    if rest or n_curves > N_CURVES_MAX:
        raise InputError(
            f"curves have {model.gaussians.curves.shape[1]} numbers per Gaussian: {2 * N_POINTS} for each of up to"
            f" {N_CURVES_MAX} curves are drawn"
        )
    return _renderer_of(n_curves).render(model, view, request)


CUT_GAUSSIANS = Representation(
    "Gaussians with cuts",
    population=CutGaussians,
    extend=partial(with_cuts, n_curves=1),
    renderer=Renderer("cuts", render_cuts, _renderer_of(1).render_vjp, SPLATTING.channels),
    rates=Rates({"curves": 1e-2, "widths": 0.0}, frozenset()),
)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer of two curves as a stage; the reference finds the hits that count, and the nearest pieces."""
    return (renderer_stage(backend, setting, CUT_GAUSSIANS._replace(extend=_near), _sides, rng),)


def _near(gaussians: Gaussians, rng: np.random.Generator) -> CutGaussians:
    """Return Gaussians whose curves pass through their bright parts; otherwise little would depend on them."""
    population = with_cuts(gaussians, rng, n_curves=2)
    return population._replace(curves=0.4 * population.curves)


def _sides(tile: TileHits, colors: Floats) -> tuple[np.ndarray, ...]:
    """Return which hits count, which are clamped, and the nearest vertex or, numbered after the vertices, piece."""
    is_hit, found = tile.alphas > 0, tile.hit.place.cut
    edges, (curves, pieces) = np.arange(N_EDGES), np.divmod(found.pieces, N_PIECES)
    first, last = np.array([*edges, 0, N_EDGES]), np.array([*edges + 1, 0, N_EDGES])  # vertices of each piece
    nearest = np.where(found.fractions > 0, N_EDGES + 1 + pieces, first[pieces])
    nearest = np.where(found.fractions < TOPS[pieces], nearest, last[pieces])
    return is_hit, tile.is_clamped, np.where(is_hit, nearest, -1), np.where(is_hit, curves, -1)


def set_width(state: TrainState, iteration: Iteration, *, width: float) -> None:
    """Set the width of all masks to ``width`` pixels; 0 makes hard edges."""
    gaussians: Any = state.gaussians
    state.gaussians = gaussians._replace(widths=np.full_like(gaussians.widths, width))


CUTS = GS_ACCEL._replace(
    name="cuts",
    events=(
        *GS_ACCEL.events,
        At(15_000, partial(set_width, width=0.5)),
        At(30_000, partial(set_width, width=0.0)),
    ),
)
"""The recipe ``cuts``: 3DGS with a cut in each Gaussian, whose edge is a pixel wide, then half a pixel, then hard."""
