"""gsplat 1.5.3's functions in plain PyTorch as a backend: NumPy in, NumPy out, gradients by autograd.

gsplat has a second implementation of its CUDA kernels for its own tests. That file is loaded alone, because importing
the package looks for CUDA. It computes everything that is compared: covariances, projection, conics, radii, tile lists,
spherical harmonics, alpha and the sums over hits. Four things are ours, since gsplat has them in CUDA only or takes
them from a package that does:

* which hits a pixel blends, from the reference's thresholds at gsplat's values (no gradient goes through it);
* the weights ``alpha_g prod (1 - alpha_j)`` of a pixel's hits, in four lines of torch;
* their sums over a pixel, in two;
* the 0.5 and the zero below colours, and the background behind the image, which gsplat adds in its own front end.

It runs in the dtype of its input, like any backend. Its clamp of alpha is always 0.999, regardless of the conventions:
compare under ``GSPLAT_1_5``. It culls by position only, and its radii are 3.33 sigma whatever the opacity.
"""

import dataclasses
import functools
import importlib.util
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np

from minisplat_ref.constants import SH_DEGREE_MAX, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import (
    Camera,
    CompositeGradient,
    Floats,
    Ints,
    PrimitiveGradient,
    Projection,
    ProjectionGradient,
    RenderOutput,
    SHGradient,
    TileBins,
    TileGrid,
)

VERSION = "1.5.3"
ALPHA_MAX = 0.999
TILE = 16
Tensor = Any


@functools.cache
def load() -> tuple[ModuleType, ModuleType]:
    """Return torch and gsplat's module of functions.

    Raises
    ------
    InputError
        If either is not installed, or gsplat is another version.
    """
    spec = importlib.util.find_spec("gsplat")
    if importlib.util.find_spec("torch") is None or spec is None:
        raise InputError("torch or gsplat is not installed; install the extra: pip install 'minisplat_ref[peers]'")
    if version("gsplat") != VERSION:
        raise InputError(f"gsplat is {version('gsplat')}; this adapter knows {VERSION}")
    import torch

    folder = Path(spec.submodule_search_locations[0])  # type: ignore[index]  # a package has one
    file_spec = importlib.util.spec_from_file_location("gsplat_torch_impl", folder / "cuda" / "_torch_impl.py")
    module = importlib.util.module_from_spec(file_spec)  # type: ignore[arg-type]
    file_spec.loader.exec_module(module)  # type: ignore[union-attr]
    return torch, module


def gsplat_torch() -> Backend:
    """Return gsplat's functions as a backend; functions that gsplat lacks are the reference's.

    Raises
    ------
    InputError
        If torch or gsplat is not installed.
    """
    load()
    return dataclasses.replace(
        REFERENCE,
        name="gsplat-torch",
        tile_width=TILE,
        tile_height=TILE,
        project=project,
        project_vjp=project_vjp,
        sh_colors=sh_colors,
        sh_colors_vjp=sh_colors_vjp,
        bin_gaussians=bin_gaussians,
        composite=composite,
        composite_vjp=composite_vjp,
    )


def project(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
) -> Projection:
    """Call ``_quat_scale_to_covar_preci`` and ``_fully_fused_projection``."""
    leaves = [_tensor(x) for x in (means, quats, scales, opacities, *_pose(camera, means))]
    radii, *fields = _project(camera, conventions, *leaves)
    radii = radii.numpy().astype(np.int32)
    rows = (radii > 0).all(axis=1)
    means2d, depths, conics, opacities = (
        np.where(rows.reshape(-1, *[1] * (field.ndim - 1)), field.numpy(), 0) for field in fields
    )
    low, high = np.floor(means2d - radii), np.ceil(means2d + radii)
    size = camera.width, camera.height
    boxes = np.where(rows[:, None], np.hstack([np.clip(low, 0, size), np.clip(high, 0, size)]), 0).astype(np.int32)
    return Projection(means2d, depths, conics, opacities, np.where(rows[:, None], radii, 0), boxes)


