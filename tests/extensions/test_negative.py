"""Negative Gaussians: shading of either sign and its gradient, where it is 3DGS, the density, training end to end."""

import json
import signal

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref import load_ply, save_ply
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.extension import find_recipe, load_extension
from minisplat_ref.extensions.negative.model import (
    FRACTION,
    SIGNED,
    compute_signed_colors,
    compute_signed_colors_vjp,
    density,
    difference,
    largest_weight,
    negate,
    with_negatives,
)
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import SPLATTING, RenderSettings, Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.strategy.clone_split import prune_faint, prune_large
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.state import Iteration, TrainState, start_again
from minisplat_ref.types import Gaussians, Model, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    DENSITY_GRID,
    GRADIENT_STEP_IMAGE,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
)

BACKGROUND = np.array([0.2, 0.5, 0.9])
DRAW = SIGNED.renderer


def of_colors(colors, **changes):
    """Return balls on the axis of a 9 x 9 camera, nearest first, 2 px wide, with constant colours [N, 3]."""
    n = len(colors)
    fields = {
        "means": np.column_stack([np.zeros((n, 2)), 3.0 + 0.1 * np.arange(n)]),
        "quats": np.tile([1.0, 0, 0, 0], (n, 1)),
        "log_scales": np.full((n, 3), np.log(0.2)),
        "opacity_logits": np.zeros(n),  # opacity 1/2
        "sh_dc": (np.asarray(colors, float) - 0.5) / SH_C0,
        "sh_rest": np.zeros((n, 0, 3)),
    }
    return Gaussians(**{**fields, **changes})


def of_either_sign(rng, n, **options):
    """Return Gaussians whose colours spread around zero, by degree 0 and above."""
    gaussians = make_gaussians(rng, n, **options)
    return gaussians._replace(sh_dc=3 * gaussians.sh_dc - 0.5 / SH_C0)


def small_view():
    return view_from(make_camera(9, 9, fx=30.0, fy=30.0))


def colors_of(gaussians, camera, backend, degree=3):
    radii = np.ones((len(gaussians.means), 2), np.int32)
    return compute_signed_colors(backend, gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, degree, radii)


def drawn(renderer, gaussians, view, backend, **options):
    return renderer.render(Model(gaussians), view, Request(background=BACKGROUND, backend=backend, **options))


# --- closed form ---


def test_a_negative_gaussian_in_front_of_a_positive_one_by_hand(backend):
    front, back = np.array([-0.4, 0.0, 0.3]), np.array([0.9, 0.6, 0.2])
    output, _ = drawn(DRAW, of_colors([front, back]), small_view(), backend)
    expected = 0.5 * front + 0.25 * back + 0.25 * BACKGROUND
    assert expected.min() < 0.5  # not an image that 3DGS could have drawn
    assert_allclose(output.image[4, 4], expected, atol=CLOSED_FORM)
    assert_allclose(output.alpha[4, 4], 0.75, rtol=CLOSED_FORM)  # it takes its part of the transmittance


def test_colors_are_the_polynomial_without_the_clamp(backend, rng):
    gaussians, camera = of_either_sign(rng, 200), make_camera(rng=rng)
    colors = colors_of(gaussians, camera, backend)
    directions = gaussians.means + camera.cam_from_world_R.T @ camera.cam_from_world_t
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    coefficients = np.concatenate([gaussians.sh_dc[:, None], gaussians.sh_rest], axis=1)
    expected = 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, 3), coefficients)
    assert 0.2 < np.mean(expected < 0) < 0.8
    assert ((expected < 0).any(axis=1) & (expected > 0).any(axis=1)).any()  # both signs in one Gaussian
    assert_allclose(colors, expected, atol=CLOSED_FORM)


