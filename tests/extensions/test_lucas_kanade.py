"""Lucas-Kanade: turns and losses by hand, flow of photographs, no motion that is 3DGS exactly, the command line."""

import json
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import gaussian_filter, shift

from data_tools.claims.lucas_kanade import body as bodies
from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.lucas_kanade import pyramid, recipe
from minisplat_ref.extensions.lucas_kanade.model import (
    CENTERS,
    GROWTHS,
    LOG_WIDTH,
    SHIFTS,
    TURNS,
    WARPED,
    first_warp,
    moved,
    turned,
    turned_vjp,
)
from minisplat_ref.extensions.lucas_kanade.pyramid import optical_flow
from minisplat_ref.extensions.lucas_kanade.recipe import (
    Pairs,
    depth_order,
    flow,
    flow_error,
    flow_error_vjp,
    image_steps,
    image_steps_vjp,
    next_view,
    order_error,
    order_error_vjp,
    ordered_pairs,
    rendered_flow,
    stages,
)
from minisplat_ref.extensions.velocity.model import MOVING, MovingGaussians
from minisplat_ref.io.images import read_image, write_image
from minisplat_ref.io.ply import save_ply
from minisplat_ref.oracle.gradients import inner_product_case
from minisplat_ref.oracle.loss_terms import loss_cases
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import Gaussians, Model, Scene, View, view_from
from scenes import as_dtype, balls, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE

RENDERER = WARPED.renderer
WARP = (CENTERS, LOG_WIDTH, SHIFTS, TURNS, GROWTHS)
# Pixels, of 95 % of a smooth texture of 64 x 48 that a spline has shifted: measured 0.065, by linear interpolation.
FLOW_OF_A_SHIFT = 0.1


def warped(gaussians, rng, scale=0.2, degree=2):
    """A model of these Gaussians with a warp of three centres."""
    dtype = gaussians.means.dtype
    shared = {
        CENTERS: gaussians.means[:3],
        LOG_WIDTH: np.array([0.1]),
        SHIFTS: scale * rng.normal(size=(3, degree, 3)),
        TURNS: scale * rng.normal(size=(3, degree, 3)),
        GROWTHS: scale * rng.normal(size=(3, degree, 1)),
    }
    return Model(gaussians, {name: array.astype(dtype) for name, array in shared.items()})


def one_gaussian(z, sigma=0.4):
    return Gaussians(
        np.array([[0.0, 0, z]]),
        np.array([[1.0, 0, 0, 0]]),
        np.full((1, 3), np.log(sigma)),
        np.array([2.0]),
        np.ones((1, 3)),
        np.zeros((1, 0, 3)),
    )


def evenly(shared):
    """The same motion everywhere: one centre, whose function is 1 within 1e-12 of the scene."""
    return {CENTERS: np.zeros((1, 3)), LOG_WIDTH: np.array([np.log(1e7)]), TURNS: np.zeros((1, 1, 3)), **shared}


# --- formulas ---


def test_a_turn_is_a_rotation(rng):
    """r = 2 tan(0.3) e_z turns by 0.6 about z, in the world; zero leaves every bit."""
    quats = rng.normal(size=(4, 4))
    turns = np.tile([0, 0, 2 * np.tan(0.3)], (4, 1))
    R = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    assert_allclose(rotation_matrices(turned(quats, turns)), R @ rotation_matrices(quats), atol=CLOSED_FORM * 10)
    assert_array_equal(turned(quats, np.zeros((4, 3))), quats)


