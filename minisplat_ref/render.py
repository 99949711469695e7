"""From parameters to an image and back: the stages chained through one backend.

Activations live here (3DGS section 5.1): ``scales = exp(log_scales)``, ``opacities = sigmoid(opacity_logits)``. Left
out: checks for NaN, which belong to whoever reads a file; a Gaussian whose footprint is not finite is culled.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.backends import CPU, Backend
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.types import (
    Camera,
    Floats,
    Gaussians,
    Projection,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
)


class RenderTape(NamedTuple):
    """What :func:`render` did, for :func:`render_vjp` and for statistics of what was visible."""

    gaussians: Gaussians
    scales: Floats  # [N, 3] activated
    opacities: Floats  # [N] activated
    camera: Camera
    background: Floats  # [D] with a depth channel's 0
    sh_degree: int  # active
    conventions: Conventions
    backend: Backend
    projection: Projection  # radii are 0 where culled
    channels: Floats  # [N, D] colours, then the depth if asked for
    bins: TileBins
    output: RenderOutput


class RenderGradient(NamedTuple):
    """Gradient of the loss with respect to everything that :func:`render` depends on."""

    gaussians: Gaussians  # by the parameters, before their activations
    background: Floats  # [3] by the background colour
    cam_from_world_R: Floats  # [3, 3] by the nine entries, unconstrained
    cam_from_world_t: Floats  # [3]
    means2d: Floats  # [N, 2] by the projected centres, per pixel: what density control looks at


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Floats | None = None,
    sh_degree: int | None = None,
    conventions: Conventions = GSPLAT_MAIN,
    backend: Backend = CPU,
    with_depth: bool = False,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> tuple[RenderOutput, RenderTape]:
    """Render one view.

    Parameters
    ----------
    gaussians : Gaussians
        Population; may be empty.
    camera : Camera
        View.
    background : ndarray of shape (3,), optional
        RGB behind everything; black by default.
    sh_degree : int, optional
        Active degree, at most the stored one, which is the default.
    conventions : Conventions
        Profile of the rasteriser.
    backend : Backend
        Implementation of the stages.
    with_depth : bool
        Append the accumulated depth, ``sum w z``, as the last channel of the image.
    with_stats, with_median_depth : bool
        As for :func:`composite`.

    Returns
    -------
    output : RenderOutput
        Image [H, W, 3] (4 with depth) and alpha [H, W] in the dtype of the Gaussians.
    tape : RenderTape
        For :func:`render_vjp`.
    """
    dtype = gaussians.means.dtype
    stored_degree = math.isqrt(gaussians.sh_rest.shape[1] + 1) - 1
    sh_degree = stored_degree if sh_degree is None else sh_degree
    if not 0 <= sh_degree <= stored_degree:
        raise InputError(f"sh_degree is {sh_degree}; these Gaussians store degrees 0 to {stored_degree}")
    background = np.zeros(3, dtype) if background is None else np.asarray(background, dtype)

    with np.errstate(over="ignore"):  # the projection culls the largest number; infinity times a zero gradient is NaN
        scales = np.minimum(np.exp(gaussians.log_scales), np.finfo(dtype).max)
    opacities = 0.5 * (1 + np.tanh(0.5 * gaussians.opacity_logits))  # the sigmoid, which cannot overflow in this form
    projection = backend.project(gaussians.means, gaussians.quats, scales, opacities, camera, conventions)
    channels = backend.sh_colors(
        gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, sh_degree, projection.radii
    )
    if with_depth:
        channels = np.column_stack([channels, projection.depths])
        background = np.append(background, dtype.type(0))
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(projection, grid, conventions)
    output = backend.composite(
        projection, channels, background, bins, conventions, with_stats=with_stats, with_median_depth=with_median_depth
    )
    return output, RenderTape(
        gaussians,
        scales,
        opacities,
        camera,
        background,
        sh_degree,
        conventions,
        backend,
        projection,
        channels,
        bins,
        output,
    )


def render_vjp(tape: RenderTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`: the stages' gradients in reverse order.

    ::

        v_log_s = s v_s,  v_logit = o (1 - o) v_o
        the means and the pose are used twice, by the projection and by the viewing direction

    Parameters
    ----------
    tape : RenderTape
        From the forward function.
    v_image : ndarray of shape (H, W, D)
        Derivative by the image; D is 4 with depth.
    v_alpha : ndarray of shape (H, W), optional
        Derivative by the accumulated opacity; 0 by default.

    Returns
    -------
    RenderGradient
        Zeros for Gaussians that were not visible.
    """
    g, camera, conventions, backend = tape.gaussians, tape.camera, tape.conventions, tape.backend
    projection = tape.projection
    v_alpha = np.zeros_like(tape.output.alpha) if v_alpha is None else v_alpha
    v = backend.composite_vjp(
        projection, tape.channels, tape.background, tape.bins, conventions, tape.output, v_image, v_alpha
    )
    v_colors = np.ascontiguousarray(v.colors[:, :3])
    v_depths = v.colors[:, 3].copy() if v.colors.shape[1] == 4 else np.zeros_like(tape.opacities)
    v_sh = backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, tape.sh_degree, projection.radii, v_colors)
    v_projection = ProjectionGradient(v.means2d, v_depths, v.conics, v.opacities)
    v_primitive = backend.project_vjp(
        g.means, g.quats, tape.scales, tape.opacities, camera, conventions, projection, v_projection
    )
    return RenderGradient(
        gaussians=Gaussians(
            means=v_primitive.means + v_sh.means,
            quats=v_primitive.quats,
            log_scales=tape.scales * v_primitive.scales,
            opacity_logits=tape.opacities * (1 - tape.opacities) * v_primitive.opacities,
            sh_dc=v_sh.sh_dc,
            sh_rest=v_sh.sh_rest,
        ),
        background=v.background[:3],
        cam_from_world_R=v_primitive.cam_from_world_R + v_sh.cam_from_world_R,
        cam_from_world_t=v_primitive.cam_from_world_t + v_sh.cam_from_world_t,
        means2d=v.means2d,
    )
