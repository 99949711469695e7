"""Polygon soups: affine and bent edits by hand, and small runs of both claims."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.polygons import edits as claims
from measured_claims import measured
from minisplat_ref.extensions.polygons.soup import carry_gaussians, make_soup
from minisplat_ref.mechanisms.meshes.fans import flatten
from scenes import make_gaussians
from tolerances import AFFINE_EDIT, EDITED_IMAGE, PARITY_FLOAT64

SHIFT = np.array([0.3, -0.2, 0.1])


def model(rng, n=30):
    """Flat Gaussians, two of them too faint to have a polygon."""
    g = make_gaussians(rng, n)
    g.log_scales[np.arange(n), np.argmin(g.log_scales, axis=1)] -= 8
    g.opacity_logits[[3, 7]] = -9
    return g


def planar(gaussians):
    spans = flatten(gaussians.means, gaussians.quats, gaussians.log_scales).spans
    return spans @ np.swapaxes(spans, 1, 2)


def is_same(a, b):
    return all(x.tobytes() == y.tobytes() and x.dtype == y.dtype for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("name", claims.MAPS)
@pytest.mark.parametrize("n_sides", [3, 8])
def test_an_affine_edit_is_the_gaussians_transformed(name, n_sides, rng):
    before, A = model(rng), claims.MAPS[name]
    soup = make_soup(before, n_sides)
    after, n = carry_gaussians(before, soup, soup.corners @ A.T + SHIFT, "it")
    assert n == 28
    direct = planar(before)[soup.rows]
    expected = A @ direct @ A.T
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert_allclose(after.means[soup.rows], before.means[soup.rows] @ A.T + SHIFT, atol=AFFINE_EDIT)
    assert_allclose(planar(after)[soup.rows] / scale, expected / scale, atol=AFFINE_EDIT)
    assert is_same([f[[3, 7]] for f in after], [f[[3, 7]] for f in before])
    again = make_soup(after, n_sides)
    if name in ("turn", "turn and scale"):  # elsewhere the axes of the ellipse lie at other corners
        assert_allclose(again.corners, soup.corners @ A.T + SHIFT, atol=AFFINE_EDIT)


def test_what_bending_costs_grows_with_the_angle_and_falls_with_the_number():
    """As the size of a splat over the radius of the bend: twice for twice the angle, half for four times as many."""
    by_angle = [claims.bend_errors(10, angle) for angle in (10, 20, 40)]
    fit = [row["corners, fit"] for row in by_angle]
    assert 1.9 < fit[1] / fit[0] < 2.1 and 1.9 < fit[2] / fit[1] < 2.1
    assert all(row["corners, fit"] < row["corners, Gram-Schmidt"] for row in by_angle)
    finer = claims.bend_errors(20, 20)
    assert 1.8 < fit[1] / finer["corners, fit"] < 2.2
    assert finer["light that passes, RMS"] < by_angle[1]["light that passes, RMS"]


def test_the_claims_draw_and_print(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(claims, "ANGLES", (10, 20))
    monkeypatch.setattr(claims, "PER_SIDE", (4, 8))
    out = tmp_path / "measured"
    result = measured(["polygons/edits", "--seeds", "1", "--out", str(out)])
    assert max(result["round trip"].values()) < PARITY_FLOAT64
    for name, errors in result["affine"].items():
        assert errors["covariance, fit"] < AFFINE_EDIT and errors["image"] < EDITED_IMAGE, name
    assert result["affine"]["shear"]["covariance, Gram-Schmidt"] > 0.1
    assert (out / "figure.png").stat().st_size > 20_000 and "| shear" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["polygons/edits", "--seeds", "0", "--out", str(tmp_path / "none")])
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["polygons/cost", "--repeats", "0"])