def test_gradients_of_the_formulas(rng):
    quats, turns = rng.normal(size=(3, 4)), rng.normal(size=(3, 3))
    check_jacobian(
        lambda q, r: (turned(q, r),), lambda v: turned_vjp(quats, turns, v), [quats, turns], names=["quats", "turns"]
    )
    cameras = (make_camera(16, 12), make_camera(20, 16, rng=rng))
    before, after = (rng.uniform(-1, 1, size=(3, 3)) + np.array([0, 0, 5.0]) for _ in range(2))
    step = image_steps(before, after, cameras)[1]
    check_jacobian(
        lambda x, y: (image_steps(x, y, cameras)[0],),
        lambda v: image_steps_vjp(step, v),
        [before, after],
        names=["before", "after"],
    )
    motion, alpha, target = rng.normal(size=(4, 5, 2)), rng.uniform(size=(4, 5)), rng.normal(size=(4, 5, 2))
    is_known = rng.uniform(size=(4, 5)) > 0.3
    check_jacobian(
        lambda f, a: (np.asarray(flow_error(f, a, target, is_known)),),
        lambda v: tuple(float(v) * each for each in flow_error_vjp(motion, alpha, target, is_known)),
        [motion, alpha],
        names=["flow", "alpha"],
    )
    sums, pairs = rng.uniform(1, 2, size=(4, 5)), Pairs(*rng.integers(0, 4, size=(2, 9, 2)))
    check_jacobian(
        lambda d, a: (np.asarray(order_error(d, a + 1, pairs, 0.1)),),
        lambda v: tuple(float(v) * each for each in order_error_vjp(sums, alpha + 1, pairs, 0.1)),
        [sums, alpha],
        names=["sums", "alpha"],
    )


def test_what_the_next_camera_does_not_see_in_front_of_it_counts_as_still():
    """Three balls that the first camera sees; the second has them at -1, 0.005 and 0.5 before itself."""
    g = balls([[0, 0, 2], [0.3, 0, 2], [-0.3, 0, 2]], [0.1] * 3, [0.5] * 3)
    after = np.array([[0.0, 0, -1], [0.3, 0, 0.005], [-0.3, 0, 0.5]])
    camera = make_camera(24, 18)
    _, _, rows = recipe.blended_steps(g, after, (camera, camera), Request(backend=REFERENCE))
    assert rows.tolist() == [2]


def test_losses_by_hand():
    """A pixel with F = (3, -1), A = 0.5 and f = (4, 2) misses by (1, -2); the other's flow is unknown. Width 2."""
    motion, alpha = np.array([[[3.0, -1], [9, 9]]]), np.array([[0.5, 1]])
    target, is_known = np.array([[[4.0, 2], [np.nan, np.nan]]]), np.array([[True, False]])
    one, two = np.sqrt(1.01), np.sqrt(4.01)
    assert flow_error(motion, alpha, target, is_known) == pytest.approx((one + two - 0.2) / 2)
    v_motion, v_alpha = flow_error_vjp(motion, alpha, target, is_known)
    assert_allclose(v_motion, [[[0.5 / one, -1 / two], [0, 0]]], rtol=CLOSED_FORM)
    assert_allclose(v_alpha, [[-2 / one + 2 / two, 0]], rtol=CLOSED_FORM)
    # Depths 2 and 6 / 2 = 3. In the right order by ln 1.5 = 0.405, in the wrong one by minus that; margin 0.1.
    sums, alpha = np.array([[2.0, 6]]), np.array([[1.0, 2]])
    left, right = np.array([[0, 0]]), np.array([[0, 1]])
    assert order_error(sums, alpha, Pairs(left, right), 0.1) == 0
    assert order_error(sums, alpha, Pairs(right, left), 0.1) == pytest.approx(0.1 + np.log(1.5))


def test_pairs_of_a_twentieth_of_the_range_have_an_order():
    """Depths of 0, 0.05 and 1: each of the three differs from each other by more than 0.02 of the range."""
    pixels, given = np.array([[0, 0], [1, 1], [2, 2]]), np.array([0.0, 0.05, 1.0])
    found = set()
    for seed in range(20):
        pairs = ordered_pairs(pixels, given, np.random.default_rng(seed))
        found |= {(int(a[0]), int(b[0])) for a, b in zip(pairs.near, pairs.far, strict=True)}
    assert found == {(0, 1), (0, 2), (1, 2)}


