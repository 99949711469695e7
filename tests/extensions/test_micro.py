"""Micro-splatting: the trace penalty, detail, children, merging, where it is 3DGS, training end to end."""

import json
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from actions import act, scene_of, state_of
from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.extension import find_recipe, load_extension
from minisplat_ref.extensions.micro.model import (
    are_alike,
    box_means,
    detail_map,
    trace_penalty,
    trace_penalty_vjp,
    traces,
)
from minisplat_ref.extensions.micro.recipe import (
    clone_and_split_by_detail,
    clusters,
    halve_children,
    halve_large,
    merge_alike,
    prune_least,
)
from minisplat_ref.methods.gaussian_splatting import prune_large
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import At, During, Every, does
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Gaussians, Model, Scene, View, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, SAMPLE_MEAN

OFF = {"trace": 0.0, "beta": 0.0, "score_mass": 1.0, "merge_reach": 0.0}


def balls(centres, sizes, colors=None):
    n = len(sizes)
    return Gaussians(
        np.asarray(centres, float),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.log(np.repeat(np.asarray(sizes, float)[:, None], 3, axis=1)),
        np.zeros(n),
        (np.zeros((n, 3)) if colors is None else np.asarray(colors) / SH_C0),
        np.zeros((n, 0, 3)),
    )


# --- the penalty ---


def test_the_penalty_by_hand():
    log_scales = np.log([[1.0, 2.0, 2.0], [0.1, 0.1, 0.1], [3.0, 0.0001, 0.0001]])  # traces 9, 0.03, 9
    assert_allclose(traces(log_scales), [9, 0.03, 9.00000002], rtol=CLOSED_FORM)
    assert_allclose(trace_penalty(log_scales, 3.0), (2 + 0 + 2 + 2e-8 / 3) / 3, rtol=CLOSED_FORM)
    v = trace_penalty_vjp(log_scales, 3.0, 2.0)
    assert_allclose(v[0], 2 * np.array([2, 8, 8]) / 9, rtol=CLOSED_FORM)
    assert_array_equal(v[1], 0)


def test_the_gradient_of_the_penalty(rng):
    log_scales = rng.normal(size=(6, 3))
    limit = float(np.median(traces(log_scales)))
    assert 0 < np.count_nonzero(traces(log_scales) > limit) < 6
    check_jacobian(
        lambda x: (np.asarray(trace_penalty(x, limit)),),
        lambda v: (trace_penalty_vjp(log_scales, limit, float(v)),),
        [log_scales],
        names=["log_scales"],
    )


def test_the_recipe_penalises_deviations_beyond_a_share_of_the_extent():
    """In a scene of extent 3, tau is (0.05 * 3)^2 = 0.0225; a ball of deviation 0.1 has the trace 0.03, a third more.

    The mean over two balls is a sixth; the slope for each axis of the large one is 2 * 0.01 / 0.0225 / 2 = 4 / 9.
    """
    gaussians = balls(np.zeros((2, 3)), [0.1, 0.05])
    (term,) = (term for term in find_recipe("micro").losses if term.name == "trace")
    value, cotangents = term.function(Rendered(None, {}, None, scene_of(extent=3.0), Model(gaussians), 1, None))
    assert value == pytest.approx(1 / 6, rel=CLOSED_FORM)
    assert_allclose(cotangents.gaussians["log_scales"], [[4 / 9] * 3, [0] * 3], rtol=CLOSED_FORM)


def test_the_recipe_halves_what_it_penalises():
    """The trace 0.0225 is that of a ball of deviation 0.0866; the halves are 0.088 / sqrt(2) wide."""
    state = state_of(balls(np.zeros((2, 3)), [0.0880, 0.0850]))
    act(find_recipe("micro"), halve_large, state, scene_of(extent=3.0))
    assert_allclose(np.exp(state.gaussians.log_scales[:, 0]), [0.085, 0.0622254, 0.0622254], rtol=1e-6)


def test_it_keeps_float32_and_takes_no_gaussians(rng):
    assert trace_penalty_vjp(rng.normal(size=(6, 3)).astype(np.float32), 1.0).dtype == np.float32
    assert trace_penalty(np.zeros((0, 3)), 1.0) == 0 and trace_penalty_vjp(np.zeros((0, 3)), 1.0).shape == (0, 3)


