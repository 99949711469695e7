"""Curves of quality over the number of Gaussians, and quality where there is detail: by hand, and through a claim."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.gdgs import counts as gdgs_counts
from data_tools.claims.kit import counts, detail
from data_tools.claims.kit.counts import Curve
from data_tools.claims.kit.detail import halves_of, quality
from measured_claims import measured
from minisplat_ref.app.cli import main
from minisplat_ref.interface.palette import RED
from minisplat_ref.metrics import ViewMetrics
from minisplat_ref.training.recipe_settings import settings_of
from minisplat_ref.types import Model, Scene, view_from
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM

TINY = ("--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")


# Flat and textured


def test_halves_are_halves():
    """This holds for an image whose right half is a ramp, and for one that is flat everywhere."""
    pixels = np.zeros((4, 8, 3), np.uint8)
    pixels[:, 4:] = 20 * np.arange(1, 5)[None, :, None]
    flat, textured = halves_of(pixels)
    assert flat[:, :3].all() and textured[:, 5:].all()
    assert_array_equal(flat, ~textured)
    assert [np.count_nonzero(half) for half in halves_of(np.zeros((4, 8, 3)))] == [16, 16]


def test_halves_are_those_of_the_mask():
    """Of a ramp that becomes steeper to the right, the mask has the three leftmost columns, and one pixel more."""
    pixels = np.zeros((2, 8, 3)) + (np.arange(8) ** 2)[:, None]
    mask = np.zeros((2, 8), bool)
    mask[:, :3] = mask[0, 7] = True
    flat, textured = halves_of(pixels, mask)
    assert_array_equal(flat | textured, mask)
    assert flat.sum() == 3 and textured.sum() == 4 and flat[:, 0].all() and textured[:, 2].all() and textured[0, 7]


def test_quality_by_hand(rng, monkeypatch):
    """The flatter half is off by 0.1 everywhere, the rest by 0.01: 20 and 40 dB; a masked column does not count."""
    pixels = np.zeros((8, 16, 3), np.uint8)
    pixels[:, 8:] = 20 * np.arange(1, 9)[None, :, None]
    mask = np.ones((8, 16), bool)
    mask[:, 3] = False
    flat, textured = halves_of(pixels, mask)
    image = pixels / 255 + np.where(flat, 0.1, np.where(textured, 0.01, 0.5))[:, :, None]
    view = view_from(make_camera())._replace(image=pixels, mask=mask)
    scene = Scene("s", (), (view,), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)

    def evaluate(model, views, settings, on_view):
        for view in views:
            on_view(view, image, ViewMetrics(view.name, 1.25, 0.0))

    monkeypatch.setattr(detail, "evaluate", evaluate)
    assert_allclose(quality(Model(make_gaussians(rng, 3)), scene), (1.25, 20, 40), rtol=CLOSED_FORM)


# Curves


def test_a_line_and_its_points_by_hand():
    def record(curve, threshold, seed, n, psnr):
        settings = {"threshold": threshold, "trace": 2.0}
        found = {"n_gaussians": n, "psnr": psnr, "flat": psnr + 1, "textured": psnr - 1}
        return {"curve": curve, "settings": settings, "seed": seed, **found}

    records = [record("a", 2e-4, 0, 1_000, 20.0), record("a", 4e-4, 0, 500, 18.0), record("a", 2e-4, 1, 1_200, 22.0)]
    records.append(record("b", 2e-4, 0, 900, 19.0))
    points = counts.points_of(records)
    assert [[r["n_gaussians"] for r in point] for point in points] == [[1_000, 1_200], [500], [900]]
    deviations = ["1,100 ± 141", "21.00 ± 1.41", "22.00 ± 1.41", "20.00 ± 1.41"]
    assert counts.to_line(points[0]) == ["a", "threshold 0.0002, trace 2", *deviations]
    assert counts.to_line(points[2])[2:] == ["900", "19.00", "20.00", "18.00"]
    curves = {name: Curve("3dgs-accel", ({"threshold": 2e-4},), RED) for name in "ab"}
    left, right = counts.draw(records, curves).axes
    assert_allclose(left.lines[0].get_xydata(), [[500, 18], [1_100, 21]])  # from few Gaussians to many
    assert_allclose(right.lines[0].get_xydata(), [[500, 17], [1_100, 20]])
    assert_allclose(left.lines[1].get_xydata(), [[1_000, 20], [500, 18], [1_200, 22]])


@pytest.fixture
def few(monkeypatch):
    curves = {name: curve._replace(points=curve.points[:1]) for name, curve in gdgs_counts.CURVES.items()}
    monkeypatch.setattr(gdgs_counts, "CURVES", curves)


def test_curves_of_counts_run_and_continue(few, tmp_path, capsys, monkeypatch):
    assert main(["synthetic", "room", "--out", str(tmp_path / "room"), *TINY]) == 0
    command = ["gdgs/counts", str(tmp_path / "room"), "--iterations", "30", "--out", str(tmp_path / "s")]
    first = measured([*command, "--seeds", "1"])
    assert [r["curve"] for r in first["records"]] == ["3dgs-accel", "gdgs"]
    trained = []
    measure = counts.measure
    monkeypatch.setattr(counts, "measure", lambda *args: trained.append(args[-1]) or measure(*args))
    assert measure_claim([*command, "--seeds", "2"]) == 0
    assert trained == [1, 1]  # seed 0 is kept
    both = json.loads((tmp_path / "s" / "result.json").read_text())["records"]
    assert [(r["curve"], r["seed"]) for r in both] == [(n, s) for n in ("3dgs-accel", "gdgs") for s in (0, 1)]
    assert both[0] == first["records"][0] and both[0]["psnr"] != both[2]["psnr"]
    assert min(r["textured"] for r in both) < min(r["flat"] for r in both)
    assert "| gdgs " in capsys.readouterr().out and (tmp_path / "s" / "figure.png").stat().st_size > 10_000


def test_what_a_curve_sets_is_set(few, tmp_path, monkeypatch):
    """What all points have in common, and what each of them has: the recipe that is trained has both."""
    seen = []

    def measure(scene, recipe, seed):
        seen.append((recipe.name, recipe.iterations, seed, settings_of(recipe)))
        return {"n_gaussians": 1, "psnr": 1.0 + len(seen), "flat": 1.0, "textured": 1.0}

    monkeypatch.setattr(counts, "measure", measure)
    curve = Curve("3dgs-accel", ({"threshold": 3e-4}, {"threshold": 5e-4}), RED, {"min_opacity": 0.25})
    monkeypatch.setattr(gdgs_counts, "CURVES", {"a curve": curve})
    command = ["gdgs/counts", "room", "--iterations", "30", "--seeds", "1", "--out", str(tmp_path / "s")]
    assert measure_claim(command) == 0
    assert [entry[:3] for entry in seen] == [("3dgs-accel", 30, 0)] * 2
    assert [entry[3]["threshold"] for entry in seen] == [3e-4, 5e-4]
    assert [entry[3]["min_opacity"] for entry in seen] == [0.25] * 2
