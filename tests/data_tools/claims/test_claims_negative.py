"""Negative Gaussians: fits by hand and their derivatives, and small runs of both claims."""

import argparse
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.negative import CLAIMS, backdrop, rings
from gradcheck import check_jacobian
from minisplat_ref.metrics import psnr
from tolerances import CLOSED_FORM


def run_claim(name, folder, *arguments):
    (claim,) = (claim for claim in CLAIMS if claim.name == name)
    parser = argparse.ArgumentParser()
    claim.add_arguments(parser)
    assert not claim.run(parser.parse_args(["--out", str(folder), *arguments]))
    assert (folder / "figure.png").stat().st_size > 10_000
    return json.loads((folder / "result.json").read_text())


def test_jacobian_of_the_hills(rng):
    parameters = np.column_stack([rng.uniform(0.5, 1.5, 3), rng.uniform(-0.5, 0.5, (3, 5))])
    model, points = rings.Sum((1, -1, 1), 2.0, "red"), rng.uniform(-1, 1, (20, 2))
    values, jacobian = rings.hills(parameters, model, points)
    assert values.shape == (3, 20)

    def vjp(v):
        return (np.einsum("kpn,kn->kp", jacobian, v),)

    check_jacobian(lambda p: (rings.hills(p, model, points)[0],), vjp, (parameters,), names=["parameters"])


def test_the_best_fit_of_a_ring_counts():
    """The PSNR is that of its image, and none of the others is better."""
    model, target = rings.MODELS["2 positive"], rings.ring(0.6)
    ones = np.random.default_rng(3)
    alone = [rings.fit_ring(target, model, 1, ones) for _ in range(3)]
    best = rings.fit_ring(target, model, 3, np.random.default_rng(3))
    assert best.psnr == max(fit.psnr for fit in alone) > alone[0].psnr
    assert_allclose(best.psnr, psnr(best.image, target.reshape(best.image.shape)), rtol=CLOSED_FORM)


def test_the_best_fit_before_a_wall_counts(monkeypatch):
    monkeypatch.setattr(backdrop, "EVALUATIONS", 25)
    behind, case = backdrop.wall("black"), backdrop.CASES["2, either sign"]
    ones = np.random.default_rng(0)
    target = backdrop.truth(behind)
    alone = [backdrop.fit_behind(behind, target, case, 1, ones).psnr for _ in range(3)]
    best = backdrop.fit_behind(behind, target, case, 3, np.random.default_rng(0)).psnr
    assert best == max(alone) > min(alone)


def test_a_fit_before_a_wall_moves_parallel_to_the_image(monkeypatch):
    """So that the order stays: a dark Gaussian at 2.9 before a bright one at 3."""
    monkeypatch.setattr(backdrop, "EVALUATIONS", 5)
    rendered, depths = backdrop._render, []

    def spy(renderer, ring, behind):
        depths.append(ring.means[:, 2].tolist())
        return rendered(renderer, ring, behind)

    monkeypatch.setattr(backdrop, "_render", spy)
    behind = backdrop.wall("black")
    backdrop.fit_behind(behind, backdrop.truth(behind), backdrop.CASES["2, clamped"], 1, np.random.default_rng(0))
    assert len(depths) >= 5 and all(of_ring == [3.0, 2.9] for of_ring in depths)


def test_rings_a_pair_beats_two_hills_on_a_thick_ring_and_loses_to_four_on_a_thin_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(rings, "THICKNESSES", (0.75, 0.2))
    monkeypatch.setattr(rings, "SIZE", 20)
    means = run_claim("rings", tmp_path / "out", "--seeds", "1", "--starts", "16")["mean_psnr"]
    pair, two, three, four = (
        means[name] for name in ("pair, heights to 100", "2 positive", "3 positive", "4 positive")
    )
    assert pair[0] > two[0] + 3 and pair[0] > three[0]
    assert pair[1] < three[1] < four[1]
    assert "| 0.75 " in capsys.readouterr().out


def test_crossings_are_interpolated(monkeypatch):
    monkeypatch.setattr(rings, "THICKNESSES", (0.8, 0.6, 0.4))
    assert_allclose(rings.crossings([10, 10, 10], [9, 7, 12]), [0.6 - 0.2 * 3 / 5], rtol=CLOSED_FORM)
    assert rings.crossings([1, 1, 1], [2, 2, 2]) == []


def test_backdrop_a_negative_color_blackens_a_hole_and_does_not_open_it(tmp_path, capsys):
    walls = run_claim("backdrop", tmp_path / "out", "--starts", "1")["walls"]
    black, dots = walls["black"], walls["dots"]
    assert black["2, either sign"]["psnr"] > black["2, clamped"]["psnr"] + 2
    assert dots["2, either sign"]["see_through"] < 0.1 < 0.8 < dots["4, clamped"]["see_through"]
    assert dots["2, either sign"]["hole_psnr"] < dots["4, clamped"]["hole_psnr"] - 5
    assert "| dots  | 4, clamped " in capsys.readouterr().out


@pytest.mark.parametrize("claim", CLAIMS)
def test_claims_refuse_to_fit_nothing(claim, tmp_path, capsys):
    parser = argparse.ArgumentParser()
    claim.add_arguments(parser)
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args(["--out", str(tmp_path / "out"), "--starts", "0"])
    assert "--starts: '0' is not a whole number of at least 1" in capsys.readouterr().err
