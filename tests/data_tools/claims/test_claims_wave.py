"""Waves: closed forms, screens and focus, and small runs of both claims."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.wave import measures as claims
from measured_claims import measured
from minisplat_ref.io import viewpoints
from minisplat_ref.io.images import read_image
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import save_ply
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.types import Camera
from scenes import as_dtype, make_gaussians
from tolerances import WAVE_BRUTE_FORCE, WAVE_SCREEN

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


@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_brute_force_finds_the_same_field(degrees):
    errors = claims.closed_form_errors(degrees)
    assert errors["closed form"] < WAVE_BRUTE_FORCE
    assert degrees == 0 or errors["sampled image"] > 100 * WAVE_BRUTE_FORCE  # the tilt matters


@pytest.mark.parametrize("alpha", [0.25, 0.9])
def test_a_screen_leaves_the_square_of_what_passes(alpha):
    found = claims.behind_a_screen(alpha)
    assert found.pop("predicted") == (1 - alpha) ** 2 and len(found) == 3
    assert_allclose(list(found.values()), (1 - alpha) ** 2, atol=WAVE_SCREEN)


def test_each_gaussian_is_sharpest_in_its_own_plane():
    stack = claims.focal_stack()
    assert_allclose(stack["sharpest"], stack["at"], atol=1e-12)


def test_the_claim_measures_its_claims(tmp_path, capsys):
    result = measured(["wave/claims", "--gaussians", "4", "--out", str(tmp_path / "measured")])
    cost, edge = result["cost"], result["edge"]
    assert (
        cost["point cloud"]["waves"] > 10 * cost["exact, whole grid"]["waves"] > 100 * cost["exact, windows"]["waves"]
    )
    assert all(found["shadow"] < 0.35 * found["light"] for found in edge.values())
    assert read_image(tmp_path / "measured" / "figure.png").std() > 1
    assert "brightest planes of Gaussians at: +4.0 mm in +4.0" in capsys.readouterr().out


def test_a_trained_scene_is_best_where_it_is_in_focus(run, tmp_path, capsys):
    ply, out = run / "point_cloud.ply", tmp_path / "measured"
    result = measured(["wave/scene", str(ply), "--out", str(out)])
    thirds = result["thirds"]
    assert thirds["near"]["depth"] < thirds["middle"]["depth"] < thirds["far"]["depth"]
    assert thirds["near"]["best focus"] < thirds["far"]["best focus"]
    assert thirds["near"]["focused nearest"] > thirds["near"]["focused farthest"] + 1  # dB
    assert result["psnr"]["in one plane"] > 20  # surfels have another low-pass
    assert read_image(out / "figure.png").std() > 1
