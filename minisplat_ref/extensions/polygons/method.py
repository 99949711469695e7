"""The ray-tracing renderer of polygons, the start of training, and the recipe."""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.polygons.geometry import Polygons, polygons_of, spans_vjp
from minisplat_ref.extensions.polygons.ray_kernels import POLYGON, tree_of
from minisplat_ref.extensions.polygons.reference import prepare_meeting
from minisplat_ref.mechanisms.meshes.fans import turn_balls
from minisplat_ref.mechanisms.rays import blending, kernels
from minisplat_ref.mechanisms.rays.pixel_rays import Tracer
from minisplat_ref.mechanisms.rays.renderer import Traced, make_ray_renderer
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Gaussians

LOG_THICKNESS = float(np.log(1e-5))  # of the axis across, as in the paper; rendering has none


def tracer_for(polygons: Polygons, conventions: Conventions, backend: Backend) -> Tracer:
    """Return the tracer of a backend: every ray against every polygon, or kernels with a tree of polygons."""
    if backend.is_compiled:
        return kernels.tracer_of(POLYGON, tree_of(polygons, conventions))
    return blending.tracer_of(prepare_meeting(polygons))


def press_flat(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians with a thickness of 1e-5 along their thinnest axes; balls are rotated at random first."""
    turned = turn_balls(gaussians, rng)
    log_scales, rows = turned.log_scales.copy(), np.arange(len(turned.log_scales))
    log_scales[rows, np.argmin(log_scales, axis=1)] = LOG_THICKNESS
    return turned._replace(log_scales=log_scales)


TRACED = Representation(
    "flat Gaussians in polygons",
    extend=press_flat,
    renderer=make_ray_renderer(Traced("polygons", polygons_of, tracer_for, spans_vjp)),
)

POLYGONS = GS_ACCEL._replace(name="polygons")
"""``polygons``: 3DGS of flat Gaussians, whose pixels are rays."""
