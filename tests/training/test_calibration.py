"""Exposure and pose of each photograph: closed forms, gradients, what they leave alone, and that they are recovered."""

import argparse
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm

from data_tools.claims import exposure as exposures_study
from data_tools.claims import find_claim
from data_tools.claims import pose as poses_study
from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io.images import read_image
from minisplat_ref.methods import get_recipe
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.calibration import (
    ANGLE_MIN,
    EXPOSURES,
    ROTATIONS,
    SHIFTS,
    correct_pose,
    correct_pose_vjp,
    expose,
    expose_vjp,
    identity_exposures,
    left_jacobian,
    with_exposures,
    with_poses,
    zero_corrections,
)
from minisplat_ref.types import Model, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    GRADIENT_REL,
    GRADIENT_STEP_IMAGE,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PRINTED_DIGITS,
)

N_VIEWS, INDEX = 3, 1
CALIBRATED = with_poses(with_exposures(SPLATTING))
BACKGROUND = np.array([0.2, 0.5, 0.8])
DEPTH = frozenset({"depth"})

# Angles with their own formula each: none, rounding alone, both sides of the series' limit, usual, half a turn.
ANGLES = (0.0, 1e-9, 1e-5, 0.9 * ANGLE_MIN, 1.1 * ANGLE_MIN, 1.0, np.pi - 1e-6)

# A Jacobian by central differences with a step of 1e-6: 1e-12 times third derivatives of order 1, 1e-16 by 1e-6.
JACOBIAN_BY_DIFFERENCES = 1e-9


@pytest.fixture
def view(rng):
    return view_from(make_camera(rng=rng))._replace(view_id=INDEX)


@pytest.fixture
def model(rng):
    """Float64, with exposures and corrections that are far from doing nothing."""
    exposures = identity_exposures(N_VIEWS)[EXPOSURES] + 0.2 * rng.normal(size=(N_VIEWS, 3, 4))
    corrections = {ROTATIONS: 0.1 * rng.normal(size=(N_VIEWS, 3)), SHIFTS: 0.1 * rng.normal(size=(N_VIEWS, 3))}
    return Model(make_gaussians(rng, 12), {EXPOSURES: exposures, **corrections})


def request(backend=REFERENCE, wants=frozenset()):
    return Request(BACKGROUND, backend=backend, wants=wants)


def image_of(renderer, model, view, wants=frozenset(), backend=REFERENCE):
    return renderer.render(model, view, request(backend, wants))[0].image


def cross_matrix(w):
    """[w]_x by its definition: its product with a vector is the cross product."""
    return np.cross(w, np.eye(3), axisb=0, axisc=0)


def rotation_vector(rng, angle):
    w = rng.normal(size=3)
    return angle * w / np.linalg.norm(w)


# Closed form ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nothing_to_calibrate_changes_no_byte(backend, rng, view, dtype):
    gaussians = as_dtype(make_gaussians(rng, 12), dtype)
    model = Model(gaussians, {**identity_exposures(N_VIEWS), **zero_corrections(N_VIEWS)})
    plain = image_of(SPLATTING, model, view, DEPTH, backend)
    calibrated = image_of(CALIBRATED, model, view, DEPTH, backend)
    assert plain.std() > 0.1
    assert calibrated.dtype == plain.dtype == dtype and calibrated.tobytes() == plain.tobytes()


def test_exposure_by_hand():
    """Red becomes half of red and a tenth; green takes all of blue; blue is 1 - green."""
    exposure = np.array([[0.5, 0, 0, 0.1], [0, 0, 1, 0], [0, -1, 0, 1]])
    assert_allclose(expose(np.array([[[0.2, 0.3, 0.4]]]), exposure), [[[0.2, 0.4, 0.7]]], rtol=CLOSED_FORM)


