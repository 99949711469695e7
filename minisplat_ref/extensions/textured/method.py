"""How textured Gaussians are drawn, and the recipes that train them."""

import math
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.textured.kernels import filled_up, response_for
from minisplat_ref.extensions.textured.population import TexturedGaussians, blank
from minisplat_ref.extensions.textured.reference import visible_frames, visible_frames_vjp
from minisplat_ref.extensions.textured.response import RESPONSE, Footprints, bounds
from minisplat_ref.methods.gaussian_splatting import GS, GS_ACCEL
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, RenderTape, Request
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import (
    Camera,
    Floats,
    Ints,
    Model,
    Primitives,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
    View,
)

BY_REFERENCE = frozenset({"stats", "median_depth"})  # what the plain kernels do not collect


class _Tape(NamedTuple):
    """What :func:`render` did."""

    gaussians: TexturedGaussians
    request: Request
    camera: Camera
    sh_degree: int | Ints  # active, of the view-dependent colour
    primitives: Primitives  # activated, with the opacity o_B
    blended: tuple[Footprints, Floats, Floats, TileBins]  # footprints, coefficients of colour, background, tile lists
    output: RenderOutput


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
    """Draw the view; without textures by 3DGS itself.

    Raises
    ------
    InputError
        Something is wanted that is not collected here.
    """
    g: TexturedGaussians = model.gaussians
    if g.opacity_textures.shape[1] == 0:
        return SPLATTING.render(model, view, request)
    backend, conventions, dtype, camera = request.backend, request.conventions, g.means.dtype, view.camera
    missing = request.wants - {"depth"} - (frozenset() if backend.is_compiled else BY_REFERENCE)
    if missing:
        way_out = "use --backend reference" if missing <= BY_REFERENCE else "train a recipe that does without"
        raise InputError(f"textured Gaussians are drawn without {', '.join(sorted(missing))}: {way_out}")
    stored_degree = math.isqrt(g.sh_rest.shape[1] + 1) - 1
    sh_degree = stored_degree if request.sh_degree is None else np.minimum(request.sh_degree, stored_degree)
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)

    with np.errstate(over="ignore"):
        scales = np.minimum(np.exp(g.log_scales), np.finfo(dtype).max)
        opacities = 1 / (1 + np.exp(-(g.opacity_logits + bounds(g.opacity_textures))))
    if request.is_visible is not None:
        opacities = np.where(request.is_visible, opacities, opacities.dtype.type(0))
    primitives = Primitives(g.means, g.quats, scales, opacities)
    projection = backend.project(*primitives, camera, conventions)
    channels = backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, sh_degree, projection.radii)  # [N, 3]
    if "depth" in request.wants:
        channels = np.column_stack([channels, projection.depths])
        background = np.append(background, background.dtype.type(0))
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(projection, grid, conventions)
    seen = with_principal_point(camera, conventions)
    frames = visible_frames(g.means, g.quats, scales, seen, projection.radii)
    footprints = Footprints(projection, g.opacity_logits, g.opacity_textures, frames)
    blended = footprints, _coefficients(g, channels, backend.is_compiled), background, bins
    if backend.is_compiled:
        output = kernel_hits.composite_hits(response_for(dtype), *blended, conventions)
    else:
        with_stats, with_median_depth = "stats" in request.wants, "median_depth" in request.wants
        output = composite_hits(
            RESPONSE, *blended, conventions, with_stats=with_stats, with_median_depth=with_median_depth
        )
    visible_ids = np.flatnonzero(projection.radii[:, 0] > 0)
    output = output._replace(visible_ids=visible_ids, n_pairs=len(bins.gaussian_ids))
    return output, _Tape(g, request, camera, sh_degree, primitives, blended, output)