def project_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    camera: Camera,
    conventions: Conventions,
    projection: Projection,
    v_projection: ProjectionGradient,
) -> PrimitiveGradient:
    """Autograd of :func:`project`."""
    rows = projection.radii[:, 0] > 0
    cotangents = [np.where(rows.reshape(-1, *[1] * (v.ndim - 1)), v, 0) for v in v_projection]
    inputs = (means, quats, scales, opacities, *_pose(camera, means))
    return PrimitiveGradient(*_autograd(lambda *x: _project(camera, conventions, *x)[1:], inputs, cotangents))


def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints) -> Floats:
    """Call ``_spherical_harmonics``."""
    leaves = [_tensor(x) for x in (means, sh_dc, sh_rest, *_pose(camera, means))]
    return np.where(radii[:, :1] > 0, _colors(_one(degree), *leaves)[0].numpy(), 0)


def sh_colors_vjp(
    means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints, v_colors: Floats
) -> SHGradient:
    """Autograd of :func:`sh_colors`."""
    inputs = means, sh_dc, sh_rest, *_pose(camera, means)
    cotangents = [np.where(radii[:, :1] > 0, v_colors, 0)]
    return SHGradient(*_autograd(functools.partial(_colors, _one(degree)), inputs, cotangents))


def _one(degree: int | Ints) -> int:
    """Return the degree of all Gaussians; gsplat has no degree of each."""
    if np.min(degree, initial=SH_DEGREE_MAX) < np.max(degree, initial=0):
        raise InputError("gsplat gives all Gaussians one degree of the spherical harmonics: give one number")
    return int(np.max(degree, initial=0))


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """Call ``_isect_tiles`` and ``_isect_offset_encode``; the lists are sorted by the depth in float32."""
    torch, gsplat = load()
    with torch.no_grad():
        means2d, radii = _tensor(projection.means2d)[None], _tensor(projection.radii)[None]
        depths = _tensor(projection.depths.astype(np.float32))[None]
        shape = grid.n_tiles_x, grid.n_tiles_y
        _, keys, ids = gsplat._isect_tiles(means2d, radii, depths, grid.tile_width, *shape)
        starts = gsplat._isect_offset_encode(keys, 1, *shape).numpy().ravel()
    gaussian_ids = ids.numpy()
    slots = np.empty(len(gaussian_ids), np.int32)
    slots[np.argsort(gaussian_ids, kind="stable")] = np.arange(len(slots))
    counts = np.bincount(gaussian_ids, minlength=len(projection.depths))
    offsets = np.append(starts, len(gaussian_ids)).astype(np.int64)
    return TileBins(gaussian_ids, offsets, slots, np.append(0, np.cumsum(counts)), grid)


