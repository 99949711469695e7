"""Every differentiable stage of a backend as a function of arrays with its VJP.

Results that are not differentiated (tile lists, dominant Gaussians, radii) are fixed at their values for the scene.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.differences import Function, Point, Vjp
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.reference.pinhole import pinhole_jacobians, pose, slope_limits, with_principal_point
from minisplat_ref.rendering import renderer, splatting
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import (
    Camera,
    Floats,
    Gaussians,
    Ints,
    Primitives,
    Projection,
    ProjectionGradient,
    RenderOutput,
    TileBins,
    TileGrid,
)

Sides = tuple[np.ndarray, ...]


class Stage(NamedTuple):
    """A function under test, where it is tested."""

    name: str
    inputs: dict[str, Floats]
    """By name, in the order of the arguments; float64."""
    outputs: tuple[str, ...]
    """Names, in the order of the results."""
    function: Function
    vjp: Vjp
    """At ``inputs``."""


def backend_stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return all differentiable stages of a backend, and the whole render.

    Parameters
    ----------
    backend : Backend
        Whose forward and backward functions are tested.
    setting : Setting
        On what.
    rng : Generator
        For photographs and depth maps.

    Returns
    -------
    tuple of Stage
        In the order of the pipeline.
    """
    antialiased = setting._replace(conventions=setting.conventions._replace(is_antialiased=True))
    return (
        project_stage(backend, setting),
        project_stage(backend, antialiased)._replace(name="project antialiased"),
        sh_stage(backend, setting),
        composite_stage(backend, setting),
        surface_stage(backend, setting),
        photometric_stage(backend, setting.camera, rng),
        render_stage(backend, setting),
    )


def project_stage(backend: Backend, setting: Setting) -> Stage:
    """Return ``project`` as a function of Gaussians and pose."""
    _, camera, _, conventions = setting
    inputs = {**setting.primitives._asdict(), **setting.pose}

    def function(means: Floats, quats: Floats, scales: Floats, opacities: Floats, R: Floats, t: Floats) -> Point:
        moved = _move_camera(camera, R, t)
        p = backend.project(means, quats, scales, opacities, moved, conventions)
        return Point(
            (p.means2d, p.depths, p.conics, p.opacities), (p.radii > 0, slope_sides(means, moved, conventions))
        )

    def vjp(*cotangents: Floats) -> tuple[Floats, ...]:
        projection = backend.project(*setting.primitives, camera, conventions)
        return backend.project_vjp(
            *setting.primitives, camera, conventions, projection, ProjectionGradient(*cotangents)
        )

    return Stage("project", inputs, ProjectionGradient._fields, function, vjp)


def sh_stage(backend: Backend, setting: Setting) -> Stage:
    """Return ``sh_colors`` as a function of means, coefficients and pose."""
    g, camera = setting.gaussians, setting.camera
    radii = backend.project(*setting.primitives, camera, setting.conventions).radii
    degree = int(np.sqrt(g.sh_rest.shape[1] + 1)) - 1
    inputs = {"means": g.means, "sh_dc": g.sh_dc, "sh_rest": g.sh_rest, **setting.pose}

    def function(means: Floats, sh_dc: Floats, sh_rest: Floats, R: Floats, t: Floats) -> Point:
        colors = backend.sh_colors(means, sh_dc, sh_rest, _move_camera(camera, R, t), degree, radii)
        return Point((colors,), (colors > 0,))

    def vjp(v_colors: Floats) -> tuple[Floats, ...]:
        return backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, degree, radii, v_colors)

    return Stage("sh_colors", inputs, ("colors",), function, vjp)


