"""From trained parameters to an image and back.

Activations live here (3DGS section 5.1): ``scales = exp(log_scales)``, ``opacities = sigmoid(opacity_logits)``. Left
out: checks for NaN, which belong to whoever reads a file; a Gaussian whose footprint is not finite is culled.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.backends import CPU, Backend
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.splatting import SplatTape, splat, splat_vjp
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Ints, Primitives, Projection, RenderOutput


class RenderTape(NamedTuple):
    """What :func:`render` did, for :func:`render_vjp` and for statistics of what was visible."""

    gaussians: Gaussians
    sh_degree: int  # active
    splats: SplatTape  # the activated Gaussians and what became of them

    @property
    def projection(self) -> Projection:
        """Footprints in the image; radii are 0 where culled."""
        return self.splats.projection


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
    is_visible: Bools | None = None,
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
    is_visible : ndarray of shape (N,) of booleans, optional
        Rows that take part; the others are culled as if they were transparent. All by default.
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

    with np.errstate(over="ignore"):
        # The projection culls the largest number; infinity times a zero gradient would be NaN.
        scales = np.minimum(np.exp(gaussians.log_scales), np.finfo(dtype).max)
        opacities = 1 / (1 + np.exp(-gaussians.opacity_logits))
    if is_visible is not None:
        opacities = np.where(is_visible, opacities, opacities.dtype.type(0))

    def shade(radii: Ints) -> Floats:
        return backend.sh_colors(gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, sh_degree, radii)

    splats = splat(
        Primitives(gaussians.means, gaussians.quats, scales, opacities),
        shade,
        camera,
        background,
        conventions,
        backend,
        with_depth=with_depth,
        with_stats=with_stats,
        with_median_depth=with_median_depth,
    )
    return splats.output, RenderTape(gaussians, sh_degree, splats)


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
    g, splats = tape.gaussians, tape.splats
    scales, opacities = splats.primitives.scales, splats.primitives.opacities
    v_alpha = np.zeros_like(splats.output.alpha) if v_alpha is None else v_alpha
    with np.errstate(over="ignore"):
        transparencies = 1 / (1 + np.exp(g.opacity_logits))  # 1 - o, of which few digits are left in 1 - 0.9999
    v = splat_vjp(splats, v_image, v_alpha)
    v_sh = splats.backend.sh_colors_vjp(
        g.means, g.sh_dc, g.sh_rest, splats.camera, tape.sh_degree, splats.projection.radii, v.colors
    )
    return RenderGradient(
        gaussians=Gaussians(
            means=v.primitives.means + v_sh.means,
            quats=v.primitives.quats,
            log_scales=scales * v.primitives.scales,
            opacity_logits=opacities * transparencies * v.primitives.opacities,
            sh_dc=v_sh.sh_dc,
            sh_rest=v_sh.sh_rest,
        ),
        background=v.background,
        cam_from_world_R=v.primitives.cam_from_world_R + v_sh.cam_from_world_R,
        cam_from_world_t=v.primitives.cam_from_world_t + v_sh.cam_from_world_t,
        means2d=v.means2d,
    )