def test_negated_coefficients_give_the_negative_color(backend, rng):
    gaussians, camera = make_gaussians(rng, 50), make_camera(rng=rng)
    sh_dc, sh_rest = negate(gaussians.sh_dc, gaussians.sh_rest)
    opposite = gaussians._replace(sh_dc=sh_dc, sh_rest=sh_rest)
    colors = colors_of(gaussians, camera, backend)
    assert np.abs(colors).min() > 0
    assert_allclose(colors_of(opposite, camera, backend), -colors, atol=CLOSED_FORM)


# --- the degenerate case ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_where_all_colors_are_positive_it_is_3dgs_exactly(backend, dtype, rng):
    gaussians = make_gaussians(rng, 40, size=0.3)
    positive = as_dtype(gaussians._replace(sh_dc=np.abs(gaussians.sh_dc) + 4.0), dtype)  # 1.1 and more, less 0.3 sums
    view = view_from(make_camera(rng=rng))
    assert colors_of(positive, view.camera, REFERENCE).min() > 0
    ours, tape = drawn(DRAW, positive, view, backend, wants=frozenset({"depth", "stats"}))
    theirs, other = drawn(SPLATTING, positive, view, backend, wants=frozenset({"depth", "stats"}))
    assert ours.alpha.mean() > COVERAGE_MIN
    assert_array_equal(ours.image, theirs.image)
    v_image = rng.normal(size=ours.image.shape).astype(dtype)
    gradients = [renderer.render_vjp(t, v_image, None) for renderer, t in ((DRAW, tape), (SPLATTING, other))]
    arrays = [(*gradient.gaussians, *gradient[1:5]) for gradient in gradients]  # shared is the last, and empty
    for a, b in zip(*arrays, strict=True):
        assert_array_equal(a, b)


def test_with_negative_colors_it_is_not_3dgs(backend, rng):
    gaussians, view = make_gaussians(rng, 40, size=0.3), view_from(make_camera(rng=rng))
    ours, theirs = (drawn(renderer, gaussians, view, backend)[0].image for renderer in (DRAW, SPLATTING))
    assert (theirs - ours).max() > 0.1  # darker where colours are negative
    assert (theirs - ours).min() >= 0


def test_culled_gaussians_have_no_color(backend, rng):
    gaussians, camera = of_either_sign(rng, 6), make_camera()
    radii = np.ones((6, 2), np.int32)
    radii[::2] = 0
    colors = compute_signed_colors(backend, gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, 3, radii)
    assert not colors[::2].any() and (colors[1::2] < 0).any()


# --- gradient ---


def test_gradient_through_the_renderer(backend, rng):
    view = view_from(make_camera(rng=rng))
    gaussians = of_either_sign(rng, 30, size=0.2)
    colors = colors_of(gaussians, view.camera, backend)
    assert 0.2 < np.mean(colors < 0) < 0.8 and ((colors < 0).any(axis=1) & (colors > 0).any(axis=1)).any()
    camera = view.camera
    names = [*Gaussians._fields, "background", "R", "t"]
    inputs = (*gaussians, BACKGROUND, camera.cam_from_world_R, camera.cam_from_world_t)
    hit_counts = []

    def run(*arrays):
        *fields, background, R, t = arrays
        moved = view._replace(camera=camera._replace(cam_from_world_R=R, cam_from_world_t=t))
        request = Request(background=background, backend=backend, wants=frozenset({"depth", "stats"}))
        return DRAW.render(Model(Gaussians(*fields)), moved, request)

    def function(*arrays):
        output, _ = run(*arrays)
        hit_counts.append(output.stats.hit_count)
        assert_array_equal(hit_counts[-1], hit_counts[0], "a hit came or went: take a smaller step")
        return output.image, output.alpha

    output, tape = run(*inputs)
    assert output.alpha.mean() > COVERAGE_MIN and output.image[..., :3].min() < 0
    cotangents = (rng.normal(size=output.image.shape), rng.normal(size=output.alpha.shape))
    v = DRAW.render_vjp(tape, *cotangents)
    gradients = (*v.gaussians, v.background, v.cam_from_world_R, v.cam_from_world_t)
    check_inner_products(function, gradients, inputs, cotangents, rng, names=names, step=GRADIENT_STEP_IMAGE)


