"""The fixed workloads: the same Gaussians, camera and cotangent for every contender, in every run.

``synth`` is random but sized like a trained scene; ``garden`` has the points of a real one (``test_garden.npz`` of
gsplat's tests) with random shapes, and many more hits per pixel. ``synth5k`` and ``garden20k`` are for slow renderers.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.types import Camera, Floats, Gaussians

SYNTH_SIZE = 50_000
GARDEN_BOX = 2.0  # world units: points within +-2 of the table
GARDEN_NEAR = 0.2  # points nearer to the camera are left out, because renderers treat them differently
GARDEN_FOCAL = 481.0  # px for both axes, and a centred principal point: some renderers support no other
GARDEN_SUBSET = 20_000


class Workload(NamedTuple):
    """One view to render, and the cotangent for its gradient."""

    name: str
    """Key in reports."""
    gaussians: Gaussians
    """float64, but every number is exact in float32, so that all precisions get the same numbers."""
    camera: Camera
    """View."""
    v_image: Floats
    """[H, W, 3] derivative of a loss with respect to the image: standard normal noise, float32 numbers as float64."""


def synth(n: int = SYNTH_SIZE, width: int = 480, height: int = 270, focal: float = 400.0) -> Workload:
    """Return random Gaussians with the sizes and opacities of trained ones, and a camera that sees most of them.

    Centres are uniform in [-1, 1]^2 x [2, 6], scales log-normal with median 0.01, opacities sigmoid(N(0, 2)), colours
    uniform and without view dependence; world and camera frame are the same.
    """
    return _workload("synth", _imitate_training(n), _centre_camera(width, height, focal))


def synth5k(n: int = 5_000) -> Workload:
    """Return the first 5,000 Gaussians of ``synth``, twice as large, on a quarter of the pixels."""
    first = Gaussians._make(field[:n] for field in _imitate_training(SYNTH_SIZE))
    doubled = first._replace(log_scales=first.log_scales + np.log(2))
    return _workload("synth5k", doubled, _centre_camera(240, 135, 200.0))


def garden(data: Path, subset: int | None = None) -> Workload:
    """Return gsplat's garden points inside [-2, 2]^3 with random shapes and opacities.

    Parameters
    ----------
    data : Path
        ``test_garden.npz`` of gsplat's repository, or its folder.
    subset : int, optional
        Number of Gaussians to draw from them; all by default.

    Raises
    ------
    InputError
        The file is not there or is another one.
    """
    points, colors, camera_from_world = _garden_file(data)
    is_inside = (np.abs(points) <= GARDEN_BOX).all(axis=1)
    points, colors, rng = points[is_inside], colors[is_inside], np.random.default_rng(0)
    scales = rng.uniform(1e-4, 0.02, points.shape)
    quats = rng.normal(size=(len(points), 4))
    opacities = np.clip(rng.uniform(size=len(points)), 1e-4, 1 - 1e-4)
    gaussians = Gaussians(
        means=points,
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        log_scales=np.log(scales),
        opacity_logits=np.log(opacities / (1 - opacities)),
        sh_dc=(colors - 0.5) / SH_C0,
        sh_rest=np.zeros((len(points), 0, 3)),
    )
    R, t = camera_from_world[:3, :3], camera_from_world[:3, 3]
    rows = np.flatnonzero(points @ R[2] + t[2] > GARDEN_NEAR)
    if subset is not None:
        rows = np.random.default_rng(1).choice(rows, subset, replace=False)
    camera = _centre_camera(648, 420, GARDEN_FOCAL)._replace(cam_from_world_R=R, cam_from_world_t=t)
    name = "garden" if subset is None else "garden20k"
    return _workload(name, Gaussians._make(field[rows] for field in gaussians), camera)


FREE: dict[str, Callable[[], Workload]] = {"synth": synth, "synth5k": synth5k}
WITH_DATA: dict[str, Callable[[Path], Workload]] = {
    "garden": garden,
    "garden20k": partial(garden, subset=GARDEN_SUBSET),
}


def get_workload(name: str, data: Path | None) -> Workload:
    """Make a workload by its name.

    Raises
    ------
    InputError
        There is none of that name, or the data that it needs are not given.
    """
    if name in FREE:
        return FREE[name]()
    if name not in WITH_DATA:
        raise InputError(f"workload {name!r} is unknown; choose from {', '.join((*FREE, *WITH_DATA))}")
    if data is None:
        raise InputError(
            f"workload {name} needs --data with gsplat's test_garden.npz, which minisplat-ref data garden fetches"
        )
    return WITH_DATA[name](data)


def _imitate_training(n: int) -> Gaussians:
    rng = np.random.default_rng(0)
    return Gaussians(
        means=np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(2, 6, n)]),
        quats=rng.normal(size=(n, 4)),
        log_scales=np.log(0.01) + 0.7 * rng.normal(size=(n, 3)),
        opacity_logits=2 * rng.normal(size=n),
        sh_dc=(rng.uniform(size=(n, 3)) - 0.5) / SH_C0,
        sh_rest=np.zeros((n, 0, 3)),
    )


def _centre_camera(width: int, height: int, focal: float) -> Camera:
    return Camera(np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height)


def _workload(name: str, gaussians: Gaussians, camera: Camera) -> Workload:
    """Round everything to float32 numbers, including the camera."""
    v_image = np.random.default_rng(1).normal(size=(camera.height, camera.width, 3))
    camera = camera._replace(
        cam_from_world_R=_round_to_float32(camera.cam_from_world_R),
        cam_from_world_t=_round_to_float32(camera.cam_from_world_t),
    )
    return Workload(name, Gaussians._make(map(_round_to_float32, gaussians)), camera, _round_to_float32(v_image))


def _round_to_float32(values: Floats) -> Floats:
    return values.astype(np.float32).astype(np.float64)


def _garden_file(data: Path) -> tuple[Floats, Floats, Floats]:
    file = data / "test_garden.npz" if data.is_dir() else data
    try:
        with np.load(file) as arrays:
            points = arrays["means3d"].astype(np.float64)
            colors = arrays["colors"].astype(np.float64) / 255
            poses = arrays["viewmats"].astype(np.float64)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{file} is not gsplat's test_garden.npz: {error}") from error
    return points, colors, poses[0]
