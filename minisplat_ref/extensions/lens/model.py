"""The renderer of Gaussians along the true rays of a lens, its gradient, the checks of both, and the recipe."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.cameras import footprint_kernels, ray_footprints
from minisplat_ref.mechanisms.cameras.kernels import response_for
from minisplat_ref.mechanisms.cameras.models import are_inside
from minisplat_ref.mechanisms.cameras.ray_footprints import RESPONSE, FootprintGradient, LensFootprints, list_tiles
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.models import Drawn, hit_sides, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering import (
    SPLATTING,
    Renderer,
    RenderGradient,
    Request,
    activate,
    choose_degree,
    parameters_vjp,
)
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.rendering.splatting import append_depths
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Camera, Floats, Ints, Model, Optics, Primitives, RenderOutput, TileBins, View

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

    def list_tiles(self) -> TileBins:
        """Return the tiles' lists, nearest means first."""
        return list_tiles(self.footprints, self.camera, self.backend, self.conventions)


class _Tape(NamedTuple):
    """The values that :func:`render_through_lens` keeps for :func:`render_through_lens_vjp`."""

    prepared: Prepared
    bins: TileBins
    output: RenderOutput


def _projection(backend: Backend) -> Any:
    """Return the module that projects: kernels or the reference."""
    return footprint_kernels if backend.is_compiled else ray_footprints


def prepare(model: Model, camera: Camera, request: Request) -> Prepared:
    """Project and shade the Gaussians of a model."""
    g, dtype = model.gaussians, model.gaussians.means.dtype
    degree = choose_degree(g.sh_rest, request.sh_degree)
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)
    primitives = activate(g, request.is_visible, request.opacity_factor)
    footprints = _projection(request.backend).project(primitives, camera, request.conventions)
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


def render_through_lens(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
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
    bins = p.list_tiles()
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
    tape = _Tape(p, bins, output)
    return output._replace(visible_ids=visible_ids, n_pairs=len(bins.gaussian_ids), extras=extras), tape


def render_through_lens_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_through_lens`.

    Means and pose have two terms, of the rays and of the viewing direction.
    """
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
    v_primitives, v_means2d = _projection(p.backend).project_vjp(p.primitives, footprints, v_footprints)
    v_sh = p.backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, p.camera, p.sh_degree, footprints.radii, v_colors)
    return RenderGradient(
        gaussians=parameters_vjp(g, p.primitives, v_primitives, v_sh),
        background=v_background,
        cam_from_world_R=v_primitives.cam_from_world_R + v_sh.cam_from_world_R,
        cam_from_world_t=v_primitives.cam_from_world_t + v_sh.cam_from_world_t,
        means2d=v_means2d,
    )


THROUGH_LENS = Representation(
    "gaussians along the rays of a lens",
    renderer=Renderer("lens", render_through_lens, render_through_lens_vjp, SPLATTING.channels, scales_opacities=True),
    takes_optics=True,
    is_inside=are_inside,
)

OPTICS = (
    None,
    Optics("brown", (-0.2, 0.05, 0.01, 0.02, 0.01, 0.0, 0.01, -0.02)),
    Optics("fisheye", (0.05, -0.02, 0.01, 0.0)),
)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer with each lens; points record which hits are listed, blended and clamped."""
    return tuple(_stage(backend, setting, optics, rng) for optics in OPTICS)


def _stage(backend: Backend, setting: Setting, optics: Optics | None, rng: np.random.Generator) -> Stage:
    camera = setting.camera._replace(optics=optics)
    bent = setting._replace(camera=camera)
    name = THROUGH_LENS.name if optics is None else f"{THROUGH_LENS.name}, {optics.model}"

    def sides(drawn: Drawn) -> list[np.ndarray]:
        prepared = prepare(drawn.model, drawn.view.camera, drawn.request._replace(backend=REFERENCE))
        bins = prepared.list_tiles()
        return [bins.gaussian_ids, *hit_sides(tile_hits(prepared.footprints, bins, setting.conventions, RESPONSE))]

    return model_stage(backend, bent, THROUGH_LENS._replace(name=name), rng, sides_of=sides)


LENS = GS_ACCEL._replace(name="lens")
"""The recipe ``lens``: 3DGS on photographs as they were taken."""