@pytest.mark.parametrize("color", [-0.7, 0.0, 0.4, 1.3])
def test_color_has_its_gradient_on_either_side_of_zero_and_at_it(backend, color):
    # dc/d(sh_dc) is Y_0 whatever the colour; 3DGS's is zero from c = 0 down.
    gaussians, camera = of_colors([[color] * 3]), small_view().camera
    radii, v_colors = np.ones((1, 2), np.int32), np.array([[1.0, -2.0, 0.5]])
    arguments = (gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, 0, radii)
    assert_allclose(compute_signed_colors(backend, *arguments), [[color] * 3], atol=CLOSED_FORM)
    assert_allclose(compute_signed_colors_vjp(backend, *arguments, v_colors).sh_dc, SH_C0 * v_colors, rtol=CLOSED_FORM)


def test_each_gaussian_has_its_own_degree_on_either_side_of_zero(backend):
    """Seen along (0.6, 0, 0.8), where degree 1 is ``C (0, 0.8, -0.6)``, in a camera that is turned.

    A last coefficient of 2 takes 1.2 C = 0.5863230 from a colour of degree 1, and nothing from one of degree 0.
    """
    C, camera, n = 0.4886025119029199, turned_camera(), 4
    base, degrees = np.array([0.9, -0.3, 0.1, -0.3]), np.array([1, 0, 1, 1])
    gaussians = balls(in_front_of(camera, [0, 0, 0]) + 3 * np.array([[0.6, 0, 0.8]] * n), np.ones(n), [0.5] * n)
    rest = np.zeros((n, 3, 3))
    rest[:, 2] = 2
    dc = np.repeat((base[:, None] - 0.5) / SH_C0, 3, axis=1)
    arguments = (backend, gaussians.means, dc, rest, camera, degrees, np.ones((n, 2), np.int32))
    expected = [0.9 - 1.2 * C, -0.3, 0.1 - 1.2 * C, -0.3 - 1.2 * C]
    assert_allclose(compute_signed_colors(*arguments), np.repeat(np.array(expected)[:, None], 3, axis=1), atol=1e-12)
    v = compute_signed_colors_vjp(*arguments, np.ones((n, 3)))
    assert_allclose(v.sh_dc, SH_C0, rtol=CLOSED_FORM)
    assert_allclose(v.sh_rest[:, :, 0], np.outer([1, 0, 1, 1], [0, 0.8 * C, -0.6 * C]), atol=1e-12)


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_parity_with_the_reference(fast_backend, dtype, rng):
    gaussians, view = as_dtype(of_either_sign(rng, 60, size=0.25), dtype), view_from(make_camera(rng=rng))
    ours, tape = drawn(DRAW, gaussians, view, fast_backend)
    theirs, other = drawn(DRAW, gaussians, view, REFERENCE)
    assert theirs.alpha.mean() > COVERAGE_MIN and theirs.image.min() < 0
    image, gradient = (
        (PARITY_FLOAT32_IMAGE, PARITY_FLOAT32_GRADIENT) if dtype == np.float32 else (PARITY_FLOAT64, PARITY_FLOAT64)
    )
    assert ours.image.dtype == dtype
    assert_allclose(ours.image, theirs.image, atol=image * np.abs(theirs.image).max())
    v_image = rng.normal(size=ours.image.shape).astype(dtype)
    v, v_reference = DRAW.render_vjp(tape, v_image, None), DRAW.render_vjp(other, v_image, None)
    for name, field, expected in zip(Gaussians._fields, v.gaussians, v_reference.gaussians, strict=True):
        assert field.dtype == dtype and expected.any()
        assert_allclose(field, expected, atol=gradient * np.abs(expected).max(), err_msg=name)


# --- the beginning, pruning, files ---


