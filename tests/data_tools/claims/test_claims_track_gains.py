"""The claim ``track-gains``: each effect is found where it is planted, and the table counts what the records say."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims import track_gains
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.track_gains import EFFECTS, Tracks, collect_tracks, cross_validate, fit_effect, plant
from minisplat_ref.datasets.synthetic import make_scene

N_VIEWS, N_POINTS = 6, 400
FOUND = 2e-3  # of a log colour, from noise of 1e-3 in a few hundred observations
PLANTED = {
    "gains": lambda t, a: np.linspace(-0.1, 0.1, N_VIEWS)[t.view],
    "response": lambda t, a: np.linspace(-0.2, 0.2, N_VIEWS)[t.view] * (a + 1)[t.point],
    "vignetting": lambda t, a: -0.3 * t.r2,
    "slope": lambda t, a: np.linspace(-0.1, 0.1, N_VIEWS)[t.view] * t.place[:, 0],
    "curved map": lambda t, a: np.linspace(-0.1, 0.1, N_VIEWS)[t.view] * t.place[:, 1] ** 2,
}


def tracks_with(effect, rng):
    """Every photograph sees every point, each at a random place, with an effect and a thousandth of noise."""
    view, point = (index.ravel() for index in np.indices((N_VIEWS, N_POINTS)))
    place, colors = rng.uniform(-1, 1, (len(view), 2)), rng.normal(-1, 0.5, N_POINTS)
    tracks = Tracks(view, point, np.zeros(len(view)), place, (place**2).sum(axis=1) / 2)
    log_color = colors[point] + PLANTED[effect](tracks, colors) + rng.normal(0, 1e-3, len(view))
    return tracks._replace(log_color=log_color)


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_is_found_and_explains_points_to_which_it_was_not_fitted(effect, rng):
    tracks = tracks_with(effect, rng)
    left = {name: cross_validate(name, tracks, N_VIEWS, N_POINTS) for name in {effect, "gains"}}
    assert left[effect] < FOUND
    assert effect == "gains" or left["gains"] > 5 * left[effect]


def test_the_coefficients_are_the_planted_ones(rng):
    gains, _ = fit_effect("gains", tracks_with("gains", rng), N_VIEWS, N_POINTS)
    assert_allclose(gains[:, 0], np.linspace(-0.1, 0.1, N_VIEWS), atol=FOUND)
    vignetting, _ = fit_effect("vignetting", tracks_with("vignetting", rng), N_VIEWS, N_POINTS)
    assert_allclose(vignetting[:, 1], -0.3, atol=FOUND)
    assert_allclose(vignetting[:, 0], 0.0, atol=FOUND)


def test_places_are_of_the_image():
    """The corner of an image is at (1, 1), half a diagonal from the principal point, where r is 1."""
    scene = make_scene("room", n_views=6, width=40, height=30, n_points=500, supersampling=1).scene
    tracks = collect_tracks(scene)
    assert (np.abs(tracks.place) < 1).all() and 0 < tracks.r2.min() and 0.3 < tracks.r2.max() < 1
    camera = scene.train_views[0].camera
    u, v = (tracks.place + 1).T * [[camera.width / 2], [camera.height / 2]]
    assert_allclose(tracks.r2, ((u - 20) ** 2 + (v - 15) ** 2) / 25**2, rtol=1e-9)


def test_planted_gains_darken():
    scene = make_scene("room", n_views=6, width=40, height=30, n_points=500, supersampling=1).scene
    assert all(
        np.array_equal(v.image, w.image)
        for v, w in zip(scene.train_views, plant(scene, 0.0, np.random.default_rng(0)).train_views, strict=True)
    )
    darker = plant(scene, 0.1, np.random.default_rng(0)).train_views
    ratios = [w.image.mean() / v.image.mean() for v, w in zip(scene.train_views, darker, strict=True)]
    assert max(ratios) == pytest.approx(1, abs=0.01) and 0.6 < min(ratios) < 0.95


def test_from_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(track_gains, "SYNTHETIC", {"n_views": 8, "width": 60, "height": 45, "n_points": 600})
    options = ["--kinds", "room", "--seeds", "0,1", "--long-side", "160"]
    assert measure_claim(["track-gains", "room", "--out", str(tmp_path / "out"), *options]) == 0
    printed = capsys.readouterr().out
    assert "| 0%" in printed and "of 2" in printed and (tmp_path / "out" / "figure.png").is_file()
