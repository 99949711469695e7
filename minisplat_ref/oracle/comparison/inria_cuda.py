"""The rasteriser of 3DGS (``diff_gaussian_rasterization``), which is one call: whatever that gives, end to end.

It gives no footprints, lists, alpha or pose gradients. Its gradient by the projected centres is in normalised device
coordinates, half an image wide; here it is per pixel.
"""

from types import ModuleType
from typing import Any

import numpy as np

from minisplat_ref.constants import INRIA, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.comparison.renderers import Renderer
from minisplat_ref.oracle.golden.arrays import Arrays
from minisplat_ref.oracle.golden.scenes import Golden

NEAR, FAR = 0.01, 100.0  # of the projection matrix, whose depth is only tested for being in front


def inria_cuda() -> Renderer:
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


def from_module(rasterizer: ModuleType, device: str) -> Renderer:
    """Compare a module of the names ``GaussianRasterizationSettings`` and ``GaussianRasterizer``."""

    def rules(asked: Conventions) -> Conventions | None:
        return INRIA if asked == INRIA else None

    return Renderer(
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
    centers = torch.zeros(len(a["means"]), 3, device=device, requires_grad=True)  # its gradient is by the 2D means
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
