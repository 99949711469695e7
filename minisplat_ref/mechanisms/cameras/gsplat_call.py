"""gsplat's ``rasterization`` with cameras that are no pinholes, in NumPy, for tests of other renderers.

With ``with_ut`` and ``with_eval3d`` gsplat renders along the rays of a lens (:mod:`.ray_footprints`): pinholes with
``radial_coeffs`` (k1 to k6) and ``tangential_coeffs`` (p1, p2), and fisheyes with ``radial_coeffs`` (k1 to k4).
``camera_model="ortho"`` is its EWA of parallel rays, which is exact (:mod:`.affine`). A fisheye sorts by distance, as
gsplat does with ``global_z_order=False``.

Left out are sizes in front of those of one scene, harmonics, depths, thin prisms and rolling shutters, and the EWA of
fisheyes, which is not exact.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.gsplat.arguments import Batch, Options, Views, check_batch
from minisplat_ref.mechanisms.cameras.affine import orthographic, with_affine
from minisplat_ref.mechanisms.cameras.kernels import response_for
from minisplat_ref.mechanisms.cameras.models import model_of
from minisplat_ref.mechanisms.cameras.ray_footprints import (
    RESPONSE,
    FootprintGradient,
    LensFootprints,
    list_tiles,
    project,
    project_vjp,
)
from minisplat_ref.mechanisms.cameras.unscented import unscented
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.rendering.backends import Backend, get_backend
from minisplat_ref.rendering.splatting import SplatTape, splat, splat_vjp
from minisplat_ref.types import Camera, Floats, Ints, Optics, PrimitiveGradient, RenderOutput

N_RADIAL = {"pinhole": 6, "fisheye": 4}
GRADIENTS = ("v_means", "v_quats", "v_scales", "v_opacities", "v_colors", "v_backgrounds", "v_viewmats")


class Shot(NamedTuple):
    """The view of one camera along its rays."""

    footprints: LensFootprints
    output: RenderOutput


class Settings(NamedTuple):
    """The request besides the scene: the cameras, with their lenses, and the options of rendering."""

    cameras: tuple[Camera, ...]
    is_parallel: bool
    conventions: Conventions
    backend: Backend


def with_lens(camera: Camera, model: str, k: list[float], p: list[float]) -> Camera:
    """Return the camera with the optics of radial and tangential coefficients; ``model`` is gsplat's name."""
    return camera._replace(optics=Optics("fisheye", tuple(k)) if model == "fisheye" else Optics("brown", (*k, *p)))


class Steps(NamedTuple):
    """The steps of the call that checks exchange."""

    bend: Callable[[Camera, str, list[float], list[float]], Camera] = with_lens
    project: Callable[..., LensFootprints] = project
    project_vjp: Callable[..., tuple[PrimitiveGradient, Floats]] = project_vjp


STEPS = Steps()