def test_a_fifth_begins_with_the_negative_of_its_color(rng):
    gaussians = as_dtype(of_colors(rng.uniform(0.1, 1, (50, 3))), np.float32)
    extended = with_negatives(gaussians, rng, fraction=FRACTION)
    colors, others = (0.5 + SH_C0 * g.sh_dc for g in (gaussians, extended))
    is_negative = (others < 0).any(axis=1)
    assert np.count_nonzero(is_negative) == 10 and extended.sh_dc.dtype == np.float32
    assert_allclose(others[is_negative], -colors[is_negative], atol=PARITY_FLOAT32_IMAGE)
    assert_array_equal(others[~is_negative], colors[~is_negative])
    assert colors.min() > 0  # the population that came in is as it was
    assert_array_equal(extended.means, gaussians.means)


@pytest.mark.parametrize(("n", "n_negative"), [(12, 2), (13, 3)])
def test_the_number_of_negatives_is_rounded(n, n_negative, rng):
    """A fifth is 2.4 and 2.6."""
    extended = with_negatives(of_colors(np.full((n, 3), 0.5)), rng, fraction=0.2)
    assert np.count_nonzero(extended.sh_dc[:, 0] < 0) == n_negative


def test_the_negative_of_a_colour_is_negative_in_every_direction(rng):
    """Of ten Gaussians two are negated, with degrees 0 and 1: seen along (0.6, 0, 0.8) and from the other side."""
    C, gaussians = 0.4886025119029199, of_either_sign(rng, 10, sh_degree=1)
    negated = with_negatives(gaussians, rng, fraction=0.2)
    for sign in (1, -1):
        Y = sign * C * np.array([0, 0.8, -0.6])
        before, after = (0.5 + SH_C0 * g.sh_dc + np.einsum("k,nkc->nc", Y, g.sh_rest) for g in (gaussians, negated))
        is_changed = (before != after).any(axis=1)
        assert is_changed.sum() == 2
        assert_allclose(after[is_changed], -before[is_changed], atol=CLOSED_FORM)


def test_a_reinitialisation_begins_with_negatives_too(rng):
    fresh = as_dtype(of_colors(np.full((30, 3), 0.5)), np.float32)
    state = TrainState(fresh, zero_moments(fresh), 0, [], rng, {})
    iteration = Iteration(*[None] * 5, RenderSettings(), find_recipe("negative").representation)
    start_again(state, iteration, fresh)
    assert np.count_nonzero(0.5 + SH_C0 * state.gaussians.sh_dc[:, 0] < 0) == 6


def test_pruning_does_not_look_at_the_color():
    gaussians = of_colors([[-0.5] * 3, [0.0] * 3, [1e-3] * 3, [0.8] * 3])
    faint = gaussians._replace(opacity_logits=np.array([0.0, 0, 0, -9]))
    assert_array_equal(prune_faint(faint, min_opacity=0.005).parent_ids, [0, 1, 2])
    assert_array_equal(prune_large(gaussians, size_limit=0.3).parent_ids, [0, 1, 2, 3])


def test_ply_keeps_negative_colors(tmp_path, rng):
    gaussians = as_dtype(of_colors(rng.uniform(-1, 1, (20, 3))), np.float32)
    save_ply(tmp_path / "a.ply", gaussians)
    loaded = load_ply(tmp_path / "a.ply", SIGNED.population)
    assert (gaussians.sh_dc < -0.5 / SH_C0).any()
    assert_array_equal(loaded.sh_dc, gaussians.sh_dc)


# --- the density ---

NARROWER = (np.array([0.3, -0.2]), np.array([[0.5, 0.1], [0.1, 0.3]]))
POSITIVE = (np.zeros(2), np.array([[1.2, -0.3], [-0.3, 0.9]]))


