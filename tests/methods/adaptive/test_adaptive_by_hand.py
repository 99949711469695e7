"""Rules and constants of ``adaptive``, each by a value that was worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import iteration_of, state_of
from minisplat_ref.methods.adaptive.evidence import Answer, Evidence, Half, weigh
from minisplat_ref.methods.adaptive.growth import collect_while_growing, grow
from minisplat_ref.methods.adaptive.pose import displacement_rotation
from minisplat_ref.methods.adaptive.progress import evaluate_measured
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.methods.adaptive.sky import Behind, fit_sky, open_pixels, sum_photographs
from minisplat_ref.methods.adaptive.switches import SWITCHES
from minisplat_ref.metrics import ssim
from minisplat_ref.rendering import SPLATTING, RenderSettings, render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.calibration import EXPOSURES, identity_exposures, with_exposures
from minisplat_ref.training.pace import Decision, Measurement, Pace, measured_ids
from minisplat_ref.training.rates import present_degrees
from minisplat_ref.training.schedule import does
from minisplat_ref.types import Camera, Scene, View
from scenes import balls, make_camera, make_gaussians

ALONG_X = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # cam_from_world_R of a camera that looks along world x
BACKGROUND = np.array([0.3, 0.3, 0.3])


def settings_of(action):
    """Return the settings with which ``adaptive`` calls an action."""
    (event,) = (event for event in ADAPTIVE.events if does(event, action))
    return event.action.keywords


def scene_with(view, n_views=6):
    """A scene that this view shows, and others like it."""
    views = tuple(view._replace(name=f"view{i}", view_id=i) for i in range(n_views))
    return scene_of(views)


def scene_of(views):
    points = np.random.default_rng(0).normal(size=(8, 3))
    return Scene("tiny", tuple(views), (), points, np.full((8, 3), 128, np.uint8), BACKGROUND, 1.0)


def view_of(camera, image=None, mask=None, view_id=0):
    image = np.zeros((camera.height, camera.width, 3), np.uint8) if image is None else image
    return View(f"view{view_id}", camera, image, mask, view_id=view_id)


# A sky ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def opaque():
    """A ball on the axis of a camera, whose image has a standard deviation of 2 of its 20 x 10 pixels."""
    camera = Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 10.0, 5.0, 20, 10)
    return balls(np.array([[0.0, 0, 5]]), [0.5], [0.99]), camera


def test_open_pixels_are_those_that_more_than_half_of_the_light_passes(opaque):
    """Alpha is a half at 1.17 sigma, which is 2.34 px without the dilation; so pixels from 3 px on are open."""
    gaussians, camera = opaque
    scene = scene_with(view_of(camera))
    found = open_pixels(state_of(scene, gaussians), iteration_of(scene), [0], np.ones(1, bool))[0]
    y, x = np.divmod(np.arange(200), 20)
    distances = np.hypot(x + 0.5 - 10, y + 0.5 - 5)
    assert set(np.flatnonzero(distances > 3)) <= set(found)
    assert not set(np.flatnonzero(distances < 2)) & set(found)


@pytest.mark.parametrize(("n_open", "says"), [(1, False), (2, True)])
def test_less_than_half_a_hundredth_of_the_pixels_say_nothing(opaque, n_open, says):
    """Of 200 pixels more than one must be open; the mask leaves the middle and one or two in a corner."""
    gaussians, camera = opaque
    mask = np.zeros((10, 20), bool)
    mask[4:6, 9:11] = mask[0, :n_open] = True
    scene = scene_with(view_of(camera, mask=mask))
    found = open_pixels(state_of(scene, gaussians), iteration_of(scene), [0], np.ones(1, bool))
    assert ([*found] == [0]) == says
    if says:
        assert_array_equal(found[0], [0, 1])


def test_a_sky_is_seen_in_the_direction_of_the_world():
    """Along world x ``Y_1`` is ``C_1 (0, 0, -1)``, and a pixel that shows it has ``b_0 b_3 = -C_0 C_1``."""
    camera = Camera(ALONG_X, np.zeros(3), 1e6, 1e6, 0.5, 0.5, 1, 1)
    scene = scene_with(view_of(camera))
    behind_the_camera = balls(np.array([[-5.0, 0, 0]]), [0.1], [0.5])
    (photograph,) = sum_photographs(
        state_of(scene, behind_the_camera), iteration_of(scene), {0: np.array([0])}, np.ones(1, bool)
    )
    expected = 0.2820947918 * 0.4886025119 * np.array([0.0, 0.0, -1.0])
    assert_allclose(photograph.normal[0, 1:4], expected, atol=1e-6)


def test_a_sky_is_drawn_towards_zero_by_a_thousandth():
    """The mean of the diagonal is 1, so 3.001 / (3 + 0.001)."""
    normal, projected = np.zeros((16, 16)), np.zeros((16, 3))
    normal[0, 0], normal[1, 1], projected[0] = 3.0, 13.0, 3.001
    assert_allclose(fit_sky([Behind(normal, projected, 1.0)])[0], 1.0, rtol=1e-12)


# What the photographs need --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "gain", "standard_error", "is_on"),
    [
        ("sky", 2.99, 0.1, False),
        ("sky", 3.01, 0.1, True),
        ("sky", 3.6, 1.21, False),
        ("sky", 3.6, 1.19, True),
        ("sky", 2.05, 0.43, False),  # the most that was measured of bare walls
        ("sky", 5.07, 1.65, True),  # the least of the sky of outdoor
        *(
            (name, *case)
            for name in ("antialiasing", "pose")
            for case in ((0.099, 0.01, False), (0.101, 0.01, True), (0.5, 0.51, False), (0.5, 0.49, True))
        ),
    ],
)
def test_a_tenth_of_a_decibel_and_one_standard_error_or_three_of_both(name, gain, standard_error, is_on):
    evidence = Evidence(gain, standard_error, np.zeros((2, 1)))
    rules = settings_of(SWITCHES[name])
    switch = replace(SWITCHES[name], examine=lambda *_: Answer(evidence, "asked", dict))
    scene = scene_with(view_of(make_camera(4, 4)))
    state = state_of(scene, balls(np.array([[0.0, 0, 5]]), [0.1], [0.5]))
    switch(state, iteration_of(scene), **rules)
    assert state.pace.switched_on == ((name,) if is_on else ())


def test_amounts_are_drawn_towards_zero_by_a_thousandth():
    """A half has ``b . b`` = 1 and ``b . r`` = 1 or -1; both together have 2 / (2 + 0.001)."""
    halves = [Half(np.eye(1), np.array([x]), 1.0) for x in (1.0, -1.0)]
    fitted = weigh([(half, half) for half in halves]).fitted
    assert_allclose(fitted[:, 0], [2 / 2.001, -2 / 2.001], rtol=1e-12)


def test_a_displacement_is_a_rotation_by_its_own_focal_length():
    """4 px to the right at f_x = 40 are 0.1 about y; 8 px down at f_y = 160 are -0.05 about x."""
    camera = make_camera(fx=40.0, fy=160.0)
    assert_allclose(displacement_rotation(camera, np.array([4.0, 8.0])), [-0.05, 0.1, 0.0])


# Measurement ----------------------------------------------------------------------------------------------------------


def rendering(image):
    return SimpleNamespace(render_view=lambda *_: (SimpleNamespace(image=image), None))


def test_held_out_views_are_measured_in_their_masks_and_as_they_are_shown():
    """In half of the mask 1.7 shows as 1, which is right; in the other half 0.6 is 0.2 off: 10 lg(1 / 0.02) dB."""
    camera = make_camera(8, 4)
    image, photograph = np.zeros((4, 8, 3)), np.full((4, 8, 3), 255, np.uint8)
    image[:2, :4], image[:2, 4:] = 1.7, 0.6
    photograph[:2, 4:] = 102
    mask = np.zeros((4, 8), bool)
    mask[:2] = True
    scene = scene_with(view_of(camera, photograph, mask))
    iteration = iteration_of(scene)._replace(render_settings=rendering(image))
    state = state_of(scene, balls(np.array([[0.0, 0, 5]]), [0.1], [0.5]))
    measured = evaluate_measured(state, iteration, ADAPTIVE.cooling, has_ssim=True)
    assert_allclose(measured.psnrs, [16.98970004] * 2, rtol=1e-6)
    assert_allclose(measured.ssims, [ssim(np.clip(image, 0, 1), photograph, mask)] * 2, rtol=1e-6)
    assert abs(measured.ssim - ssim(np.clip(image, 0, 1), photograph)) > 0.05  # the mask matters


def test_the_exposure_of_held_out_views_is_no_error_of_the_model():
    """A photograph of three quarters of the brightness is right to its rounding, 1 / (255 sqrt(12)), or 59 dB.

    That is so with the exposure that its tracks may show, 0.6, which is wrong. In a training without exposures it is a
    quarter of the brightness off, some 18 dB: then the model has to explain the difference, too.
    """
    rng = np.random.default_rng(1)
    truth = make_gaussians(np.random.default_rng(5), 30)
    cameras = [make_camera(24, 16, rng=rng) for _ in range(6)]
    images = [np.clip(render(truth, camera, background=BACKGROUND, backend=CPU)[0].image, 0, 1) for camera in cameras]
    darker = [np.round(255 * 0.75 * image).astype(np.uint8) for image in images]
    scene = scene_of([view_of(cameras[i], darker[i], view_id=i) for i in range(6)])
    exposed = RenderSettings(BACKGROUND, renderer=with_exposures(SPLATTING))
    state, iteration = state_of(scene, truth), iteration_of(scene)
    without = evaluate_measured(state, iteration, ADAPTIVE.cooling)
    state.shared = identity_exposures(6)
    state.shared[EXPOSURES][measured_ids(6, ADAPTIVE.cooling.hold_out_every), :, :3] = 0.6 * np.eye(3)
    measured = evaluate_measured(state, iteration._replace(render_settings=exposed), ADAPTIVE.cooling)
    assert_allclose(measured.psnrs, 20 * np.log10(255 * np.sqrt(12)), atol=1)
    assert max(without.psnrs) < 20


def test_what_was_measured_when_something_was_decided_is_of_the_time_before():
    """Of those since half of the work, 500 of 1,000 pairs, only what came after the decision at 800 counts."""
    measurements = tuple(Measurement(step, (20.0, 20.0), 10, step) for step in (400, 500, 800, 900, 1000))
    decided = Decision(800, "resolution", "", None, None)
    assert [m.step for m in Pace(measurements, n_pairs=1000).recent()] == [500, 800, 900, 1000]
    assert [m.step for m in Pace(measurements, (decided,), n_pairs=1000).recent()] == [900, 1000]


# Growth and degrees ---------------------------------------------------------------------------------------------------


def test_gaussians_are_halved_from_four_ten_thousandths_on():
    scene = scene_with(view_of(make_camera(4, 4)))
    state = state_of(scene, balls(np.array([[0.0, 0, 5]] * 3), [0.1] * 3, [0.5] * 3))
    state.stats = {"gradient_sum": 2 * np.array([3.9e-4, 4.1e-4, 7e-4]), "view_count": np.full(3, 2)}
    assert grow(state, iteration_of(scene), **settings_of(grow) | {"max_growth": 1.0}).startswith("66.7% have")
    assert len(state.gaussians.means) == 5


def test_a_fifth_is_halved_at_most():
    scene = scene_with(view_of(make_camera(4, 4)))
    state = state_of(scene, balls(np.array([[0.0, 0, 5]] * 10), [0.1] * 10, [0.5] * 10))
    state.stats = {"gradient_sum": np.ones(10), "view_count": np.ones(10, int)}
    grow(state, iteration_of(scene), **settings_of(grow) | {"error_views": 0})
    assert len(state.gaussians.means) == 12


def test_gradients_are_forgotten_when_the_rates_fall_and_work_is_counted():
    scene = scene_with(view_of(make_camera(4, 4)))
    state = state_of(scene, balls(np.array([[0.0, 0, 5]]), [0.1], [0.5]))
    state.stats = {"gradient_sum": np.ones(1), "view_count": np.ones(1, int), "other": 1}
    state.pace = Pace(n_pairs=7, cooling_from=10)
    collect_while_growing(state, iteration_of(scene)._replace(output=SimpleNamespace(n_pairs=5)))
    assert state.stats == {"other": 1} and state.pace.n_pairs == 12


def test_one_colour_makes_a_degree():
    """Of three channels and, in degree 2, five coefficients, one number that is not 0 is enough."""
    sh_rest = np.zeros((4, 15, 3))
    sh_rest[1, 2, 0] = sh_rest[2, 3, 1] = sh_rest[3, 14, 2] = 0.1
    assert_array_equal(present_degrees(sh_rest), [0, 1, 2, 3])
