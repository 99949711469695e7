"""Rendering of reflective surfels: shaded one by one and then blended, or blended and then shaded pixel by pixel.

The shared parameter ``shading_stage`` selects which (:mod:`.population`). Per surfel, each has a colour, which is
blended as in 2D Gaussian Splatting. Per pixel, materials, normals, own colours and the light from around are blended::

    X = sum_i w_i x_i / A,   n = sum_i w_i n_i / |sum_i w_i n_i|,   image = A sRGB(shade(X, n)) + (1 - A) background

An own colour is what harmonics make of the viewing direction, as in 3DGS, but linear; per pixel it takes the place of
what the albedo scatters of the environment, as in the released code. A population without ``around_dc`` has neither it
nor light from around.

with the accumulated opacity A. With occlusion, ``1 - V`` is the opacity of the surfels along the reflected ray, from
the expected depth of the pixel on (:mod:`minisplat_ref.mechanisms.gbuffer.visibility`).
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.srgb import encode_srgb, encode_srgb_vjp
from minisplat_ref.mechanisms.gbuffer import around, around_kernels, pixel_kernels, pixels, shading, shading_kernels
from minisplat_ref.mechanisms.gbuffer.around import (
    Coefficients,
    Sight,
    sight_of,
    towards_vjp,
)
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.pixels import N_MATERIAL, Blended, Points, find_rows
from minisplat_ref.mechanisms.gbuffer.population import (
    PER_PIXEL,
    STAGE,
    WITH_OCCLUSION,
    ReflectiveSurfels,
    sigmoid,
)
from minisplat_ref.mechanisms.gbuffer.prefilter import prefilter, prefilter_vjp
from minisplat_ref.mechanisms.gbuffer.shading import Around, Surface, mirror_rays
from minisplat_ref.mechanisms.gbuffer.visibility import transmittances
from minisplat_ref.mechanisms.rays.pixel_rays import Rays
from minisplat_ref.mechanisms.surfels import renderer as discs
from minisplat_ref.mechanisms.surfels.projection import SurfelGradient, centers_moved
from minisplat_ref.reference.pinhole import pose, with_principal_point
from minisplat_ref.rendering import Renderer, RenderGradient, Request, choose_degree, parameters_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.sky import unit_rays
from minisplat_ref.types import Floats, Ints, Model, RenderOutput, SHGradient, View

MAPS = {"albedo": 3, "metallic": 1, "roughness": 1}
"""The material's channels, in the order in which surfels carry them."""
RAY_START = 0.02  # of the pixel's depth: where a reflected ray begins, so that it misses its own surface
GUIDES = frozenset({"depth", "normal"})  # what shading per pixel needs


class MaterialGradient(NamedTuple):
    """Gradient of the loss with respect to the parameters of materials."""

    fields: Mapping[str, Floats]
    """By the fields of the population that only materials are made of."""
    quats: Floats | float = 0.0
    """[N, 4]; 0 where no material has a direction."""
    cam_from_world_R: Floats | float = 0.0
    """[3, 3]."""


def blend_flat(
    seen: discs.Seen, colors: Floats, carried: Floats, further: Floats, request: Request
) -> tuple[RenderOutput, discs.BlendTape]:
    """Blend surfels that each have one material; see :func:`minisplat_ref.mechanisms.surfels.renderer.blend`."""
    return discs.blend(seen, colors, np.column_stack([carried, further]), request)


def blend_flat_vjp(
    tape: discs.BlendTape, v_image: Floats, v_alpha: Floats | None
) -> tuple[discs.BlendedGradient, Floats]:
    """Gradient of :func:`blend_flat`: of everything but ``further``, and of that."""
    v = discs.blend_vjp(tape, v_image, v_alpha)
    return v._replace(carried=v.carried[:, :N_MATERIAL]), v.carried[:, N_MATERIAL:]


