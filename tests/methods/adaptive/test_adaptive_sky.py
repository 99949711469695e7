"""When ``adaptive`` puts a sky in the place of Gaussians: with the evidence of the photographs, and not without."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import iteration_of, state_of
from minisplat_ref.methods.adaptive.numbers import SKY_GAIN_MIN
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.methods.adaptive.sky import (
    HUGE,
    LARGE,
    Behind,
    behind,
    compare,
    fit_sky,
    open_pixels,
)
from minisplat_ref.methods.adaptive.switches import switch_sky_on
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy.ops import concat
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import Pace
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import At
from minisplat_ref.training.sky import SKY, with_sky
from minisplat_ref.types import Model, Scene, View, view_from
from scenes import as_dtype, make_camera, make_gaussians

N_VIEWS = 10
EXTENT = 3.0  # world units; all Gaussians of the truth are smaller than a quarter of it
BLACK = np.zeros(3)
COLORS = np.array([[2.0, 1.5, 1.2], [0.0, 0.1, 0.3]])  # of degree 0, and of Y_1-1
RECOVERED = 0.05  # of a brightness: photographs are bytes, and the ridge draws towards zero


@pytest.fixture(scope="module")
def truth():
    gaussians = as_dtype(make_gaussians(np.random.default_rng(5), 30), np.float32)
    return gaussians._replace(sh_dc=np.clip(gaussians.sh_dc, -0.6, 0.4), sh_rest=0 * gaussians.sh_rest)


@pytest.fixture(scope="module")
def sky():
    coefficients = np.zeros((16, 3), np.float32)
    coefficients[:2] = COLORS
    return coefficients


def scene_of(truth, shared):
    """Photographs of the truth under a sky, if ``shared`` has one."""
    rng, views = np.random.default_rng(1), []
    for i in range(N_VIEWS):
        camera = make_camera(24, 16, rng=rng)
        image = (
            with_sky(SPLATTING).render(Model(truth, shared), view_from(camera), Request(BLACK, backend=CPU))[0].image
        )
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), None, view_id=i))
    colors = np.full((len(truth.means), 3), 128, np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, BLACK, EXTENT)


def with_veils(truth, size):
    """The truth with three grey Gaussians of a size in units of the scene's extent in its middle."""
    veils = type(truth)(*(field[:3].copy() for field in truth))
    veils.means[:] = truth.means.mean(axis=0) + np.arange(3)[:, None] * np.float32(0.2)
    veils.log_scales[:], veils.opacity_logits[:], veils.sh_dc[:] = np.log(size * EXTENT), 3.0, 0.0
    return concat(truth, veils)


# Least squares --------------------------------------------------------------------------------------------------------


def test_sums_by_hand():
    """Two pixels with T = 1 and 1/2 that see Y_0 = 2 alone, residuals 1 and 3 in red."""
    basis, residual = np.zeros((2, 16)), np.zeros((2, 3))
    basis[:, 0], residual[:, 0] = 2.0, [1.0, 3.0]
    photograph = behind(residual, np.array([1.0, 0.5]), basis)
    assert photograph.normal[0, 0] == 5.0 and photograph.projected[0, 0] == 5.0 and photograph.energy == 10.0
    coefficients = np.zeros((16, 3))
    coefficients[0, 0] = 1.0
    assert photograph.squared_residual(coefficients) == pytest.approx((1 - 2) ** 2 + (3 - 1) ** 2)


def test_what_nobody_sees_through_has_no_colour():
    assert_array_equal(fit_sky([Behind(np.zeros((16, 16)), np.zeros((16, 3)), 1.0)]), np.zeros((16, 3)))


def test_photographs_judge_each_other():
    """Residuals of one field: where all agree the sky is worth it; where each has its own colour it costs."""

    def photograph(color):
        normal, projected = np.zeros((16, 16)), np.zeros((16, 3))
        normal[0, 0], projected[0] = 1.0, color
        return Behind(normal, projected, 3 * color**2 + 0.1)

    nothing = [Behind(np.zeros((16, 16)), np.zeros((16, 3)), 1.0)] * 6
    agreeing, differing = [photograph(0.5)] * 6, [photograph(0.5 * (-1) ** k) for k in range(6)]
    assert compare(nothing, agreeing).gain == pytest.approx(10 * np.log10(1 / 0.1), abs=0.01)
    assert not compare(nothing, differing).is_above(0.0)
    assert compare(agreeing, agreeing).gain == 0.0, "gaps that the same sky fills either way are no evidence"


# The decision ---------------------------------------------------------------------------------------------------------


