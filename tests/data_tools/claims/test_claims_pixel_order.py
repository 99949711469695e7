"""Pixel order: orders and orbits by hand, and small runs of all claims."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims import pixel_order as clouds
from data_tools.claims.__main__ import main as measure_claim
from minisplat_ref.mechanisms.tangent.rays import orbit_camera


def test_footprints_err_the_same_at_any_angle():
    errors = clouds.projection_errors(6, 0)
    assert np.ptp(errors["tangent planes"]) < 1e-3 < 0.05 < errors["EWA"][-1] - errors["EWA"][0]
    assert errors["EWA"][0] == pytest.approx(errors["tangent planes"][0], rel=1e-6)


def test_orders_of_the_claim():
    primitives, colors = clouds.cloud(60, np.random.default_rng(1))
    rows = {
        row["order"]: row
        for row in clouds.orders(primitives, colors, clouds.wide_camera(70.0), np.array([[30.5, 33.5], [20.5, 25.5]]))
    }
    assert rows["exact"]["misordered"] == 0 == rows["exact"]["largest_error"]
    assert (
        rows["list by z"]["misordered"] > 0.02 and rows["buffer of 4"]["misordered"] < rows["list by z"]["misordered"]
    )


@pytest.mark.parametrize(
    ("claim", "options", "says"),
    [
        ("rotation", ["--gaussians", "6", "--steps", "2"], "tangent planes, exact order"),
        ("projection", ["--gaussians", "2"], "55 degrees"),
        ("order", ["--gaussians", "20", "--every", "32"], "buffer of 8"),
    ],
)
def test_the_claims(claim, options, says, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clouds, "ORBIT_STEPS", 2)
    out = tmp_path / "measured"
    assert measure_claim([f"pixel-order/{claim}", *options, "--out", str(out)]) == 0
    assert (out / "figure.png").stat().st_size > 10_000 and says in capsys.readouterr().out
    assert json.loads((out / "result.json").read_text())
    with pytest.raises(SystemExit, match="2"):
        measure_claim([f"pixel-order/{claim}", "--gaussians", "0", "--out", str(tmp_path / "none")])
    assert not (tmp_path / "none").exists()


def test_an_orbit_by_hand():
    """A quarter of a circle about (0, 0, 4) takes the camera from the origin to 4 beside the centre, which it faces."""
    for quarter, x in ((np.pi / 2, 4.0), (-np.pi / 2, -4.0)):
        seen_by = orbit_camera(clouds.wide_camera(), quarter, clouds.CENTER)
        assert_allclose(seen_by.center, [x, 0, 4], atol=1e-12)
        assert_allclose(seen_by.cam_from_world_R.T @ [0, 0, 1], [-x / 4, 0, 0], atol=1e-12)


def test_whole_gaussians_that_change_places_at_once_make_the_image_jump():
    """In an orbit in steps of a hundredth of a degree the mean of the rays jumps by camera z, and not by pixels."""
    found = clouds.rotation(60, 2, 0)
    by_z, by_pixel = found["3DGS: EWA, by z"], found["tangent planes, exact order"]
    assert by_z["orbit_in_tenths_mean"] > 2 * by_pixel["orbit_in_tenths_mean"]


def test_a_run_without_test_views_is_refused(tmp_path, capsys):
    assert measure_claim(["pixel-order/order", "--ply", str(tmp_path / "no.ply"), "--out", str(tmp_path / "o")]) == 2
    assert not (tmp_path / "o").exists() and "no.ply" in capsys.readouterr().err