def test_the_oracle_checks_it():
    extension = load_extension("micro")
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, extension.representation, extension.stages)
    assert report.n_failed == 0 and sum("trace_penalty" in case.name for case in report.cases) == 2


# --- detail ---


def test_detail_is_one_on_a_ramp_and_lies_at_the_edge():
    y, x = np.mgrid[:20, :30].astype(float)
    ramp = np.repeat((2 * x + y)[..., None], 3, axis=2)
    assert_allclose(detail_map(ramp)[1:-1, 1:-1].std(), 0, atol=CLOSED_FORM)
    assert_array_equal(detail_map(np.full((20, 30, 3), 7, np.uint8)), 1)
    step = np.repeat(np.where(x < 15, 0, 200)[..., None], 3, axis=2).astype(np.uint8)
    detail = detail_map(step)
    assert_array_equal(np.flatnonzero(detail.sum(axis=0)), [14, 15])
    assert_allclose(detail.mean(), 1, rtol=CLOSED_FORM)


def test_box_means_are_means_over_boxes(rng):
    image = rng.normal(size=(9, 11))
    boxes = np.array([[0, 0, 11, 9], [2, 3, 5, 4], [10, 8, 11, 9], [4, 4, 4, 7], [0, 0, 0, 0]], np.int32)
    expected = [image[y0:y1, x0:x1].mean() for x0, y0, x1, y1 in boxes[:3]]
    assert_allclose(box_means(image, boxes), [*expected, 0, 0], atol=CLOSED_FORM)


