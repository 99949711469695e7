"""Waves: closed forms, screens and focus, and small runs of both claims."""

import pytest
from numpy.testing import assert_allclose

from data_tools.claims.wave import measures as claims
from measured_claims import measured
from minisplat_ref.io.images import read_image
from tolerances import WAVE_BRUTE_FORCE, WAVE_SCREEN
from wave_run import run  # noqa: F401  (a fixture)


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
