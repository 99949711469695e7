"""gsplat 1.5.3's own torch statement of 2D Gaussian Splatting as a ``rasterization_2dgs`` on torch tensors.

gsplat tests its kernels against ``_torch_impl_2dgs``; that file and ``depth_to_normal`` are loaded alone, because
importing the package looks for CUDA. They compute projection, alphas, colours, opacities, normals and surface normals,
and torch differentiates them. The parts that gsplat has in CUDA only are ours: which hits a pixel blends, from the
reference's thresholds (no gradient goes through it), and the median depth and the distortion, in a few lines of torch
each.

Its normals are multiplied by the third scale, which the kernels leave out: give it third scales of one.
"""

import functools
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np

from minisplat_ref.constants import GSPLAT_1_5, MEDIAN_TRANSMITTANCE
from minisplat_ref.mechanisms.surfels.projection import GSPLAT, project
from minisplat_ref.mechanisms.surfels.renderer import list_tiles
from minisplat_ref.mechanisms.surfels.response import Layout, surfel_response
from minisplat_ref.oracle.peers.gsplat_torch import load, ray_sums, ray_weights
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Primitives

Tensor = Any


@functools.cache
def load_2dgs() -> tuple[ModuleType, ModuleType]:
    """Return gsplat's torch module of 2D Gaussian Splatting, and its module with ``depth_to_normal``.

    Raises
    ------
    InputError
        If torch or gsplat is not installed, or gsplat is another version.
    """
    _, implementation = load()
    found = importlib.util.find_spec("gsplat")
    folder = Path(found.submodule_search_locations[0])  # type: ignore[union-attr,index]  # load() has found it
    known = {name: ModuleType(name) for name in ("gsplat", "gsplat.cuda")}
    with patch.dict(sys.modules, {**known, "gsplat.cuda._torch_impl": implementation}):
        modules = []
        for name in ("cuda/_torch_impl_2dgs.py", "utils.py"):
            spec = importlib.util.spec_from_file_location(f"gsplat_{Path(name).stem}", folder / name)
            module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
            spec.loader.exec_module(module)  # type: ignore[union-attr]
            modules.append(module)
    return modules[0], modules[1]


def rasterization_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    backgrounds: Tensor,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    sh_degree: int | None = None,
    render_mode: str = "RGB+ED",
    distloss: bool = True,
    depth_mode: str = "expected",
) -> tuple[Tensor, ...]:
    """Return gsplat's seven results for one camera and colours with expected depth, the mode of its trainer."""
    torch, implementation = load()
    gsplat, utils = load_2dgs()
    assert render_mode == "RGB+ED" and len(viewmats) == 1, "what the oracle compares"
    planes = {"near_plane": near_plane, "far_plane": far_plane}
    given = means, quats, scales, viewmats, Ks, width, height
    radii, means2d, depths, transforms, normals = gsplat._fully_fused_projection_2dgs(*given, **planes)
    values = _colors(implementation, means, colors, viewmats, sh_degree)
    values = torch.cat([values, depths[0][:, None]], 1)[None]
    ids, pixels = _hits((means, quats, scales, opacities), viewmats, Ks, (width, height), planes)
    blended = means2d, transforms, opacities[None], values, normals
    (image, alpha, shown), weights, transmittances = _accumulate(gsplat, blended, ids, pixels, (width, height))
    median, distortion = _measure_rays(weights, transmittances, values[0, :, -1][ids], pixels, (width, height))
    behind = torch.cat([backgrounds, torch.zeros_like(backgrounds[:, :1])], 1)
    image = image + behind[:, None, None] * (1 - alpha)
    expected = image[..., -1:] / alpha.clamp(min=1e-10)
    image = torch.cat([image[..., :-1], expected], -1)
    to_world = torch.linalg.inv(viewmats)
    surface = utils.depth_to_normal(median if depth_mode == "median" else expected, to_world, Ks)
    shown = torch.einsum("cij,chwj->chwi", to_world[:, :3, :3], shown)
    meta = {"radii": radii, "means2d": means2d, "depths": depths, "ray_transforms": transforms, "normals": normals}
    return image, alpha, shown, surface, distortion, median, meta


