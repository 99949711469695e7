"""The renderer that traces a ray per pixel, and the recipe that trains with it."""

from typing import Any

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.rays.geometry import Whitened, whiten, whiten_vjp
from minisplat_ref.extensions.rays.kernels import RESPONSE, tree_of
from minisplat_ref.extensions.rays.reference import prepare_meeting
from minisplat_ref.mechanisms.rays import blending, kernels
from minisplat_ref.mechanisms.rays.pixel_rays import Tracer
from minisplat_ref.mechanisms.rays.renderer import Traced, make_ray_renderer
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Model


def whiten_model(model: Model) -> Whitened:
    """Return the Gaussians of a model as rays meet them."""
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-model.gaussians.opacity_logits.astype(np.float64)))
    return _prepare(model.gaussians, opacities)


def tracer_for(gaussians: Whitened, conventions: Conventions, backend: Backend) -> Tracer:
    """Return the tracer of a backend: every ray against every Gaussian, or kernels with a tree, which is built here."""
    if backend.is_compiled:
        return kernels.tracer_of(RESPONSE, tree_of(gaussians, conventions))
    return blending.tracer_of(prepare_meeting(gaussians))


def _prepare(population: Any, opacities: Floats) -> Whitened:
    return whiten(population.means, population.quats, population.log_scales, opacities)


def _shapes_vjp(population: Any, gaussians: Whitened, v_maps: Floats) -> tuple[Floats, Floats]:
    return whiten_vjp(population.quats, population.log_scales, gaussians, v_maps)


TRACED = Representation(
    "gaussians traced by rays", renderer=make_ray_renderer(Traced("rays", _prepare, tracer_for, _shapes_vjp))
)

RAYS = GS_ACCEL._replace(name="rays")
"""The recipe ``rays``: 3DGS with traced rays instead of footprints."""
