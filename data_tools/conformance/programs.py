"""Renderers that Python calls on a CPU: gsplat's functions in torch, torch-splatting, OpenSplat, LiteSplat.

Each takes a probe and the cache folder, and returns the picture [H, W, 3] in 8 bits. What a renderer's own driver does
between its functions (a clamp, a background) is done here as it is done there.
"""

import contextlib
import importlib
import io
import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from data_tools.conformance.fetching import clone
from data_tools.conformance.probes import FOCAL, HEIGHT, WIDTH, Probe, golden_of
from minisplat_ref.constants import GSPLAT_1_5, SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.golden.format import STAGE_INPUTS
from minisplat_ref.types import Floats, Gaussians

NEAR, FAR = 0.001, 1000.0
TORCH_SPLATTING = ("hbb1/torch-splatting", "3fa49bd6")
OPENSPLAT = ("pierotofy/OpenSplat", "15b7e800")
OF_TORCH_SPLATTING = 256  # px, side of the grid that it renders


def eight_bits(image: Any) -> Floats:
    """Return an image as 8 bits hold it."""
    return np.asarray(np.rint(255 * np.clip(np.nan_to_num(np.asarray(image)), 0, 1)) / 255).reshape(HEIGHT, WIDTH, 3)


def needed(name: str, package: str) -> Any:
    """Return an installed module.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"needs {package}: pip install {package} ({error})") from error


def view_of(probe: Probe) -> Floats:
    """Return the view matrix [4, 4], in OpenCV's axes."""
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = probe.camera
    return view


def projection() -> Floats:
    """Return the projection [4, 4] of trainers, whose principal point is the image's middle; y is down."""
    depth, shift = (FAR + NEAR) / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
    return np.array([[2 * FOCAL / WIDTH, 0, 0, 0], [0, 2 * FOCAL / HEIGHT, 0, 0], [0, 0, depth, shift], [0, 0, 1, 0]])


def coefficients(gaussians: Gaussians) -> Floats:
    """Return the harmonics' coefficients [N, 16, 3], of degree 3 whatever the scene has."""
    n, k = gaussians.sh_rest.shape[:2]
    rest = np.concatenate([gaussians.sh_rest, np.zeros((n, 15 - k, 3), np.float32)], axis=1)
    return np.concatenate([gaussians.sh_dc[:, None], rest], axis=1)


def gsplat_torch(probe: Probe, _: Path) -> Floats:
    """Render by gsplat's own functions in torch, with the blending of docs/ORACLE.md."""
    needed("torch", "torch")
    needed("gsplat", "gsplat==1.5.3")
    from minisplat_ref.oracle.golden.running import run_stages
    from minisplat_ref.oracle.peers.gsplat_torch import gsplat_torch as functions

    scene = golden_of(probe, GSPLAT_1_5)
    arrays = {name: scene.arrays[name] for name in (*STAGE_INPUTS["view"], "features", "feature_background")}
    return eight_bits(run_stages(functions(), scene._replace(arrays=arrays), "float32")["image"])


def torch_splatting(probe: Probe, cache: Path) -> Floats:
    """Render by hbb1/torch-splatting, whose tensors are put on the CPU; over black, and the background after it."""
    torch = needed("torch", "torch==2.13.0")
    needed("einops", "einops")
    overrides = needed("torch.overrides", "torch")
    folder = str(clone(*TORCH_SPLATTING, cache))

    class OnCpu(overrides.TorchFunctionMode):  # type: ignore[misc, name-defined]
        """Its code names the device ``cuda``."""

        def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            kwargs = {name: "cpu" if value == "cuda" else value for name, value in (kwargs or {}).items()}
            return function(*("cpu" if isinstance(a, str) and a == "cuda" else a for a in args), **kwargs)

    sys.path.insert(0, folder)
    try:
        renderer = importlib.import_module("gaussian_splatting.gauss_render").GaussRenderer
    finally:
        sys.path.remove(folder)
    g, view = probe.gaussians, view_of(probe)
    camera = SimpleNamespace(
        image_width=WIDTH,
        image_height=HEIGHT,
        FoVx=2 * np.arctan(WIDTH / 2 / FOCAL),
        FoVy=2 * np.arctan(HEIGHT / 2 / FOCAL),
        focal_x=FOCAL,
        focal_y=FOCAL,
        world_view_transform=_float(torch, view.T),
        projection_matrix=_float(torch, projection().T),
        camera_center=_float(torch, -view[:3, :3].T @ view[:3, 3]),
    )
    scene = SimpleNamespace(
        get_xyz=_float(torch, g.means),
        get_opacity=torch.sigmoid(_float(torch, g.opacity_logits))[:, None],
        get_scaling=torch.exp(_float(torch, g.log_scales)),
        get_rotation=_float(torch, g.quats),
        get_features=_float(torch, coefficients(g)),
    )
    with OnCpu(), torch.no_grad():
        try:
            shown = renderer(active_sh_degree=3, white_bkgd=False)(camera, scene)
        except (RuntimeError, IndexError) as error:
            raise InputError(f"torch-splatting, {probe.name}: {str(error).splitlines()[0]}") from error
    image, alpha = (shown[name][:HEIGHT, :WIDTH].numpy() for name in ("render", "alpha"))
    return eight_bits(image + (1 - alpha) * np.array(probe.background))