def test_pairs_are_ordered():
    pixels = np.array([[0, 0], [1, 1], [2, 2], [0, 0], [3, 3]])
    given = np.array([5.0, 1.0, 3.0, 9.0, 1.1])
    near, far = ordered_pairs(pixels, given, np.random.default_rng(1))
    depth_of = {(1, 1): 1.0, (2, 2): 3.0, (3, 3): 1.1}
    assert len(near) and (near != far).any(axis=1).all()
    for a, b in zip(near.tolist(), far.tolist(), strict=True):
        low, high = depth_of.get(tuple(a), 5.0), depth_of.get(tuple(b), 5.0)
        assert low < high and {low, high} != {1.0, 1.1}  # which differ by less than 2 % of the range
    assert len(ordered_pairs(pixels[:0], given[:0], np.random.default_rng(1)).near) == 0


# --- flow of photographs ---


@pytest.fixture(scope="module")
def texture():
    image = gaussian_filter(np.random.default_rng(0).uniform(size=(48, 64, 3)), (2.5, 2.5, 0))
    return (image - image.min()) / np.ptp(image)


@pytest.mark.parametrize("motion", [(0.4, -0.3), (5.0, -4.0)])
def test_flow_of_a_shift(texture, motion):
    """The second has at p + d what the first has at p; five pixels are found by the pyramid."""
    second = shift(texture, (motion[1], motion[0], 0), order=3, mode="nearest")
    found = optical_flow(texture, second)
    inside = np.zeros((48, 64), bool)
    inside[10:-10, 10:-10] = True
    assert found.is_known[inside].mean() > 0.9
    assert np.quantile(np.abs(found.motion - motion)[inside & found.is_known], 0.95) < FLOW_OF_A_SHIFT
    if motion[0] > 1:
        assert not found.is_known[:, -4:].any()  # these leave the image


def test_what_leaves_the_image_has_no_flow(texture, monkeypatch):
    """Even where the flow back is not asked for."""
    monkeypatch.setattr(pyramid, "RETURN_MAX", np.inf)
    second = shift(texture, (0, 4, 0), order=3, mode="nearest")
    is_known = optical_flow(texture, second).is_known
    assert not is_known[10:-10, -3:].any() and is_known[10:-10, 10:-10].all()


def test_a_flow_of_half_the_size_is_doubled():
    """Every second pixel was kept: those between lie between, and a pixel there is two here."""
    coarse = np.stack([np.arange(4.0)[None, :] + np.zeros((3, 1)), np.ones((3, 4))], axis=2)
    fine = pyramid._enlarged(coarse, (6, 8))
    assert_array_equal(fine[2, :, 0], [0, 1, 2, 3, 4, 5, 6, 6])
    assert_array_equal(fine[..., 1], np.full((6, 8), 2.0))


def test_flow_of_nothing(texture):
    flat = np.full((48, 64, 3), 128, np.uint8)
    assert not optical_flow(flat, flat).is_known.any()
    stripes = np.tile(np.sin(np.arange(64) / 2)[None, :, None], (48, 1, 3)) / 2 + 0.5
    assert not optical_flow(stripes, stripes)[1][8:-8, 8:-8].any()  # along them nothing is known
    found = optical_flow(texture, texture)
    assert found.is_known.mean() > 0.9 and not found.motion.any()


def test_bytes_and_shares_have_the_same_flow(texture):
    first, second = (np.round(255 * image).astype(np.uint8) for image in (texture, shift(texture, (0, 1, 0), order=1)))
    as_bytes, as_shares = optical_flow(first, second), optical_flow(first / 255, second / 255)
    assert_array_equal(as_bytes.is_known, as_shares.is_known)
    assert_allclose(as_bytes.motion, as_shares.motion, atol=1e-9)


def test_what_does_not_come_back_has_no_flow(texture):
    """Half of the second photograph shows something else: there is a flow, and it does not return."""
    other = gaussian_filter(np.random.default_rng(7).uniform(size=texture.shape), (2.5, 2.5, 0))
    second = texture.copy()
    second[:, 32:] = ((other - other.min()) / np.ptp(other))[:, 32:]
    is_known = optical_flow(texture, second).is_known
    assert is_known[8:-8, 4:20].mean() > 0.9 > 0.5 > is_known[8:-8, 44:-4].mean()


