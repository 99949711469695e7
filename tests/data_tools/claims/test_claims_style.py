"""Swatches and distances by hand, and a small run."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from data_tools.claims import style as claim
from data_tools.claims.__main__ import main as measure_claim
from minisplat_ref.datasets.synthetic import make_scene


def test_swatches_are_stripes_and_checks():
    """Four dark pixels of nine, along either axis, the same along the other diagonal; checks of six pixels."""
    found = claim.swatches()
    y, x = np.mgrid[: claim.SIDE, : claim.SIDE]
    phase = (x + y) % 9
    is_dark = found["stripes"][..., 2] < 0.7
    assert_array_equal(is_dark[phase > 0], phase[phase > 0] < 5)  # at 0, between two stripes, rounding decides
    red = found["checks"][..., 1] < 0.5
    assert_array_equal(red[6:], ~red[:-6])
    assert_array_equal(red[:, 6:], ~red[:, :-6])
    assert red[:6, :6].all() and not red[:6, 6:12].any()


def test_sliced_distance_by_hand(rng):
    """A shift by t along one axis of one dimension moves every quantile by t; equal sets are 0 apart."""
    a = rng.normal(size=(400, 1))
    assert claim.sliced_distance(a, a + 0.3, rng) == pytest.approx(0.3)
    assert claim.sliced_distance(a, a[::-1], rng) == 0


def test_views_of_one_wall_agree_where_they_show_the_same():
    """The photographs of a ray-traced room differ by less than 6 levels at the same points, a negative by far more."""
    made = make_scene("room", n_views=6, width=64, height=48, supersampling=1, n_points=50, test_every=3)
    views, depths = made.scene.train_views[:2], made.train_depths[:2]
    images = [view.image / 255 for view in views]
    cameras = tuple(view.camera for view in views)
    same = claim.disagreement(tuple(images), tuple(depths), cameras)
    other = claim.disagreement((images[0], 1 - images[1]), tuple(depths), cameras)
    behind = claim.disagreement(tuple(images), (depths[0], 1.05 * depths[1]), cameras)
    assert len(behind) < 0.1 * len(same)  # another surface hides the point
    assert len(same) > 100 and np.median(same) < 6 / 255 < 0.2 * np.median(other)


def test_the_claim_runs(tmp_path, monkeypatch, capsys):
    room = make_scene("room", n_views=4, width=56, height=48, supersampling=1, n_points=150, test_every=4)
    monkeypatch.setattr(claim, "make_scene", lambda name: room)
    words = ["style/swatches", "--training", "2", "--iterations", "5", "--seeds", "1"]
    assert measure_claim([*words, "--out", str(tmp_path / "s")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(("| stripes", "| checks"))]
    counts = [int(line.split("|")[-2].strip().split()[0].replace(",", "")) for line in lines]
    assert len(lines) == 4 and counts[0] > counts[1] and counts[2] > counts[3]
    assert all(2 < float(line.split("|")[4].split()[0]) < 60 for line in lines)  # disagreement, levels of 255
