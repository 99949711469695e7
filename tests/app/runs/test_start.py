"""``--init``: the start from a point cloud of the user's, by hand, degenerate, and through the command line."""

import json
import signal

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minisplat_ref as ms
from minisplat_ref.app.cli import main
from minisplat_ref.app.comparison import runs
from minisplat_ref.app.runs.checkpoints import newest_model
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.app.runs.settings import load
from minisplat_ref.app.runs.start import load_start, make_start
from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io import load_ply, load_scene
from minisplat_ref.io.frames import place_scene
from minisplat_ref.io.ply import COLORS, write_vertices
from minisplat_ref.methods import RECIPES
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train as train_state
from minisplat_ref.training.recipe_settings import configure
from photo_scenes import write_colmap
from run_commands import in_process, write_room
from tolerances import ROUNDED_TO_FLOAT32

SCENE = {"n_views": 8, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
SQUARE = np.array([[1.0, 0, 5], [2, 0, 5], [1, 1, 5], [2, 1, 5]])  # before the cameras of write_colmap


def write_cloud(path, points, colors=None):
    columns = dict(zip("xyz", np.asarray(points, np.float64).T, strict=True))
    columns |= {} if colors is None else dict(zip(COLORS, np.asarray(colors, np.uint8).T, strict=True))
    write_vertices(path, columns)
    return path


@pytest.fixture
def photographs(tmp_path):
    return write_colmap(tmp_path / "scene", n=4)


def test_start_by_hand(photographs, tmp_path):
    """Corners of a unit square: as in the test of the scene's own points, of which there are three here."""
    scene = load_scene(photographs, test_every=0)
    colors = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]]
    start, notices = load_start(write_cloud(tmp_path / "a.ply", SQUARE, colors), scene)
    assert notices == [] and len(scene.points) == 3
    gaussians = initial_state(start, RECIPES["3dgs"], seed=0).gaussians
    assert_array_equal(gaussians.means, SQUARE)
    assert_allclose(np.exp(gaussians.log_scales), np.sqrt(4 / 3), rtol=ROUNDED_TO_FLOAT32)
    assert_allclose(0.5 + SH_C0 * gaussians.sh_dc, np.array(colors) / 255, atol=ROUNDED_TO_FLOAT32)


def test_from_python(photographs, tmp_path):
    scene = load_scene(photographs, test_every=0)
    cloud = ms.load_points(write_cloud(tmp_path / "a.ply", SQUARE))
    start = scene._replace(points=cloud.points, point_colors=cloud.colors)
    assert_array_equal(initial_state(start, RECIPES["3dgs"], seed=0).gaussians.means, SQUARE)


def test_coincident_points(photographs, tmp_path):
    """Two in one place look to the others; five in one place get the least scale that there is."""
    points = np.concatenate([SQUARE, SQUARE[:1], np.tile([3.0, 0, 9], (5, 1))])
    start, _ = load_start(write_cloud(tmp_path / "a.ply", points), load_scene(photographs, test_every=0))
    log_scales = initial_state(start, RECIPES["3dgs"], seed=0).gaussians.log_scales
    assert_allclose(np.exp(log_scales[[0, 4]]), np.sqrt(2 / 3), rtol=ROUNDED_TO_FLOAT32)  # distances 0, 1, 1
    assert_allclose(log_scales[5:], 0.5 * np.log(1e-7), rtol=ROUNDED_TO_FLOAT32)


def test_notices(photographs, tmp_path):
    points = np.concatenate([SQUARE, [[np.nan, 0, 5], [0, np.inf, 5]]])
    start, notices = load_start(write_cloud(tmp_path / "a.ply", points), load_scene(photographs, test_every=0))
    assert_array_equal(start.points, SQUARE)
    assert (start.point_colors == 128).all()
    assert notices == [
        f"{tmp_path / 'a.ply'}: 2 of 6 points are not finite and left out",
        f"{tmp_path / 'a.ply'}: no properties red, green, blue; all points start gray",
    ]


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "a.ply: 0 points; to start from them, give at least 4, or leave --init out"),
        (SQUARE[:1], "a.ply: 1 point; to start"),
        (SQUARE[:3], "a.ply: 3 points; to start"),
        (np.where(np.eye(4, 3), np.nan, SQUARE), r"a.ply: 1 point, as 3 of 4 points are not finite; to start"),
        (
            SQUARE * [1, 1, -1],
            "a.ply: no training view sees any of the 4 points; give them in the world frame of scene",
        ),
    ],
)
def test_bad_clouds(photographs, tmp_path, points, message):
    with pytest.raises(InputError, match=message):
        load_start(write_cloud(tmp_path / "a.ply", points), load_scene(photographs, test_every=0))


def test_one_point_in_view_is_enough(photographs, tmp_path):
    points = SQUARE * [[1, 1, 1], [1, 1, -1], [1, 1, -1], [1, 1, -1]]
    start, _ = load_start(write_cloud(tmp_path / "a.ply", points), load_scene(photographs, test_every=0))
    assert len(start.points) == 4