def test_a_lone_pixel_does_not_spoil_the_flow(texture, monkeypatch):
    """The median of 3 x 3 pixels takes out what one window got wrong."""
    steps = np.zeros((5, 5, 2))
    steps[2, 2] = 1.0
    monkeypatch.setattr(pyramid, "_step", lambda first, moved: steps)
    monkeypatch.setattr(pyramid, "N_STEPS", 1)
    assert not pyramid._flow(texture[:5, :5], texture[:5, :5]).any()


# --- rendered flow ---


def test_flow_of_one_gaussian():
    """Before the axis at depth 4, it moves by (0.4, -0.2, 0) a unit of time: over half a unit, 20 / 4 times that."""
    model = Model(one_gaussian(4.0), evenly({SHIFTS: np.array([[[0.8, -0.4, 0.0]]]), GROWTHS: np.zeros((1, 1, 1))}))
    camera = make_camera(16, 12, fx=20.0, fy=20.0)
    first, second = view_from(camera, time=0.0), view_from(camera, time=0.5)
    motion, alpha, _ = rendered_flow(model, first, second, Request(backend=REFERENCE))
    assert alpha.max() > 0.8
    assert_allclose(motion, alpha[..., None] * [2.0, -1.0], atol=1e-10)


def test_flow_of_a_camera():
    """What stands still moves as the camera does: 0.1 to the right is 20 * 0.1 / 4 pixels to the left."""
    model = Model(one_gaussian(4.0), evenly({SHIFTS: np.zeros((1, 1, 3)), GROWTHS: np.zeros((1, 1, 1))}))
    camera = make_camera(16, 12, fx=20.0, fy=20.0)
    other = camera._replace(cam_from_world_t=camera.cam_from_world_t - [0.1, 0, 0])
    motion, alpha, _ = rendered_flow(model, view_from(camera), view_from(other, time=1.0), Request(backend=REFERENCE))
    assert_allclose(motion, alpha[..., None] * [-0.5, 0.0], atol=1e-10)
    behind = camera._replace(cam_from_world_t=camera.cam_from_world_t - [0, 0, 9])
    aside = model._replace(gaussians=model.gaussians._replace(means=np.array([[0.3, 0, 4.0]])))
    motion, _, _ = rendered_flow(aside, view_from(camera), view_from(behind, time=1.0), Request(backend=REFERENCE))
    assert not motion.any()  # the second camera has passed it


def test_gaussians_move_turn_and_grow():
    model = Model(
        one_gaussian(4.0),
        evenly(
            {
                SHIFTS: np.array([[[0.0, 0, 1], [1, 0, 0]]]),
                TURNS: np.array([[[0.2, 0, 0], [0, 0, 0]]]),
                GROWTHS: np.array([[[0.0], [4.0]]]),
            }
        ),
    )
    there = moved(model, 0.5).gaussians
    assert_allclose(there.means, [[0.25, 0, 4.5]], rtol=1e-10)  # 0.5 of the first power, 0.25 of the second
    assert_allclose(there.quats, [[1, 0.05, 0, 0]], rtol=1e-10)
    assert_allclose(there.log_scales, np.log(0.4) + np.ones((1, 3)), rtol=1e-10)


# --- gradients and backends ---


