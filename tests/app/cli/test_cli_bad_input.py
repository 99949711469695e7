"""Bad input on the command line: one line that names the culprit, exit code 2, and nothing half-written."""

import json

import numpy as np
import pytest

from minisplat_ref import Gaussians, save_ply
from minisplat_ref.app.cli import main
from minisplat_ref.io.images import write_image
from minisplat_ref.io.ply import load_ply
from photo_scenes import PINHOLE, edit_transforms, write_colmap, write_transforms

OPENCV = (*PINHOLE, 0.1, 0.0, 0.0, 0.0)


RECIPE = ("--recipe", "3dgs-accel")  # which is content with few views


@pytest.fixture
def refused(tmp_path, capfd):
    """Run a command line that must be refused, and leave the folder as it was; return the line that says why."""

    def run(*arguments):
        before = sorted(tmp_path.rglob("*"))
        assert main([str(argument) for argument in arguments]) == 2
        captured = capfd.readouterr()
        lines = captured.err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("minisplat-ref: error: "), captured.err
        assert captured.out == ""
        assert sorted(tmp_path.rglob("*")) == before
        return lines[0]

    return run


@pytest.fixture
def train_refused(refused, tmp_path):
    """Train on a scene that must be refused; return the line that says why."""

    def run(scene, *options):
        return refused("train", scene, *RECIPE, "--iterations", "2", "--out", tmp_path / "out", *options)

    return run


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["tran", "x"], "train"),
        (["train", "x", "--downscal", "2"], "--downscale"),
        (["train", "x", "--iter=2"], "--iterations"),  # not an abbreviation, though it begins like one
        (["train", "x", "--sead", "2"], "--seed"),
        (["oracle", "gradient"], "gradients"),
        (["train", "x", "--backend", "cppu"], "cpu"),
        (["train", "x", "--nothing-like-it"], None),
        (["train", "x", "y"], None),
        (["render", "x", "--scene", "y"], None),  # not --backend
    ],
)
def test_what_was_probably_meant(words, meant, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(words)
    (line,) = capsys.readouterr().err.splitlines()
    assert ("did you mean" in line) == (meant is not None)
    assert meant is None or f"; did you mean {meant}? (see: minisplat-ref " in line


def test_a_config_that_is_none(refused, tmp_path):
    (tmp_path / "config.json").write_text("{}")
    assert "config.json is not the configuration of a training" in refused(
        "train", "--config", tmp_path / "config.json"
    )
    assert "nowhere" in refused("train", "--config", tmp_path / "nowhere")
    assert "leave out --config" in refused("train", "--resume", tmp_path, "--config", tmp_path / "config.json")


def gaussians(n=4):
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return Gaussians(np.zeros((n, 3)), quats, np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 0, 3)))


def write_run(folder, scene):
    """A run folder as train leaves it, by hand: settings and Gaussians."""
    folder.mkdir()
    settings = {
        "scene": str(scene),
        "downscale": 1,
        "test_every": 8,
        "undistort": False,
        "recipe": "3dgs",
        "schedule_iterations": 2,
        "iterations": 2,
        "seed": 0,
        "profile": "INRIA",
        "backend": "cpu",
    }
    (folder / "config.json").write_text(json.dumps({"settings": settings, "background": [0, 0, 0]}))
    (folder / "cameras.json").write_text(json.dumps([camera_entry()]))
    save_ply(folder / "point_cloud.ply", gaussians())
    return folder


def camera_entry(**changes):
    entry = {"img_name": "a", "width": 8, "height": 6, "fx": 9.0, "fy": 9.0, "split": "train"}
    return {**entry, "position": [0, 0, -3], "rotation": np.eye(3).tolist(), **changes}


# Scenes


def test_missing_scene_folder(train_refused, tmp_path):
    assert str(tmp_path / "nowhere") in train_refused(tmp_path / "nowhere")


def test_folder_without_a_scene(train_refused, tmp_path):
    (tmp_path / "empty").mkdir()
    line = train_refused(tmp_path / "empty")
    assert str(tmp_path / "empty") in line and "minisplat-ref sfm" in line


