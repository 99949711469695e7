"""gsplat's ``rasterization_2dgs`` in NumPy: surfels and a batch of cameras in; all seven results out, and gradients.

Whatever gsplat 1.5.3 computes is computed here by its rules (:data:`.projection.GSPLAT`): the depth of a hit is that of
the centre, the low-pass is centred at the box of the disc, distortion is ``sum_ij w_i w_j |z_i - z_j|``, and the median
depth is read from the last channel, which in mode ``RGB`` is the last colour. Left out, and refused by name: sparse and
absolute gradients, and the packed output.

The steps between arguments and results are a value, :class:`Steps`, so that a check can plant an error in one of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import validation as check
from minisplat_ref.constants import GSPLAT_1_5, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.gsplat.arguments import TILE_SIZE, Batch, Options, Views, split_batches
from minisplat_ref.gsplat.call import remove_rotation
from minisplat_ref.mechanisms.depth_maps.normals import LENGTH_MIN, central_normals, central_normals_vjp
from minisplat_ref.mechanisms.surfels.projection import GSPLAT, SurfelGradient, Surfels, project, project_vjp
from minisplat_ref.mechanisms.surfels.ray_measures import RayMeasures
from minisplat_ref.mechanisms.surfels.renderer import Shown, list_tiles
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp
from minisplat_ref.rendering.backends import REFERENCE, Backend, get_backend
from minisplat_ref.types import Camera, Floats, Ints, Primitives, RenderOutput

DEPTH_MODES = ("expected", "median")
NAMES = ("render_colors", "render_alphas", "render_normals", "surf_normals", "render_distort", "render_median")
"""The images that a call returns, in this order; each has a cotangent."""
GRADIENTS = ("v_means", "v_quats", "v_scales", "v_opacities", "v_colors", "v_viewmats", "v_backgrounds")


class Steps(NamedTuple):
    """The steps of a call."""

    project: Callable[..., Surfels] = project
    project_vjp: Callable[..., Any] = project_vjp
    blend: Callable[[Shown], RenderOutput] = Shown.blend
    blend_vjp: Callable[..., Any] = Shown.blend_vjp
    measure: Callable[[Shown], RayMeasures] = Shown.measure_rays
    measure_vjp: Callable[..., tuple[Floats, ...]] = Shown.measure_rays_vjp
    expect: Callable[[Floats, Floats], Floats] = expected_depth
    normals_of: Callable[[Floats, Camera], Floats] = central_normals


STEPS = Steps()
"""Those of gsplat."""


class Settings(NamedTuple):
    """The request of a call besides the options of every call."""

    has_distortion: bool
    reads_median: bool
    """Whether the surface whose normals are returned is that of the median depths."""
    conventions: Conventions
    backend: Backend
    steps: Steps


class OneView(NamedTuple):
    """A view, and the values that its gradient needs."""

    shown: Shown
    primitives: Primitives
    blended: RenderOutput
    measures: RayMeasures
    images: tuple[Floats, ...]
    """In the order of ``NAMES``."""


def rasterization_2dgs(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    colors: Floats,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = TILE_SIZE,
    backgrounds: Floats | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
    depth_mode: str = "expected",
    *,
    backend: str | Backend = "cpu",
    steps: Steps = STEPS,
) -> tuple[Floats, Floats, Floats, Floats | None, Floats, Floats, dict[str, Any]]:
    """Render surfels through C cameras.

    Parameters
    ----------
    means, quats, scales, opacities, colors, viewmats, Ks, width, height
        As for :func:`minisplat_ref.gsplat.call.rasterization`, batches included. The third scale is not read.
    near_plane, far_plane, radius_clip, sh_degree, backgrounds, render_mode
        As there.
    tile_size : int
        Side of gsplat's tiles, px; a surfel is rendered on all tiles that its radii reach, so it matters at their
        borders.
    distloss : bool
        Whether to measure the distortion, for which a depth must be rendered.
    depth_mode : {"expected", "median"}
        The depth of the surface whose normals are returned.
    backend : {"cpu", "cpu-exact", "reference"} or Backend
        Implementation of the blending.
    steps : Steps
        For checks.
    eps2d : float
        It has no effect in gsplat either.
    packed, sparse_grad, absgrad : bool
        False alone; the values are the same.

    Returns
    -------
    render_colors : ndarray of shape (C, H, W, D)
    render_alphas : ndarray of shape (C, H, W, 1)
    render_normals : ndarray of shape (C, H, W, 3)
        ``sum w n``, world frame.
    surf_normals : ndarray of shape (C, H, W, 3) or None
        Of the surface through the depths, world frame, towards the camera; None without both colours and depth.
    render_distort : ndarray of shape (C, H, W, 1)
        0 without `distloss`.
    render_median : ndarray of shape (C, H, W, 1)
    meta : dict
        ``radii, means2d, depths, ray_transforms, opacities, normals`` of every camera [C, N, ...]; 0 where culled.

    Raises
    ------
    InputError
        If an argument has a wrong shape, dtype or value, or requests something that is not computed.
    """
    others = {"packed": packed, "sparse_grad": sparse_grad, "absgrad": absgrad}
    settings = _check(distloss, render_mode, depth_mode, near_plane, far_plane, backend, steps, others)
    options = Options(sh_degree, render_mode, False, tile_size, radius_clip)
    views = Views(viewmats, Ks, width, height)
    lead, batches = split_batches((means, quats, scales, opacities), None, colors, views, backgrounds, options)
    shown = [_render_one(batch, c, settings) for batch in batches for c in range(len(batch.cameras))]
    front = (*lead, len(batches[0].cameras))
    images = [
        np.stack(image).reshape(*front, *image[0].shape) for image in zip(*(s.images for s in shown), strict=True)
    ]
    fields = ("radii", "means2d", "depths", "opacities", "normals")
    stacked = {name: np.stack([getattr(s.shown.surfels, name) for s in shown]) for name in fields}
    stacked["depths"] = np.stack([s.shown.surfels.transforms[:, 2, 2] for s in shown])
    stacked["ray_transforms"] = np.stack([s.shown.surfels.transforms for s in shown])
    dtype = images[0].dtype
    meta = {
        name: array.reshape(*front, *array.shape[1:]).astype(array.dtype if array.dtype.kind == "i" else dtype)
        for name, array in stacked.items()
    }
    surf_normals = images[3] if render_mode in ("RGB+D", "RGB+ED") else None
    return images[0], images[1], images[2], surf_normals, images[4], images[5], meta


def rasterization_2dgs_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    colors: Floats,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    *,
    cotangents: dict[str, Floats],
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    sh_degree: int | None = None,
    tile_size: int = TILE_SIZE,
    backgrounds: Floats | None = None,
    render_mode: str = "RGB",
    distloss: bool = False,
    depth_mode: str = "expected",
    backend: str | Backend = "cpu",
    steps: Steps = STEPS,
    **others: Any,
) -> dict[str, Floats]:
    """Gradient of :func:`rasterization_2dgs`; renders the views once more.

    Parameters
    ----------
    means, quats, scales, opacities, colors, viewmats, Ks, width, height
        As there, and so are all options.
    cotangents : dict of ndarray
        ``v_render_colors`` and so on, one for each name in ``NAMES``, in the shape of the result; those left out are 0.

    Returns
    -------
    dict of ndarray
        ``v_means, v_quats, v_scales, v_opacities, v_colors, v_viewmats``, and ``v_backgrounds`` where there are some,
        in the shapes of the arguments. The third scale's are 0.
    """
    settings = _check(distloss, render_mode, depth_mode, near_plane, far_plane, backend, steps, others)
    options = Options(sh_degree, render_mode, False, tile_size, radius_clip)
    views = Views(viewmats, Ks, width, height)
    lead, batches = split_batches((means, quats, scales, opacities), None, colors, views, backgrounds, options)
    unknown = cotangents.keys() - {f"v_{name}" for name in NAMES}
    if unknown:
        raise InputError(f"cotangent {sorted(unknown)[0]!r} is unknown; there are v_{', v_'.join(NAMES)}")
    found = []
    for index, batch in zip(np.ndindex(lead), batches, strict=True):
        own = {name: np.asarray(v)[index] if lead else np.asarray(v) for name, v in cotangents.items()}
        found.append(_batch_vjp(batch, own, settings))
    names = [name for name in GRADIENTS if not (name == "v_backgrounds" and backgrounds is None)]
    return {name: np.stack([f[name] for f in found]).reshape(*lead, *found[0][name].shape) for name in names}


def _check(
    distloss: bool,
    render_mode: str,
    depth_mode: str,
    near_plane: float,
    far_plane: float,
    backend: str | Backend,
    steps: Steps,
    others: dict[str, Any],
) -> Settings:
    """Return the request besides the options, checked.

    Raises
    ------
    InputError
        It is not computed, or contradicts itself.
    TypeError
        gsplat has no such keyword.
    """
    for name, value in others.items():
        if name not in ("eps2d", "packed", "sparse_grad", "absgrad"):
            raise TypeError(f"rasterization_2dgs() got an unexpected keyword argument {name!r}")
        if value and name != "eps2d":
            raise InputError(f"{name}=True is not computed; the values are the same without it: leave it out")
    check.check_choice("depth_mode", depth_mode, DEPTH_MODES)
    if distloss and render_mode == "RGB":
        raise InputError("distloss needs a depth: give render_mode D, ED, RGB+D or RGB+ED")
    conventions = check.choose_conventions(GSPLAT_1_5, near_plane, far_plane, None, "classic")
    stages = get_backend(backend) if isinstance(backend, str) else backend
    return Settings(distloss, depth_mode == "median", conventions, stages, steps)


def _render_one(batch: Batch, c: int, settings: Settings) -> OneView:
    """Render view c by gsplat's rules."""
    camera, options, conventions, steps = batch.cameras[c], batch.options, settings.conventions, settings.steps
    primitives, dtype = batch.primitives, batch.primitives.means.dtype
    rules = GSPLAT._replace(tile_size=options.tile_size)
    surfels = steps.project(primitives, camera, conventions, rules, options.radius_clip)
    channels = [_colors(batch, c, settings, surfels.radii)] if options.has_colors else []
    if options.has_depth:
        channels.append(surfels.depths[:, None])
    n_colors = sum(part.shape[1] for part in channels)
    values = np.column_stack([*channels, surfels.normals]).astype(dtype)
    background = np.zeros(values.shape[1], dtype)
    if options.has_colors:
        background[: batch.backgrounds.shape[1]] = batch.backgrounds[c]
    read = surfels._replace(depths=values[:, n_colors - 1].astype(np.float64))  # as gsplat does: the last channel
    bins = list_tiles(surfels, camera, conventions, REFERENCE)
    shown = Shown(read, values, background, bins, conventions, settings.backend, Layout())
    blended, measures = steps.blend(shown), steps.measure(shown)
    image, normals = blended.image[..., :n_colors].copy(), blended.image[..., n_colors:]
    if options.has_expected_depth:
        image[..., -1] = steps.expect(image[..., -1], blended.alpha)
    to_world = np.linalg.inv(camera.cam_from_world_R).T.astype(dtype)  # of rows
    surface = np.zeros_like(normals)
    if options.has_colors and options.has_depth:
        depth = measures.median.astype(dtype) if settings.reads_median else image[..., -1]
        surface = _unit(steps.normals_of(depth, camera) @ camera.cam_from_world_R.astype(dtype))
    distortion = measures.distortion.astype(dtype) if settings.has_distortion else np.zeros_like(blended.alpha)
    columns = (blended.alpha, distortion, measures.median.astype(dtype))
    alpha, distortion, median = (column[..., None] for column in columns)
    return OneView(
        shown, primitives, blended, measures, (image, alpha, normals @ to_world, surface, distortion, median)
    )


