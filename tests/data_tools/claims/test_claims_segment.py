"""Masks that are shifted, lost and grown, intersection over union by hand, and a small run."""

from functools import partial

import numpy as np
import pytest

from data_tools.claims import segment as claim
from data_tools.claims.__main__ import main as measure_claim
from minisplat_ref.datasets.synthetic import make_scene


def test_masks_are_shifted_and_lost():
    mask = np.zeros((6, 8), int)
    mask[1, 2] = 4
    assert np.argwhere(claim.shift(mask, 3, -1)).tolist() == [[4, 1]]
    assert not claim.shift(mask, -2, 0).any()
    full = [np.full((20, 20), 1 + i) for i in range(10)]
    spoiled = claim.spoil(full, 0.3, 0.2, np.random.default_rng(1))
    zeros = [int((m == 0).sum()) for m in spoiled]
    assert sum(n == 400 for n in zeros) == 2  # lost
    moved = [n for n in zeros if 0 < n < 400]
    assert len(moved) == 3 and all(400 - 17 * 17 <= n <= 400 - 15 * 15 for n in moved)  # by 3 to 5 along both axes
    assert all((m == 1 + i).any() or n == 400 for i, (m, n) in enumerate(zip(spoiled, zeros, strict=True)))
    all_moved = claim.spoil([np.ones((20, 20), int)] * 60, 1.0, 0.0, np.random.default_rng(1))
    counts = np.array([[20 - m.any(axis=1).sum(), 20 - m.any(axis=0).sum()] for m in all_moved])
    assert all(set(along) == {3, 4, 5} for along in counts.T)
    starts = {tuple(np.argwhere(m)[0] > 0) for m in all_moved}
    assert len(starts) == 4  # to either side, along both axes


def test_objects_are_grown_over_the_background_alone():
    """A disc around one pixel by hand; between two objects each pixel is that of the nearer."""
    mask = np.zeros((7, 12), int)
    mask[3, 3], mask[3, 8] = 1, 2
    grown = claim.grow(mask, 2)
    assert (grown == 1).sum() == (grown == 2).sum() == 13  # lattice points of a disc of radius 2
    assert grown[1, 3] == grown[3, 5] == 1 and grown[3, 6] == 2 and grown[2, 5] == grown[1, 4] == 0
    assert claim.grow(mask, 3)[3, 3:9].tolist() == [1, 1, 1, 2, 2, 2]
    full = np.array([[1, 2]])
    assert np.array_equal(claim.grow(full, 4), full)


def test_a_share_of_masks_spills_over():
    mask = np.zeros((9, 9), int)
    mask[4, 4] = 3
    spilt = claim.spill([mask] * 10, 0.3, 1, np.random.default_rng(1))
    assert sorted(int((each == 3).sum()) for each in spilt) == [1] * 7 + [5] * 3
    others = [claim.spill([mask] * 10, 0.3, 1, np.random.default_rng(seed)) for seed in range(20)]
    assert len({tuple(int((each == 3).sum()) for each in spilt) for spilt in others}) > 10  # at random


def test_iou_by_hand(monkeypatch):
    monkeypatch.setattr("data_tools.claims.kit.objects.OBJECTS", ((1,), (2,)))
    truth, found = np.array([[1, 1, 2, 0]]), np.array([[1, 2, 2, 2]])
    assert claim.mean_iou([found], [truth]) == pytest.approx((1 / 2 + 1 / 3) / 2)


def test_the_claim_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(claim, "CONDITIONS", {"clean": (0.0, 0.0), "30 % lost": (0.0, 0.3)})
    monkeypatch.setattr(claim, "SPILLS", {"all grown by 2": (1.0, 2)})
    monkeypatch.setattr(claim, "BIASES", (0.0, 0.4))
    small = partial(make_scene, n_views=9, width=64, height=48, supersampling=1, n_points=2000)
    monkeypatch.setattr(claim, "make_scene", small)
    words = ["segment/masks", "--iterations", "40", "--seeds", "1", "--out", str(tmp_path / "s")]
    assert measure_claim(words) == 0
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    found = {row[1].strip(): row[2].split()[0] for row in rows}
    assert float(found["clean"]) > 0.2
    assert found["all grown by 2"] != found["clean"] != found["30 % lost"]
