"""Multi-scale: coverage, selection, levels by their moments, where it is 3DGS, the coarse loss, from end to end."""

import json
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from actions import act, scene_of, state_of
from gradcheck import check_inner_products
from minisplat_ref import load_ply, save_ply
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.multi_scale.model import (
    LEVELS,
    NO_CELL,
    MultiScaleGaussians,
    Plan,
    add_levels,
    are_shown,
    coverages,
    level_zero,
    pixel_densities,
)
from minisplat_ref.extensions.multi_scale.recipe import coarse, finest_densities, insert_levels
from minisplat_ref.io.label import Label
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.strategy.simplify import optical_masses
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import Gaussians, Model, Scene, View, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, COVERAGE_MIN, GRADIENT_STEP_IMAGE, MERGED_MOMENTS, PARITY_FLOAT64

DRAW = LEVELS.renderer
EVERYTHING = 1e9  # pixels of coverage, so that all Gaussians that share a cell are merged


def grid(n_side, spacing, depth=4.03, size=0.05):
    """Return small opaque balls in a plane in front of the camera, none of them on the border of a cell."""
    steps = (np.arange(n_side) - (n_side - 1) / 2) * spacing + 0.0137
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    n = len(x)
    return Gaussians(
        np.column_stack([x, y, np.full(n, depth)]),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), np.log(size)),
        np.full(n, 1.0),
        np.random.default_rng(0).uniform(-1, 1, (n, 3)),
        np.zeros((n, 0, 3)),
    )


def camera_of(size, focal=64.0):
    return make_camera(size, size, fx=focal * size / 64, fy=focal * size / 64)


def in_levels(gaussians, plan, camera=None):
    densities = finest_densities(gaussians.means, [camera or camera_of(64)])
    return add_levels(level_zero(gaussians, None), densities, plan, GSPLAT_MAIN)


def shown_in(levels, camera):
    return are_shown(levels.cells, pixel_densities(levels.means, camera, 0.01))


# --- coverage and selection ---


def test_coverage_is_the_width_of_the_visible_ellipse():
    """The middle scale of a flat Gaussian counts, and alpha at half that width is 1/255."""
    log_scales, logits = np.log([[0.001, 0.2, 0.7]]), np.array([2.0])
    (S,) = coverages(log_scales, logits, np.array([50.0]), GSPLAT_MAIN)
    alpha = 1 / (1 + np.exp(-2.0)) * np.exp(-0.5 * (S / 2 / (0.2 * 50)) ** 2)
    assert_allclose(alpha, GSPLAT_MAIN.alpha_min, rtol=CLOSED_FORM)
    assert coverages(log_scales, np.array([-9.0]), np.array([50.0]), GSPLAT_MAIN) == 0


def test_densities_are_pixels_per_unit_and_stop_at_the_near_plane():
    camera = make_camera(fx=30.0, fy=30.0)
    means = np.array([[0.0, 1, 3], [0, 0, 6], [0, 0, -5]])
    assert_allclose(pixel_densities(means, camera, 0.5), [10, 5, 60], rtol=CLOSED_FORM)


def test_a_parent_appears_where_its_members_disappear():
    cells = np.array([[0, 0.1], [0.1, 0.4], [0.4, NO_CELL], [0, NO_CELL]])
    for density, expected in ((11, [1, 0, 0, 1]), (10, [1, 0, 0, 1]), (9, [0, 1, 0, 1]), (2, [0, 0, 1, 1])):
        assert_array_equal(are_shown(cells, np.full(4, float(density))), np.array(expected, bool))
    assert are_shown(cells.astype(np.float32), np.full(4, 1e30, np.float32))[3]  # overflows, and is shown


# --- levels ---


def test_levels_keep_light_and_moments():
    gaussians = grid(16, 0.05)._replace(opacity_logits=np.full(256, -4.0))  # so faint that no merged one is clamped
    levels = in_levels(gaussians, Plan(4, 2, EVERYTHING))
    own, parent = levels.cells.T
    assert_array_equal(levels.means[:256], gaussians.means)
    masses, n_members = optical_masses(levels), 0
    for row in np.flatnonzero(own > 0):
        front = np.flatnonzero((parent == own[row]) & (np.arange(len(own)) < row))
        cell = np.floor(levels.means[front] / own[row])
        members = front[(cell == np.floor(levels.means[row] / own[row])).all(axis=1)]
        shares = masses[members] / masses[members].sum()
        assert_allclose(levels.means[row], shares @ levels.means[members], atol=MERGED_MOMENTS)
        n_members += len(members)
    assert n_members == np.count_nonzero(parent < NO_CELL) > 256  # each has one parent, level 1 has some, too
    for camera in (camera_of(16), camera_of(4)):
        assert_allclose(masses[shown_in(levels, camera)].sum(), masses[:256].sum(), rtol=MERGED_MOMENTS)