def composite(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Call ``accumulate`` for the hits that pass its thresholds; it has no statistics and no median depth."""
    if with_stats or with_median_depth:
        raise InputError("gsplat's torch functions have no blend statistics and no median depth")
    leaves = [_tensor(x) for x in (projection.means2d, projection.conics, projection.opacities, colors, background)]
    image, alpha = _composite(projection, bins, conventions, *leaves)
    return RenderOutput(image.numpy(), alpha.numpy(), None, None)


def composite_vjp(
    projection: Projection,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_image: Floats,
    v_alpha: Floats,
) -> CompositeGradient:
    """Autograd of :func:`composite`."""
    inputs = projection.means2d, projection.conics, projection.opacities, colors, background
    function = functools.partial(_composite, projection, bins, conventions)
    return CompositeGradient(*_autograd(function, inputs, (v_image, v_alpha)))


def _project(
    camera: Camera,
    conventions: Conventions,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    R: Tensor,
    t: Tensor,
) -> tuple[Tensor, ...]:
    torch, gsplat = load()
    covariances, _ = gsplat._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    view = torch.cat([torch.cat([R, t[:, None]], 1), torch.eye(4, dtype=means.dtype)[3:]])
    K = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=means.dtype)
    radii, means2d, depths, conics, compensations = gsplat._fully_fused_projection(
        means,
        covariances,
        view[None],
        K[None],
        camera.width,
        camera.height,
        eps2d=conventions.eps2d,
        near_plane=conventions.near_plane,
        far_plane=conventions.far_plane,
        calc_compensations=conventions.is_antialiased,
    )
    opacities = opacities if compensations is None else opacities * compensations[0]
    return radii[0], means2d[0], depths[0], conics[0], opacities


def _colors(degree: int, means: Tensor, sh_dc: Tensor, sh_rest: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, ...]:
    torch, gsplat = load()
    coefficients = torch.cat([sh_dc[:, None], sh_rest], 1)
    return (torch.clamp_min(gsplat._spherical_harmonics(degree, means + R.T @ t, coefficients) + 0.5, 0),)


def _composite(
    projection: Projection,
    bins: TileBins,
    conventions: Conventions,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    background: Tensor,
) -> tuple[Tensor, Tensor]:
    torch, gsplat = load()
    pixels, ids = _hits(projection, bins, conventions._replace(alpha_max=ALPHA_MAX))
    width, height = bins.grid.width, bins.grid.height
    nerfacc = ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha = ray_weights  # type: ignore[attr-defined]
    nerfacc.accumulate_along_rays = ray_sums  # type: ignore[attr-defined]
    with patch.dict(sys.modules, {"nerfacc": nerfacc}):  # accumulate imports it when called
        image, alpha = gsplat.accumulate(
            means2d[None],
            conics[None],
            opacities[None],
            colors[None],
            ids,
            pixels,
            torch.zeros_like(ids),
            width,
            height,
        )
    alpha = alpha[0]
    return image[0] + background * (1 - alpha), alpha[:, :, 0]


def _hits(projection: Projection, bins: TileBins, conventions: Conventions) -> tuple[Tensor, Tensor]:
    """Return pixel [M] and Gaussian [M] of every blended hit, pixel by pixel and front to back."""
    torch, _ = load()
    pixels, ids = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for tile in tile_hits(projection, bins, conventions):
        p, g = np.nonzero(tile.alphas.T > 0)
        pixels.append(tile.ys[p] * bins.grid.width + tile.xs[p])
        ids.append(tile.ids[g].astype(np.int64))
    return torch.from_numpy(np.concatenate(pixels)), torch.from_numpy(np.concatenate(ids))


def ray_weights(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Return weight and transmittance of each hit, as running products over a table with a row for each pixel."""
    torch, _ = load()
    is_first = torch.ones_like(ray_indices, dtype=torch.bool)
    is_first[1:] = ray_indices[1:] != ray_indices[:-1]
    index = torch.arange(len(ray_indices))
    place = index - torch.cummax(torch.where(is_first, index, 0), 0).values if len(index) else index
    table = torch.zeros((n_rays, int(place.max()) + 2 if len(index) else 1), dtype=alphas.dtype)
    table = table.index_put((ray_indices, place + 1), alphas)
    transmittances = torch.cumprod(1 - table, 1)[ray_indices, place]
    return alphas * transmittances, transmittances


def ray_sums(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Return the sums [n_rays, D] of the hits' weights times values, or of the weights alone."""
    torch, _ = load()
    terms = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros((n_rays, terms.shape[1]), dtype=weights.dtype).index_add(0, ray_indices, terms)


def _autograd(
    function: Callable[..., tuple[Tensor, ...]], inputs: tuple[Floats, ...], cotangents: Any
) -> tuple[Floats, ...]:
    """Return the gradients with respect to all inputs, zeros for those without effect."""
    torch, _ = load()
    leaves = [_tensor(x).requires_grad_() for x in inputs]
    pairs = [(out, _tensor(v)) for out, v in zip(function(*leaves), cotangents, strict=True) if out.requires_grad]
    outputs, weights = zip(*pairs, strict=True)
    gradients = torch.autograd.grad(outputs, leaves, weights, allow_unused=True)
    return tuple(np.zeros_like(x) if g is None else g.numpy() for x, g in zip(inputs, gradients, strict=True))


def _pose(camera: Camera, like: Floats) -> tuple[Floats, Floats]:
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    return np.asarray(R, like.dtype), np.asarray(t, like.dtype)


def _tensor(array: Floats | Ints) -> Tensor:
    torch, _ = load()
    return torch.from_numpy(np.array(array))