def test_image_is_mapped_and_the_background_with_it(backend, model, view):
    """What is seen is mapped, through an empty scene the background alone."""
    only_exposures = model._replace(shared={EXPOSURES: model.shared[EXPOSURES]})
    A, b = np.split(model.shared[EXPOSURES][INDEX], [3], axis=1)
    plain = image_of(SPLATTING, model, view, backend=backend)
    expected = np.array([[A @ color + b[:, 0] for color in row] for row in plain])
    assert_allclose(image_of(CALIBRATED, only_exposures, view, backend=backend), expected, atol=CLOSED_FORM)
    empty = only_exposures._replace(gaussians=make_gaussians(np.random.default_rng(0), 0))
    assert_allclose(image_of(CALIBRATED, empty, view)[3, 4], A @ BACKGROUND + b[:, 0], rtol=CLOSED_FORM)


def test_depth_is_not_exposed(model, view):
    only_exposures = model._replace(shared={EXPOSURES: model.shared[EXPOSURES]})
    plain, exposed = (image_of(r, only_exposures, view, DEPTH) for r in (SPLATTING, CALIBRATED))
    assert plain[..., 3].std() > 0.1
    assert_array_equal(exposed[..., 3], plain[..., 3])
    assert np.abs(exposed[..., :3] - plain[..., :3]).mean() > 0.01


def test_the_inner_image_is_not_written_to(model, view):
    """The wrapped renderer's tape holds the image that it made."""
    made = []

    def render(model, view, request):
        output, tape = SPLATTING.render(model, view, request)
        made.append((output.image, output.image.copy()))
        return output, tape

    image_of(with_exposures(SPLATTING._replace(render=render)), model, view)
    assert_array_equal(*made[0])


def test_quarter_turn_by_hand():
    """Turning the camera frame by 90 degrees about z takes x to y: (x, y, z) becomes (-y, x, z)."""
    R, t = np.eye(3), np.array([1.0, 2.0, 3.0])
    w, u = np.array([0, 0, np.pi / 2]), np.array([0.1, 0.2, 0.3])
    corrected_R, corrected_t = correct_pose(R, t, w, u)
    assert_allclose(corrected_R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=CLOSED_FORM)
    assert_allclose(corrected_t, [-2 + 0.1, 1 + 0.2, 3 + 0.3], rtol=CLOSED_FORM)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_is_the_exponential(rng, angle):
    R, t, w = make_camera(rng=rng).cam_from_world_R, rng.normal(size=3), rotation_vector(rng, angle)
    Q = expm(cross_matrix(w))
    corrected_R, corrected_t = correct_pose(R, t, w, np.zeros(3))
    assert_allclose(corrected_R, Q @ R, atol=CLOSED_FORM)
    assert_allclose(corrected_t, Q @ t, atol=CLOSED_FORM)


def test_corrected_view_is_that_of_the_corrected_camera(backend, model, view):
    only_poses = model._replace(shared={name: model.shared[name] for name in (ROTATIONS, SHIFTS)})
    camera = view.camera
    Q, u = expm(cross_matrix(model.shared[ROTATIONS][INDEX])), model.shared[SHIFTS][INDEX]
    moved = camera._replace(
        cam_from_world_R=Q @ camera.cam_from_world_R, cam_from_world_t=Q @ camera.cam_from_world_t + u
    )
    expected = image_of(SPLATTING, model, view_from(moved), backend=backend)
    got = image_of(CALIBRATED, only_poses, view, backend=backend)
    assert np.abs(expected - image_of(SPLATTING, model, view, backend=backend)).mean() > 0.01
    assert_allclose(
        got, expected, atol=1e3 * CLOSED_FORM
    )  # the poses differ by 1e-16, edges magnify it by focal / size


def test_view_that_is_not_trained_on_has_neither(model, view):
    """Held-out views and cameras of one's own have no row: not the last one, which -1 would index."""
    held_out = view._replace(view_id=-1)
    assert_array_equal(image_of(CALIBRATED, model, held_out), image_of(SPLATTING, model, held_out))
    _, tape = CALIBRATED.render(model, held_out, request())
    v_image = np.ones((view.camera.height, view.camera.width, 3))
    _, plain_tape = SPLATTING.render(model, held_out, request())
    v, plain = CALIBRATED.render_vjp(tape, v_image, None), SPLATTING.render_vjp(plain_tape, v_image, None)
    assert dict(v.shared) == {}
    assert_array_equal(v.gaussians.means, plain.gaussians.means)


# Gradients ------------------------------------------------------------------------------------------------------------