def test_veils_before_a_sky_are_replaced_by_it(truth, sky):
    scene = scene_of(truth, {SKY: sky})
    state = state_of(scene, with_veils(truth, 1.5 * HUGE))
    assert "in place of 3" in switch_sky_on(state, iteration_of(scene, 100), min_sky_gain=SKY_GAIN_MIN)
    assert_array_equal(state.gaussians.means, truth.means)
    assert state.adam.first.means.shape == truth.means.shape
    assert state.pace.switched_on == ("sky",) and state.pace.decisions[0].gain > SKY_GAIN_MIN
    view = scene.train_views[0]
    nothing = type(truth)(*(field[:0] for field in truth))
    found, true = (
        with_sky(SPLATTING).render(Model(nothing, {SKY: s}), view_from(view.camera), Request(BLACK))[0].image
        for s in (state.shared[SKY], sky)
    )
    assert_allclose(found, true, atol=RECOVERED)
    assert not state.shared_adam.first[SKY].any()
    assert "there is a sky" in switch_sky_on(state, iteration_of(scene, 100), min_sky_gain=SKY_GAIN_MIN)


def test_what_the_scene_has_not_learned_does_not_count(truth, sky):
    """Whatever photographs show before the sky, here noise, the evidence for it is the same."""
    scene, decisions, rng = scene_of(truth, {SKY: sky}), [], np.random.default_rng(2)
    is_large = np.arange(len(truth.means) + 3) >= len(truth.means)
    veiled = state_of(scene, with_veils(truth, 1.5 * HUGE))
    pixels = open_pixels(veiled, iteration_of(scene, 100), range(N_VIEWS), ~is_large)
    views = []
    for view in scene.train_views:
        is_hidden = ~np.isin(np.arange(24 * 16), pixels.get(view.view_id, [])).reshape(16, 24)
        assert 10 < np.count_nonzero(is_hidden) < 24 * 16
        noise = rng.integers(0, 256, view.image.shape, dtype=np.uint8)
        views.append(view._replace(image=np.where(is_hidden[:, :, None], noise, view.image)))
    for each in (scene, scene._replace(train_views=tuple(views))):
        state = state_of(each, with_veils(truth, 1.5 * HUGE))
        switch_sky_on(state, iteration_of(each, 100), min_sky_gain=SKY_GAIN_MIN)
        decisions += state.pace.decisions
    assert len(decisions) == 2 and decisions[0] == decisions[1]


def test_photographs_that_show_no_sky_say_nothing(truth, sky):
    """Masks leave out what is behind the scene."""
    scene = scene_of(truth, {SKY: sky})
    state = state_of(scene, with_veils(truth, 1.5 * HUGE))
    is_large = np.arange(len(state.gaussians.means)) >= len(truth.means)
    pixels = open_pixels(state, iteration_of(scene, 100), range(N_VIEWS), ~is_large)
    masks = [~np.isin(np.arange(24 * 16), pixels[k]).reshape(16, 24) for k in range(N_VIEWS)]
    views = tuple(view._replace(mask=mask) for view, mask in zip(scene.train_views, masks, strict=True))
    masked = iteration_of(scene._replace(train_views=views), 100)
    note = switch_sky_on(state, masked, min_sky_gain=SKY_GAIN_MIN)
    assert note == "nothing done: 0 photographs show what is behind the scene without 3 large Gaussians"
    assert state.shared == {}


def test_gaussians_that_are_large_but_not_huge_stay(truth, sky):
    scene = scene_of(truth, {SKY: sky})
    state = state_of(scene, with_veils(truth, 0.5 * (LARGE + HUGE)))
    switch_sky_on(state, iteration_of(scene, 100), min_sky_gain=SKY_GAIN_MIN)
    assert state.pace.switched_on == ("sky",) and len(state.gaussians.means) == len(truth.means) + 3


def test_large_things_that_are_there_stay(truth):
    everything = with_veils(truth, 1.5 * HUGE)
    scene = scene_of(everything, {})
    state = state_of(scene, everything)
    assert "nothing done: a sky in place of 3" in switch_sky_on(
        state, iteration_of(scene, 100), min_sky_gain=SKY_GAIN_MIN
    )
    assert state.shared == {} and state.pace == Pace() and len(state.gaussians.means) == len(everything.means)


def test_without_large_gaussians_nothing_is_asked(truth, sky):
    scene = scene_of(truth, {SKY: sky})
    state = state_of(scene, truth)
    assert "no Gaussian is large" in switch_sky_on(state, iteration_of(scene, 100), min_sky_gain=SKY_GAIN_MIN)


def test_training_goes_on_with_the_sky_byte_for_byte(truth, sky, tmp_path):
    scene = scene_of(truth, {SKY: sky})
    early = (event._replace(step=20) if isinstance(event, At) else event for event in ADAPTIVE.events)
    recipe = ADAPTIVE._replace(events=tuple(early), iterations=64)
    saved = []

    def save(report):
        if report.step == 30:
            saved.append(tmp_path / "30.npz")
            save_state(saved[0], report.state, recipe)

    def start():
        return state_of(scene, with_veils(truth, 1.5 * HUGE))

    straight = train(scene, recipe, seed=0, state=start(), on_step=save)
    again = train(scene, recipe, seed=0, state=load_state(saved[0], recipe))
    assert "sky" in straight.pace.switched_on
    assert_array_equal(again.shared[SKY], straight.shared[SKY])
    assert_array_equal(again.gaussians.means, straight.gaussians.means)
