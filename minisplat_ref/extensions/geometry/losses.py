"""The geometric terms as loss terms, with the channels that receive their gradients, and the checks of these."""

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.geometry import kernels, reference
from minisplat_ref.extensions.geometry.weights import GeometricWeights
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.pieces import SEED, Module, tiny_setting
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.types import Camera, Floats


def geometric(rendered: Rendered, weights: GeometricWeights) -> tuple[float, Cotangents]:
    """Return the geometric loss, and its derivatives with respect to the depth channel and alpha.

    Parameters
    ----------
    rendered : Rendered
        The view, with a depth channel.
    weights : GeometricWeights
        Factors of the terms.
    """
    view = rendered.view
    points = rendered.scene.points[view.point_ids] if view.point_ids is not None else rendered.scene.points[:0]
    photograph = view.image * np.float32(1 / 255)  # [H, W, 3]
    sums = np.ascontiguousarray(rendered.channel("depth")[..., 0])  # [H, W] sum w z
    module: Any = kernels if rendered.request.backend.is_compiled else reference
    loss, tape = module.geometric_loss(sums, rendered.output.alpha, photograph, view.camera, points, weights, view.mask)
    v_sums, v_alpha = module.geometric_loss_vjp(tape)
    return loss, Cotangents({"depth": v_sums[..., None]}, v_alpha)


def sfm_depth(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the Huber loss of the depth at the sparse points of the view.

    Raises
    ------
    InputError
        The scene does not record which view sees which point.
    """
    if rendered.view.point_ids is None:
        raise InputError(
            f"scene {rendered.scene.name} does not say which view sees which point, as COLMAP scenes do: leave"
            " sfm_depth out of the loss"
        )
    return geometric(rendered, GeometricWeights(sfm_depth=1.0))


_WANTS = frozenset({"depth"})
LOSSES = (
    LossTerm("sfm_depth", sfm_depth, weight=0.0, wants=_WANTS),
    LossTerm(
        "depth_smoothness",
        partial(geometric, weights=GeometricWeights(depth_smoothness=1.0)),
        weight=0.0,
        wants=_WANTS,
    ),
    LossTerm(
        "normal_smoothness",
        partial(geometric, weights=GeometricWeights(normal_smoothness=1.0)),
        weight=0.0,
        wants=_WANTS,
    ),
)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the loss as a backend computes it and, for the reference, also its formulas."""
    if backend.is_compiled:
        return (geometric_stage(kernels, setting.camera, rng),)
    return (geometric_stage(reference, setting.camera, rng), *PIECES[reference](reference)[:-1])


def geometric_stage(module: Module, camera: Camera, rng: np.random.Generator) -> Stage:
    """Return ``geometric_loss`` of a module with all terms, as a function of accumulated depth and opacity.

    One pixel is masked out.
    """
    shape = camera.height, camera.width
    depth, alpha = rng.uniform(2, 3, size=shape), rng.uniform(0.3, 1, size=shape)
    photograph = rng.uniform(size=(*shape, 3))
    points, weights = points_near(depth, camera, rng), GeometricWeights(0.7, 1.3, 0.9)
    mask = np.ones(shape, dtype=bool)
    mask[1, 1] = False
    accumulated = depth * alpha
    inputs: dict[str, Floats] = {"accumulated_depth": accumulated, "alpha": alpha}

    def function(accumulated_depth: Floats, alpha: Floats) -> Point:
        loss, _ = module.geometric_loss(accumulated_depth, alpha, photograph, camera, points, weights, mask)
        depth = expected_depth(accumulated_depth, alpha)
        return Point((np.asarray(loss),), tuple(np.sign(np.diff(depth, axis=axis)) for axis in (0, 1)))

    def vjp(v_loss: Floats) -> tuple[Floats, ...]:
        _, tape = module.geometric_loss(accumulated, alpha, photograph, camera, points, weights, mask)
        return module.geometric_loss_vjp(tape, float(v_loss))

    return Stage("geometric_loss", inputs, ("loss",), function, vjp)


def points_near(depth: Floats, camera: Camera, rng: np.random.Generator) -> Floats:
    """Return world points [6, 3], 0.3 % and 6 % in front of and behind a depth map: both regimes of the Huber loss."""
    rows, columns = (rng.choice(size, 6, replace=size < 6) for size in depth.shape)
    z = depth[rows, columns] * (1 + np.array([0.003, -0.004, 0.002, 0.06, -0.06, 0.05]))
    in_camera = z[:, None] * pinhole_rays(columns + 0.5, rows + 0.5, camera)
    return (in_camera - camera.cam_from_world_t) @ camera.cam_from_world_R


def depth_map_pieces(m: Module) -> tuple[Stage, ...]:
    """Return ``depth_normals`` as a stage; one pixel has no depth."""
    rng, camera = np.random.default_rng(SEED), tiny_setting().camera
    depth = rng.uniform(2, 3, size=(4, 5))
    depth[1, 2] = 0.0
    has_depth = (depth > 0).astype(float)  # nor can a pixel without a depth be moved onto the surface
    return (
        Stage(
            "depth_normals",
            {"depth": depth},
            ("normals",),
            lambda z: Point((m.depth_normals(z * has_depth, camera),)),
            lambda v: (m.depth_normals_vjp(depth, camera, v),),
        ),
    )


def geometric_pieces(m: Module) -> tuple[Stage, ...]:
    """Return the three terms and their sum as stages."""
    rng, camera = np.random.default_rng(SEED), tiny_setting().camera
    depth, photograph = rng.uniform(2, 3, size=(7, 9)), rng.uniform(size=(7, 9, 3))
    points = points_near(depth, camera, rng)
    normals = rng.normal(size=(6, 8, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)

    def term(name: str, array: Floats, input_name: str, *others: Any) -> Stage:
        function, vjp = getattr(m, name), getattr(m, f"{name}_vjp")
        return Stage(
            name,
            {input_name: array},
            ("loss",),
            lambda moved: Point((np.asarray(function(moved, *others)),)),
            lambda v: (vjp(array, *others, float(v)),),
        )

    return (
        term("sfm_depth_loss", depth, "depth", camera, points),
        term("depth_smoothness", depth, "depth", photograph),
        term("normal_smoothness", normals, "normals", photograph),
        geometric_stage(m, camera, rng),
    )


PIECES: dict[ModuleType, Callable[[Module], tuple[Stage, ...]]] = {
    reference: lambda m: (*depth_map_pieces(m), *geometric_pieces(m)),
}
"""The module with gradients, and the stages that test its functions."""
