"""The renderer of Gaussians along the true rays of a lens, and its gradient."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.cameras.kernels import response_for
from minisplat_ref.mechanisms.cameras.ray_footprints import (
    RESPONSE,
    FootprintGradient,
    LensFootprints,
    list_tiles,
    project,
    project_vjp,
)
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.rendering import RenderGradient, Request, activate, choose_degree, parameters_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.rendering.splatting import append_depths
from minisplat_ref.types import (
    Camera,
    Floats,
    Ints,
    Model,
    Primitives,
    RenderOutput,
    TileBins,
    View,
)

WANTS = frozenset({"depth", "stats", "median_depth", "dominant_depth"})


class Prepared(NamedTuple):
    """A view of Gaussians after projection and shading."""

    gaussians: Any
    sh_degree: int | Ints  # active
    primitives: Primitives
    camera: Camera
    footprints: LensFootprints
    channels: Floats  # [N, D] colours, then the depth on request
    background: Floats  # [D]
    has_depth: bool
    conventions: Conventions
    backend: Backend

    def listed(self) -> TileBins:
        """Return the tiles' lists, nearest means first."""
        return list_tiles(self.footprints, self.camera, self.backend, self.conventions)


class Tape(NamedTuple):
    """The values that :func:`render` keeps for :func:`render_vjp`."""

    prepared: Prepared
    bins: TileBins
    output: RenderOutput


def prepare(model: Model, camera: Camera, request: Request) -> Prepared:
    """Project and shade the Gaussians of a model."""
    g, dtype = model.gaussians, model.gaussians.means.dtype
    degree = choose_degree(g.sh_rest, request.sh_degree)
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)
    primitives = activate(g, request.is_visible)
    footprints = project(primitives, camera, request.conventions)
    channels = request.backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, degree, footprints.radii)
    has_depth = "depth" in request.wants
    if has_depth:
        channels, background = append_depths(channels, background, footprints.depths)
    return Prepared(
        g,
        degree,
        primitives,
        camera,
        footprints,
        channels,
        background,
        has_depth,
        request.conventions,
        request.backend,
    )


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Tape]:
    """Render a view as its camera's lens shows it; return the image and a tape.

    Raises
    ------
    InputError
        Something is wanted that needs an image without distortion, or the camera is refused by
        :func:`~minisplat_ref.mechanisms.cameras.ray_footprints.project`.
    """
    if request.wants - WANTS:
        names = ", ".join(sorted(request.wants - WANTS))
        raise InputError(f"lens does not give {names}: use a recipe that does not ask for it, such as 3dgs-accel")
    p = prepare(model, view.camera, request)
    bins = p.listed()
    blend = (
        partial(kernel_hits.composite_hits, response_for(p.channels.dtype))
        if p.backend.is_compiled
        else partial(composite_hits, RESPONSE)
    )
    output = blend(
        p.footprints,
        p.channels,
        p.background,
        bins,
        p.conventions,
        with_stats=bool(request.wants & {"stats", "dominant_depth"}),
        with_median_depth="median_depth" in request.wants,
    )
    extras = {}
    if "dominant_depth" in request.wants:
        assert output.stats is not None
        extras["dominant_depth"] = np.append(p.footprints.depths, 0)[output.stats.dominant_ids].astype(p.channels.dtype)
    visible_ids = np.flatnonzero(p.footprints.radii[:, 0] > 0)
    tape = Tape(p, bins, output)
    return output._replace(visible_ids=visible_ids, n_pairs=len(bins.gaussian_ids), extras=extras), tape


def render_vjp(tape: Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`; means and pose have two terms, of the rays and of the viewing direction."""
    p, bins, output = tape
    g, footprints = p.gaussians, p.footprints
    v_output = v_image, np.zeros_like(output.alpha) if v_alpha is None else v_alpha
    inputs = footprints, p.channels, p.background, bins, p.conventions, output, v_output
    if p.backend.is_compiled:
        v = kernel_hits.composite_hits_vjp(response_for(p.channels.dtype), *inputs)
    else:
        v = composite_hits_vjp(RESPONSE, *inputs)
    v_colors, v_background, v_depths = v.colors, v.background, np.zeros(len(v.colors))
    if p.has_depth:
        v_colors, v_depths = np.ascontiguousarray(v.colors[:, :-1]), v.colors[:, -1].astype(np.float64)
        v_background = v.background[:-1]
    v_positions, v_whitenings, v_opacities = v.primitives
    v_footprints = FootprintGradient(v_positions, v_whitenings, v_opacities, v_depths)
    v_primitives, v_means2d = project_vjp(p.primitives, footprints, v_footprints)
    v_sh = p.backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, p.camera, p.sh_degree, footprints.radii, v_colors)
    return RenderGradient(
        gaussians=parameters_vjp(g, p.primitives, v_primitives, v_sh),
        background=v_background,
        cam_from_world_R=v_primitives.cam_from_world_R + v_sh.cam_from_world_R,
        cam_from_world_t=v_primitives.cam_from_world_t + v_sh.cam_from_world_t,
        means2d=v_means2d,
    )