def composite_stage(backend: Backend, setting: Setting) -> Stage:
    """Return ``composite`` of footprints, opacities, three channels and background; tile lists and boxes are fixed."""
    projection, bins, colors = _prepare_compositing(backend, setting)
    conventions, background = setting.conventions, setting.background
    inputs = {
        "means2d": projection.means2d,
        "conics": projection.conics,
        "opacities": projection.opacities,
        "colors": colors,
        "background": background,
    }

    def function(means2d: Floats, conics: Floats, opacities: Floats, colors: Floats, background: Floats) -> Point:
        p = projection._replace(means2d=means2d, conics=conics, opacities=opacities)
        output = backend.composite(p, colors, background, bins, conventions)
        return Point((output.image, output.alpha), hit_sides(p, bins, conventions))

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        output = backend.composite(projection, colors, background, bins, conventions)
        return backend.composite_vjp(projection, colors, background, bins, conventions, output, v_image, v_alpha)

    return Stage("composite", inputs, ("image", "alpha"), function, vjp)


def surface_stage(backend: Backend, setting: Setting) -> Stage:
    """Return ``surface_points`` of Gaussians, for the view's dominant ones, one of them moved behind the camera."""
    projection, bins, colors = _prepare_compositing(backend, setting)
    output = backend.composite(projection, colors, setting.background, bins, setting.conventions, with_stats=True)
    ids, camera = output.stats.dominant_ids, setting.camera  # type: ignore[union-attr]  # stats were asked for
    means, quats, scales, _ = setting.primitives
    means = np.where(np.arange(len(means))[:, None] == ids[0, 0], 2 * camera.center - means, means)
    inputs = {"means": means, "quats": quats, "scales": scales}

    def function(means: Floats, quats: Floats, scales: Floats) -> Point:
        surface = backend.surface_points(means, quats, scales, camera, ids)
        return Point(tuple(surface), (surface.depths > 0,))

    def vjp(v_points: Floats, v_depths: Floats) -> tuple[Floats, ...]:
        return backend.surface_points_vjp(means, quats, scales, camera, ids, v_points, v_depths)

    return Stage("surface_points", inputs, ("points", "depths"), function, vjp)


def photometric_stage(backend: Backend, camera: Camera, rng: np.random.Generator) -> Stage:
    """Return ``photometric_loss`` as a function of the image, with some pixels masked out."""
    shape = camera.height, camera.width, 3
    target, image = rng.uniform(size=shape), rng.uniform(size=shape)
    mask = rng.uniform(size=shape[:2]) < 0.8

    def function(image: Floats) -> Point:
        loss, _ = backend.photometric_loss(image, target, 0.2, mask)
        return Point((np.asarray(loss),), (np.sign(image - target),))

    def vjp(v_loss: Floats) -> tuple[Floats, ...]:
        _, tape = backend.photometric_loss(image, target, 0.2, mask)
        return (backend.photometric_loss_vjp(tape, float(v_loss)),)

    return Stage("photometric_loss", {"image": image}, ("loss",), function, vjp)


def splat_stage(backend: Backend, setting: Setting, module: object = splatting, *, with_depth: bool = True) -> Stage:
    """Return ``splat`` as a function of activated Gaussians, colours, background and pose."""
    _, _, colors = _prepare_compositing(backend, setting)
    _, camera, background, conventions = setting
    inputs = {**setting.primitives._asdict(), "colors": colors, "background": background, **setting.pose}

    def tape_of(*args: Floats) -> splatting.SplatTape:
        *primitives, colors, background, R, t = args
        view = (
            Primitives(*primitives),
            lambda radii: colors,
            _move_camera(camera, R, t),
            background,
            conventions,
            backend,
        )
        return module.splat(*view, with_depth=with_depth)  # type: ignore[attr-defined]

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        v = module.splat_vjp(tape_of(*inputs.values()), v_image, v_alpha)  # type: ignore[attr-defined]
        return (*v.primitives[:4], v.colors, v.background, *v.primitives[4:])

    return Stage(
        "splat with depth" if with_depth else "splat",
        inputs,
        ("image", "alpha"),
        lambda *args: _view_point(tape_of(*args)),
        vjp,
    )