class Materials(NamedTuple):
    """The materials of surfels: one for a whole surfel, as :data:`FLAT`, or another one at each of its points.

    The functions of blending are those of :mod:`minisplat_ref.mechanisms.surfels.renderer` with ``further`` beside
    ``carried``, which may have another form; a tape has ``shown``, and normals and materials are in the same channels.
    """

    carried: Callable[[discs.Seen], Any]
    """The materials of the surfels of a view, as ``blend`` takes them."""
    carried_vjp: Callable[[discs.Seen, Any], MaterialGradient]
    """Gradient of ``carried``."""
    blend: Callable[..., tuple[RenderOutput, Any]] = blend_flat
    """``blend(seen, colors, carried, further, request)``: the channels of ``further`` [N, K] follow the materials."""
    blend_vjp: Callable[..., tuple[discs.BlendedGradient, Floats]] = blend_flat_vjp
    """Gradient of ``blend``, and that with respect to ``further``."""


class Twins(NamedTuple):
    """The modules that compute something in NumPy or by kernels, with the same functions."""

    shading: Any
    pixels: Any
    around: Any


IN_NUMPY = Twins(shading, pixels, around)
COMPILED = Twins(shading_kernels, pixel_kernels, around_kernels)


def choose_twins(backend: Backend) -> Twins:
    """Return the modules of a backend."""
    return COMPILED if backend.is_compiled else IN_NUMPY


class ReflectiveTape(NamedTuple):
    """The values that :func:`render_reflective` keeps for :func:`render_reflective_vjp`."""

    model: Model
    seen: discs.Seen
    request: Request
    blend: Any  # tape of the materials' ``blend``
    rows: Ints  # [M] visible surfels
    sight: Sight
    sh_degree: int | Ints  # of own colours
    shading: Any  # tape of ``shade``
    linear: Floats  # [M or P, 3] colours before the curve of sRGB
    encoded: Floats  # [M or P, 3] and after it
    environment: Floats  # [H, 2 H, 3]
    points: Points | None  # of shading per pixel
    slices: dict[str, slice]  # of what is blended
    materials: Materials


def channels(wants: frozenset[str]) -> dict[str, slice]:
    """Return the image's channels by name: those of surfels, and maps of the material, as sums over the hits."""
    slices = discs.channels(wants - MAPS.keys())
    first = max(part.stop for part in slices.values())
    for name, size in MAPS.items():
        if name in wants:
            slices[name] = slice(first, first + size)
            first += size
    return slices


def flat_materials(g: ReflectiveSurfels) -> Floats:
    """Return albedo, metallic share and roughness of all surfels, [N, 5]."""
    return np.column_stack([sigmoid(g.albedo_logits), sigmoid(g.metallic_logits), sigmoid(g.roughness_logits)])


def _flat_materials_vjp(seen: discs.Seen, v_materials: Floats) -> MaterialGradient:
    """Gradient of :func:`flat_materials`: ``v_logit = s (1 - s) v_s``."""
    shares = flat_materials(seen.gaussians)
    v = shares * (1 - shares) * v_materials
    return MaterialGradient({"albedo_logits": v[:, :3], "metallic_logits": v[:, 3], "roughness_logits": v[:, 4]})


FLAT = Materials(lambda seen: flat_materials(seen.gaussians), _flat_materials_vjp)