def _colors(implementation: ModuleType, means: Tensor, colors: Tensor, viewmats: Tensor, degree: int | None) -> Tensor:
    torch, _ = load()
    if degree is None:
        return colors
    center = torch.linalg.inv(viewmats)[0, :3, 3]
    return torch.clamp_min(implementation._spherical_harmonics(degree, means - center, colors) + 0.5, 0)


def _hits(
    primitives: tuple[Tensor, ...], viewmats: Tensor, Ks: Tensor, size: tuple[int, int], planes: dict[str, float]
) -> tuple[Tensor, Tensor]:
    """Return surfel [M] and pixel [M] of every blended hit, pixel by pixel and front to back."""
    torch, _ = load()
    M, K = viewmats[0].detach().numpy().astype(np.float64), Ks[0].numpy().astype(np.float64)
    camera = Camera(M[:3, :3], M[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], *size)
    conventions = GSPLAT_1_5._replace(near_plane=planes["near_plane"], far_plane=planes["far_plane"])
    given = Primitives(*(x.detach().numpy().astype(np.float64) for x in primitives))
    surfels = project(given, camera, conventions, GSPLAT)
    bins = list_tiles(surfels, camera, conventions, REFERENCE)
    ids, pixels = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for tile in tile_hits(surfels, bins, conventions, surfel_response(Layout())):
        p, g = np.nonzero(tile.alphas.T > 0)
        pixels.append(tile.ys[p] * size[0] + tile.xs[p])
        ids.append(tile.ids[g].astype(np.int64))
    return torch.from_numpy(np.concatenate(ids)), torch.from_numpy(np.concatenate(pixels))


def _accumulate(
    gsplat: ModuleType, blended: tuple[Tensor, ...], ids: Tensor, pixels: Tensor, size: tuple[int, int]
) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """Call ``accumulate_2dgs``; return its results, and the weight and the transmittance of each hit within it."""
    torch, _ = load()
    kept: list[Tensor] = []

    def keep(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        kept[:] = ray_weights(alphas, ray_indices, n_rays)
        return kept[0], kept[1]

    nerfacc = ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha = keep  # type: ignore[attr-defined]
    nerfacc.accumulate_along_rays = ray_sums  # type: ignore[attr-defined]
    with patch.dict(sys.modules, {"nerfacc": nerfacc}):  # accumulate_2dgs imports it when called
        results = gsplat.accumulate_2dgs(*blended, ids, pixels, torch.zeros_like(ids), *size)
    return results, kept[0], kept[1]


def _measure_rays(
    weights: Tensor, transmittances: Tensor, z: Tensor, pixels: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return the median depth and the distortion [1, H, W, 1] of the hits, as :mod:`..ray_measures` defines them."""
    torch, _ = load()
    is_first = torch.ones_like(pixels, dtype=torch.bool)
    is_first[1:] = pixels[1:] != pixels[:-1]
    starts = torch.cummax(torch.where(is_first, torch.arange(len(pixels)), 0), 0).values
    terms = weights * z
    running = torch.cumsum(terms, 0) - terms
    before = running - running[starts]  # sum of w z over the pixel's earlier hits
    is_candidate = transmittances > MEDIAN_TRANSMITTANCE
    is_median = is_candidate.clone()
    is_median[:-1] &= ~is_candidate[1:] | is_first[1:]
    of_hits = torch.where(is_median, z, 0), 2 * (terms * (1 - transmittances) - weights * before)
    shape = (1, size[1], size[0], 1)
    median, distortion = (ray_sums(hits, None, pixels, size[0] * size[1]).reshape(shape) for hits in of_hits)
    return median, distortion
