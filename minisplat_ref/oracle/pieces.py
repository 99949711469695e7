"""The reference's formulas one by one, inside the stages: the building blocks of a stage's gradient.

Each function here takes a module of :mod:`minisplat_ref.reference`, or a copy of it with an error in one place; the
tests do the latter with every operator of every gradient.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from minisplat_ref import reference
from minisplat_ref.constants import COMPENSATION_FLOOR, GSPLAT_MAIN, Conventions
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting, make_setting
from minisplat_ref.oracle.stages import (
    Stage,
    composite_stage,
    photometric_stage,
    project_stage,
    render_stage,
    sh_stage,
    splat_stage,
    surface_stage,
    with_module,
)
from minisplat_ref.reference.hits import CONIC, Hit, Response, Shading, tile_hits
from minisplat_ref.rendering import renderer, splatting
from minisplat_ref.types import Bools, Floats, Ints, Projection, TileBins, TileGrid

Module = Any
"""A module, or a changed copy of it."""
SEED = 20240229


def tiny_setting(conventions: Conventions = GSPLAT_MAIN, sh_degree: int = 1) -> Setting:
    """Return five Gaussians in 9 x 7 pixels."""
    return make_setting(np.random.default_rng(SEED), 5, 9, 7, conventions, sh_degree)


def project_setting(setting: Setting) -> tuple[Projection, TileBins]:
    """Return footprints and tile lists, computed by the reference."""
    backend, camera, conventions = with_module(), setting.camera, setting.conventions
    projection = backend.project(*setting.primitives, camera, conventions)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    return projection, backend.bin_gaussians(projection, grid, conventions)


def covariance_pieces(m: Module) -> tuple[Stage, ...]:
    """``rotation_matrices`` and ``covariances``."""
    rng = np.random.default_rng(SEED)
    quats, scales = rng.normal(size=(2, 4)), rng.uniform(0.3, 2, size=(2, 3))
    return (
        Stage(
            "rotation_matrices",
            {"quats": quats},
            ("rotations",),
            lambda quats: Point((m.rotation_matrices(quats),)),
            lambda v: (m.rotation_matrices_vjp(quats, v),),
        ),
        Stage(
            "covariances",
            {"quats": quats, "scales": scales},
            ("covariances",),
            lambda quats, scales: Point((m.covariances(quats, scales),)),
            lambda v: m.covariances_vjp(quats, scales, v),
        ),
    )


def pinhole_pieces(m: Module) -> tuple[Stage, ...]:
    """``pinhole`` and its Jacobian, inside and outside the clamp, on either side of each axis."""
    camera = tiny_setting().camera
    points = np.array([[0.2, -0.3, 2.0], [3.0, 0.2, 2.5], [-0.4, -2.0, 1.5], [-4.0, 5.0, 3.0]])
    limits = m.slope_limits(camera, GSPLAT_MAIN, points.dtype)

    def jacobians(points: Floats) -> Point:
        slopes = points[:, :2] / points[:, 2:]
        return Point((m.pinhole_jacobians(points, camera, *limits),), (limits[0] < slopes, slopes < limits[1]))

    return (
        Stage(
            "pinhole",
            {"means_cam": points},
            ("means2d",),
            lambda points: Point((m.pinhole(points, camera),)),
            lambda v: (m.pinhole_vjp(points, camera, v),),
        ),
        Stage(
            "pinhole_jacobians",
            {"means_cam": points},
            ("jacobians",),
            jacobians,
            lambda v: (m.pinhole_jacobians_vjp(points, camera, *limits, v),),
        ),
    )


def antialiasing_pieces(m: Module) -> tuple[Stage, ...]:
    """``compensations``, above and on their floor."""
    blur = GSPLAT_MAIN.eps2d * np.eye(2)
    sharp = np.array([[[1.5, 0.4], [0.4, 0.7]], [[0.2, -0.05], [-0.05, 0.1]], [[1e-3, 0.0], [0.0, 1e-3]]])

    def function(sharp: Floats) -> Point:
        rho = m.compensations(sharp, sharp + blur)
        return Point((rho,), (rho > COMPENSATION_FLOOR,))

    def vjp(v: Floats) -> tuple[Floats, ...]:
        return (m.compensations_vjp(sharp, sharp + blur, v),)

    return (Stage("compensations", {"covariances2d": sharp}, ("compensations",), function, vjp),)


def ssim_pieces(m: Module) -> tuple[Stage, ...]:
    """``ssim_map``, and the loss."""
    rng = np.random.default_rng(SEED)
    image, target = rng.uniform(size=(2, 6, 5, 1))
    ssim = Stage(
        "ssim_map",
        {"image": image},
        ("ssim",),
        lambda image: Point((m.ssim_map(image, target),)),
        lambda v: (m.ssim_map_vjp(image, target, v),),
    )
    stages = with_module(photometric_loss=m.photometric_loss, photometric_loss_vjp=m.photometric_loss_vjp)
    return ssim, photometric_stage(stages, tiny_setting().camera, rng)


def depth_pieces(m: Module) -> tuple[Stage, ...]:
    """``expected_depth``, one pixel without a hit, and ``surface_points``."""
    rng = np.random.default_rng(SEED)
    depth, alpha = rng.uniform(2, 3, size=(4, 5)), rng.uniform(0.3, 1, size=(4, 5))
    alpha[1, 2] = 0.0
    accumulated = depth * alpha
    is_hit = (alpha > 0).astype(float)  # differences must not turn an empty pixel into a hit

    def expected(accumulated: Floats, alpha: Floats) -> Point:
        return Point((m.expected_depth(accumulated * is_hit, alpha * is_hit),))

    stages = with_module(surface_points=m.surface_points, surface_points_vjp=m.surface_points_vjp)
    return (
        Stage(
            "expected_depth",
            {"accumulated_depth": accumulated, "alpha": alpha},
            ("depth",),
            expected,
            lambda v: m.expected_depth_vjp(accumulated, alpha, v),
        ),
        surface_stage(stages, tiny_setting()),
    )


def _projection_pieces(m: Module) -> tuple[Stage, ...]:
    stages, setting = with_module(project=m.project, project_vjp=m.project_vjp), tiny_setting()
    antialiased = setting._replace(conventions=setting.conventions._replace(is_antialiased=True))
    return project_stage(stages, setting), project_stage(stages, antialiased)


def _sh_pieces(m: Module) -> tuple[Stage, ...]:
    stages = with_module(sh_colors=m.sh_colors, sh_colors_vjp=m.sh_colors_vjp)
    return (sh_stage(stages, tiny_setting(sh_degree=3)),)


def slant(hits: Module) -> Response:
    """Return the conic with depths and colours that vary over the Gaussian."""

    def hit(projection: Projection, ids: Ints, centers: Floats) -> Hit:
        flat: Hit = hits.conic_hit(projection, ids, centers)
        return flat._replace(depths=flat.depths + 0.1 * flat.place.offsets.sum(axis=2))

    def hit_vjp(p: Projection, ids: Ints, hit: Hit, v_mean: Floats, v_shape: Floats, v_x: Floats) -> Any:
        v_means2d, v_conics, v_opacities = hits.conic_hit_vjp(p, ids, hit, v_mean, v_shape, None)
        v_means2d[:, 0] += v_x.sum(axis=1)
        return v_means2d, v_conics, v_opacities

    def shade(colors: Floats, place: Any) -> Floats:
        return colors[:, None] * np.sin(place.offsets[:, :, :1])

    def shade_vjp(colors: Floats, place: Any, v: Floats) -> tuple[Floats, Floats]:
        x = place.offsets[:, :, 0]
        return np.einsum("gpd,gp->gd", v, np.sin(x)), np.einsum("gpd,gd,gp->gp", v, colors, np.cos(x))

    return Response(CONIC.boxes, hit, hit_vjp, CONIC.fields, Shading(shade, shade_vjp))


def _list_sides(response: Response, projection: Projection, bins: TileBins) -> tuple[Bools, ...]:
    """Return which hits of every tile are blended, and which are clamped."""
    tiles = tile_hits(projection, bins, GSPLAT_MAIN, response)
    return tuple(side for tile in tiles for side in (tile.alphas > 0, tile.is_clamped))


def blending_stage(
    compositing: Module, response: Any, list_sides: Callable[..., tuple[Any, ...]] = _list_sides
) -> Stage:
    """Return ``composite_hits`` of a response to projected Gaussians; tile lists and boxes are fixed.

    ``list_sides`` maps the response, footprints and tile lists to the decisions of a point.
    """
    plain, p, bins = composite_stage(with_module(), tiny_setting()), *project_setting(tiny_setting())

    def moved(means2d: Floats, conics: Floats, opacities: Floats) -> Projection:
        return p._replace(means2d=means2d, conics=conics, opacities=opacities)

    def function(means2d: Floats, conics: Floats, opacities: Floats, colors: Floats, background: Floats) -> Point:
        q = moved(means2d, conics, opacities)
        output = compositing.composite_hits(response, q, colors, background, bins, GSPLAT_MAIN)
        return Point((output.image, output.alpha), list_sides(response, q, bins))

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        arguments = response, p, plain.inputs["colors"], plain.inputs["background"], bins, GSPLAT_MAIN
        v = compositing.composite_hits_vjp(*arguments, compositing.composite_hits(*arguments), (v_image, v_alpha))
        return *v.primitives, v.colors, v.background

    return Stage("composite_hits", plain.inputs, ("image", "alpha"), function, vjp)


def _hits_pieces(m: Module) -> tuple[Stage, ...]:
    return (blending_stage(reference.compositing, slant(m)),)


def _compositing_pieces(m: Module) -> tuple[Stage, ...]:
    stage = composite_stage(with_module(composite=m.composite, composite_vjp=m.composite_vjp), tiny_setting())
    return stage, blending_stage(m, slant(reference.hits))


PIECES: dict[ModuleType, Callable[[Module], tuple[Stage, ...]]] = {
    reference.covariance: covariance_pieces,
    reference.pinhole: pinhole_pieces,
    reference.antialiasing: antialiasing_pieces,
    reference.projection: _projection_pieces,
    reference.spherical_harmonics: _sh_pieces,
    reference.hits: _hits_pieces,
    reference.compositing: _compositing_pieces,
    reference.depth: depth_pieces,
    reference.loss: ssim_pieces,
    splatting: lambda m: tuple(splat_stage(with_module(), tiny_setting(), m, with_depth=d) for d in (False, True)),
    renderer: lambda m: (render_stage(with_module(), tiny_setting(), m),),
}
"""Every module with gradients, and the stages that its functions are tested in."""