def test_gradient_of_exposure(rng):
    colors, exposure = rng.random((3, 4, 3)), rng.normal(size=(3, 4))

    def vjp(v_exposed):
        return expose_vjp(colors, exposure, v_exposed)

    check_jacobian(lambda *x: (expose(*x),), vjp, [colors, exposure], names=["colors", "exposure"])


def test_sums_over_pixels_do_not_lose_digits(rng):
    """Two million float32 pixels: adding them up one after the other in float32 would leave four digits."""
    colors = rng.random((1080, 1920, 3), np.float32)
    v_exposed = (1e-7 * rng.normal(size=colors.shape) + 1e-8).astype(np.float32)
    _, v_exposure = expose_vjp(colors, np.eye(3, 4, dtype=np.float32), v_exposed)
    v, c = (
        v_exposed.reshape(-1, 3).astype(float),
        np.pad(colors.reshape(-1, 3).astype(float), ((0, 0), (0, 1)), constant_values=1),
    )
    assert_allclose(v_exposure, v.T @ c, rtol=0, atol=1e-6 * np.abs(v.T @ c).max())


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_the_derivative_of_the_exponential(rng, angle):
    w, step = rotation_vector(rng, angle), 1e-6
    columns = []
    for direction in np.eye(3):
        up, down = (expm(cross_matrix(w + sign * step * direction)) for sign in (1, -1))
        turn = (up - down) / (2 * step) @ expm(cross_matrix(w)).T  # [J e_k]_x
        columns.append([turn[2, 1], turn[0, 2], turn[1, 0]])
    assert_allclose(left_jacobian(w), np.stack(columns, axis=1), atol=JACOBIAN_BY_DIFFERENCES)


def test_left_jacobian_has_no_step_where_the_series_ends(rng):
    """The two formulas meet: a difference between them would be one of the gradient, too small to see otherwise."""
    axis = rotation_vector(rng, 1.0)
    below, above = (left_jacobian(ANGLE_MIN * (1 + side * 1e-12) * axis) for side in (-1, 1))
    assert_allclose(below, above, rtol=0, atol=3e-16)  # what 1e-12 of the angle changes, and a rounding


@pytest.mark.parametrize("angle", ANGLES)
def test_gradient_of_the_pose(rng, angle):
    R, t = make_camera(rng=rng).cam_from_world_R, rng.normal(size=3)
    w, u = rotation_vector(rng, angle), rng.normal(size=3)

    def vjp(v_R, v_t):
        return correct_pose_vjp(R, t, w, v_R, v_t)

    check_jacobian(lambda w, u: correct_pose(R, t, w, u), vjp, [w, u], names=["rotation", "shift"])


@pytest.mark.parametrize("wants", [frozenset(), DEPTH], ids=["rgb", "rgb and depth"])
def test_gradient_through_the_whole_renderer(rng, model, view, wants):
    """Everything at once: the population, the exposures and the corrections, whichever channels there are."""
    names = [*model.gaussians._fields, EXPOSURES, ROTATIONS, SHIFTS]
    inputs = [*model.gaussians, *(model.shared[name] for name in names[-3:])]

    def outputs(*values):
        shared = dict(zip(names[-3:], values[-3:], strict=True))
        output, tape = CALIBRATED.render(Model(model.gaussians._make(values[:-3]), shared), view, request(wants=wants))
        return (output.image, output.alpha), tape

    (image, alpha), tape = outputs(*inputs)
    cotangents = [rng.normal(size=image.shape), rng.normal(size=alpha.shape)]
    v = CALIBRATED.render_vjp(tape, *cotangents)
    assert set(v.shared) == {EXPOSURES, ROTATIONS, SHIFTS}
    for name in v.shared:
        assert not np.delete(v.shared[name], INDEX, axis=0).any()  # the other photographs have nothing to do with it
    gradients = [*v.gaussians, *(v.shared[name] for name in names[-3:])]
    check_inner_products(
        lambda *values: outputs(*values)[0], gradients, inputs, cotangents, rng, names=names, step=GRADIENT_STEP_IMAGE
    )


