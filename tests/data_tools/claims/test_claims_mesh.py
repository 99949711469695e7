"""Distances between surfaces: a plane beside a plane, parts that are missing, and draws that are uniform."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.mesh_distances import OrientedPoints, compare_surfaces, sample_surface
from measured_claims import measured
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError


def grid(x_max, z, normal=(0.0, 0, 1)):
    """Points a hundredth apart in ``[0, x_max] x [0, 1]`` at a height."""
    x, y = np.meshgrid(np.arange(0.005, x_max, 0.01), np.arange(0.005, 1, 0.01))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return OrientedPoints(points, np.tile(normal, (len(points), 1)))


def test_a_plane_beside_a_plane():
    """A tenth apart, with normals tilted by 30 degrees and turned around."""
    tilted = grid(1, 0.1, (0.5, 0, -(0.75**0.5)))
    for tau, f_score in ((0.11, 1.0), (0.09, 0.0)):
        found = compare_surfaces(tilted, grid(1, 0.0), tau)
        assert_allclose((found.accuracy, found.completeness, found.chamfer), 0.1, rtol=1e-9)
        assert (found.f_score, found.normal_error) == (f_score, pytest.approx(30.0))


def test_what_is_missing_is_incomplete_and_not_inaccurate():
    """Half of a square: points of the other half are a quarter away on average; P = 1, R = 0.5 + 0.1, F = 3 / 4."""
    found = compare_surfaces(grid(0.5, 0.0), grid(1, 0.0), tau=0.1 + 1e-9)
    assert found.accuracy == 0.0
    assert found.completeness == pytest.approx(0.5 * 0.255, rel=1e-9)  # 0.01, 0.02 ... 0.5 over half of the points
    assert found.f_score == pytest.approx(2 * 0.6 / 1.6)
    turned = compare_surfaces(grid(1, 0.0), grid(0.5, 0.0), tau=0.1 + 1e-9)
    assert (turned.accuracy, turned.completeness) == (found.completeness, 0.0)
    assert turned.f_score == found.f_score


def test_points_are_drawn_uniformly_by_area(rng):
    """Two triangles, one of three times the area of the other, in different planes."""
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1]])
    drawn = sample_surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), 40_000, rng)
    is_flat = drawn.points[:, 2] == 0
    assert np.mean(is_flat) == pytest.approx(0.75, abs=0.02)  # nine standard deviations
    assert_allclose(drawn.normals[is_flat], np.tile([0.0, 0, 1], (is_flat.sum(), 1)))
    assert_allclose(drawn.points[is_flat].mean(axis=0), [1, 1 / 3, 0], atol=0.03)  # its centroid
    assert (drawn.points[is_flat] @ [1 / 3, 1, 0] <= 1 + 1e-12).all()


def test_the_claim_measures_meshes(tmp_path, capsys, monkeypatch):
    pytest.importorskip("skimage")
    tiny = {"n_views": 8, "width": 48, "height": 36, "n_points": 200, "supersampling": 1, "test_every": 4}
    monkeypatch.setattr("data_tools.claims.mesh.make_scene", lambda name: make_scene(name, **tiny))
    monkeypatch.setattr("data_tools.claims.mesh.VOXELS", (0.1, 0.2))
    monkeypatch.setattr("data_tools.claims.mesh.DEPTH_VOXEL", 0.2)
    monkeypatch.setattr("data_tools.claims.mesh.N_POINTS", 2000)
    out = tmp_path / "claim"
    options = ["--recipes", "3dgs-accel", "--iterations", "150", "--seeds", "0", "--out", str(out)]
    records = measured(["mesh", "room", *options])["records"]
    assert [(r["depth"], r["voxel"]) for r in records] == [
        ("median", 0.1),
        ("median", 0.2),
        ("expected", 0.2),
        ("midpoint", 0.2),
    ]
    assert all(0 < r["chamfer"] < 1 and 0 < r["f_score"] < 1 for r in records)
    assert (out / "figure.png").stat().st_size > 10_000 and "| 3dgs-accel | midpoint |" in capsys.readouterr().out


def test_the_claim_trains_recipes_with_settings_and_refuses_unknown_ones(tmp_path, capsys, monkeypatch):
    pytest.importorskip("skimage")
    trained = []

    def record(made, recipe, seed):
        trained.append(recipe)
        raise InputError("enough")

    monkeypatch.setattr("data_tools.claims.mesh.train_run", record)
    options = ["--iterations", "150", "--seeds", "0"]
    command = ["mesh", "room", "--recipes", "3dgs-accel+dssim_weight=0.5", *options]
    assert measure_claim([*command, "--out", str(tmp_path / "one")]) == 2 and "enough" in capsys.readouterr().err
    assert trained[0].losses[0].function.keywords["dssim_weight"] == 0.5 and trained[0].iterations == 150
    command = ["mesh", "room", "--recipes", "3dgs-accel,surfels+distort=1", *options]
    assert measure_claim([*command, "--out", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err.strip()
    assert "surfels has no distort to set" in error and "\n" not in error and len(trained) == 1
    assert not (tmp_path / "none" / "result.json").exists()