def test_detail_lowers_the_threshold(rng):
    """Of two Gaussians with equal gradients, the one in front of detail is cloned; at beta 0 neither is."""
    gaussians = balls([[0, 0, 0], [1, 0, 0]], [0.1, 0.1])
    for beta, n in ((0.0, 2), (0.5, 3), (2.0, 4)):
        stats = {
            "gradient_sum": np.array([0.8, 0.8]),
            "view_count": np.array([2, 2], np.int32),
            "detail_sum": np.array([8.0, 2.0], np.float32),  # g = 4 and 1
        }
        state = TrainState(gaussians, zero_moments(gaussians), 0, [], rng, stats)
        scene = Scene("", (), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
        iteration = Iteration(scene, *[None] * 4)
        clone_and_split_by_detail(state, iteration, threshold=0.7, size_fraction=1.0, beta=beta)
        assert len(state.gaussians.means) == n
        assert not state.stats


# --- children and merging ---


def test_children_have_half_the_covariance_and_stand_where_the_other_half_is(rng):
    parent = balls(np.zeros((4000, 3)), np.ones(4000))
    quats = np.tile(rng.normal(size=4), (4000, 1))
    parent = parent._replace(quats=quats, log_scales=np.tile(np.log([1.0, 0.5, 0.2]), (4000, 1)))
    children = halve_children(parent, np.arange(4000), rng)
    sigma = covariances(parent.quats[:1], np.exp(parent.log_scales[:1]))[0]
    own = covariances(children.quats[:1], np.exp(children.log_scales[:1]))[0]
    assert len(children.means) == 8000
    assert_allclose(own, sigma / 2, atol=CLOSED_FORM)
    assert_allclose(np.cov(children.means.T), sigma / 2, atol=SAMPLE_MEAN)


def test_alike_are_near_and_of_one_color_and_size():
    distances = np.array([0.4, 0.6, 0.4, 0.4, 0.0])
    sizes = np.array([[1, 1.5], [1, 1], [1, 1], [1, 2.1], [1, 1]])
    colors = np.zeros((5, 2, 3))
    colors[2, 0, 1] = 0.11
    assert_array_equal(
        are_alike(distances, sizes, colors, reach=0.5, color_reach=0.1), [True, False, False, False, True]
    )
    assert not are_alike(distances, sizes, colors, reach=0.0, color_reach=0.1).any()


@pytest.mark.parametrize("n", [0, 1])
def test_one_gaussian_has_no_neighbour(n):
    assert_array_equal(clusters(balls(np.zeros((n, 3)), np.ones(n)), reach=1.0, color_reach=1.0), np.arange(n))


def test_twins_are_merged_and_others_are_not():
    gaussians = balls([[0, 0, 0], [5, 0, 0], [0.05, 0, 0], [5.05, 0, 0]], [0.1, 0.1, 0.1, 0.1], np.eye(4, 3))
    alike = gaussians._replace(sh_dc=gaussians.sh_dc * [[1], [1], [0], [0]])
    assert_array_equal(clusters(gaussians, reach=0.5, color_reach=2.0), [0, 1, 0, 1])
    assert_array_equal(clusters(alike, reach=0.5, color_reach=0.5), [0, 1, 2, 3])


def test_merged_twins_weigh_as_much_as_the_light_that_they_stop():
    """Opacities of 1/2 and 7/8 are optical depths of ln 2 and 3 ln 2, so the place is three quarters of the way."""
    gaussians = balls([[1, 0, 0], [1, 0.04, 0]], [0.1, 0.1], [[0.02, 0, 0.08], [0.06, 0, 0.04]])
    state = state_of(gaussians._replace(opacity_logits=np.log([1.0, 7.0])))
    act(find_recipe("micro"), merge_alike, state, scene_of())
    assert_allclose(state.gaussians.means, [[1, 0.03, 0]], rtol=CLOSED_FORM)
    assert_allclose(SH_C0 * state.gaussians.sh_dc, [[0.05, 0, 0.05]], rtol=CLOSED_FORM, atol=CLOSED_FORM)
    # Of Sigma, along y, 0.01 + 0.25 * 0.03^2 + 0.75 * 0.01^2.
    assert_allclose(covariances(state.gaussians.quats, np.exp(state.gaussians.log_scales))[0, 1, 1], 0.0103, rtol=1e-9)


@pytest.mark.parametrize(
    ("distance", "color", "is_merged"),
    [(0.17, 0.09, True), (0.18, 0.09, False), (0.17, 0.11, False)],  # sqrt(3) * 0.1 is 0.173
)
def test_the_recipe_merges_within_a_size_and_a_tenth_of_a_colour(distance, color, is_merged):
    state = state_of(balls([[0, 0, 0], [0, distance, 0]], [0.1, 0.1], [[0, 0, 0], [0, 0, color]]))
    note = act(find_recipe("micro"), merge_alike, state, scene_of())
    assert len(state.gaussians.means) == 2 - is_merged
    assert note == (None if is_merged else "nothing done: no two neighbours are alike")


def test_the_recipe_removes_a_hundredth_of_opacity_times_size():
    """Of four balls of one opacity the two of size 0.5 and 0.4 have 0.9 % of the sum of the sizes, 100.

    Of the sum of their squares the second has 99.4 % alone.
    """
    state = state_of(balls(np.zeros((4, 3)), [0.5, 92.0, 7.1, 0.4]))
    act(find_recipe("micro"), prune_least, state, scene_of())
    assert_allclose(np.exp(state.gaussians.log_scales[:, 0]), [92.0, 7.1])
    faint = balls(np.zeros((3, 3)), [1.0, 1.0, 1.0])._replace(opacity_logits=np.array([4.0, -6.0, 4.0]))
    state = state_of(faint)  # opacities of 0.982, 0.0025 and 0.982
    act(find_recipe("micro"), prune_least, state, scene_of())
    assert_array_equal(state.gaussians.opacity_logits, [4.0, 4.0])


@pytest.mark.parametrize(("mass", "size"), [(1.0, 1e-9), (0.99, np.inf)])
def test_nothing_is_removed_where_all_count_or_a_size_is_infinite(mass, size):
    state = state_of(balls(np.zeros((3, 3)), [1.0, 1.0, size]))
    note = prune_least(state, None, score_mass=mass)
    assert note == "nothing done: all are kept" and len(state.gaussians.means) == 3


# --- where it is 3DGS ---


def tiny_scene(rng):
    truth = as_dtype(make_gaussians(rng, 30), np.float32)
    views = []
    for i in range(4):
        camera = make_camera(24, 16, rng=rng)
        image = SPLATTING.render(Model(truth), view_from(camera), Request(backend=REFERENCE))[0].image
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), None))
    colors = rng.integers(0, 256, (30, 3), np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, np.zeros(3), 1.0)


