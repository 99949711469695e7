"""Satellites: boxes and surface models by hand, measures of the truth, each arm, and small runs of both claims."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.satellite import boxes
from data_tools.claims.satellite import measures as claims
from data_tools.claims.satellite.measures import perspective_residual
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.satellite.model import IN_SHADOW, RADIOMETRY
from minisplat_ref.extensions.satellite.surface import surface_model
from minisplat_ref.mechanisms.cameras.affine import downward
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.types import Model
from plateau import plateau  # noqa: F401  (a fixture)
from scenes import as_dtype
from tolerances import CLOSED_FORM

# --- cameras ---


def test_what_is_high_is_seen_beside():
    """By a tilt of (0.4, -0.3), 10 m move by 4 m to the west in the image and, as north is up, by 3 m to the north."""
    camera = downward(boxes._camera(np.array([0.4, -0.3]), 96, 96.0, None))  # pixels of a metre

    def seen(x, y, z):
        return camera.cam_from_world_R @ (np.array([x, y, z]) / boxes.SCALE) + camera.cam_from_world_t

    assert_allclose(seen(0, 0, 0), [48, 48, 0], atol=CLOSED_FORM)
    assert_allclose(seen(7, 5, 0), [55, 43, 0], rtol=CLOSED_FORM, atol=CLOSED_FORM)
    assert_allclose(seen(7, 5, 10), [51, 40, -10], rtol=CLOSED_FORM)


# --- consistency of views ---


def terms_of(recipe):
    return {term.name for term in recipe.losses}


def rows_of(said):
    """Return the cells of the table's rows."""
    rows = [
        [cell.strip() for cell in line.strip("| ").split("|")] for line in said.splitlines() if line.startswith("|")
    ]
    return rows[2:]


def test_boxes_truth():
    """Heights are those of the boxes, walls are seen at a slant, and a shadow has the length that the sun says."""
    box = boxes.Boxes(np.array([[-10.0, -10, 0]]), np.array([[10.0, 10, 12]]), np.ones((2, 2, 3)))
    sun = np.array([-1.0, 0.0, 1.0])
    _, heights, is_shadow = boxes.trace(box, boxes.zenith(96), sun)
    assert heights[48, 48] == pytest.approx(12) and heights[48, 60] == pytest.approx(0)
    dark = np.flatnonzero(is_shadow[48])
    assert (dark[0], dark[-1]) == (58, 69)  # pixels of a metre: x from 10 to 22 m


def test_residuals_grow_as_the_distance_shrinks():
    """Ten times nearer, ten times worse; 11.8 pixels from 5 km, and three times that at a slant."""
    near, far = (perspective_residual(distance, 0.0) for distance in (5e3, 50e3))
    assert near == pytest.approx(10 * far, rel=0.02) and near == pytest.approx(11.8, abs=0.1)
    assert perspective_residual(5e3, 25.0) > 2 * near


def test_a_tower_stands_in_its_cells(plateau):
    """Of 36 x 24 cells over 2 x 2 units, x = 0.5 is in column 27, and y = 0.3, with north up, in row 8."""
    model, _ = plateau
    x, y, _ = model.gaussians.means.T
    is_tower = (np.abs(x - 0.5) < 0.15) & (np.abs(y - 0.3) < 0.15)
    means = np.where(is_tower[:, None], model.gaussians.means * [1, 1, 2], model.gaussians.means)
    higher = model._replace(gaussians=model.gaussians._replace(means=means))
    heights = surface_model(higher, (24, 36), boxes.SCALE)
    assert heights[8, 27] == pytest.approx(12, abs=0.1) and heights[0, 0] == pytest.approx(6, abs=0.1)
    rows, columns = np.nonzero(heights > 9)
    assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], [8.4, 27], atol=0.5)
    wide = surface_model(higher, (24, 36), boxes.SCALE, half=4.0)  # there are Gaussians up to 2 units away
    assert np.isnan(wide[:4]).all() and np.isnan(wide[:, -6:]).all() and wide[14, 16] == pytest.approx(6, abs=0.1)


@pytest.mark.parametrize(("opacity", "is_surface"), [(0.45, False), (0.55, True)])
def test_a_surface_hides_half_of_what_is_below(plateau, opacity, is_surface):
    """A single broad Gaussian: in its middle alpha is its opacity."""
    model, _ = plateau
    one = type(model.gaussians)(*(field[:1] for field in model.gaussians))
    one = one._replace(
        means=np.array([[0, 0, 0.1]]),
        log_scales=np.log([[1.0, 1.0, 1e-4]]),
        opacity_logits=np.array([np.log(opacity / (1 - opacity))]),
    )
    heights = surface_model(model._replace(gaussians=one), (25, 25), boxes.SCALE)
    assert np.isfinite(heights[12, 12]) == is_surface


