"""The recipe of 2D Gaussian Splatting, and what its gradient check covers.

Population, renderer and losses are those of :mod:`minisplat_ref.mechanisms.surfels`.
"""

from typing import Any

import numpy as np

from minisplat_ref.mechanisms.depth_maps import normal_kernels, normals
from minisplat_ref.mechanisms.surfels.discs import DISC_EVENTS, DISCS
from minisplat_ref.mechanisms.surfels.gradient_checks import rays_stage, renderer_stage
from minisplat_ref.mechanisms.surfels.losses import LOSSES
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend

RECIPE = GS_ACCEL._replace(name="surfels", losses=(*GS_ACCEL.losses, *LOSSES), events=DISC_EVENTS)
"""``surfels``: the schedule and the density control of 3DGS with the paper's two losses."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer with all its channels, rays, and normals from depths."""
    module: Any = normal_kernels if backend.is_compiled else normals
    depth = rng.uniform(2, 3, size=(6, 7))
    of_depths = Stage(
        "central_normals",
        {"depth": depth},
        ("normals",),
        lambda z: Point((module.central_normals(z, setting.camera),)),
        lambda v: (module.central_normals_vjp(depth, setting.camera, v),),
    )
    return renderer_stage(backend, setting, DISCS, rng), rays_stage(backend, setting, rng), of_depths