def _coefficients(g: TexturedGaussians, channels: Floats, is_compiled: bool) -> Floats:
    """Return [N, D K]: of each channel its colour and its texture; a depth has none. Kernels take K = 16."""
    n, k = g.opacity_textures.shape
    textures = filled_up(g.color_textures, 3) if is_compiled else g.color_textures.reshape(n, 3, k)
    n_channels, n_coefficients = channels.shape[1], 1 + textures.shape[2]
    coefficients = np.zeros((n, n_channels, n_coefficients), channels.dtype)
    coefficients[:, :, 0], coefficients[:, :3, 1:] = channels, textures
    return coefficients.reshape(n, n_channels * n_coefficients)


def render_vjp(tape: _Tape | RenderTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`: of the projection, the colours and the frames, added up.

    ::

        v_log_s = s v_s;  v_l is the response's own, since o_B and m share it
    """
    if isinstance(tape, RenderTape):
        return SPLATTING.render_vjp(tape, v_image, v_alpha)
    g, backend, conventions, camera = tape.gaussians, tape.request.backend, tape.request.conventions, tape.camera
    v_alpha = np.zeros_like(tape.output.alpha) if v_alpha is None else v_alpha
    arguments = *tape.blended, conventions, tape.output, (v_image, v_alpha)
    if backend.is_compiled:
        v = kernel_hits.composite_hits_vjp(response_for(g.means.dtype), *arguments)
    else:
        v = composite_hits_vjp(RESPONSE, *arguments)
    v_means2d, v_conics, v_opacities, v_logits, v_opacity_textures, v_frames = v.primitives
    n, k = g.opacity_textures.shape
    n_channels = v_image.shape[2]
    v_colors = v.colors.reshape(n, n_channels, v.colors.shape[1] // n_channels)  # [N, D, K]

    projection, scales = tape.blended[0].projection, tape.primitives.scales
    v_depths = np.ascontiguousarray(v_colors[:, 3, 0]) if v_image.shape[2] > 3 else np.zeros_like(projection.depths)
    v_projection = ProjectionGradient(v_means2d, v_depths, v_conics, v_opacities)
    v_flat = backend.project_vjp(*tape.primitives, camera, conventions, projection, v_projection)
    v_channels = np.ascontiguousarray(v_colors[:, :3, 0])
    v_sh = backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, tape.sh_degree, projection.radii, v_channels)
    seen = with_principal_point(camera, conventions)
    v_frame = visible_frames_vjp(g.means, g.quats, scales, seen, projection.radii, v_frames)
    return RenderGradient(
        gaussians=TexturedGaussians(
            means=v_flat.means + v_sh.means + v_frame.means,
            quats=v_flat.quats + v_frame.quats,
            log_scales=scales * (v_flat.scales + v_frame.scales),
            opacity_logits=v_logits,
            sh_dc=v_sh.sh_dc,
            sh_rest=v_sh.sh_rest,
            color_textures=np.ascontiguousarray(v_colors[:, :3, 1 : k + 1]).reshape(n, 3 * k),
            opacity_textures=v_opacity_textures,
        ),
        background=v.background[:3],
        cam_from_world_R=v_flat.cam_from_world_R + v_sh.cam_from_world_R + v_frame.cam_from_world_R,
        cam_from_world_t=v_flat.cam_from_world_t + v_sh.cam_from_world_t + v_frame.cam_from_world_t,
        means2d=v_means2d,
    )


# Chosen between those of 3DGS for a colour's degree 0 and, 20 times less, for its higher degrees.
RATES = Rates({"color_textures": 2.5e-3 / 4, "opacity_textures": 5e-2 / 4}, frozenset())

TEXTURED_GAUSSIANS = Representation(
    "textured Gaussians",
    population=TexturedGaussians,
    extend=blank,
    renderer=Renderer("textured", render, render_vjp, SPLATTING.channels),
    rates=RATES,
)

TEXTURED = GS_ACCEL._replace(name="textured")
"""``textured``: 3DGS with textures from the first iteration on."""

FINE_TUNING = GS._replace(
    name="textured-fine-tuning",
    learning_rates=GS.learning_rates.changed(means=0.0, quats=0.0, log_scales=0.0),
    events=(),
    sh_milestones=(0, 0, 0),
)
"""Opacities, colours and textures alone, of all Gaussians as they are: the paper's fine-tuning."""