def test_each_place_is_shown_once_at_every_size():
    """Cells nest, so at any size each Gaussian of level 0, or exactly one that it was merged into, is shown."""
    levels = in_levels(grid(16, 0.05), Plan(2, 4, EVERYTHING))
    counts = []
    for size in (64, 40, 32, 24, 16, 8, 4):
        is_shown = shown_in(levels, camera_of(size))
        is_covered = np.zeros(256, int)
        for row in np.flatnonzero(is_shown):
            is_covered[leaves(levels, row)] += 1
        assert_array_equal(is_covered, 1)
        counts.append(is_shown.sum())
    assert counts[0] == 256 and (np.diff(counts) <= 0).all() and counts[-1] < 40


def leaves(levels, row):
    """Return the Gaussians of level 0 that a row represents."""
    own, parent = levels.cells.T
    if own[row] == 0:
        return [row]
    front = np.flatnonzero((parent == own[row]) & (np.arange(len(own)) < row))
    cell = np.floor(levels.means[front] / own[row])
    members = front[(cell == np.floor(levels.means[row] / own[row])).all(axis=1)]
    return [leaf for member in members for leaf in leaves(levels, member)]


def test_large_gaussians_are_not_merged():
    gaussians = grid(8, 0.05)
    large = np.arange(64) % 2 == 0
    log_scales = np.where(large[:, None], np.log(1.0), gaussians.log_scales)
    levels = in_levels(gaussians._replace(log_scales=log_scales), Plan(4, 1, 4.0))
    assert (levels.cells[:64, 1][large] == NO_CELL).all() and (levels.cells[:64, 1][~large] < NO_CELL).any()


def test_the_recipe_merges_what_is_thinner_than_four_pixels_in_levels_of_four():
    """At about 8 pixels per unit, cells of level 1 are 1/2 wide, of level 2 2, of level 3 8, and a pixel each.

    A ball of opacity 0.98 is seen until 3.323 deviations from its centre. So 4 pixels are 0.602 deviations to the left
    and right: 0.301 units at level 1, 1.204 at level 2. Of three pairs, the first is just below the former, the second
    just above, and the third just above the latter. Each pair is in a cell of every level, and the last cell holds all.
    """
    camera = turned_camera(fx=40.0, fy=25.0)
    camera = camera._replace(cam_from_world_t=[0.0, 0.0, 5.0] - camera.cam_from_world_R @ [1.25, 0.25, 0.25])
    pair = np.array([[0.2, 0.2, 0.2], [0.3, 0.3, 0.3]])
    centers = (pair + np.array([[[0, 0, 0]], [[1, 0, 0]], [[2, 0, 0]]])).reshape(6, 3)
    gaussians = balls(centers, np.repeat([0.299, 0.303, 1.21], 2), np.full(6, 0.98))
    state = state_of(level_zero(gaussians, None))
    act(find_recipe("multi-scale"), insert_levels, state, scene_of([camera]))
    own = [0, 0, 0, 0, 0, 0, 0.5, 2, 8]
    parents = [0.5, 0.5, 2, 2, 8, 8, 2, 8, NO_CELL]
    assert_array_equal(state.gaussians.cells, np.column_stack([own, parents]))


def test_densities_are_those_of_the_mean_focal_length_at_the_depth():
    """sqrt(40 * 22.5) = 30 at a depth of 5, in a camera that is turned."""
    camera = turned_camera(fx=40.0, fy=22.5)
    means = in_front_of(camera, [[0.3, -0.2, 5.0], [-4.0, 1.0, 0.25]])
    assert_allclose(pixel_densities(means, camera, 0.5), [6, 60], rtol=PARITY_FLOAT64)


