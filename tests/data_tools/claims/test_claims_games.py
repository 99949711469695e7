"""GaMeS: equal counts on and off the faces, and the median distance by hand."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from data_tools.claims import games as claim
from data_tools.claims.__main__ import main as measure_claim
from minisplat_ref.datasets.synthetic import make_scene
from scenes import as_dtype, make_gaussians


@pytest.fixture(scope="module")
def wall():
    return make_scene("plain-wall", n_views=6, width=32, height=24, supersampling=1, n_points=200, test_every=3)


def test_the_claim_compares_on_and_off_the_faces(tmp_path, monkeypatch, wall, capsys):
    monkeypatch.setattr(claim, "make_scene", lambda name: wall)
    monkeypatch.setattr(claim, "ARMS", (("exact mesh", 1),))
    monkeypatch.setattr(claim, "VOXEL", 0.5)
    assert measure_claim(["games/counts", "x", "--iterations", "3", "--seeds", "1", "--out", str(tmp_path / "s")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| exact")]
    assert len(lines) == 2
    counts = [line.split("|")[2].strip() for line in lines]
    assert counts[0] == counts[1] and "on it" in lines[0] and "free" in lines[1]


def test_the_free_arm_has_no_density_control():
    recipe = claim.unbound(100)
    assert recipe.events == () and recipe.name == "3dgs-accel" and recipe.iterations == 100


def test_the_median_of_what_is_opaque_is_measured(wall, rng):
    """Of distances 0, 0.01, 0.5 and 9, whose last is of a Gaussian of opacity 0.09: the median is 0.01."""
    points = claim.true_points(wall)
    g = as_dtype(make_gaussians(rng, 4), np.float32)
    normal = np.eye(3)[np.argmin(np.ptp(points, axis=0))]
    means = points[100] + np.array([0.0, 0.01, 0.5, 9.0])[:, None] * normal
    logits = np.array([2.0, 2.0, 2.0, np.log(0.09 / 0.91)])
    g = g._replace(means=means.astype(np.float32), opacity_logits=logits.astype(np.float32))
    found = claim.outcome(wall, cKDTree(points), g, claim.unbound(1))
    assert found["n_gaussians"] == 4 and found["distance"] == pytest.approx(0.01, rel=0.05)