def rasterization(
    *,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    camera_model: str = "pinhole",
    radial_coeffs: Floats | None = None,
    tangential_coeffs: Floats | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    backend: str | Backend = "cpu",
    conventions: Conventions = GSPLAT_MAIN,
    steps: Steps = STEPS,
    **scene: Any,
) -> tuple[Floats, Floats, dict[str, Any]]:
    """Return the images [C, H, W, D], opacities [C, H, W, 1] and meta of a scene.

    Parameters
    ----------
    viewmats, Ks, width, height
        As for :func:`minisplat_ref.rasterization`.
    camera_model : {"pinhole", "fisheye", "ortho"}
        The first two with exact rays, the last with conics.
    radial_coeffs : ndarray of shape (C, 6) or, of fisheyes, (C, 4), optional
    tangential_coeffs : ndarray of shape (C, 2), optional
    with_ut, with_eval3d : bool
        Both True for pinholes and fisheyes, both False for ``ortho``.
    backend, conventions
        Implementation and profile.
    steps : Steps
        For checks.
    **scene
        ``means, quats, scales, opacities, colors`` [N, D] and ``backgrounds``, as there.

    Returns
    -------
    tuple
        The meta has ``radii`` [C, N, 2], ``means2d`` [C, N, 2], of the unscented transform where all sigma points are
        seen, and ``depths`` [C, N]; 0 where culled.

    Raises
    ------
    InputError
        An argument is wrong, or a lens folds inside the image.
    """
    batch = _check(scene, Views(viewmats, Ks, width, height))
    lens = (camera_model, radial_coeffs, tangential_coeffs, with_ut, with_eval3d)
    settings = _read_settings(batch, lens, backend, conventions, steps)
    outputs: list[RenderOutput] = []
    metas: list[dict[str, Any]] = []
    for c in range(len(settings.cameras)):
        if settings.is_parallel:
            tape = _shoot_parallel(batch, c, settings)
            outputs.append(tape.output)
            metas.append({name: getattr(tape.projection, name) for name in ("radii", "means2d", "depths")})
        else:
            shot = _shoot(batch, c, settings, steps)
            outputs.append(shot.output)
            f = shot.footprints
            metas.append({"radii": f.radii, "means2d": _unscented_means(f), "depths": f.depths})
    images, alphas = (np.stack([getattr(output, name) for output in outputs]) for name in ("image", "alpha"))
    return images, alphas[..., None], {name: np.stack([meta[name] for meta in metas]) for name in metas[0]}


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
    with_ut: bool = False,
    with_eval3d: bool = False,
    backend: str | Backend = "cpu",
    conventions: Conventions = GSPLAT_MAIN,
    steps: Steps = STEPS,
    **scene: Any,
) -> dict[str, Floats]:
    """Gradient of :func:`rasterization`, by the names of :func:`minisplat_ref.rasterization_vjp`.

    With parallel rays ``A = F R`` and ``b = F t + c``, ``F = diag(fx, fy, 1)``, so ``v_R = F v_A`` and ``v_t = F v_b``.

    Raises
    ------
    InputError
        As there.
    """
    batch = _check(scene, Views(viewmats, Ks, width, height))
    lens = (camera_model, radial_coeffs, tangential_coeffs, with_ut, with_eval3d)
    settings = _read_settings(batch, lens, backend, conventions, steps)
    given = {f"v_{name}": np.zeros_like(field) for name, field in batch.primitives._asdict().items()}
    given |= {"v_colors": np.zeros_like(batch.colors), "v_backgrounds": np.zeros_like(batch.backgrounds)}
    given["v_viewmats"] = np.zeros((len(settings.cameras), 4, 4), batch.colors.dtype)
    for c, camera in enumerate(settings.cameras):
        v_output = np.asarray(v_render_colors)[c], np.asarray(v_render_alphas)[c, ..., 0]
        if settings.is_parallel:
            v = splat_vjp(_shoot_parallel(batch, c, settings), *v_output)
            v_primitives, v_colors, v_background = v.primitives, v.colors, v.background
            F = np.array([camera.fx, camera.fy, 1.0])
            v_R, v_t = F[:, None] * v_primitives.cam_from_world_R, F * v_primitives.cam_from_world_t
        else:
            v_primitives, v_colors, v_background = _shoot_vjp(batch, c, settings, steps, v_output)
            v_R, v_t = v_primitives.cam_from_world_R, v_primitives.cam_from_world_t
        for name in batch.primitives._fields:
            given[f"v_{name}"] += getattr(v_primitives, name)
        v_own = given["v_colors"][c] if batch.has_own_colors else given["v_colors"]
        v_own += v_colors
        given["v_backgrounds"][c] = v_background
        given["v_viewmats"][c, :3] = np.column_stack([v_R, v_t])
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