def test_nothing_to_merge_and_nothing_seen():
    far_apart = grid(3, 1.0)
    assert len(in_levels(far_apart, Plan(2, 2, EVERYTHING)).means) == 9
    behind = far_apart._replace(means=-far_apart.means)
    with pytest.raises(InputError, match="no training view sees a Gaussian"):
        finest_densities(behind.means, [camera_of(64)])


# --- where it is 3DGS ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_level_zero_is_3dgs_exactly(backend, dtype, rng):
    gaussians, view = as_dtype(make_gaussians(rng, 40), dtype), view_from(make_camera(rng=rng))
    zero = level_zero(gaussians, rng)
    wants, v_image = frozenset({"depth", "stats"}), rng.normal(size=(18, 24, 4)).astype(dtype)
    some = rng.uniform(size=40) < 0.7
    for is_visible in (None, some):
        request = Request(backend=backend, wants=wants, is_visible=is_visible)
        ours, tape = DRAW.render(Model(zero), view, request)
        theirs, other = SPLATTING.render(Model(gaussians), view, request)
        assert ours.alpha.mean() > COVERAGE_MIN
        assert_array_equal(ours.image, theirs.image)
        v, v_other = DRAW.render_vjp(tape, v_image, None), SPLATTING.render_vjp(other, v_image, None)
        for name in Gaussians._fields:
            assert getattr(v.gaussians, name).tobytes() == getattr(v_other.gaussians, name).tobytes(), name


def test_a_view_of_levels_is_that_of_the_rows_it_shows(backend):
    levels = in_levels(grid(16, 0.05), Plan(2, 4, EVERYTHING))
    for size in (64, 16):
        camera = camera_of(size)
        rows = shown_in(levels, camera)
        alone = Gaussians(*(field[rows] for field in levels[:6]))
        ours, _ = DRAW.render(Model(levels), view_from(camera), Request(backend=backend))
        theirs, _ = SPLATTING.render(Model(alone), view_from(camera), Request(backend=backend))
        assert_array_equal(ours.image, theirs.image)
        assert_array_equal(ours.visible_ids, np.flatnonzero(rows)[theirs.visible_ids])


