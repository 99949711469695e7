"""Renderers on a GPU: gsplat's kernels, one by one, and the rasteriser of 3DGS, which is one call.

gsplat 1.5 and 1.6: each kernel gets the reference's input. Left out: its rendering of batches, packed projection, and
the loss, which gsplat does not have.

``diff_gaussian_rasterization``: the results of its one call, end to end; no footprints, lists, alpha or pose gradients.
Its gradient with respect to the projected centres is in normalised device coordinates, in which an image is two wide;
here it is per pixel.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.golden.format import Arrays, Golden
from minisplat_ref.oracle.golden.running import COLORS_GRADIENT, PROJECT_GRADIENT, grid_of, reference_bins
from minisplat_ref.oracle.renderer import ComparedRenderer
from minisplat_ref.types import Floats

TILE = 16  # pixels
Tensor = Any


def gsplat_cuda() -> ComparedRenderer:
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


def from_functions(functions: ModuleType, name: str, profile: Conventions, device: str) -> ComparedRenderer:
    """Compare functions of gsplat's names and signatures.

    Parameters
    ----------
    functions : module
        With ``fully_fused_projection``, ``spherical_harmonics``, ``isect_tiles``, ``isect_offset_encode`` and
        ``rasterize_to_pixels``.
    name : str
        For reports.
    profile : Conventions
        The conventions of this version.
    device : str
        Where the functions compute.
    """

    def arrays(truth: Golden) -> Arrays:
        scene = _Scene(functions, truth, device)
        return _project(scene) | _list_tiles(scene) | _shade(scene) | _composite(scene)

    return ComparedRenderer(name, "float32", True, arrays, rules_of(profile))


def rules_of(profile: Conventions) -> Callable[[Conventions], Conventions | None]:
    """Return the rules of a version of gsplat: a function of the conventions of a scene."""

    def rules(asked: Conventions) -> Conventions | None:
        free = {field: getattr(asked, field) for field in ("is_antialiased", "near_plane", "far_plane", "eps2d")}
        ours = profile._replace(**free)
        # Scenes under the conventions of another family would be rendered wrongly, which would prove nothing about
        # gsplat.
        return ours if ours._replace(name=asked.name, alpha_max=asked.alpha_max) == asked else None

    return rules


class _Scene(NamedTuple):
    """A scene as tensors."""

    functions: ModuleType
    truth: Golden
    device: str

    def tensor(self, name: str, *, is_leaf: bool = False) -> Tensor:
        """An array of the truth, in float32 where it is floating; differentiable if it is a leaf."""
        import torch

        array = self.truth.arrays[name]
        array = array.astype(np.float32) if array.dtype.kind == "f" else array
        return torch.tensor(array, device=self.device, requires_grad=is_leaf)

    def leaves(self, *names: str) -> list[Tensor]:
        """Differentiable tensors of these names."""
        return [self.tensor(name, is_leaf=True) for name in names]


def _project(scene: _Scene) -> Arrays:
    import torch

    c, camera = scene.truth.conventions, scene.truth.camera
    leaves = scene.leaves("means", "quats", "scales", "opacities", "cam_from_world_R", "cam_from_world_t")
    means, quats, scales, opacities, R, t = leaves
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]], device=scene.device)
    K = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], device=scene.device)
    radii, means2d, depths, conics, compensations = scene.functions.fully_fused_projection(
        means,
        None,
        quats,
        scales,
        torch.cat([torch.cat([R, t[:, None]], dim=1), bottom])[None],
        K[None],
        camera.width,
        camera.height,
        eps2d=c.eps2d,
        near_plane=c.near_plane,
        far_plane=c.far_plane,
        calc_compensations=c.is_antialiased,
        opacities=opacities.detach(),
    )
    opacities2d = opacities * (compensations[0] if c.is_antialiased else 1)
    is_shown = (radii[0] > 0).all(dim=1)  # the rows of culled Gaussians are uninitialised
    fields = {"means2d": means2d[0], "depths": depths[0], "conics": conics[0], "opacities2d": opacities2d}
    fields = {name: torch.where(is_shown.view(-1, *(1,) * (x.dim() - 1)), x, 0) for name, x in fields.items()}
    gradients = _gradients([(x, scene.tensor(f"v_{name}")) for name, x in fields.items()], leaves)
    shown = {name: _numpy(x) for name, x in fields.items()}
    return shown | {"radii": _numpy(radii[0])} | dict(zip(PROJECT_GRADIENT, gradients, strict=True))


def _list_tiles(scene: _Scene) -> Arrays:
    n_x, n_y = _tiles(scene)
    inputs = [scene.tensor(name)[None].contiguous() for name in ("means2d", "radii", "depths")]
    _, isect_ids, flatten_ids = scene.functions.isect_tiles(*inputs, TILE, n_x, n_y)
    starts = scene.functions.isect_offset_encode(isect_ids, 1, n_x, n_y)
    return {
        "tile_size": np.array([TILE, TILE], np.int32),
        "gaussian_ids": _numpy(flatten_ids),
        "tile_offsets": np.append(_numpy(starts).ravel(), len(flatten_ids)).astype(np.int64),
    }


def _shade(scene: _Scene) -> Arrays:
    import torch

    leaves = scene.leaves("means", "sh_dc", "sh_rest", "cam_from_world_R", "cam_from_world_t")
    means, sh_dc, sh_rest, R, t = leaves
    coefficients = torch.cat([sh_dc[:, None], sh_rest], dim=1)  # [N, K, 3]
    is_shown = scene.tensor("radii")[:, 0] > 0
    sums = scene.functions.spherical_harmonics(scene.truth.sh_degree, means + R.T @ t, coefficients, masks=is_shown)
    colors = torch.where(is_shown[:, None], torch.clamp_min(sums + 0.5, 0), 0)
    gradients = _gradients([(colors, scene.tensor("v_colors"))], leaves)
    return {"colors": _numpy(colors), **dict(zip(COLORS_GRADIENT, gradients, strict=True))}


def _composite(scene: _Scene) -> Arrays:
    import torch

    n_x, n_y = _tiles(scene)
    camera = scene.truth.camera
    bins = reference_bins(scene.truth.arrays, scene.truth.conventions, (TILE, TILE))
    names = ("means2d", "conics", "colors", "opacities2d", "background")
    leaves = scene.leaves(*names)
    *footprints, background = leaves
    image, alpha = scene.functions.rasterize_to_pixels(
        *(value[None] for value in footprints),
        camera.width,
        camera.height,
        TILE,
        torch.tensor(bins.tile_offsets[:-1].reshape(1, n_y, n_x).astype(np.int32), device=scene.device),
        torch.tensor(bins.gaussian_ids, device=scene.device),
        backgrounds=background[None],
    )
    image, alpha = image[0], alpha[0, :, :, 0]
    gradients = _gradients([(image, scene.tensor("v_image")), (alpha, scene.tensor("v_alpha"))], leaves)
    out = {f"v_{name}": v for name, v in zip(names, gradients, strict=True)}
    return {"image": _numpy(image), "alpha": _numpy(alpha), **out}


def _tiles(scene: _Scene) -> tuple[int, int]:
    grid = grid_of(scene.truth.arrays, (TILE, TILE))
    return grid.n_tiles_x, grid.n_tiles_y


def _gradients(pairs: list[tuple[Tensor, Tensor]], leaves: list[Tensor]) -> list[Floats]:
    """Return the gradients of the sum of output times cotangent."""
    import torch

    return [_numpy(v) for v in torch.autograd.grad(sum((x * v).sum() for x, v in pairs), leaves)]


def _numpy(value: Tensor) -> Floats:
    array: Floats = value.detach().cpu().numpy()
    return array


NEAR, FAR = 0.01, 100.0  # of the projection matrix, whose depth is only tested for being in front


def inria_cuda() -> ComparedRenderer:
    """Compare the installed ``diff_gaussian_rasterization``.

    Raises
    ------
    InputError
        If it or PyTorch is not installed, or there is no CUDA device.
    """
    try:
        import diff_gaussian_rasterization as rasterizer
        import torch
    except ImportError as error:
        raise InputError(
            f"the 3DGS rasteriser cannot be imported ({error}): install diff_gaussian_rasterization, or compare"
            " profile:INRIA"
        ) from None
    if not torch.cuda.is_available():
        raise InputError("the 3DGS rasteriser needs a CUDA device, PyTorch finds none here: compare profile:INRIA")
    return from_module(rasterizer, "cuda")


def from_module(rasterizer: ModuleType, device: str) -> ComparedRenderer:
    """Compare a module of the names ``GaussianRasterizationSettings`` and ``GaussianRasterizer``."""

    def rules(asked: Conventions) -> Conventions | None:
        return INRIA if asked == INRIA else None

    return ComparedRenderer(
        "diff_gaussian_rasterization",
        "float32",
        False,
        lambda truth: _arrays(rasterizer, truth, device),
        rules,
        ignores=("v_alpha", "v_depths"),
    )


def _arrays(rasterizer: ModuleType, truth: Golden, device: str) -> Arrays:
    import torch

    a, camera = truth.arrays, truth.camera

    def tensor(array: Any, *, is_leaf: bool = False) -> Any:
        return torch.tensor(np.asarray(array, np.float32), device=device, requires_grad=is_leaf)

    names = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest")
    leaves = {name: tensor(a[name], is_leaf=True) for name in names}
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = camera.cam_from_world_R, camera.cam_from_world_t
    slopes = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy  # tan(half field of view)
    clip = np.zeros((4, 4))
    clip[0, 0], clip[1, 1], clip[3, 2] = 1 / slopes[0], 1 / slopes[1], 1
    clip[2, 2], clip[2, 3] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
    settings: dict[str, Any] = {
        "image_height": camera.height,
        "image_width": camera.width,
        "tanfovx": slopes[0],
        "tanfovy": slopes[1],
        "bg": tensor(a["background"]),
        "scale_modifier": 1.0,
        "viewmatrix": tensor(view.T),  # row vectors
        "projmatrix": tensor((clip @ view).T),
        "sh_degree": truth.sh_degree,
        "campos": tensor(camera.center),
        "prefiltered": False,
        "debug": False,
    }
    fields = rasterizer.GaussianRasterizationSettings._fields
    settings |= {name: False for name in fields if name not in settings}  # switches of later versions
    centers = torch.zeros(len(a["means"]), 3, device=device, requires_grad=True)  # its gradient is that of the 2D means
    image, radii, *_ = rasterizer.GaussianRasterizer(rasterizer.GaussianRasterizationSettings(**settings))(
        means3D=leaves["means"],
        means2D=centers,
        shs=torch.cat([leaves["sh_dc"][:, None], leaves["sh_rest"]], dim=1),
        opacities=leaves["opacities"][:, None],
        scales=leaves["scales"],
        rotations=torch.nn.functional.normalize(leaves["quats"]),
    )
    total = (image.permute(1, 2, 0) * tensor(a["v_image"])).sum()
    gradients = [v.cpu().numpy() for v in torch.autograd.grad(total, [*leaves.values(), centers])]
    out: Arrays = dict(zip((f"v_{name}" for name in names), gradients, strict=False))
    out["v_means2d"] = gradients[-1][:, :2] * np.array([2 / camera.width, 2 / camera.height], np.float32)
    out["image"], out["radii"] = image.detach().permute(1, 2, 0).cpu().numpy(), radii.cpu().numpy()
    return out