@pytest.mark.parametrize("mean1", [NARROWER[0], POSITIVE[0]], ids=["apart", "same mean"])
def test_largest_weight_is_the_least_quotient(mean1):
    negative = (mean1, NARROWER[1])
    axis = np.linspace(-5, 5, 401)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    quotients = density(points, *POSITIVE) / density(points, *negative)
    bound = largest_weight(*POSITIVE, *negative)
    assert 0.1 < bound < 1
    assert bound <= quotients.min() and quotients.min() - bound < DENSITY_GRID * bound
    at_most = difference(points, *POSITIVE, *negative, bound)
    assert at_most.min() > -CLOSED_FORM
    assert difference(points, *POSITIVE, *negative, 1.02 * bound).min() < -1e-4  # beyond it is none
    assert_allclose(at_most.sum() * (axis[1] - axis[0]) ** 2, 1, atol=DENSITY_GRID)


def test_equal_means_leave_the_root_of_the_determinants():
    bound = largest_weight(*POSITIVE, POSITIVE[0], NARROWER[1])
    assert_allclose(bound, np.sqrt(np.linalg.det(NARROWER[1]) / np.linalg.det(POSITIVE[1])), rtol=CLOSED_FORM)


def test_a_wider_negative_gaussian_leaves_no_weight():
    wider = np.diag([0.5, 1.5])  # in one direction only
    assert largest_weight(*POSITIVE, POSITIVE[0], wider) == 0
    far = np.array([[0.0, 30.0]])
    assert density(far, *POSITIVE) / density(far, POSITIVE[0], wider) < 1e-9


def test_equally_wide_in_one_direction():
    covariance1 = np.diag([0.25, 1.0])
    assert_allclose(largest_weight(np.zeros(2), np.eye(2), np.zeros(2), covariance1), 0.5, rtol=CLOSED_FORM)
    assert largest_weight(np.zeros(2), np.eye(2), np.array([0.0, 0.1]), covariance1) == 0
    shifted = largest_weight(np.zeros(2), np.eye(2), np.array([0.3, 0.0]), covariance1)
    assert_allclose(shifted, 0.5 * np.exp(-0.5 * 0.09 / 0.75), rtol=CLOSED_FORM)


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
TRAIN = ["--recipe", "negative", "--test-every", "4", "--seed", "3"]


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "finished"
    assert main(["train", str(scene_folder), *TRAIN, "--iterations", "30", "--out", str(folder)]) == 0
    return folder


def test_trains_renders_and_evaluates(run_folder, scene_folder, tmp_path, capsys):
    gaussians = load_ply(run_folder / "point_cloud.ply")
    assert (0.5 + SH_C0 * gaussians.sh_dc < 0).any()
    psnr = json.loads((run_folder / "metrics.json").read_text())["psnr"]
    assert main(["eval", str(run_folder)]) == 0
    assert json.loads((run_folder / "metrics.json").read_text())["psnr"] == psnr
    assert main(["render", str(run_folder), "--out", str(tmp_path / "views")]) == 0
    assert len(list((tmp_path / "views").glob("*.png"))) == 2
    losses = [json.loads(line)["loss"] for line in (run_folder / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]


def test_a_ply_is_drawn_with_its_extension(run_folder, tmp_path):
    ply, options = str(run_folder / "point_cloud.ply"), ["--cameras", str(run_folder / "cameras.json")]
    for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
        assert main(["render", ply, *options, *extension, "--out", str(tmp_path / name)]) == 0
    images = [{p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} for name in ("ours", "theirs")]
    assert images[0].keys() == images[1].keys() and images[0] != images[1]


def test_interrupted_then_resumed_gives_the_bytes_of_an_uninterrupted_run(
    scene_folder, run_folder, tmp_path, monkeypatch
):
    report_step = Progress.__call__

    def press_ctrl_c(progress, report):
        report_step(progress, report)
        if report.step == 17:
            signal.raise_signal(signal.SIGINT)

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", press_ctrl_c)
        assert main(["train", str(scene_folder), *TRAIN, "--iterations", "30", "--out", str(folder)]) == 130
    assert (folder / "point_cloud.ply").read_bytes() != (run_folder / "point_cloud.ply").read_bytes()
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()


def test_extension_is_found():
    extension = load_extension("negative")
    assert [recipe.name for recipe in extension.recipes] == ["negative"]
    assert find_recipe("mini-splatting", extension="negative").representation is SIGNED