def test_the_gradient_of_the_whole_model(small_proof):
    """On kernels; the reference's is checked for every extension by test_every_extension.py."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, LEVELS)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


# --- training ---


def rendered(gaussians, rng, step, mask=None):
    camera = make_camera(32, 32, fx=40.0, fy=40.0)
    view = View("a", camera, rng.integers(0, 256, (32, 32, 3), np.uint8), mask, view_id=0)
    scene = Scene("", (view,), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
    request = Request(np.zeros(3), backend=REFERENCE)
    return Rendered(None, {}, view, scene, Model(gaussians), step, request)


TERM = partial(coarse, factor=2, n_levels=2, period=4, dssim_weight=0.2)


def test_the_gradient_of_the_coarse_loss(rng):
    levels = level_zero(make_gaussians(rng, 12, depth=4.0, size=0.4), rng)
    given = rendered(levels, rng, step=4)
    names = [name for name in Gaussians._fields if name != "sh_rest"]

    def loss(*fields):
        moved = levels._replace(**dict(zip(names, fields, strict=True)))
        return (np.asarray(TERM(given._replace(model=Model(moved)))[0]),)

    value, cotangents = TERM(given)
    assert value > 0
    check_inner_products(
        loss,
        [cotangents.gaussians[name] for name in names],
        [getattr(levels, name) for name in names],
        [np.ones(())],
        rng,
        names=names,
        step=GRADIENT_STEP_IMAGE,
    )


def test_the_coarse_loss_alternates_between_levels_and_respects_the_mask(rng):
    levels = level_zero(make_gaussians(rng, 12), rng)
    assert TERM(rendered(levels, rng, step=5)) == (0.0, TERM(rendered(levels, rng, step=5))[1])
    assert not TERM(rendered(levels, rng, step=5))[1].gaussians
    values = [TERM(rendered(levels, np.random.default_rng(0), step=step))[0] for step in (4, 8, 12)]
    assert values[0] == values[2] != values[1]  # a half, a quarter, a half
    nothing = np.zeros((32, 32), bool)
    assert TERM(rendered(levels, rng, 4, nothing))[0] == 0
    some = np.ones((32, 32), bool)
    some[:, :16] = False
    assert 0 < TERM(rendered(levels, np.random.default_rng(0), 4, some))[0] != values[0]
    tiny = partial(TERM, factor=8, n_levels=1)  # of 32 pixels 4
    assert tiny(rendered(levels, rng, step=4))[0] == 0


def test_until_levels_are_inserted_it_is_3dgs_to_the_byte(rng):
    truth = as_dtype(make_gaussians(rng, 30), np.float32)
    views = []
    for i in range(4):
        camera = make_camera(24, 16, rng=rng)
        image = SPLATTING.render(Model(truth), view_from(camera), Request(backend=REFERENCE))[0].image
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), None))
    colors = rng.integers(0, 256, (30, 3), np.uint8)
    scene = Scene("tiny", tuple(views), (), truth.means.astype(float), colors, np.zeros(3), 1.0)
    ours, theirs = (
        train(scene, find_recipe(name)._replace(iterations=20), seed=1).gaussians for name in ("multi-scale", "3dgs")
    )
    for name in Gaussians._fields:
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), name


SCENE = {"n_views": 6, "width": 64, "height": 48, "n_points": 300, "test_every": 4}
TRAIN = ["--recipe", "multi-scale", "--test-every", "4", "--iterations", "40", "--set", "factor=2"]


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


def test_training_inserts_levels_and_the_ply_keeps_them(run_folder, tmp_path, capsys):
    levels = load_ply(run_folder / "point_cloud.ply", MultiScaleGaussians)
    assert 0 < np.count_nonzero(levels.cells[:, 0]) < len(levels.means)
    save_ply(tmp_path / "again.ply", levels, Label("multi-scale"))
    assert (tmp_path / "again.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()
    events = [json.loads(line) for line in (run_folder / "events.jsonl").read_text().splitlines()]
    assert [event["action"] for event in events].count("insert_levels") == 1
    assert main(["eval", str(run_folder)]) == 0


def test_interrupted_after_the_insertion_then_resumed_gives_the_same_bytes(
    scene_folder, run_folder, tmp_path, monkeypatch
):
    report_step = Progress.__call__

    def interrupt(progress, report):
        report_step(progress, report)
        if report.step == 27:
            raise KeyboardInterrupt

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", interrupt)
        assert main(["train", str(scene_folder), *TRAIN, "--out", str(folder)]) == 130
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()


def test_levels_are_built_of_a_trained_scene_and_drawn(scene_folder, tmp_path, capsys):
    run, out = tmp_path / "plain", tmp_path / "levels.ply"
    short = ["--recipe", "3dgs-accel", "--test-every", "4", "--iterations", "20"]
    assert main(["train", str(scene_folder), *short, "--out", str(run)]) == 0
    ply = str(run / "point_cloud.ply")
    assert main(["multi-scale", "build", ply, "--factor", "2", "--out", str(out)]) == 0
    assert "coarser Gaussians beside" in capsys.readouterr().out
    levels, plain = load_ply(out, MultiScaleGaussians), load_ply(ply)
    n = len(plain.means)
    assert len(levels.means) > n
    assert_array_equal(levels.means[:n], plain.means)
    sizes = [["--size", size, "--frames", "1"] for size in ("128x96", "16x12")]
    for i, size in enumerate(sizes):
        for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
            assert main(["render", str(out), *size, *extension, "--out", str(tmp_path / f"{name}{i}")]) == 0
    assert main(["multi-scale", "build", str(out), "--out", str(tmp_path / "twice.ply")]) == 2
    assert "has levels already" in capsys.readouterr().err and not (tmp_path / "twice.ply").exists()
    assert main(["render", ply, "--extension", "multi-scale"]) == 2
    assert "no property cells" in capsys.readouterr().err
    for options, words in (
        (["--factor", "1"], "--factor above 1"),
        (["--cameras", str(tmp_path / "none.json")], "none.json"),
    ):
        assert main(["multi-scale", "build", ply, *options, "--out", str(tmp_path / "bad.ply")]) == 2
        assert words in capsys.readouterr().err and not (tmp_path / "bad.ply").exists()


def test_it_trains_on_photographs(shared_data, tmp_path):
    fox = str(shared_data / "fox")
    options = ["--downscale", "4", "--recipe", "multi-scale", "--iterations", "20", "--out", str(tmp_path / "fox")]
    assert main(["train", fox, *options]) == 0
    assert load_ply(tmp_path / "fox" / "point_cloud.ply", MultiScaleGaussians).cells[:, 0].any()