def render_reflective(
    model: Model,
    view: View,
    request: Request,
    visibility: Floats | None = None,
    *,
    mirrors: bool,
    materials: Materials = FLAT,
) -> tuple[RenderOutput, ReflectiveTape]:
    """Render a view of reflective surfels; see :func:`minisplat_ref.mechanisms.surfels.renderer.render_surfels`.

    Parameters
    ----------
    model : Model
        :class:`.population.ReflectiveSurfels`, and the shared parameters of :func:`.population.first_light`.
    view, request
        As there; the maps of ``MAPS`` can be wanted, too.
    visibility : ndarray of shape (H, W), optional
        How much of the environment each pixel's reflected ray sees; traced by default.
    mirrors : bool
        Whether surfels reflect light besides scattering it.
    materials : Materials
        How surfels have their materials. Shading surfel by surfel takes ``FLAT`` alone.

    Raises
    ------
    InputError
        The model has no environment.
    """
    if ENVIRONMENT not in model.shared:
        raise InputError("a file of reflective surfels has no place for their light: render the run's folder instead")
    g, dtype = model.gaussians, model.gaussians.means.dtype
    stage = round(float(model.shared[STAGE][0]))
    maps = request.wants & MAPS.keys()
    own = request._replace(wants=request.wants - maps | (GUIDES if stage >= PER_PIXEL else frozenset()))
    seen = discs.look(model, view, own)
    rows = np.flatnonzero(seen.surfels.radii[:, 0] > 0)
    camera = with_principal_point(view.camera, request.conventions)
    sight = sight_of(g.means[rows], seen.surfels.normals[rows].astype(dtype), pose(camera, dtype))
    sh_degree = choose_degree(g.sh_rest, request.sh_degree)
    environment = np.exp(model.shared[ENVIRONMENT].astype(dtype))
    light, carried, colors = prefilter(environment), materials.carried(seen), np.zeros_like(g.means)
    slices = discs.channels(own.wants)
    twins = choose_twins(request.backend)
    if stage < PER_PIXEL:
        surface = _surface(carried[rows], sight.normals @ sight.R, -sight.d @ sight.R)
        linear, shaded = twins.shading.shade(surface, light, mirrors=mirrors)
        encoded = colors[rows] = encode_srgb(linear)
        output, tape = discs.blend(seen, colors, carried if maps else carried[:, :0], own)
        image, points, rgb = output.image, None, output.image[:, :, :3]
    else:
        further = np.zeros_like(g.means) if has_own_colors(g) else g.means[:, :0]
        if has_own_colors(g):
            radii = seen.surfels.radii
            colors = request.backend.sh_colors(g.means, g.sh_dc, g.sh_rest, seen.camera, sh_degree, radii)
            further[rows] = twins.around.light_around(sight, coefficients(g, rows))
        output, tape = materials.blend(seen, colors, carried, further, own._replace(background=None))
        image, blended = output.image, _name_channels(output.image, output.alpha, slices)
        shown = find_rows(blended, request.conventions.alpha_min / 2)
        points = twins.pixels.points_of(blended, shown, camera)
        hidden = None
        if stage >= WITH_OCCLUSION and has_own_colors(g):
            if visibility is None:
                sees = _visibility(points, output, seen, request)
            else:
                sees = visibility.ravel()[shown]
            hidden = Around(sees, points.further)
        scattered = points.own if has_own_colors(g) else None
        linear, shaded = twins.shading.shade(points.surface, light, hidden, mirrors, scattered)
        encoded, A = encode_srgb(linear), points.alpha[:, None]
        behind = _background(request, dtype)
        rgb = np.broadcast_to(behind, (*output.alpha.shape, 3)).copy()
        rgb.reshape(-1, 3)[shown] = A * encoded + (1 - A) * behind
    wanted = [image[:, :, slices[name]] for name in discs.channels(request.wants - maps) if name != "rgb"]
    first = max(part.stop for part in slices.values())
    for (name, size), at in zip(MAPS.items(), (0, 3, 4), strict=True):
        if name in maps:
            wanted.append(image[:, :, first + at : first + at + size])
    output = output._replace(image=np.concatenate([rgb, *wanted], axis=2))
    return output, ReflectiveTape(
        *(model, seen, request, tape, rows, sight, sh_degree, shaded, linear, encoded, environment, points, slices),
        materials,
    )