def _read_settings(
    batch: Batch,
    lens: tuple[str, Floats | None, Floats | None, bool, bool],
    backend: str | Backend,
    conventions: Conventions,
    steps: Steps,
) -> Settings:
    """Return the request, checked."""
    model, radial, tangential, *flags = lens
    stages = get_backend(backend) if isinstance(backend, str) else backend
    if model == "ortho":
        if radial is not None or tangential is not None:
            raise InputError("camera_model='ortho' has no distortion: leave out radial_coeffs and tangential_coeffs")
        if any(flags):
            raise InputError("camera_model='ortho' is drawn by conics, which are exact: leave out with_ut, with_eval3d")
        return Settings(batch.cameras, True, conventions, stages)
    if model not in N_RADIAL:
        raise InputError(f"camera_model={model!r} is not computed: choose from {', '.join(N_RADIAL)}, ortho")
    if not all(flags):
        raise InputError(f"camera_model={model!r} is drawn along rays: give with_ut=True and with_eval3d=True")
    k = _coefficients("radial_coeffs", radial, len(batch.cameras), N_RADIAL[model])
    p = _coefficients("tangential_coeffs", tangential, len(batch.cameras), 2)
    if model == "fisheye" and tangential is not None:
        raise InputError("a fisheye has no tangential_coeffs: leave them out")
    is_bare = model == "pinhole" and radial is None and tangential is None
    bent = [steps.bend(camera, model, k[c], p[c]) for c, camera in enumerate(batch.cameras)]
    return Settings(batch.cameras if is_bare else tuple(bent), False, conventions, stages)


def _coefficients(name: str, value: Floats | None, n_cameras: int, n: int) -> list[list[float]]:
    """Return coefficients [C][n]; zeros where none are given."""
    array = np.zeros((n_cameras, n)) if value is None else np.asarray(value, np.float64)
    if array.shape != (n_cameras, n) or not np.isfinite(array).all():
        raise InputError(f"{name} must be {n_cameras} x {n} finite numbers, not of shape {list(array.shape)}")
    rows: list[list[float]] = array.tolist()
    return rows


def _unscented_means(f: LensFootprints) -> Floats:
    """Return the means [N, 2] of the unscented transform, px; 0 where culled or a sigma point is not seen."""
    rows = np.flatnonzero(f.radii[:, 0] > 0)
    means, _, is_whole = unscented(f.positions[rows], np.linalg.inv(f.whitenings[rows]), model_of(f.camera), f.camera)
    found = np.zeros_like(f.means2d)
    found[rows] = np.where(is_whole[:, None], means, 0)
    return found


def _shoot(batch: Batch, c: int, settings: Settings, steps: Steps) -> Shot:
    """Render one camera along its rays."""
    camera, colors = settings.cameras[c], batch.colors_of(c)
    footprints = steps.project(batch.primitives, camera, settings.conventions)
    bins = list_tiles(footprints, camera, settings.backend, settings.conventions)
    inputs = footprints, colors, batch.backgrounds[c], bins, settings.conventions
    blend: Callable[..., RenderOutput] = (
        partial(kernel_hits.composite_hits, response_for(colors.dtype))
        if settings.backend.is_compiled
        else partial(composite_hits, RESPONSE)
    )
    return Shot(footprints, blend(*inputs))


def _shoot_vjp(
    batch: Batch, c: int, settings: Settings, steps: Steps, v_output: tuple[Floats, Floats]
) -> tuple[PrimitiveGradient, Floats, Floats]:
    """Gradient of :func:`_shoot`: of Gaussians and pose, colours [N, D] and background [D]."""
    shot, colors = _shoot(batch, c, settings, steps), batch.colors_of(c)
    f, conventions = shot.footprints, settings.conventions
    bins = list_tiles(f, settings.cameras[c], settings.backend, conventions)
    inputs = f, colors, batch.backgrounds[c], bins, conventions, shot.output, v_output
    blend_vjp = (
        partial(kernel_hits.composite_hits_vjp, response_for(colors.dtype))
        if settings.backend.is_compiled
        else partial(composite_hits_vjp, RESPONSE)
    )
    v = blend_vjp(*inputs)
    v_positions, v_whitenings, v_opacities = v.primitives
    v_footprints = FootprintGradient(v_positions, v_whitenings, v_opacities, np.zeros(len(colors)))
    v_primitives, _ = steps.project_vjp(batch.primitives, f, v_footprints)
    return v_primitives, v.colors, v.background


def _shoot_parallel(batch: Batch, c: int, settings: Settings) -> SplatTape:
    """Render one camera with parallel rays."""
    colors = batch.colors_of(c)

    def shade(radii: Ints) -> Floats:
        return colors

    affine = with_affine(settings.backend, orthographic)
    return splat(batch.primitives, shade, settings.cameras[c], batch.backgrounds[c], settings.conventions, affine)