# The command line


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture
def dense(scene_folder, tmp_path):
    """More points than the scene has, between its own; one is not finite."""
    scene = load_scene(scene_folder)
    points, colors = (
        np.concatenate([a, (0.5 * a + 0.5 * np.roll(a, 1, axis=0)).astype(a.dtype)])
        for a in (scene.points, scene.point_colors)
    )
    points[7, 1] = np.nan
    return write_cloud(tmp_path / "dense.ply", points, colors)


def train(scene_folder, out, *options):
    return main(["train", str(scene_folder), "--test-every", "4", "--seed", "3", "--out", str(out), *options])


def test_train_starts_from_the_cloud(scene_folder, dense, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    schedule = ["--recipe", "3dgs-accel", "--iterations", "3"]
    assert train(scene_folder, tmp_path / "run", *schedule, "--init", "dense.ply") == 0
    captured = capfd.readouterr()
    assert "8 training and 3 test views of 32 x 24, 60 points" in captured.out
    assert f"starts from 119 points of {dense}" in captured.out
    assert f"minisplat-ref: {dense}: 1 of 120 points are not finite and left out" in captured.err
    assert json.loads((tmp_path / "run" / "config.json").read_text())["settings"]["init"] == str(dense)
    gaussians = load_ply(tmp_path / "run" / "point_cloud.ply")
    cloud = ms.load_points(dense)
    moved = np.abs(gaussians.means - cloud.points).max()
    assert 0 < moved < 0.01 * np.ptp(cloud.points)  # three steps of 1.6e-4 extents, and no densification yet


def test_resumed_and_measured_without_the_file(scene_folder, dense, tmp_path, capfd, monkeypatch):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train(scene_folder, whole, "--iterations", "8", "--init", str(dense)) == 0
    report_step = Progress.__call__

    def press_ctrl_c(progress, report):
        report_step(progress, report)
        if report.step == 5:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", press_ctrl_c)
        assert train(scene_folder, parts, "--iterations", "8", "--init", str(dense)) == 130
    dense.unlink()
    assert main(["train", "--resume", str(parts)]) == 0
    assert (parts / "point_cloud.ply").read_bytes() == (whole / "point_cloud.ply").read_bytes()
    assert json.loads((parts / "config.json").read_text())["settings"]["init"] == str(dense)
    assert main(["eval", str(parts)]) == 0
    capfd.readouterr()
    assert main(["train", "--resume", str(parts), "--iterations", "14", "--init", str(dense)]) == 2
    assert "leave out --init" in capfd.readouterr().err


def test_the_scene_s_own_points_give_the_same_bytes(scene_folder, tmp_path):
    scene = load_scene(scene_folder)
    cloud = write_cloud(tmp_path / "own.ply", scene.points, scene.point_colors)
    assert train(scene_folder, tmp_path / "own", "--iterations", "6", "--init", str(cloud)) == 0
    sparse = ("--set", "starts_densely=false")
    assert train(scene_folder, tmp_path / "plain", "--iterations", "6", *sparse) == 0
    contents = [(tmp_path / name / "point_cloud.ply").read_bytes() for name in ("own", "plain")]
    assert contents[0] == contents[1]


def test_losses_on_sparse_points_keep_the_scene_s_own(scene_folder, tmp_path):
    """Views know rows of the scene's 60 points, which the cloud of ten does not have."""
    cloud = write_cloud(tmp_path / "few.ply", load_scene(scene_folder).points[:10])
    options = ["--recipe", "3dgs-accel", "--iterations", "3", "--extension", "geometry", "--set", "sfm_depth=1"]
    assert train(scene_folder, tmp_path / "run", *options, "--init", str(cloud)) == 0
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["n_gaussians"] == 10


@pytest.mark.parametrize("command", [["train"], ["compare", "--recipes", "3dgs,3dgs-accel"]])
@pytest.mark.parametrize(("case", "reason"), [("missing", "cannot be opened"), ("empty", "0 points")])
def test_refused(photographs, tmp_path, capfd, command, case, reason):
    path = tmp_path / "a.ply"
    if case == "empty":
        write_cloud(path, np.zeros((0, 3)))
    options = ["--test-every", "2", "--init", str(path), "--out", str(tmp_path / "out")]
    assert main([*command, str(photographs), *options]) == 2
    captured = capfd.readouterr()
    assert (captured.out, len(captured.err.splitlines())) == ("", 1)
    assert str(path) in captured.err and reason in captured.err
    assert not (tmp_path / "out").exists()


def test_compare_starts_all_from_it(scene_folder, dense, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(runs, "warm_up", lambda plan, scene: None)
    monkeypatch.setattr(runs, "train_here", in_process)
    options = ["--recipes", "3dgs,3dgs-accel", "--iterations", "4", "--test-every", "4", "--init", str(dense)]
    assert main(["compare", str(scene_folder), *options, "--out", str(tmp_path / "out")]) == 0
    assert capfd.readouterr().out.count(f"starts from 119 points of {dense}") == 2
    content = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert content["settings"]["init"] == str(dense)
    assert [recipe["mean"]["n_gaussians"] for recipe in content["recipes"]] == [119, 119]
    assert str(dense) in (tmp_path / "out" / "report.html").read_text()


# From a run


@pytest.fixture(scope="module")
def few(scene_folder, tmp_path_factory):
    """A run with the exposures of its photographs."""
    out = tmp_path_factory.mktemp("runs") / "few"
    assert train(scene_folder, out, "--recipe", "3dgs-accel", "--iterations", "4", "--set", "exposure=learned") == 0
    return out


def scene_of(scene_folder):
    return place_scene(load_scene(scene_folder, test_every=4))


def test_a_run_goes_on_where_it_ended(few, scene_folder):
    """Every field is that of the result, and so is the exposure; moments begin afresh."""
    recipe = configure(find_recipe("3dgs", 10), exposure="learned")
    start = make_start(few, scene_of(scene_folder), recipe, 0)
    saved = newest_model(few, load(few)).model
    for name, field in start.state.gaussians._asdict().items():
        assert_array_equal(field, getattr(saved.gaussians, name), err_msg=name)
    assert saved.shared.keys() == start.state.shared.keys() != set()
    assert all((start.state.shared[name] == values).all() for name, values in saved.shared.items())
    assert start.state.step == 0 and not any(moments.any() for moments in start.state.adam.first)
    assert start.source.endswith("few, trained with 3dgs-accel and rendered by splatting") and start.notices == []
    before = [field.copy() for field in saved.gaussians]
    train_state(scene_of(scene_folder), recipe, state=start.state, seed=0)
    again = newest_model(few, load(few)).model
    assert all((a == b).all() for a, b in zip(before, again.gaussians, strict=True))  # the run itself stays


@pytest.mark.parametrize(
    ("recipe", "settings", "says"),
    [
        ("3dgs", {}, "has parameters exposures besides its Gaussians, which recipe 3dgs does not train: add --set exp"),
        ("velocity", {}, "which recipe velocity does not train: add --set exposure=learned"),
    ],
)
def test_parameters_that_a_recipe_lacks_are_named(few, scene_folder, recipe, settings, says):
    with pytest.raises(InputError, match=says):
        make_start(few, scene_of(scene_folder), configure(find_recipe(recipe, 10), **settings), 0)


def test_another_number_of_photographs_is_refused(few, scene_folder):
    scene = place_scene(load_scene(scene_folder, test_every=2))
    with pytest.raises(InputError, match="give the photographs of that run, divided by the same --test-every"):
        make_start(few, scene, configure(find_recipe("3dgs", 10), exposure="learned"), 0)


def test_a_run_of_another_place_is_refused(few, scene_folder):
    scene = scene_of(scene_folder)
    turned = [
        view._replace(camera=view.camera._replace(cam_from_world_t=view.camera.cam_from_world_t - [0, 0, 1e3]))
        for view in scene.train_views
    ]
    with pytest.raises(InputError, match=r"no training view sees any of its \d+ Gaussians; give a run of scene nook"):
        make_start(few, scene._replace(train_views=tuple(turned)), find_recipe("3dgs", 10), 0)


def test_from_one_extension_to_another(scene_folder, tmp_path, capfd):
    """3DGS becomes a moving scene at rest; a moving scene does not become 3DGS, unless as points."""
    plain, moving, out = (tmp_path / name for name in ("plain", "moving", "out"))
    assert train(scene_folder, plain, "--recipe", "3dgs", "--iterations", "2") == 0
    options = ["--recipe", "velocity", "--iterations", "1"]
    assert train(scene_folder, moving, *options, "--init", str(plain)) == 0
    said = capfd.readouterr().out
    assert f"starts from 60 Gaussians of {plain}, trained with 3dgs and rendered by splatting, here by velocity" in said
    start = load_ply(plain / "point_cloud.ply")
    population = find_recipe("velocity").representation.population
    assert 0 < np.abs(load_ply(moving / "point_cloud.ply", population).means - start.means).max() < 1e-2
    assert train(scene_folder, out, "--recipe", "3dgs", "--iterations", "2", "--init", str(moving)) == 2
    error = capfd.readouterr().err.strip().splitlines()[-1]
    assert "holds moving Gaussians with velocities, which recipe 3dgs does not train" in error and not out.exists()
    assert "give --init" in error and "point_cloud.ply to start from its points alone" in error


def test_a_folder_without_a_run_is_refused(scene_folder, tmp_path, capfd):
    (tmp_path / "empty").mkdir()
    assert train(scene_folder, tmp_path / "out", "--init", str(tmp_path / "empty")) == 2
    assert "holds no run, config.json is missing" in capfd.readouterr().err