def _unit(vectors: Floats) -> Floats:
    """Return vectors of length one; zeros stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), LENGTH_MIN)


def _colors(batch: Batch, c: int, settings: Settings, radii: Ints) -> Floats:
    """Return the colours [N, D] that camera c sees."""
    colors = batch.colors_of(c)
    if batch.options.sh_degree is None:
        return colors
    camera, degree = remove_rotation(batch.cameras[c]), batch.options.sh_degree
    return settings.backend.sh_colors(batch.primitives.means, colors[:, 0], colors[:, 1:], camera, degree, radii)


def _batch_vjp(batch: Batch, cotangents: dict[str, Floats], settings: Settings) -> dict[str, Floats]:
    """Gradient of the views of one scene."""
    dtype, C = batch.primitives.means.dtype, len(batch.cameras)
    v = {
        **{f"v_{name}": np.zeros_like(field) for name, field in batch.primitives._asdict().items()},
        "v_colors": np.zeros_like(batch.colors),
        "v_viewmats": np.zeros((C, 4, 4), dtype),
        "v_backgrounds": np.zeros_like(batch.backgrounds),
    }
    for c in range(C):
        view = _render_one(batch, c, settings)
        v_images = []
        for name, image in zip(NAMES, view.images, strict=True):
            given = cotangents.get(f"v_{name}")
            shape = (C, *image.shape)
            if given is not None and np.shape(given) != shape:
                raise InputError(f"v_{name} has shape {list(np.shape(given))}; it must be {list(shape)}")
            v_images.append(np.zeros_like(image) if given is None else np.asarray(given[c], dtype))
        _add_view_vjp(v, batch, c, settings, view, v_images)
    return v


def _add_view_vjp(
    v: dict[str, Floats], batch: Batch, c: int, settings: Settings, view: OneView, v_images: list[Floats]
) -> None:
    """Add the gradient of view c to ``v``: the chain rule over the steps of :func:`_render_one` in reverse.

    World normals are ``w = R^-1 n``, as in gsplat, whatever R: ``v_n = R^-T v_w``, ``v_R = -R^-T v_w w^T``. Those of
    the surface are unit vectors along ``R^T n``, because gsplat takes the cross product in the world. Spherical
    harmonics add, via the camera's centre ``o = -R^-1 t``, ``v_R = -u o^T`` and ``v_t = -u`` with ``u = R^-T v_o``.
    """
    camera, options, steps, dtype = batch.cameras[c], batch.options, settings.steps, batch.primitives.means.dtype
    v_image, v_alpha, v_normals, v_surface, v_distortion, v_median = v_images
    R, n_colors = camera.cam_from_world_R.astype(dtype), v_image.shape[2]
    v_normals = v_normals @ np.linalg.inv(R)  # in the camera's frame
    v_image, v_alpha, v_median = v_image.copy(), v_alpha[..., 0], v_median[..., 0]
    v_R = np.zeros((3, 3), dtype)
    if options.has_colors and options.has_depth:
        depth = view.measures.median.astype(dtype) if settings.reads_median else view.images[0][..., -1]
        n = view.images[3]
        v_turned = v_surface - n * np.sum(n * v_surface, axis=2, keepdims=True)
        v_R += np.einsum("hwi,hwj->ij", steps.normals_of(depth, camera), v_turned)
        v_depth = central_normals_vjp(depth, camera, v_turned @ R.T)
        if settings.reads_median:
            v_median = v_median + v_depth
        else:
            v_image[..., -1] += v_depth
    if options.has_expected_depth:
        sums = view.blended.image[..., n_colors - 1]
        v_image[..., -1], v_more = expected_depth_vjp(sums, view.blended.alpha, v_image[..., -1])
        v_alpha = v_alpha + v_more
    v_R -= np.einsum("hwi,hwj->ij", v_normals, view.images[2])
    v_blended = np.ascontiguousarray(np.concatenate([v_image, v_normals], axis=2))
    of_image = steps.blend_vjp(view.shown, view.blended, v_blended, v_alpha)
    v_along = v_distortion[..., 0] if settings.has_distortion else np.zeros_like(v_alpha)
    of_rays = steps.measure_vjp(view.shown, view.measures, v_median, v_along)
    v_T, v_c, v_o, v_read = (a + b for a, b in zip(of_image.primitives, of_rays, strict=True))

    v_values = of_image.colors.astype(np.float64)
    v_values[:, n_colors - 1] += v_read
    v_depths = v_values[:, n_colors - 1] if options.has_depth else np.zeros(len(v_values))
    v_surfels = SurfelGradient(v_T, v_c, v_o, v_depths, v_values[:, n_colors:])
    v_p = steps.project_vjp(view.primitives, camera, settings.conventions, view.shown.surfels, v_surfels)
    for name, field in zip(Primitives._fields, v_p, strict=False):
        v[f"v_{name}"] += field
    v_R, v_t = v_R + v_p.cam_from_world_R, v_p.cam_from_world_t
    if options.has_colors:
        n_given = n_colors - options.has_depth
        v_given = v_values[:, :n_given].astype(dtype)
        v["v_backgrounds"][c] += of_image.background[:n_given]
        own = v["v_colors"][c] if batch.has_own_colors else v["v_colors"]
        if options.sh_degree is None:
            own += v_given
        else:
            means, colors = batch.primitives.means, batch.colors_of(c)
            radii, unrotated = view.shown.surfels.radii, remove_rotation(camera)
            v_sh = settings.backend.sh_colors_vjp(
                means, colors[:, 0], colors[:, 1:], unrotated, options.sh_degree, radii, v_given
            )
            own += np.concatenate([v_sh.sh_dc[:, None], v_sh.sh_rest], axis=1)
            v["v_means"] += v_sh.means
            u = np.linalg.solve(R.T, -v_sh.cam_from_world_t)  # t of the unrotated camera is -o
            v_R, v_t = v_R + np.outer(u, unrotated.cam_from_world_t), v_t - u
    v["v_viewmats"][c, :3] += np.column_stack([v_R, v_t])