def test_backends_agree(rng, model, view, fast_backend):
    single = Model(as_dtype(model.gaussians, np.float32), model.shared)
    results = []
    v_image = rng.normal(size=(view.camera.height, view.camera.width, 4)).astype(np.float32)
    for backend in (REFERENCE, fast_backend):
        output, tape = CALIBRATED.render(single, view, request(backend, DEPTH))
        results.append((output.image, CALIBRATED.render_vjp(tape, v_image, None).shared))
    (expected, v_expected), (got, v_got) = results
    assert_allclose(got, expected, rtol=0, atol=PARITY_FLOAT32_IMAGE * np.abs(expected).max())
    for name, v in v_expected.items():
        assert np.abs(v).max() > 0.1
        assert_allclose(v_got[name], v, rtol=0, atol=PARITY_FLOAT32_GRADIENT * np.abs(v).max(), err_msg=name)


def test_order_of_wrapping_does_not_matter(rng, model, view):
    v_image = rng.normal(size=(view.camera.height, view.camera.width, 3))
    other = with_exposures(with_poses(SPLATTING))
    results = []
    for renderer in (CALIBRATED, other):
        output, tape = renderer.render(model, view, request(CPU))
        results.append((output.image, renderer.render_vjp(tape, v_image, None).shared))
    assert_array_equal(results[0][0], results[1][0])
    assert results[0][1].keys() == results[1][1].keys()
    for name, v in results[0][1].items():
        assert_allclose(results[1][1][name], v, rtol=GRADIENT_REL)


# Recovery -------------------------------------------------------------------------------------------------------------
# Photographs of 64 x 48 pixels and 300 iterations without density control: seconds. The studies do the same at length.


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=12, width=64, height=48, n_points=1500, test_every=4).scene


BRIEFLY = get_recipe("3dgs-accel", 300)._replace(events=())


def test_common_map_is_found_exactly(rng):
    """Maps that differ from the true ones by a common map, and by nothing else, have no error."""
    exposures = np.eye(3, 4) + 0.2 * rng.normal(size=(5, 3, 4))
    K = np.eye(3, 4) + 0.2 * rng.normal(size=(3, 4))
    color = rng.random(3)
    truth = exposures_study.compose(exposures, K)
    assert_allclose(expose(expose(color, K), exposures[2]), expose(color, truth[2]), rtol=CLOSED_FORM)
    assert_allclose(exposures_study.common_map(exposures, truth), K, atol=1e2 * CLOSED_FORM)  # by a 15 x 3 system
    assert_allclose(expose(expose(color, K), exposures_study.inverse(K)), color, rtol=1e2 * CLOSED_FORM)


def test_color_error_by_hand(rng):
    """An offset of 0.1 in every channel is an error of 0.1; twice the colour is one of the colours' own size."""
    colors, identity = rng.random((7, 3)), np.eye(3, 4)[None]
    brighter, twice = identity + 0.1 * np.array([0, 0, 0, 1.0]), 2 * identity
    assert_allclose(exposures_study.color_errors(brighter, identity, colors), [0.1], rtol=1e2 * CLOSED_FORM)
    assert_allclose(
        exposures_study.color_errors(twice, identity, colors), [np.sqrt((colors**2).mean())], rtol=CLOSED_FORM
    )


def test_exposures_are_recovered(scene):
    result = exposures_study.measure(scene, BRIEFLY, seed=0)
    levels = {arm: np.mean(row["levels"]) for arm, row in result.items()}
    assert levels["undisturbed"] < 1e-9
    assert levels["disturbed"] > 15  # of 255
    assert levels["calibrated"] < 0.25 * levels["disturbed"]  # measured: a sixth
    psnr = {arm: row["psnr"] for arm, row in result.items()}
    lost = psnr["undisturbed"] - psnr["disturbed"]
    assert lost > 1.0
    assert psnr["calibrated"] > psnr["disturbed"] + 0.7 * lost  # measured: nine tenths of what was lost


