"""DisC-GS: the edge that is found, the card by hand, and small runs."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.cuts import card, edge
from measured_claims import measured
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


def test_the_window_with_the_strongest_edge_is_found():
    """A slanted edge in a corner, and beside it a finer pattern of more contrast but without a direction."""
    photograph = np.full((110, 150, 3), 0.5)
    ys, xs = np.mgrid[:110, :150]
    photograph[50:110, 90:150] = np.where(xs + 0.5 * ys > 160, 0.9, 0.2)[50:110, 90:150, None]
    photograph[:48, :48] = 0.45 + 0.1 * ((xs // 4 + ys // 4) % 2)[:48, :48, None]
    target, (x, y) = edge.find_edge(photograph)
    assert 80 <= x <= 102 and 44 <= y <= 62
    assert_array_equal(target.image, photograph[y : y + card.SIZE, x : x + card.SIZE])
    assert 0.03 < target.band.mean() < 0.3
    with pytest.raises(InputError, match="30 x 110 pixels, and an edge takes a window of 48 x 48"):
        edge.find_edge(photograph[:, :30])


def test_the_band_is_a_pixel_and_a_half_wide():
    gradients = np.zeros((9, 9))
    gradients[:, 4], gradients[:, 8] = 1.0, 0.49  # the second is too weak
    assert_array_equal(edge.near_strong(gradients)[3], np.isin(np.arange(9), [3, 4, 5]))


def test_one_gaussian_with_a_cut_is_a_cut_gaussian():
    """Starting with a curve on the right side it is reproduced; 3DGS spills over the edge."""
    target = card.cut_gaussian()
    plain, found = (card.measure_card(target, card.fit_card(target, 1, n, 300, 3)) for n in (0, 1))
    assert found["psnr"] > plain["psnr"] + 20 and found["edge_width"] < 2 < plain["edge_width"]


def test_the_width_of_an_edge():
    image = np.zeros((card.SIZE, card.SIZE, 3))
    image[:, :20] = 1.0
    assert card.edge_width(image) == pytest.approx(0.8)  # of a step from one pixel to the next
    image = np.clip((30.5 - np.arange(card.SIZE)) / 10, 0, 1)[None, :, None] * np.ones((card.SIZE, 1, 3))
    assert card.edge_width(image) == pytest.approx(8.0)


def test_the_claim(tmp_path, monkeypatch, capsys):
    from data_tools.claims.cuts import training as claim

    monkeypatch.setattr(claim, "NUMBERS", {"plain": (1,), "cut": (1,)})
    out = tmp_path / "measured"
    assert len(measured(["cuts/card", "--iterations", "5", "--seeds", "2", "--out", str(out)])["rows"]) == 4
    assert (out / "figure.png").stat().st_size > 10_000 and "| cut Gaussian" in capsys.readouterr().out
    monkeypatch.setattr(edge, "NUMBERS", ((2,), (2,), (2,)))
    photographs = tmp_path / "photographs"
    write_scene(make_scene("room", supersampling=1, **SCENE | {"width": 56, "height": 50}), photographs, SCENE)
    options = ["--iterations", "4", "--seeds", "2", "--out", str(tmp_path / "edge")]
    rows = measured(["cuts/edge", str(photographs), *options])["rows"]
    assert [row["n_floats"] for row in rows] == [28, 44, 60] and "| 2 curves" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["cuts/card", "--seeds", "0", "--out", str(tmp_path / "none")])
    assert not (tmp_path / "none").exists()
