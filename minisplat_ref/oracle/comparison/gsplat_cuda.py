"""gsplat's CUDA kernels, one by one, each fed with the reference's own input; for gsplat 1.5 and 1.6.

Left out: its rendering of batches, packed projection, and the loss, which gsplat leaves to others.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.comparison.renderers import Renderer
from minisplat_ref.oracle.golden.arrays import Arrays
from minisplat_ref.oracle.golden.scenes import Golden
from minisplat_ref.oracle.golden.stages import reference_bins

TILE = 16  # pixels


def gsplat_cuda() -> Renderer:
    """Compare the installed gsplat.

    Raises
    ------
    InputError
        If PyTorch or gsplat is not installed, or there is no CUDA device.
    """
    try:
        import gsplat
        import torch
    except ImportError as error:
        raise InputError(f"gsplat cannot be imported ({error}): install it, or compare gsplat-torch") from None
    if not torch.cuda.is_available():
        raise InputError("gsplat's kernels need a CUDA device, PyTorch finds none here: compare gsplat-torch instead")
    profile = GSPLAT_1_5 if tuple(map(int, gsplat.__version__.split(".")[:2])) < (1, 6) else GSPLAT_MAIN
    return from_functions(gsplat, f"gsplat {gsplat.__version__}", profile, "cuda")


def from_functions(functions: ModuleType, name: str, profile: Conventions, device: str) -> Renderer:
    """Compare functions of gsplat's names and signatures.

    Parameters
    ----------
    functions : module
        With ``fully_fused_projection``, ``spherical_harmonics``, ``isect_tiles``, ``isect_offset_encode`` and
        ``rasterize_to_pixels``.
    name : str
        For reports.
    profile : Conventions
        What this version does.
    device : str
        Where the functions compute.
    """
    return Renderer(name, "float32", True, lambda truth: _arrays(functions, truth, device), rules_of(profile))


def rules_of(profile: Conventions) -> Callable[[Conventions], Conventions | None]:
    """What a version of gsplat does with the conventions that a scene asks for."""

    def rules(asked: Conventions) -> Conventions | None:
        free = {field: getattr(asked, field) for field in ("is_antialiased", "near_plane", "far_plane", "eps2d")}
        ours = profile._replace(**free)
        # Scenes by the rules of another family would be drawn wrongly, and say nothing about gsplat.
        return ours if ours._replace(name=asked.name, alpha_max=asked.alpha_max) == asked else None

    return rules


def _arrays(functions: ModuleType, truth: Golden, device: str) -> Arrays:
    import torch

    c, a, camera = truth.conventions, truth.arrays, truth.camera

    def tensor(name: str, *, is_leaf: bool = False) -> Any:
        array = a[name].astype(np.float32) if a[name].dtype.kind == "f" else a[name]
        return torch.tensor(array, device=device, requires_grad=is_leaf)

    def numpy(value: Any) -> Any:
        return value.detach().cpu().numpy()

    out: Arrays = {}
    R, t = tensor("cam_from_world_R", is_leaf=True), tensor("cam_from_world_t", is_leaf=True)
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]], device=device)
    viewmat = torch.cat([torch.cat([R, t[:, None]], dim=1), bottom])  # [4, 4]
    K = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], device=device)

    leaves = {name: tensor(name, is_leaf=True) for name in ("means", "quats", "scales", "opacities")}
    radii, means2d, depths, conics, compensations = functions.fully_fused_projection(
        leaves["means"],
        None,
        leaves["quats"],
        leaves["scales"],
        viewmat[None],
        K[None],
        camera.width,
        camera.height,
        eps2d=c.eps2d,
        near_plane=c.near_plane,
        far_plane=c.far_plane,
        calc_compensations=c.is_antialiased,
        opacities=leaves["opacities"].detach(),
    )
    opacities2d = leaves["opacities"][None] * (compensations if c.is_antialiased else 1)
    shown = (radii[0] > 0).all(dim=-1)  # gsplat leaves rows of culled Gaussians as they were
    footprint = {"means2d": means2d[0], "depths": depths[0], "conics": conics[0], "opacities2d": opacities2d[0]}
    out |= {name: numpy(torch.where(shown.view(-1, *(1,) * (x.dim() - 1)), x, 0)) for name, x in footprint.items()}
    out["radii"] = numpy(radii[0])
    total = sum(
        (torch.where(shown.view(-1, *(1,) * (x.dim() - 1)), x, 0) * tensor(f"v_{name}")).sum()
        for name, x in footprint.items()
    )
    names = ("v_means_projection", "v_quats", "v_scales", "v_opacities", "v_R_projection", "v_t_projection")
    out |= zip(names, map(numpy, torch.autograd.grad(total, [*leaves.values(), R, t])), strict=True)

    n_x, n_y = -(-camera.width // TILE), -(-camera.height // TILE)
    seen = [tensor(name)[None].contiguous() for name in ("means2d", "radii", "depths")]
    _, isect_ids, flatten_ids = functions.isect_tiles(*seen, TILE, n_x, n_y)
    offsets = functions.isect_offset_encode(isect_ids, 1, n_x, n_y)
    out["tile_size"] = np.array([TILE, TILE], np.int32)
    out["gaussian_ids"] = numpy(flatten_ids)
    out["tile_offsets"] = np.append(numpy(offsets).ravel(), len(out["gaussian_ids"])).astype(np.int64)

    shading = {name: tensor(name, is_leaf=True) for name in ("means", "sh_dc", "sh_rest")}
    coefficients = torch.cat([shading["sh_dc"][:, None], shading["sh_rest"]], dim=1)  # [N, K, 3]
    directions = shading["means"] + R.T @ t
    is_shown = tensor("radii")[:, 0] > 0
    sums = functions.spherical_harmonics(truth.sh_degree, directions, coefficients, masks=is_shown)
    colors = torch.where(is_shown[:, None], torch.clamp_min(sums + 0.5, 0), 0)
    out["colors"] = numpy(colors)
    names = ("v_means_colors", "v_sh_dc", "v_sh_rest", "v_R_colors", "v_t_colors")
    total = (colors * tensor("v_colors")).sum()
    out |= zip(names, map(numpy, torch.autograd.grad(total, [*shading.values(), R, t])), strict=True)

    bins = reference_bins(a, c, (TILE, TILE))
    blended = {name: tensor(name, is_leaf=True) for name in ("means2d", "conics", "colors", "opacities2d")}
    background = tensor("background", is_leaf=True)
    image, alpha = functions.rasterize_to_pixels(
        *(value[None] for value in blended.values()),
        camera.width,
        camera.height,
        TILE,
        torch.tensor(bins.tile_offsets[:-1].reshape(1, n_y, n_x).astype(np.int32), device=device),
        torch.tensor(bins.gaussian_ids, device=device),
        backgrounds=background[None],
    )
    out["image"], out["alpha"] = numpy(image[0]), numpy(alpha[0, :, :, 0])
    total = (image[0] * tensor("v_image")).sum() + (alpha[0, :, :, 0] * tensor("v_alpha")).sum()
    names = ("v_means2d", "v_conics", "v_colors", "v_opacities2d", "v_background")
    out |= zip(names, map(numpy, torch.autograd.grad(total, [*blended.values(), background])), strict=True)
    return out