def opensplat(probe: Probe, cache: Path) -> Floats:
    """Render by OpenSplat's functions of the CPU, which are compiled against torch."""
    torch = needed("torch", "torch==2.13.0")
    folder = clone(*OPENSPLAT, cache)
    module = _compiled(folder, cache / "opensplat")
    g, view = probe.gaussians, view_of(probe)
    rays = g.means + view[:3, :3].T @ view[:3, 3]
    arrays = (
        g.means,
        g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True),
        np.exp(g.log_scales),
        1 / (1 + np.exp(-g.opacity_logits[:, None])),
        coefficients(g),
        rays / np.linalg.norm(rays, axis=1, keepdims=True),
        view,
        projection() @ view,
        np.array(probe.background),
    )
    camera = [FOCAL, FOCAL, *probe.centre]
    return eight_bits(module.render(*(_float(torch, a) for a in arrays), camera, WIDTH, HEIGHT, 3).numpy())


def _compiled(folder: Path, built: Path) -> Any:
    extension = needed("torch.utils.cpp_extension", "torch==2.13.0")
    built.mkdir(parents=True, exist_ok=True)
    ours, theirs = Path(__file__).with_name("opensplat.cpp"), folder / "rasterizer" / "gsplat-cpu"
    try:
        return extension.load(
            "opensplat",
            [str(ours), str(theirs / "gsplat_cpu.cpp")],
            extra_cflags=["-O2"],
            extra_include_paths=[str(theirs)],
            build_directory=str(built),
        )
    except (RuntimeError, OSError) as error:
        raise InputError(f"OpenSplat's rasteriser does not compile: {str(error).splitlines()[0]}") from error


def litesplat(probe: Probe, cache: Path) -> Floats:
    """Render by LiteSplat, in Keras on torch: base colours, black behind; its image has y up."""
    os.environ.setdefault("KERAS_BACKEND", "torch")
    needed("torch", "torch==2.13.0")
    core = needed("litesplat.core", "litesplat==0.1.1")
    g, view = probe.gaussians, view_of(probe)
    scene = cache / "litesplat" / probe.name
    scene.mkdir(parents=True, exist_ok=True)
    camera = {
        "camera_id": 0,
        "model": "PINHOLE",
        "image_name": probe.name,
        "width": WIDTH,
        "height": HEIGHT,
        "fx": FOCAL,
        "fy": FOCAL,
        "cx": probe.centre[0],
        "cy": probe.centre[1],
        "rotation": view[:3, :3].tolist(),
        "translation": view[:3, 3].tolist(),
    }
    rows = zip(
        g.means.tolist(),
        g.quats.tolist(),
        np.exp(g.log_scales).tolist(),
        (1 / (1 + np.exp(-g.opacity_logits))).tolist(),
        np.clip(g.sh_dc * SH_C0 + 0.5, 0, None).tolist(),
        strict=True,
    )
    names = ("position", "rotation", "scale", "opacity", "color")
    (scene / "camera.json").write_text(json.dumps([camera]))
    (scene / "gaussians.json").write_text(json.dumps([dict(zip(names, row, strict=True)) for row in rows]))
    with contextlib.redirect_stdout(io.StringIO()):
        gaussians = core.GaussianParameterLayer(str(scene), trainable=False)
        shown = core.CameraLayer(str(scene), gaussians)(inputs=(HEIGHT, WIDTH), render=False)
    image = shown.detach().numpy()[::-1]
    return eight_bits(image)


def _float(torch: Any, array: Floats) -> Any:
    return torch.tensor(np.asarray(array), dtype=torch.float32)
