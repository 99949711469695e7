"""Public functions that render a workload and differentiate it: ``render``, or gsplat's call on activated Gaussians.

Both start from parameters and end with their gradient, so that their times can be compared: activations count in both.
``rasterization_vjp`` keeps nothing of the forward pass, because of gsplat's signature; it renders once more, which
counts as part of its backward pass.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.gsplat.call import rasterization, rasterization_vjp
from minisplat_ref.rendering import RenderTape, render, render_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Camera, Floats, Gaussians


class Passes(NamedTuple):
    """A forward pass and its backward pass."""

    forward: Callable[[Gaussians, Camera, Conventions, Backend], tuple[Floats, Any]]
    """From parameters to the image [H, W, 3], and the values that ``backward`` needs."""
    backward: Callable[[Any, Floats], Gaussians]
    """From that and the image's derivative to the parameters'."""


def _render(
    gaussians: Gaussians, camera: Camera, conventions: Conventions, backend: Backend
) -> tuple[Floats, RenderTape]:
    output, tape = render(gaussians, camera, conventions=conventions, backend=backend)
    return output.image, tape


def _render_vjp(tape: RenderTape, v_image: Floats) -> Gaussians:
    return render_vjp(tape, v_image).gaussians


def _rasterization(
    gaussians: Gaussians, camera: Camera, conventions: Conventions, backend: Backend
) -> tuple[Floats, dict[str, Any]]:
    """Render, and return the call's arguments, which are all that its gradient needs."""
    dtype, viewmat = gaussians.means.dtype, np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = camera.cam_from_world_R, camera.cam_from_world_t
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    coefficients = np.concatenate([gaussians.sh_dc[:, None], gaussians.sh_rest], axis=1)  # [N, K, 3]
    arguments: dict[str, Any] = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": np.exp(gaussians.log_scales),
        "opacities": 1 / (1 + np.exp(-gaussians.opacity_logits)),
        "colors": coefficients,
        "viewmats": viewmat[None].astype(dtype),
        "Ks": K[None].astype(dtype),
        "width": camera.width,
        "height": camera.height,
        "sh_degree": math.isqrt(coefficients.shape[1]) - 1,
        "profile": conventions,
        "backend": backend,
    }
    images, _, _ = rasterization(**arguments)
    return images[0], arguments


def _rasterization_vjp(arguments: dict[str, Any], v_image: Floats) -> Gaussians:
    """``v_log_s = s v_s``, ``v_logit = o (1 - o) v_o``."""
    v_alphas = np.zeros((1, *v_image.shape[:2], 1), v_image.dtype)
    v = rasterization_vjp(**arguments, v_render_colors=v_image[None], v_render_alphas=v_alphas)
    scales, opacities = arguments["scales"], arguments["opacities"]
    return Gaussians(
        means=v["v_means"],
        quats=v["v_quats"],
        log_scales=scales * v["v_scales"],
        opacity_logits=opacities * (1 - opacities) * v["v_opacities"],
        sh_dc=v["v_colors"][:, 0],
        sh_rest=v["v_colors"][:, 1:],
    )


RENDER = Passes(_render, _render_vjp)
RASTERIZATION = Passes(_rasterization, _rasterization_vjp)