def test_similarity_is_found_exactly(rng):
    """Cameras that are all moved by one similarity are the same cameras, and see the same."""
    truth = [make_camera(rng=rng) for _ in range(5)]
    similarity = poses_study.Similarity(1.3, expm(cross_matrix(rng.normal(size=3))), rng.normal(size=3))
    given = [poses_study.carry_back(camera, similarity) for camera in truth]
    found = poses_study.align(given, truth)
    for field, expected in zip(found, similarity, strict=True):
        assert_allclose(field, expected, atol=1e3 * CLOSED_FORM)  # centres are 0.1 apart
    aligned = [poses_study.carry(camera, found) for camera in given]
    degrees, shifts = poses_study.errors(aligned, truth)
    assert max(degrees) < 1e-5 and max(shifts) < 1e3 * CLOSED_FORM  # an angle of 1e-13 radians is a cosine of 1
    point = rng.normal(size=3)
    in_trained_scene = similarity.S.T @ (point - similarity.d) / similarity.s
    for camera, other in zip(truth, given, strict=True):
        x_true = camera.cam_from_world_R @ point + camera.cam_from_world_t
        x = other.cam_from_world_R @ in_trained_scene + other.cam_from_world_t
        assert_allclose(similarity.s * x, x_true, atol=1e2 * CLOSED_FORM)  # the same pixel


def test_disturbance_is_as_large_as_it_says(scene):
    disturbance = poses_study.Disturbance(degrees=1.0, shift=0.01)
    disturbed = poses_study.disturb_poses(scene, disturbance, np.random.default_rng(0))
    cameras, truth = ([view.camera for view in s.train_views] for s in (disturbed, scene))
    degrees, _ = poses_study.errors(cameras, truth)
    assert_allclose(degrees, 1.0, rtol=1e-9)  # an angle from a matrix loses half the digits of a small one
    for camera, true in zip(cameras, truth, strict=True):
        Q = camera.cam_from_world_R @ true.cam_from_world_R.T
        shift = camera.cam_from_world_t - Q @ true.cam_from_world_t
        assert_allclose(np.linalg.norm(shift), 0.01 * scene.extent, rtol=1e2 * CLOSED_FORM)


def test_poses_are_recovered(scene):
    result = poses_study.measure(scene, BRIEFLY, poses_study.Disturbance(degrees=1.0, shift=0.01), seed=0)
    mean = {arm: {key: np.mean(row[key]) for key in ("degrees", "shifts", "pixels")} for arm, row in result.items()}
    assert mean["disturbed"]["degrees"] > 0.9 and mean["disturbed"]["pixels"] > 0.7
    # measured: a half, two thirds and a quarter of the error are left; a pixel is a degree
    for key, part in (("degrees", 0.65), ("shifts", 0.8), ("pixels", 0.4)):
        assert mean["calibrated"][key] < part * mean["disturbed"][key], key
    psnr = {arm: row["psnr"] for arm, row in result.items()}
    lost = psnr["undisturbed"] - psnr["disturbed"]
    assert lost > 1.0
    assert psnr["calibrated"] > psnr["disturbed"] + 0.7 * lost  # measured: six sevenths of what was lost


@pytest.mark.parametrize("study", [find_claim("exposure"), find_claim("pose")], ids=lambda study: study.name)
def test_studies_write_what_they_print(study, tmp_path, capsys):
    parser = argparse.ArgumentParser()
    study.add_arguments(parser)
    out = tmp_path / "out"
    args = ["room", "--out", str(out), "--iterations", "5", "--views", "6", "--width", "32"]
    assert not study.run(parser.parse_args(args))
    (result,) = out.glob("*.json")
    (figure,) = out.glob("*.png")
    arms = json.loads(result.read_text())["arms"]
    assert list(arms) == ["undisturbed", "disturbed", "calibrated"]
    assert read_image(figure).std() > 1
    rows = [line.strip("| ").split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    for arm, row in zip(arms, rows[2:], strict=True):
        assert row[0].strip() == arm
        assert abs(float(row[-1]) - arms[arm]["psnr"]) < 100 * PRINTED_DIGITS


def test_study_needs_held_out_views_and_a_small_disturbance(tmp_path):
    parser = argparse.ArgumentParser()
    find_claim("pose").add_arguments(parser)
    with pytest.raises(InputError, match="--degrees is 100"):
        find_claim("pose").run(parser.parse_args(["room", "--out", str(tmp_path / "out"), "--degrees", "100"]))
    assert not (tmp_path / "out").exists()