def test_missing_images_folder(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene")
    (scene / "images").rename(tmp_path / "images")
    assert "images/" in train_refused(scene)


def test_missing_image(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene")
    (scene / "images" / "0002.png").unlink()
    assert "0002.png" in train_refused(scene)


def test_truncated_image(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene")
    image = scene / "images" / "0001.png"
    image.write_bytes(image.read_bytes()[:60])
    assert "0001.png" in train_refused(scene)


def test_image_that_does_not_match_its_camera(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene")
    write_image(scene / "images" / "0003.png", np.zeros((10, 10, 3), np.uint8))
    line = train_refused(scene)
    assert "0003.png" in line and "10x10" in line and "32x24" in line


def test_distorted_camera_model_names_the_way_out(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene", model="OPENCV", params=OPENCV)
    line = train_refused(scene)
    assert "OPENCV" in line and "minisplat-ref undistort" in line


def test_unsupported_camera_model_with_undistort(train_refused, tmp_path):
    scene = write_transforms(tmp_path / "scene", camera_model="EQUIRECTANGULAR", fl_x=40.0)
    assert "EQUIRECTANGULAR" in train_refused(scene, "--undistort")


def test_damaged_colmap_model(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene")
    (scene / "sparse" / "0" / "images.txt").unlink()
    assert str(scene / "sparse" / "0") in train_refused(scene)


@pytest.mark.parametrize("n_views", [1, 2])
def test_scene_with_too_few_views(train_refused, tmp_path, n_views):
    """Two views are one for training and one for testing."""
    scene = write_colmap(tmp_path / "scene", n=n_views)
    line = train_refused(scene)
    assert str(scene) in line and "at least 2" in line


def test_nan_in_a_pose(train_refused, tmp_path):
    scene = write_transforms(tmp_path / "scene", fl_x=40.0)

    def break_pose(content):
        content["frames"][1]["transform_matrix"][0][3] = float("nan")

    edit_transforms(scene / "transforms.json", break_pose)
    assert "0001.png" in train_refused(scene)


def test_nan_in_the_points(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene")
    points = scene / "sparse" / "0" / "points3D.txt"
    points.write_text(points.read_text().replace("7 0 0 5", "7 nan 0 5"))
    assert "points" in train_refused(scene)


# Arguments


def test_out_that_holds_something(train_refused, refused, tmp_path):
    scene = write_colmap(tmp_path / "scene")
    run = write_run(tmp_path / "out", scene)
    assert f"train --resume {run}" in train_refused(scene)
    (run / "config.json").unlink()
    assert "not an empty folder" in train_refused(scene)
    assert "not an empty folder" in refused("demo", "--out", run)


def test_out_below_a_file(refused, tmp_path):
    scene = write_colmap(tmp_path / "scene", n=4)
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "run"
    assert str(out) in refused("train", scene, *RECIPE, "--iterations", "2", "--test-every", "0", "--out", out)


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (["--recipe", "5dgs"], "'5dgs'"),
        (["--downscale", "x"], "--downscale"),
        (["--iterations", "0"], "--iterations"),
        (["--profile", "none"], "--profile"),
        (["--unknown"], "--unknown"),
        (["--resume", "."], "leave out"),
        (["--budget", "0"], "--budget"),
        (
            ["--budget", "9", *RECIPE],
            "--budget means nothing to recipe 3dgs-accel: leave it out, or take one of mini-splatting",
        ),
        (["--simplify", "rank", *RECIPE], "--simplify means nothing to recipe 3dgs-accel: leave it out"),
        (["--scene-type", "indoor", "--recipe", "3dgs"], "--scene-type means nothing to recipe 3dgs: leave it out"),
        (["--set", "exposure"], "'exposure' is not NAME=VALUE"),
        (["--set", "exposure=yes"], "exposure=yes: choose from none, tracks, refined, learned"),
        (["--set", "pose=yes"], "pose=yes is neither true nor false"),
        (["--set", "threshold=x"], "threshold=x is not a number"),
        (["--set", "thresholds=1", *RECIPE], "no thresholds to set; did you mean threshold?"),
        (["--extension", "none"], "extension 'none' does not exist: choose from "),
    ],
)
def test_bad_options(options, culprit, tmp_path, capfd):
    scene = write_colmap(tmp_path / "scene")
    try:
        code = main(["train", str(scene), *options, "--out", str(tmp_path / "out")])
    except SystemExit as exit_info:  # argparse leaves in this way
        code = exit_info.code
    captured = capfd.readouterr()
    assert (code, captured.out, len(captured.err.splitlines())) == (2, "", 1)
    assert culprit in captured.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("recipe", ["mini-splatting", "mini-splatting2"])
def test_two_views_for_a_recipe_that_compares_views(train_refused, tmp_path, recipe):
    scene = write_colmap(tmp_path / "scene", n=3)
    line = train_refused(scene, "--recipe", recipe, "--test-every", "3")
    assert "2 training views" in line and "use 3dgs-accel" in line


def test_depth_of_points_without_tracks(tmp_path, capfd):
    scene = write_transforms(tmp_path / "scene", fl_x=40.0)
    options = [*RECIPE, "--extension", "geometry", "--set", "sfm_depth=1", "--iterations", "2"]
    assert main(["train", str(scene), *options, "--out", str(tmp_path / "out")]) == 2
    assert "does not say which view sees which point" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


def test_curve_of_no_test_views(train_refused, tmp_path):
    scene = write_colmap(tmp_path / "scene", n=4)
    assert "--test-every" in train_refused(scene, "--test-every", "0", "--eval-every", "1")


# Comparisons


@pytest.fixture
def compare_refused(refused, tmp_path):
    """Compare on a scene that could be trained; return the line that says why not."""
    scene = write_colmap(tmp_path / "scene", n=6)

    def run(*options, recipes="3dgs,3dgs-accel"):
        return refused("compare", scene, "--out", tmp_path / "out", "--recipes", recipes, "--test-every", "3", *options)

    return run


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--iterations", "3,2,1"], "3 numbers for 2 recipes"),
        (["--test-every", "0"], "has no test views"),
        (["--test-every", "1"], "0 training and 6 test"),
        (["--seeds", "1,0,1"], "--seeds names 1 more than once"),
        (["--budget", "10"], "--budget means nothing to 3dgs, 3dgs-accel"),
        (["--scene-type", "outdoor"], "--scene-type means nothing to 3dgs, 3dgs-accel"),
    ],
)
def test_bad_comparison(compare_refused, options, reason):
    assert reason in compare_refused(*options)


@pytest.mark.parametrize(("recipes", "culprit"), [("3dgs,5dgs", "'5dgs'"), ("3dgs,3dgs", "--recipes names 3dgs")])
def test_bad_recipes_to_compare(compare_refused, recipes, culprit):
    assert culprit in compare_refused(recipes=recipes)


def test_comparison_of_a_missing_scene(refused, tmp_path):
    options = ["--recipes", "3dgs", "--out", tmp_path / "out"]
    assert str(tmp_path / "nowhere") in refused("compare", tmp_path / "nowhere", *options)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--recipes", "3dgs", "--out", "there"], "give a SCENE to train on, or --resume DIR"),
        (["scene", "--out", "there"], "give --recipes A,B, or --resume DIR"),
        (["scene", "--recipes", "3dgs"], "give --out DIR, or --resume DIR"),
        (["--resume", "there", "--seeds", "1"], "leave out --seeds"),
        (["scene", "--resume", "there", "--test-every", "4"], "leave out SCENE, --test-every"),
        (["--resume", "there"], "there holds no comparison, plan.json is missing"),
    ],
)
def test_comparison_without_what_it_needs(refused, options, reason):
    assert reason in refused("compare", *options)


@pytest.mark.parametrize("plan", ["{}", '{"scene": "scene"}', "[]", "{"])
def test_comparison_with_a_damaged_plan(refused, tmp_path, plan):
    (tmp_path / "plan.json").write_text(plan)
    assert str(tmp_path / "plan.json") in refused("compare", "--resume", tmp_path)


def test_comparison_into_an_occupied_folder(compare_refused, tmp_path):
    write_run(tmp_path / "out", tmp_path / "scene")
    assert str(tmp_path / "out") in compare_refused()
    (tmp_path / "out" / "config.json").unlink()
    assert f"{tmp_path / 'out'} is not an empty folder" in compare_refused()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--recipes", "3dgs,,3dgs-accel", "--out", "there"], "a name is missing"),
        (["--recipes", "", "--out", "there"], "a name is missing"),
        (["--recipes", "3dgs", "--iterations", "10,x", "--out", "there"], "'x' is not a whole number"),
        (["--recipes", "3dgs", "--seeds", "0,", "--out", "there"], "'' is not a whole number"),
    ],
)
def test_bad_options_of_a_comparison(options, reason, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        main(["compare", "scene", *options])
    captured = capfd.readouterr()
    assert (exit_info.value.code, captured.out, len(captured.err.splitlines())) == (2, "", 1)
    assert reason in captured.err
    assert not any(tmp_path.iterdir())


# Gaussians


def broken_ply(path, breakage):
    """Write a PLY with something wrong in it; return what the error must name besides the file."""
    population = gaussians()
    if breakage == "nan":
        population.means[2, 1] = np.nan
        return write_unchecked(path, population), "property y is nan in row 2"
    if breakage == "zero quaternion":
        population.quats[3] = 0
        save_ply(path, population)
        return path, "row 3 is a zero quaternion"
    save_ply(path, population)
    if breakage == "truncated":
        path.write_bytes(path.read_bytes()[:-10])
        return path, "truncated"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    return path, "not a PLY of Gaussians"


def write_unchecked(path, population):
    """Write what save_ply refuses: numbers first, then the bytes of one of them replaced."""
    finite = population._replace(means=np.where(np.isnan(population.means), 123.0, population.means))
    save_ply(path, finite)
    marked = np.float32(123.0).tobytes()
    content = path.read_bytes()
    assert content.count(marked) == 1
    path.write_bytes(content.replace(marked, np.float32(np.nan).tobytes()))
    return path


@pytest.mark.parametrize("command", ["render", "info"])
@pytest.mark.parametrize("breakage", ["nan", "zero quaternion", "truncated", "no Gaussians"])
def test_broken_ply(refused, tmp_path, command, breakage):
    path, reason = broken_ply(tmp_path / "broken.ply", breakage)
    line = refused(command, path)
    assert str(path) in line and reason in line


def test_helper_writes_good_plys_too(tmp_path):
    save_ply(tmp_path / "good.ply", gaussians())
    assert len(load_ply(tmp_path / "good.ply").means) == 4


# Runs


@pytest.mark.parametrize("command", [["render"], ["eval"], ["info"], ["train", "--resume"]])
def test_missing_input(refused, tmp_path, command):
    assert str(tmp_path / "nowhere") in refused(*command, tmp_path / "nowhere")


@pytest.mark.parametrize("command", [["render"], ["eval"], ["train", "--resume"]])
def test_folder_that_holds_no_run(refused, tmp_path, command):
    scene = write_colmap(tmp_path / "scene")
    line = refused(*command, scene)
    assert str(scene) in line and "config.json" in line


@pytest.mark.parametrize("content", ["{", "[]", '{"settings": {"scene": "a"}}'])
@pytest.mark.parametrize("command", [["render"], ["eval"], ["info"], ["train", "--resume"]])
def test_damaged_config(refused, tmp_path, command, content):
    run = write_run(tmp_path / "run", tmp_path / "scene")
    (run / "config.json").write_text(content)
    assert str(run / "config.json") in refused(*command, run)


def test_scene_of_a_run_has_moved(refused, tmp_path):
    run = write_run(tmp_path / "run", tmp_path / "scene")
    assert str(tmp_path / "scene") in refused("eval", run)
    assert str(tmp_path / "other") in refused("eval", run, "--scene", tmp_path / "other")


def test_resume_without_or_with_a_damaged_checkpoint(refused, tmp_path):
    run = write_run(tmp_path / "run", write_colmap(tmp_path / "scene"))
    assert str(run / "checkpoint.npz") in refused("train", "--resume", run)
    (run / "checkpoint.npz").write_bytes(b"PK\x03\x04 cut short")
    assert str(run / "checkpoint.npz") in refused("train", "--resume", run)
    assert str(run / "checkpoint.npz") in refused("info", run / "checkpoint.npz")


def test_run_without_test_views(refused, tmp_path):
    run = write_run(tmp_path / "run", tmp_path / "scene")
    assert "no test views" in refused("render", run, "--cameras", "test")


def test_ply_has_no_cameras_of_its_own(refused, tmp_path):
    save_ply(tmp_path / "a.ply", gaussians())
    assert "--cameras train" in refused("render", tmp_path / "a.ply", "--cameras", "train")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{", "JSON"),
        ("[]", "list of cameras"),
        ([camera_entry(), {"width": 3}], "camera 1"),
        ([camera_entry(width=0)], "positive"),
        ([camera_entry(fx=float("nan"))], "finite"),
        ([camera_entry(rotation=np.diag([2.0, 1, 1]).tolist())], "rotation"),
    ],
)
def test_bad_camera_file(refused, tmp_path, content, reason):
    save_ply(tmp_path / "a.ply", gaussians())
    cameras = tmp_path / "cameras.json"
    cameras.write_text(content if isinstance(content, str) else json.dumps(content))
    line = refused("render", tmp_path / "a.ply", "--cameras", cameras)
    assert str(cameras) in line and reason in line
