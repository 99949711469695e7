"""The population of Gaussians with cuts, its renderer, and the recipe that trains it."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.cuts.curve import N_POINTS
from minisplat_ref.extensions.cuts.kernels import response_for
from minisplat_ref.extensions.cuts.response import RESPONSE, CutFootprints, image_points, image_points_vjp
from minisplat_ref.mechanisms.payload.renderer import Payload, PayloadGradient, Projected, payload_renderer
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Gaussians

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
    """[N, 8] control points of a cubic, in standard deviations along the Gaussian's first two axes, point by point."""
    widths: Floats
    """[N] width of the mask in the image, px; 0 makes a hard edge. Events set it; it is not trained."""


def with_cuts(gaussians: Gaussians, rng: np.random.Generator) -> CutGaussians:
    """Return Gaussians, each with a straight curve on one side of its centre in a random direction."""
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


def _is_plain(gaussians: CutGaussians) -> bool:
    return gaussians.curves.shape[1] == 0


def _footprints(projected: Projected) -> CutFootprints:
    g, rows = projected.gaussians, projected.rows
    points = np.zeros((len(g.curves), N_POINTS, 2), g.means.dtype)
    points[rows] = image_points(g.curves[rows], projected.of(rows), projected.camera, projected.conventions)
    return CutFootprints(projected.projection, points, g.widths)


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


PAYLOAD = Payload("Gaussians with cuts", RESPONSE, response_for, _is_plain, _footprints, _footprints_vjp)


def set_width(state: TrainState, iteration: Iteration, *, width: float) -> None:
    """Set the width of all masks to ``width`` pixels; 0 makes hard edges."""
    gaussians: Any = state.gaussians
    state.gaussians = gaussians._replace(widths=np.full_like(gaussians.widths, width))


CUT_GAUSSIANS = Representation(
    "Gaussians with cuts",
    population=CutGaussians,
    extend=with_cuts,
    renderer=payload_renderer("cuts", PAYLOAD),
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
"""The recipe ``cuts``: 3DGS with a cut in each Gaussian, whose edge is a pixel wide, then half a pixel, then hard."""
