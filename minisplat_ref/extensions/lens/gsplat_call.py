"""gsplat's ``rasterization`` with cameras that are no pinholes, in NumPy, for tests of other renderers.

With ``with_ut`` and ``with_eval3d`` gsplat draws what this extension draws: pinholes with ``radial_coeffs`` (k1 to k6)
and ``tangential_coeffs`` (p1, p2), and fisheyes with ``radial_coeffs`` (k1 to k4). ``camera_model="ortho"`` is its EWA
of parallel rays, which is exact. Sizes in front of those of one scene are left out, and so are thin prisms and rolling
shutters; a fisheye sorts by distance, as gsplat does with ``global_z_order=False``.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.backends import Backend, get_backend
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.lens.kernels import response_for
from minisplat_ref.extensions.lens.reference import RESPONSE, FootprintGradient, LensFootprints, project, project_vjp
from minisplat_ref.extensions.lens.renderer import list_tiles
from minisplat_ref.gsplat_arguments import Batch, Options, Views, check_batch
from minisplat_ref.mechanisms.cameras.affine import orthographic, with_affine
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.splatting import splat
from minisplat_ref.types import Camera, Floats, Ints, Optics, RenderOutput

N_RADIAL = {"pinhole": 6, "fisheye": 4}


class Shot(NamedTuple):
    """What one camera sees."""

    camera: Camera
    footprints: LensFootprints
    output: RenderOutput


def rasterization(
    *,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    camera_model: str = "pinhole",
    radial_coeffs: Floats | None = None,
    tangential_coeffs: Floats | None = None,
    backend: str | Backend = "cpu",
    conventions: Conventions = GSPLAT_MAIN,
    **scene: Any,
) -> tuple[Floats, Floats]:
    """Return the images [C, H, W, D] and opacities [C, H, W, 1] of a scene.

    Parameters
    ----------
    viewmats, Ks, width, height
        As for :func:`minisplat_ref.rasterization`.
    camera_model : {"pinhole", "fisheye", "ortho"}
        The first two with exact rays, the last with conics.
    radial_coeffs : ndarray of shape (C, 6) or, of fisheyes, (C, 4), optional
    tangential_coeffs : ndarray of shape (C, 2), optional
    backend, conventions
        Implementation and profile.
    **scene
        ``means, quats, scales, opacities, colors`` [N, D] and ``backgrounds``, as there.

    Raises
    ------
    InputError
        An argument is wrong, or a lens folds inside the image.
    """
    stages = get_backend(backend) if isinstance(backend, str) else backend
    batch = _check(scene, Views(viewmats, Ks, width, height))
    if camera_model == "ortho":
        if radial_coeffs is not None or tangential_coeffs is not None:
            raise InputError("camera_model='ortho' has no distortion: leave out radial_coeffs and tangential_coeffs")
        outputs = [_shoot_parallel(batch, c, conventions, stages) for c in range(len(batch.cameras))]
    else:
        cameras = _with_lenses(batch.cameras, camera_model, radial_coeffs, tangential_coeffs)
        outputs = [_shoot(batch, c, camera, conventions, stages).output for c, camera in enumerate(cameras)]
    images, alphas = (np.stack([getattr(output, name) for output in outputs]) for name in ("image", "alpha"))
    return images, alphas[..., None]


def rasterization_vjp(
    *,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    v_render_colors: Floats,
    v_render_alphas: Floats,
    camera_model: str = "pinhole",
    radial_coeffs: Floats | None = None,
    tangential_coeffs: Floats | None = None,
    backend: str | Backend = "cpu",
    conventions: Conventions = GSPLAT_MAIN,
    **scene: Any,
) -> dict[str, Floats]:
    """Gradient of :func:`rasterization` along exact rays, by the names of :func:`minisplat_ref.rasterization_vjp`.

    Raises
    ------
    InputError
        As there, and for ``ortho``, whose gradient is that of ``mechanisms.cameras.affine``.
    """
    stages = get_backend(backend) if isinstance(backend, str) else backend
    batch = _check(scene, Views(viewmats, Ks, width, height))
    cameras = _with_lenses(batch.cameras, camera_model, radial_coeffs, tangential_coeffs)
    given = {f"v_{name}": np.zeros_like(field) for name, field in batch.primitives._asdict().items()}
    given |= {"v_colors": np.zeros_like(batch.colors), "v_backgrounds": np.zeros_like(batch.backgrounds)}
    given["v_viewmats"] = np.zeros((len(cameras), 4, 4), batch.colors.dtype)
    for c, camera in enumerate(cameras):
        shot, colors = _shoot(batch, c, camera, conventions, stages), batch.colors_of(c)
        f = shot.footprints
        bins = list_tiles(f, camera, stages, conventions)
        v_output = np.asarray(v_render_colors)[c], np.asarray(v_render_alphas)[c, ..., 0]
        inputs = f, colors, batch.backgrounds[c], bins, conventions, shot.output, v_output
        blend_vjp = (
            partial(kernel_hits.composite_hits_vjp, response_for(colors.dtype))
            if stages.is_compiled
            else partial(composite_hits_vjp, RESPONSE)
        )
        v = blend_vjp(*inputs)
        v_positions, v_whitenings, v_opacities = v.primitives
        v_footprints = FootprintGradient(v_positions, v_whitenings, v_opacities, np.zeros(len(colors)))
        v_primitives, _ = project_vjp(batch.primitives, f, v_footprints)
        for name in batch.primitives._fields:
            given[f"v_{name}"] += getattr(v_primitives, name)
        v_own = given["v_colors"][c] if batch.has_own_colors else given["v_colors"]
        v_own += v.colors
        given["v_backgrounds"][c] = v.background
        given["v_viewmats"][c, :3, :3] = v_primitives.cam_from_world_R
        given["v_viewmats"][c, :3, 3] = v_primitives.cam_from_world_t
    return given


def _check(scene: Mapping[str, Any], views: Views) -> Batch:
    """Check and pack the arguments."""
    names = ("means", "quats", "scales", "opacities")
    if missing := [name for name in (*names, "colors") if name not in scene]:
        raise InputError(f"{missing[0]} is missing: give means, quats, scales, opacities and colors")
    if surplus := sorted(set(scene) - {*names, "colors", "backgrounds"}):
        raise InputError(f"{surplus[0]} is not computed with this camera: leave it out")
    means, quats, scales, opacities = (scene[name] for name in names)
    options = Options(None, "RGB")
    return check_batch((means, quats, scales, opacities), views, scene["colors"], scene.get("backgrounds"), options)


def _with_lenses(
    cameras: Sequence[Camera], model: str, radial: Floats | None, tangential: Floats | None
) -> list[Camera]:
    """Return the cameras with the optics that gsplat's coefficients describe."""
    if model not in N_RADIAL:
        raise InputError(f"camera_model={model!r} has no exact rays here: choose from {', '.join(N_RADIAL)}")
    k = _coefficients("radial_coeffs", radial, len(cameras), N_RADIAL[model])
    p = _coefficients("tangential_coeffs", tangential, len(cameras), 2)
    if model == "fisheye":
        if tangential is not None:
            raise InputError("a fisheye has no tangential_coeffs: leave them out")
        return [camera._replace(optics=Optics("fisheye", tuple(k[c]))) for c, camera in enumerate(cameras)]
    if radial is None and tangential is None:
        return list(cameras)
    return [camera._replace(optics=Optics("brown", (*k[c], *p[c]))) for c, camera in enumerate(cameras)]