def test_an_arm_lacks_what_its_name_says():
    scene, recipe = boxes.make_scene(0, 4, 8).scene, find_recipe("satellite", 100)
    found = {arm: claims.arm_of(arm, recipe, scene) for arm in claims.ARMS}
    assert found["all"] == (recipe, scene)
    for name, term in (("sparsity", "opacity_sparsity"), ("view consistency", "view_consistency")):
        assert terms_of(recipe) - terms_of(found[f"without {name}"][0]) == {term}
    assert terms_of(recipe) - terms_of(found["without entropy"][0]) == {"shadow_entropy"}
    assert all(any(view.camera.optics.coefficients[2:]) for view in scene.train_views)
    assert not any(any(view.camera.optics.coefficients[2:]) for view in found["without shadows"][1].train_views)
    changed = {arm: own for arm, (own, _) in found.items() if own != recipe}
    assert set(claims.ARMS) - set(changed) == {"all", "without shadows", "limits 8 m below the ground"}
    assert [arm for arm, own in changed.items() if not own.has_random_background] == ["a black background"]
    assert [arm for arm, own in changed.items() if own.events != recipe.events] == ["an opaque start"]
    assert len(changed["an opaque start"].events) == len(recipe.events) - 1
    rates = changed["means at the rate of 3DGS"].learning_rates.of["means"]
    assert (rates.first, rates.last, rates.steps) == (1.6e-4, 1.6e-6, 100)
    still = changed["without radiometry"].representation.rates.of
    assert (still[RADIOMETRY], still[IN_SHADOW]) == (0, 0.01)


def test_the_truth_measures_as_it_should(monkeypatch):
    """Heights that are all off by the same are no error; one of 64 pixels that is 6.4 m off is 0.1 m of it."""
    truth = boxes.make_scene(1, n_points=60, size=8)
    state = initial_state(truth.scene, find_recipe("satellite", 10), 0)
    model = Model(as_dtype(state.gaussians, np.float64), {RADIOMETRY: truth.radiometry, IN_SHADOW: np.zeros((6, 3))})
    heights = truth.heights + 5
    heights[3, 3] += 6.4
    monkeypatch.setattr(claims, "surface_model", lambda *_, **__: heights)
    found, _ = claims.measure(model, truth)
    assert found.height_mae == pytest.approx(0.1) and found.gain_error < 1e-12
    doubled = model._replace(shared=model.shared | {RADIOMETRY: 2 * truth.radiometry})
    assert claims.measure(doubled, truth)[0].gain_error < 1e-12  # relative to the first photograph
    off = truth.radiometry + np.array([0, 0.1, 0, 0, 0, 0])[:, None, None]
    gains = claims.measure(model._replace(shared=model.shared | {RADIOMETRY: off}), truth)[0].gain_error
    assert gains == pytest.approx(0.1 / np.sqrt(5))  # one of five is off, in every entry


def test_the_claim_of_boxes_runs(tmp_path, monkeypatch, capsys):
    for module, name, value in ((claims, "SIZE", 16), (claims, "N_POINTS", 60)):
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(claims, "make_scene", partial(boxes.make_scene, size=16))
    command = ["satellite/boxes", "--iterations", "2", "--seeds", "1", "--out", str(tmp_path / "s")]
    assert measure_claim(command) == 0
    said = capsys.readouterr().out
    assert all(said.count(f"| {arm} ") == 1 for arm in claims.ARMS)
    heights = boxes.make_scene(0, size=16).heights
    plane = np.abs(heights - np.median(heights)).mean()
    assert f"a plane at the median height has an MAE of {plane:.2f} m" in said
    maes = [float(line.split("|")[2]) for line in said.splitlines() if line.startswith("| ") and "height" not in line]
    assert maes == sorted(maes, reverse=True)
    assert np.load(tmp_path / "s" / "all.npy").shape == (16, 16)
    drawn = claims.draw({"truth": heights, "high": np.full((2, 2), 12.0)})
    shown = [ax.images[0].get_array() for ax in drawn.axes if ax.images]
    assert len(shown) == 2 and shown[1].ravel().tolist() == [0.5] * 12  # of 24 m


def test_the_claim_of_distances_runs(tmp_path, capsys):
    assert measure_claim(["satellite/distance", "--out", str(tmp_path / "d")]) == 0
    said = capsys.readouterr().out
    at_nadir = {km: float(value) for km, angle, value in rows_of(said) if angle == "0"}
    by_hand = {km: 353.5 / 0.3 * 50 / (1e3 * float(km)) for km in ("5", "50", "500")}  # as in test_satellite
    assert at_nadir == pytest.approx(by_hand, rel=0.05)
    assert sum(angle == "25" for _, angle, _ in rows_of(said)) == 3