def test_the_gradient_of_the_whole_model():
    """On kernels; those of the reference agree with them, below."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, WARPED)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


def test_the_gradient_of_the_flow(rng):
    """On the reference; the loss below is checked on kernels."""
    setting = make_setting(rng, 12, 24, 18, GSPLAT_MAIN, sh_degree=0)
    (stage,) = stages(REFERENCE, setting, rng)
    case = inner_product_case(stage, rng)
    assert case.passed and set(stage.inputs) == {*Gaussians._fields[:4], *WARP}, case


@pytest.mark.parametrize(("name", "n_cases"), [("flow", 2), ("depth_order", 1)])
def test_the_gradients_of_the_losses(name, n_cases):
    (term,) = (term for term in find_recipe("lucas-kanade").losses if term.name == name)
    cases = loss_cases(term, CPU, GSPLAT_MAIN, WARPED)
    assert len(cases) == n_cases and all(case.passed for case in cases), cases


def test_backends_agree(rng):
    model = warped(as_dtype(make_gaussians(rng, 30), np.float32), rng)
    view = view_from(make_camera(), time=0.7)
    v_image = rng.normal(size=(18, 24, 3)).astype(np.float32)
    (image, v), (expected, v_expected) = (
        (output.image, RENDERER.render_vjp(tape, v_image, None))
        for output, tape in (RENDERER.render(model, view, Request(backend=backend)) for backend in (CPU, REFERENCE))
    )
    assert image.dtype == np.float32 and np.abs(image - expected).max() <= PARITY_FLOAT32_IMAGE
    for name in WARP:
        ours, theirs = v.shared[name], v_expected.shared[name]
        assert ours.dtype == np.float32 and ours.shape == model.shared[name].shape
        assert np.abs(ours - theirs).max() <= PARITY_FLOAT32_GRADIENT * np.abs(theirs).max() and theirs.any(), name


def test_degree_one_with_a_centre_at_every_gaussian_is_linear_motion(rng):
    """A width of nearly nothing makes the basis the identity: image and gradients are those of ``velocity``."""
    g, view, request = make_gaussians(rng, 30), view_from(make_camera(), time=0.7), Request(backend=REFERENCE)
    velocities = 0.3 * rng.normal(size=(30, 3))
    nothing = {TURNS: np.zeros((30, 1, 3)), GROWTHS: np.zeros((30, 1, 1)), LOG_WIDTH: np.array([-20.0])}
    model = Model(g, {CENTERS: g.means, SHIFTS: velocities[:, None], **nothing})
    linear = Model(MovingGaussians(**g._asdict(), velocities=velocities))
    (output, tape), (expected, tape_of_linear) = (
        renderer.render(each, view, request) for renderer, each in ((RENDERER, model), (MOVING.renderer, linear))
    )
    assert_array_equal(output.image, expected.image)
    v_image = rng.normal(size=output.image.shape)
    found = RENDERER.render_vjp(tape, v_image, None)
    theirs = MOVING.renderer.render_vjp(tape_of_linear, v_image, None).gaussians
    assert_allclose(found.shared[SHIFTS][:, 0], theirs.velocities, rtol=1e-9, atol=1e-12)
    assert np.abs(theirs.velocities).max() > 0.01


# --- no motion ---


def tiny_scene(rng, times=(0.0, 0.3, 0.6, 1.0)):
    """Views of static Gaussians, with their centres as points."""
    truth = as_dtype(make_gaussians(rng, 30), np.float32)
    views = []
    for i, time in enumerate(times):
        camera = make_camera(24, 18)
        image = SPLATTING.render(Model(truth), view_from(camera), Request(backend=REFERENCE))[0].image
        levels = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
        views.append(View(f"view{i}", camera, levels, None, view_id=i, time=time))
    colors = rng.integers(0, 256, (30, 3), np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, np.zeros(3), 1.0)


def test_no_motion_is_3dgs_to_the_byte(backend, rng):
    """A warp that is not trained: fields, moments and every image are those of 3DGS."""
    scene, results = tiny_scene(rng), []
    recipe = find_recipe("lucas-kanade", 40)
    still = recipe.learning_rates.change(**dict.fromkeys(WARP, 0.0))
    plain = find_recipe("3dgs-accel", 40)
    for each in (recipe._replace(learning_rates=still, losses=plain.losses), plain):
        images = []
        on_step = partial(lambda images, report: images.append(report.output.image), images)
        results.append((train(scene, each, seed=1, on_step=on_step, backend=backend), images))
    (state, images), (expected, expected_images) = results
    for ours, theirs in ((state.gaussians, expected.gaussians), *zip(state.adam[:2], expected.adam[:2], strict=True)):
        for name in Gaussians._fields:
            assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), name
    assert len(images) == 40
    assert all(a.tobytes() == b.tobytes() for a, b in zip(images, expected_images, strict=True))
    assert not state.shared[SHIFTS].any()


# --- losses ---


def rendered_view(scene, model, view_id=0, wants=frozenset({"depth"})):
    view, request = scene.train_views[view_id], Request(backend=REFERENCE, wants=wants)
    output, _ = RENDERER.render(model, view, request)
    return Rendered(output, RENDERER.channels(wants), view, scene, model, 1, request)


def test_the_next_photograph(rng):
    views = tiny_scene(rng).train_views
    near, far = (views[1]._replace(name=name, time=0.3) for name in ("near", "far"))
    far = far._replace(camera=far.camera._replace(cam_from_world_t=far.camera.cam_from_world_t + 1))
    scene = tiny_scene(rng)._replace(train_views=(views[3], far, near, views[0]))
    assert next_view(scene, views[0]).name == "near"  # not the one of time 1, nor another camera's
    assert next_view(scene, near).name == "view3"
    assert next_view(scene, views[3]) is None


def test_flow_of_photographs_that_do_not_move(rng):
    """Two equal photographs, and a model that moves: its own flow is the error; after the last there is none."""
    scene = tiny_scene(rng)
    still = Model(make_gaussians(rng, 30), first_warp(scene, rng, n_centers=4, degree=2))
    assert flow(rendered_view(scene, still), flows="")[0] == 0
    model = warped(make_gaussians(rng, 30), rng)
    value, v = flow(rendered_view(scene, model), flows="")
    assert value > 0 and v.shared[SHIFTS].any() and set(v.gaussians) == set(Gaussians._fields[:4])
    assert flow(rendered_view(scene, model, 3), flows="")[0] == 0


def test_given_flows(rng, tmp_path):
    """A given flow is compared where it is a number, and the mask of the photograph counts."""
    scene, model = tiny_scene(rng), warped(make_gaussians(rng, 30), rng)
    view = scene.train_views[0]
    rendered = rendered_view(scene, model)
    motion, alpha, _ = rendered_flow(model, view, scene.train_views[1], rendered.request)
    given = motion / np.maximum(alpha, 1e-12)[..., None]
    given[alpha < 1e-3] = np.nan
    np.save(tmp_path / "view0.npy", given)
    assert flow(rendered, flows=str(tmp_path))[0] < 1e-12
    given[:, :12] += 1.0
    np.save(tmp_path / "view0.npy", given)
    np.save(tmp_path / "other.npy", given)
    hidden = np.zeros((18, 24), bool)
    hidden[:, 12:] = True
    other = rendered._replace(view=view._replace(name="other"))
    assert flow(other, flows=str(tmp_path))[0] > 0.01
    assert flow(other._replace(view=other.view._replace(mask=hidden)), flows=str(tmp_path))[0] < 1e-12


def test_a_motion_along_one_axis_alone_is_unknown(rng, tmp_path):
    view = tiny_scene(rng).train_views[0]
    given = np.zeros((18, 24, 2))
    given[4, 5, 0] = given[6, 7, 1] = np.nan
    np.save(tmp_path / "view0.npy", given)
    known = recipe._given_flow(tmp_path, view)
    assert np.argwhere(~known.is_known).tolist() == [[4, 5], [6, 7]] and np.isfinite(known.motion).all()


def test_a_lone_photograph_is_taken_to_look_the_same_a_unit_of_time_later(rng, monkeypatch):
    scene, asked = tiny_scene(rng, times=(0.25,)), []

    def remembered(model, view, other, request):
        asked.append((view.time, other.time))
        return rendered_flow(model, view, other, request)

    monkeypatch.setattr(recipe, "rendered_flow", remembered)
    flow(rendered_view(scene, warped(make_gaussians(rng, 30), rng)), flows="")
    assert asked == [(0.25, 1.25)]


def test_depths_are_compared_where_the_image_is_opaque_and_not_masked(rng, tmp_path, monkeypatch):
    """Half of the pixels have an alpha of 0.6, half of 0.4; the mask leaves the upper rows. 1,024 are drawn at most."""
    scene, model = tiny_scene(rng), warped(make_gaussians(rng, 30), rng)
    rendered, compared = rendered_view(scene, model), []
    alpha = np.where(np.arange(24) < 12, 0.6, 0.4) * np.ones((18, 1))
    mask = np.arange(18)[:, None] * np.ones((1, 24)) < 9
    monkeypatch.setattr(recipe, "ordered_pairs", lambda *given: compared.append(given[0]) or ordered_pairs(*given))
    np.save(tmp_path / "view0.npy", rng.uniform(size=(18, 24)))
    seen = rendered._replace(output=rendered.output._replace(alpha=alpha), view=rendered.view._replace(mask=mask))
    depth_order(seen, depths=str(tmp_path), margin=0.0)
    rows, columns = compared[0].T
    assert len(rows) == 9 * 12 and rows.max() == 8 and columns.max() == 11
    large = scene.train_views[0]._replace(name="large", camera=make_camera(40, 30))
    np.save(tmp_path / "large.npy", rng.uniform(size=(30, 40)))
    pixels, depths = recipe._map_samples(tmp_path, large, rng)
    assert len(pixels) == len(depths) == len(np.unique(pixels, axis=0)) == 1_024


def test_sparse_points_are_at_rows_and_columns(rng):
    """Of a camera of 24 x 18 pixels, f = 20, a point at (0.5, 0.2, 2) is in column 12 + 5 and row 9 + 2."""
    scene = tiny_scene(rng)
    camera = make_camera(24, 18, fx=20.0, fy=20.0)._replace(cx=12.0, cy=9.0)
    view = scene.train_views[0]._replace(camera=camera, point_ids=np.array([0]))
    placed = scene._replace(points=np.array([[0.5, 0.2, 2.0]]))
    rendered = rendered_view(scene, warped(make_gaussians(rng, 30), rng))._replace(scene=placed, view=view)
    pixels, depths = recipe._point_samples(rendered)
    assert pixels.tolist() == [[11, 17]] and depths.tolist() == [2.0]


@pytest.mark.parametrize("fault", ["missing", "shape", "text"])
def test_bad_maps(rng, tmp_path, fault):
    scene, model = tiny_scene(rng), warped(make_gaussians(rng, 30), rng)
    if fault == "shape":
        np.save(tmp_path / "view0.npy", np.zeros((3, 4)))
    if fault == "text":
        (tmp_path / "view0.npy").write_text("flow")
    message = "needs numbers of shape" if fault == "shape" else "cannot be read as an array"
    with pytest.raises(InputError, match=rf"view0\.npy .*{message}"):
        flow(rendered_view(scene, model), flows=str(tmp_path))
    with pytest.raises(InputError, match=rf"view0\.npy .*{message}"):
        depth_order(rendered_view(scene, model), depths=str(tmp_path), margin=0.01)


def test_order_of_given_depths(rng, tmp_path):
    """The rendered depths themselves, in any growing unit, are in order; upside down they are not."""
    scene, model = tiny_scene(rng), warped(make_gaussians(rng, 30), rng)
    rendered = rendered_view(scene, model)
    depth = rendered.channel("depth")[..., 0] / np.maximum(rendered.output.alpha, 1e-12)
    depth[rendered.output.alpha < 0.5] = np.nan
    for name, given in (("right", depth**3), ("wrong", -depth)):
        folder = tmp_path / name
        folder.mkdir()
        np.save(folder / "view0.npy", given)
    assert depth_order(rendered, depths=str(tmp_path / "right"), margin=0.0)[0] == 0
    value, v = depth_order(rendered, depths=str(tmp_path / "wrong"), margin=0.0)
    assert value > 0.01 and v.channels["depth"].any() and v.alpha.any()
    with pytest.raises(InputError, match="which view sees which point"):
        depth_order(rendered, depths="", margin=0.0)


# --- from a folder of photographs to images ---


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    """The body, small, as a folder with times."""
    folder = tmp_path_factory.mktemp("scenes") / "body"
    (folder / "images").mkdir(parents=True)
    with pytest.MonkeyPatch.context() as patched:
        for name, value in {"N_GAUSSIANS": 60, "N_FRAMES": 6, "WIDTH": 48, "HEIGHT": 32, "FOCAL": 55.0}.items():
            patched.setattr(bodies, name, value)
        body = bodies.make_body(np.random.default_rng(0))
        scene = bodies.film(body, 0.2)
    frames = []
    for view in (*scene.train_views, *scene.test_views):
        write_image(folder / "images" / f"{view.name}.png", view.image)
        R, t = view.camera.cam_from_world_R, view.camera.cam_from_world_t
        matrix = np.column_stack([R.T * [1.0, -1.0, -1.0], -R.T @ t]).tolist()  # world_from_camera, OpenGL axes
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": matrix, "time": view.time})
    save_ply(folder / "points.ply", body.gaussians)
    content = {"fl_x": 55.0, "fl_y": 55.0, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "body"
    options = ("--recipe", "lucas-kanade", "--iterations", "60", "--set", "n_centers=5", "--test-every", "3")
    assert main(["train", str(scene_folder), *options, "--out", str(folder)]) == 0
    return folder


def test_a_run_has_its_warp(run_folder):
    with np.load(run_folder / "shared.npz") as shared:
        assert shared[SHIFTS].shape == (5, 3, 3) and shared[SHIFTS].any() and shared[TURNS].any()


def test_a_time_is_rendered(run_folder, tmp_path, capsys):
    """The same cameras at two times differ, and at their own times are as without the option."""
    images = {}
    for name, options in {"own": [], "early": ["--time", "0"], "late": ["--time", "1"]}.items():
        out = tmp_path / name
        assert main(["render", str(run_folder), "--cameras", "all", "--out", str(out), *options]) == 0
        images[name] = np.stack([read_image(file).astype(int) for file in sorted(out.glob("*.png"))])
    assert np.abs(images["early"] - images["late"]).max() > 3
    times = [entry.get("time", 0.0) for entry in json.loads((run_folder / "cameras.json").read_text())]
    assert min(times) == 0 and max(times) > 0.5
    assert any(np.array_equal(a, b) for a, b in zip(images["own"], images["early"], strict=True))
    with pytest.raises(SystemExit, match="2"):
        main(["render", str(run_folder), "--time", "noon"])
    assert "'noon' is not a time" in capsys.readouterr().err


def test_a_file_has_no_warp(run_folder, tmp_path, capsys):
    ply, out = str(run_folder / "point_cloud.ply"), str(tmp_path / "out")
    assert main(["render", ply, "--out", out, "--cameras", "orbit", "--frames", "1"]) == 2
    assert "give the folder of the run, or --extension core" in capsys.readouterr().err
    core = ["--extension", "core", "--cameras", "orbit", "--frames", "1"]
    assert main(["render", ply, "--out", out, *core]) == 0


def test_no_sequence_is_refused(scene_folder, tmp_path, capsys):
    content = json.loads((scene_folder / "transforms.json").read_text())
    for frame in content["frames"]:
        del frame["time"]
    still = tmp_path / "still"
    still.mkdir()
    (still / "images").symlink_to(scene_folder / "images")
    (still / "points.ply").symlink_to(scene_folder / "points.ply")
    (still / "transforms.json").write_text(json.dumps(content))
    out = tmp_path / "out"
    assert main(["train", str(still), "--recipe", "lucas-kanade", "--iterations", "9", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "is no sequence" in error and error.count("\n") == 1 and not (out / "point_cloud.ply").exists()