def _coefficients(name: str, value: Floats | None, n_cameras: int, n: int) -> list[list[float]]:
    """Return coefficients [C][n]; zeros where none are given."""
    array = np.zeros((n_cameras, n)) if value is None else np.asarray(value, np.float64)
    if array.shape != (n_cameras, n) or not np.isfinite(array).all():
        raise InputError(f"{name} must be {n_cameras} x {n} finite numbers, not of shape {list(array.shape)}")
    rows: list[list[float]] = array.tolist()
    return rows


def _shoot(batch: Batch, c: int, camera: Camera, conventions: Conventions, stages: Backend) -> Shot:
    """Render one camera along its rays."""
    footprints, colors = project(batch.primitives, camera, conventions), batch.colors_of(c)
    bins = list_tiles(footprints, camera, stages, conventions)
    inputs = footprints, colors, batch.backgrounds[c], bins, conventions
    blend = partial(kernel_hits.composite_hits, response_for(colors.dtype)) if stages.is_compiled else None
    output = composite_hits(RESPONSE, *inputs) if blend is None else blend(*inputs)
    return Shot(camera, footprints, output)


def _shoot_parallel(batch: Batch, c: int, conventions: Conventions, stages: Backend) -> RenderOutput:
    """Render one camera with parallel rays."""
    colors = batch.colors_of(c)

    def shade(radii: Ints) -> Floats:
        return colors

    affine = with_affine(stages, orthographic)
    return splat(batch.primitives, shade, batch.cameras[c], batch.backgrounds[c], conventions, affine).output