def render_reflective_vjp(tape: ReflectiveTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_reflective`, by the chain rule; the visibility of the environment is constant.

    Per pixel::

        v_X = v_shade / A,   v_N = (v_n - n (n.v_n)) / |N|
        v_A = v_image . (sRGB - background) - sum v_X . X,   v_background = sum (1 - A) v_image
    """
    g, dtype, request = tape.model.gaussians, tape.linear.dtype, tape.request
    v_alpha = np.zeros(v_image.shape[:2], v_image.dtype) if v_alpha is None else v_alpha.copy()
    v_sums = _v_blended(tape, v_image)
    R = tape.sight.R
    v_R, v_x, v_normals = np.zeros((3, 3)), np.zeros_like(tape.sight.x), np.zeros_like(tape.sight.normals)
    twins = choose_twins(request.backend)
    if tape.points is not None:
        p, rgb = tape.points, v_image[:, :, :3].reshape(-1, 3)
        A, v_seen = p.alpha[:, None], rgb[p.rows]
        v_shown = A * v_seen
        v_background = rgb.sum(axis=0) - v_shown.sum(axis=0)
        v = twins.shading.shade_vjp(tape.shading, encode_srgb_vjp(tape.linear, v_shown))
        v_alpha.reshape(-1)[p.rows] += np.sum(v_seen * (tape.encoded - _background(request, dtype)), axis=1)
        v_sums[:, :, :3] = 0
        camera = with_principal_point(tape.seen.camera, request.conventions)
        twins.pixels.points_vjp(p, camera, v, _name_channels(v_sums, v_alpha, tape.slices))
        v_R += R @ (p.surface.normals.T @ v.surface.normals + p.surface.to_camera.T @ v.surface.to_camera)
    zero = np.zeros((3, 3), dtype)
    v_sh = SHGradient(np.zeros_like(g.means), np.zeros_like(g.sh_dc), np.zeros_like(g.sh_rest), zero, zero[0])
    v_fields: dict[str, Floats] = {}
    if tape.points is not None:
        v_blend, v_further = tape.materials.blend_vjp(tape.blend, v_sums, v_alpha)
        v_carried = v_blend.carried
        if has_own_colors(g):
            radii = tape.seen.surfels.radii
            v_sh = request.backend.sh_colors_vjp(
                g.means, g.sh_dc, g.sh_rest, tape.seen.camera, tape.sh_degree, radii, v_blend.colors
            )
            v_around = twins.around.light_around_vjp(tape.sight, coefficients(g, tape.rows), v_further[tape.rows])
            v_fields = {"around_dc": v_around.dc, "around_rest": v_around.rest}
            v_x, v_normals, v_R = v_around.x, v_around.normals, v_R + v_around.R
    else:
        v_blend = discs.blend_vjp(tape.blend, v_sums, v_alpha)
        v_background, v_carried = v_blend.background, np.zeros((len(g.means), N_MATERIAL), dtype)
        v_carried[:, : v_blend.carried.shape[1]] = v_blend.carried
        v = twins.shading.shade_vjp(tape.shading, encode_srgb_vjp(tape.linear, v_blend.colors[tape.rows]))
        v_carried[tape.rows, :3] += v.surface.albedo
        v_carried[tape.rows, 3] += v.surface.metallic
        v_carried[tape.rows, 4] += v.surface.roughness
        v_normals = v.surface.normals @ R.T
        v_x = towards_vjp(tape.sight.x, tape.sight.d, -v.surface.to_camera @ R.T)
        v_R = tape.sight.normals.T @ v.surface.normals - tape.sight.d.T @ v.surface.to_camera
    v_all = _parameters_vjp(tape, v_blend.surfels, (v_x, v_normals, v_R), v_sh, v_carried)
    return v_all._replace(
        gaussians=v_all.gaussians._replace(**v_fields),
        background=v_background.astype(dtype),
        shared={
            ENVIRONMENT: (tape.environment * prefilter_vjp(tape.environment, v.light)).astype(dtype),
            STAGE: np.zeros_like(tape.model.shared[STAGE]),
        },
    )


def _parameters_vjp(
    tape: ReflectiveTape,
    v: SurfelGradient,
    of_sight: tuple[Floats, Floats, Floats],
    v_sh: SHGradient,
    v_carried: Any,
) -> RenderGradient:
    """Return the gradient with respect to population and pose, without those of background and shared parameters."""
    g, rows, (v_x, v_normals, v_R) = tape.model.gaussians, tape.rows, of_sight
    all_normals = v.normals.copy()
    all_normals[rows] += v_normals
    v = v._replace(normals=all_normals)
    v_primitives = discs.look_vjp(tape.seen, tape.request.conventions, tape.request.backend, v)
    v_means = v_sh.means.copy()
    v_means[rows] += v_x @ tape.sight.R
    v_R = v_R + v_x.T @ g.means[rows] + v_sh.cam_from_world_R
    v_materials = tape.materials.carried_vjp(tape.seen, v_carried)
    v_primitives = v_primitives._replace(quats=v_primitives.quats + v_materials.quats)
    v_R = v_R + v_materials.cam_from_world_R
    of_six = parameters_vjp(g, tape.seen.primitives, v_primitives, v_sh._replace(means=v_means))
    return RenderGradient(
        gaussians=of_six._replace(**v_materials.fields),
        background=np.zeros(3, g.means.dtype),
        cam_from_world_R=(v_primitives.cam_from_world_R + v_R).astype(g.means.dtype),
        cam_from_world_t=(v_primitives.cam_from_world_t + v_x.sum(axis=0) + v_sh.cam_from_world_t).astype(
            g.means.dtype
        ),
        means2d=centers_moved(v, tape.seen.surfels).astype(g.means.dtype),
    )


def _surface(carried: Floats, normals: Floats, to_camera: Floats) -> Surface:
    return Surface(np.ascontiguousarray(carried[:, :3]), carried[:, 3], carried[:, 4], normals, to_camera)


def has_own_colors(g: Any) -> bool:
    """Return whether surfels have own colours, and light from around, for shading per pixel."""
    return "around_dc" in g._fields


def coefficients(g: ReflectiveSurfels, rows: Ints) -> Coefficients:
    """Return the coefficients of the light from around of surfels ``rows`` [M]."""
    return Coefficients(g.around_dc, g.around_rest, rows)


def _name_channels(sums: Floats, alpha: Floats, slices: dict[str, slice]) -> Blended:
    return Blended(sums, alpha, slices["normal"].start, max(part.stop for part in slices.values()))


def _background(request: Request, dtype: np.dtype) -> Floats:
    """Return the colour [3] behind all surfels."""
    return np.zeros(3, dtype) if request.background is None else request.background.astype(dtype)


def _visibility(points: Points, output: RenderOutput, seen: discs.Seen, request: Request) -> Floats:
    """Return the fraction of the environment that the reflected ray of each pixel sees."""
    depth = output.image.reshape(-1, output.image.shape[2])[points.rows, 3] / points.alpha
    camera = with_principal_point(seen.camera, request.conventions)
    R, t = pose(camera, np.dtype(np.float64))
    ray = unit_rays(camera, points.rows, np.dtype(np.float64))
    origins = (ray / ray[:, 2:] * depth[:, None] - t) @ R
    _, r = mirror_rays(Surface(*(field.astype(np.float64) for field in points.surface)))
    near = RAY_START * depth
    rays = Rays(origins, r, near, np.full_like(near, np.inf))
    return transmittances(seen.primitives, rays, request.conventions, request.backend).astype(output.image.dtype)


def _v_blended(tape: ReflectiveTape, v_image: Floats) -> Floats:
    """Return the derivative with respect to the blended values from that of the requested channels."""
    blended, maps = tape.slices, tape.request.wants & MAPS.keys()
    first = max(part.stop for part in blended.values())
    n_carried = N_MATERIAL if tape.points is not None or maps else 0
    if tape.points is not None:
        n_carried += tape.points.further.shape[1]
    v = np.zeros((*v_image.shape[:2], first + n_carried), v_image.dtype)
    for name, part in channels(tape.request.wants).items():
        if name in MAPS:
            at = first + {"albedo": 0, "metallic": 3, "roughness": 4}[name]
            v[:, :, at : at + MAPS[name]] = v_image[:, :, part]
        else:
            v[:, :, blended[name]] = v_image[:, :, part]
    return v


REFLECTIVE = Renderer("reflective surfels", partial(render_reflective, mirrors=True), render_reflective_vjp, channels)