def render_stage(backend: Backend, setting: Setting, module: object = renderer) -> Stage:
    """Return ``render`` with depth as a function of every trained parameter, background and pose."""
    gaussians, camera, background, conventions = setting
    inputs = {**gaussians._asdict(), "background": background, **setting.pose}

    def tape_of(*args: Floats) -> renderer.RenderTape:
        *parameters, background, R, t = args
        _, tape = module.render(  # type: ignore[attr-defined]
            Gaussians(*parameters),
            _move_camera(camera, R, t),
            background=background,
            conventions=conventions,
            backend=backend,
            with_depth=True,
        )
        return tape

    def function(*args: Floats) -> Point:
        splats = tape_of(*args).splats
        outputs, sides = _view_point(splats)
        return Point(outputs, (*sides, splats.channels > 0))

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        v = module.render_vjp(tape_of(*inputs.values()), v_image, v_alpha)  # type: ignore[attr-defined]
        return (*v.gaussians, v.background, v.cam_from_world_R, v.cam_from_world_t)

    return Stage("render", inputs, ("image", "alpha"), function, vjp)


def with_module(**functions: object) -> Backend:
    """Return the reference with some of its stages replaced."""
    return dataclasses.replace(REFERENCE, **functions)  # type: ignore[arg-type]


def _move_camera(camera: Camera, R: Floats, t: Floats) -> Camera:
    return camera._replace(cam_from_world_R=R, cam_from_world_t=t)


def _prepare_compositing(backend: Backend, setting: Setting) -> tuple[Projection, TileBins, Floats]:
    """Return footprints, tile lists and degree-0 colours of the scene, to start in the middle of the pipeline."""
    camera, conventions = setting.camera, setting.conventions
    projection = backend.project(*setting.primitives, camera, conventions)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    return projection, backend.bin_gaussians(projection, grid, conventions), setting.gaussians.sh_dc


def _view_point(tape: splatting.SplatTape) -> Point:
    sides = hit_sides(tape.projection, tape.bins, tape.conventions)
    slopes = slope_sides(tape.primitives.means, tape.camera, tape.conventions)
    return Point((tape.output.image, tape.output.alpha), (*sides, slopes))


def hit_sides(projection: Projection, bins: TileBins, conventions: Conventions) -> Sides:
    """Return the listed Gaussians, the blended hits and the clamped hits."""
    tiles = list(tile_hits(projection, bins, conventions))
    blended = np.concatenate([np.ravel(tile.alphas > 0) for tile in tiles])
    return bins.gaussian_ids, bins.tile_offsets, blended, np.concatenate([np.ravel(tile.is_clamped) for tile in tiles])


def slope_sides(means: Floats, camera: Camera, conventions: Conventions) -> np.ndarray:
    """Return whether each point's slopes are inside the Jacobian's clamp."""
    camera = with_principal_point(camera, conventions)
    R, t = pose(camera, means.dtype)
    in_camera, limits = means @ R.T + t, np.full(2, np.inf)
    free = pinhole_jacobians(in_camera, camera, -limits, limits)
    return pinhole_jacobians(in_camera, camera, *slope_limits(camera, conventions, means.dtype)) == free


def watch(backend: Backend) -> tuple[Backend, list[np.ndarray]]:
    """Return the backend, and a list to which its stages append the sides of their thresholds."""
    sides: list[np.ndarray] = []

    def project(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
    ) -> Projection:
        projection = backend.project(means, quats, scales, opacities, camera, conventions)
        sides.extend((projection.radii > 0, slope_sides(means, camera, conventions)))
        return projection

    def sh_colors(
        means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints
    ) -> Floats:
        colors = backend.sh_colors(means, sh_dc, sh_rest, camera, degree, radii)
        sides.append(colors > 0)
        return colors

    def composite(
        projection: Projection,
        colors: Floats,
        background: Floats,
        bins: TileBins,
        conventions: Conventions,
        **asked: bool,
    ) -> RenderOutput:
        sides.extend(hit_sides(projection, bins, conventions))
        return backend.composite(projection, colors, background, bins, conventions, **asked)

    return dataclasses.replace(backend, project=project, sh_colors=sh_colors, composite=composite), sides