def shortened(recipe):
    """Return the recipe in 40 iterations with all its events, and a low threshold of densification."""

    def sooner(event):
        if isinstance(event, During):
            return event._replace(stop=30)
        if isinstance(event, At):
            return event
        start, stop = (29, 40) if event.start >= 14_999 else (5, 30)
        prune = partial(prune_large, size_fraction=2.0)
        return Every(10, prune if does(event, prune_large) else event.action, start=start, stop=stop)

    recipe = configure(recipe, threshold=2e-3, size_fraction=0.15, ceiling=0.05)
    return recipe._replace(iterations=40, events=tuple(sooner(event) for event in recipe.events))


def test_switched_off_it_is_3dgs_to_the_byte(backend, rng):
    scene = tiny_scene(rng)
    recipes = (configure(shortened(find_recipe("micro")), **OFF), shortened(find_recipe("3dgs-accel")))
    ours, theirs = (train(scene, recipe, seed=1, backend=backend) for recipe in recipes)
    assert len(ours.gaussians.means) > 40  # rows have come
    for a, b in ((ours.gaussians, theirs.gaussians), *zip(ours.adam[:2], theirs.adam[:2], strict=True)):
        for name in Gaussians._fields:
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


@pytest.mark.parametrize(("name", "value"), [("trace", 1e-3), ("beta", 0.5), ("score_mass", 0.9), ("merge_reach", 1.0)])
def test_each_of_the_four_changes_something(name, value, rng):
    scene = tiny_scene(rng)
    settings = {**OFF, name: value, "trace_limit": 0.2, "merge_color": 1.0}
    changed, plain = (
        train(scene, configure(shortened(find_recipe("micro")), **each), seed=1) for each in (settings, OFF)
    )
    assert min(len(changed.gaussians.means), len(plain.gaussians.means)) > 30
    assert changed.gaussians.means.tobytes() != plain.gaussians.means.tobytes()
    if name == "trace":
        assert traces(changed.gaussians.log_scales).max() < traces(plain.gaussians.log_scales).max()
    if name in ("score_mass", "merge_reach"):
        assert len(changed.gaussians.means) < len(plain.gaussians.means)


def test_the_recipe_is_that_of_3dgs_with_one_event_changed_and_four_more():
    ours, theirs = find_recipe("micro"), find_recipe("3dgs-accel")
    assert len(ours.events) == len(theirs.events) + 4
    assert sum(does(event, clone_and_split_by_detail) for event in ours.events) == 1
    assert all(isinstance(event.action, partial) or isinstance(event, During) for event in ours.events)


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
TRAIN = ["--recipe", "micro", "--test-every", "4", "--seed", "3", "--iterations", "300", "--set", "trace_limit=0.2"]


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "finished"
    assert main(["train", str(scene_folder), *TRAIN, "--out", str(folder)]) == 0
    return folder


def test_it_trains_and_says_what_it_did(run_folder, capsys):
    fired = [json.loads(line) for line in (run_folder / "events.jsonl").read_text().splitlines()]
    actions = {record["action"] for record in fired}
    assert {"clone_and_split_by_detail", "halve_large", "prune_least", "merge_alike"} <= actions
    metrics = json.loads((run_folder / "metrics.json").read_text())
    assert metrics["psnr"] > 10
    assert main(["eval", str(run_folder)]) == 0
    assert json.loads((run_folder / "metrics.json").read_text())["psnr"] == metrics["psnr"]


def test_interrupted_then_resumed_gives_the_same_bytes(scene_folder, run_folder, tmp_path, monkeypatch):
    report_step = Progress.__call__

    def interrupt(progress, report):
        report_step(progress, report)
        if report.step == 117:  # between two densifications: the detail collected so far is in the checkpoint
            raise KeyboardInterrupt

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", interrupt)
        assert main(["train", str(scene_folder), *TRAIN, "--out", str(folder)]) == 130
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()


def test_it_trains_on_photographs(shared_data, tmp_path):
    fox = str(shared_data / "fox")
    options = ["--downscale", "4", "--recipe", "micro", "--iterations", "20", "--out", str(tmp_path / "fox")]
    assert main(["train", fox, *options]) == 0
    assert json.loads((tmp_path / "fox" / "metrics.json").read_text())["psnr"] > 10


def test_a_setting_that_it_does_not_have_is_refused(scene_folder, tmp_path, capsys):
    options = ["--recipe", "micro", "--set", "traces=1", "--out", str(tmp_path / "run")]
    assert main(["train", str(scene_folder), *options]) == 2
    assert "has no traces to set" in capsys.readouterr().err and not (tmp_path / "run").exists()
