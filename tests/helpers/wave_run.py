"""The folder of a run with flat Gaussians, for tests of holograms."""

import json

import numpy as np
import pytest

from minisplat_ref.io import viewpoints
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import save_ply
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.types import Camera
from scenes import as_dtype, make_gaussians

CAMERA = Camera(np.eye(3), np.zeros(3), 48.0, 48.0, 24.0, 16.0, 48, 32)
SURFELS = Label("surfels")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run's folder with a few flat Gaussians, two cameras that see them and one that does not."""
    folder = tmp_path_factory.mktemp("wave")
    g = make_gaussians(np.random.default_rng(3), 40, size=0.1, opacity_logit=2.0)
    g.log_scales[:, 2] = -12
    save_ply(folder / "point_cloud.ply", as_dtype(g, np.float32), SURFELS)
    away = CAMERA._replace(cam_from_world_R=np.diag([-1.0, 1.0, -1.0]))
    beside = CAMERA._replace(cam_from_world_t=np.array([0.2, 0.0, 0.0]))
    named = [("beside", beside, "train"), ("test", CAMERA, "test"), ("away", away, "train")]
    views = [Viewpoint(name, camera, split) for name, camera, split in named]
    (folder / "cameras.json").write_text(json.dumps(viewpoints.to_json(views)))
    return folder
