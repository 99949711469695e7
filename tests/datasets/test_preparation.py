"""The commands that prepare scenes: downscaling and undistortion; structure from motion has its own file."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputWarning
from minisplat_ref.io import load_scene
from minisplat_ref.io.images import read_image, resize_image, write_image
from minisplat_ref.io.lens import import_pycolmap
from minisplat_ref.io.ply import write_vertices
from photo_scenes import HEIGHT, WIDTH, assert_refused, colored_image, write_colmap, write_transforms
from tolerances import SAME_CAMERAS, WEBP_LEVELS

ROOT = Path(__file__).parents[2]
DISTORTED = (40.0, 42.0, 16.0, 12.0, 0.1, -0.05, 0.004, -0.003)  # OPENCV
NERFSTUDIO = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"), DISTORTED, strict=True))


def assert_same_views(scene, other, check_images):
    for a, b in zip((*scene.train_views, *scene.test_views), (*other.train_views, *other.test_views), strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.camera.cam_from_world_R, b.camera.cam_from_world_R, atol=SAME_CAMERAS)
        np.testing.assert_allclose(a.camera.cam_from_world_t, b.camera.cam_from_world_t, atol=SAME_CAMERAS)
        np.testing.assert_allclose(a.camera[2:8], b.camera[2:8], rtol=SAME_CAMERAS)
        if check_images:
            np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.mask, b.mask)


# downscale


def test_downscale(tmp_path, rng, capsys):
    size = 97, 83
    write_colmap(tmp_path, names=["a/0.png", "a/1.png", "2.jpg", "3.png"], camera_size=size)
    images = {name: rng.integers(0, 256, (*size[::-1], 4), dtype=np.uint8) for name in ("a/0.png", "3.png")}
    for name, image in images.items():
        write_image(tmp_path / "images" / name, image)
    on_the_fly = load_scene(tmp_path, downscale=5)
    assert main(["downscale", str(tmp_path), "--downscale", "5"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'images_5'}\n"
    for name, image in images.items():
        np.testing.assert_array_equal(read_image(tmp_path / "images_5" / name), resize_image(image, 19, 17))
    ready_made = load_scene(tmp_path, downscale=5)
    for a, b in zip(on_the_fly.train_views, ready_made.train_views, strict=True):
        assert a.camera[2:8] == b.camera[2:8] and a.image.shape == b.image.shape


def test_downscale_of_a_folder_of_images(tmp_path):
    (tmp_path / "train").mkdir()
    write_image(tmp_path / "train" / "a.png", colored_image(1, 40, 32))
    assert main(["downscale", str(tmp_path / "train")]) == 0
    np.testing.assert_array_equal(read_image(tmp_path / "train_2" / "a.png"), colored_image(1, 20, 16))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "no such folder"),
        (["empty"], "no images in it"),
        (["scene", "--downscale", "1"], "--downscale is 1; it must be at least 2"),
        (
            ["scene", "--downscale", "3"],
            "images_3: already there and not empty; choose another name or remove it first",
        ),
        (["broken"], "b.png: not an image that Pillow can read"),
        (["large"], "--downscale 2 leaves 40 x 15 pixels of a photograph, and hardly any structure"),
        (["large", "--downscale", "1000"], "fewer than 16 x 16: give at most 1"),
    ],
)
def test_downscale_refuses(tmp_path, capsys, arguments, message):
    write_colmap(tmp_path / "scene")
    shutil.copytree(tmp_path / "scene" / "images", tmp_path / "scene" / "images_3")
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "large").mkdir()
    write_image(tmp_path / "large" / "a.png", colored_image(1, 80, 30))
    write_image(tmp_path / "broken" / "a.png", colored_image(1))
    (tmp_path / "broken" / "b.png").write_text("no image")
    before = sorted(tmp_path.rglob("*"))
    assert_refused(capsys, tmp_path, main(["downscale", str(tmp_path / arguments[0]), *arguments[1:]]), message)
    assert sorted(tmp_path.rglob("*")) == before


# undistort


def test_undistort_colmap_agrees_with_loading_undistorted(tmp_path, rng):
    scene = write_colmap(tmp_path / "scene", model="OPENCV", params=DISTORTED)
    write_image(scene / "images" / "0001.png", rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    (scene / "masks").mkdir()
    write_image(scene / "masks" / "0002.png", rng.random((HEIGHT, WIDTH)) < 0.5)
    assert main(["undistort", str(scene), "--out", str(tmp_path / "deep" / "out")]) == 0
    undistorted = load_scene(tmp_path / "deep" / "out")
    expected = load_scene(scene, undistort=True)
    assert_same_views(undistorted, expected, check_images=True)
    np.testing.assert_array_equal(undistorted.points, expected.points)
    assert sorted(path.name for path in (tmp_path / "deep" / "out").iterdir()) == ["images", "masks", "sparse"]


def test_undistort_transforms_agrees_with_loading_undistorted(tmp_path, rng):
    scene = write_transforms(tmp_path / "scene", **NERFSTUDIO, aabb_scale=4, ply_file_path="p.ply")
    write_image(scene / "images" / "0001.png", rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    write_vertices(scene / "p.ply", {"x": np.array([1.0]), "y": np.array([2.0]), "z": np.array([3.0])})
    write_image(scene / "m.png", rng.random((HEIGHT, WIDTH)) < 0.5)
    content = json.loads((scene / "transforms.json").read_text())
    content["frames"][2] |= {"mask_path": "m.png", "k1": 0.4}
    (scene / "transforms.json").write_text(json.dumps(content))
    assert main(["undistort", str(scene), "--out", str(tmp_path / "out")]) == 0
    with pytest.warns(InputWarning, match="has no red, green, blue: its points are gray"):
        undistorted = load_scene(tmp_path / "out")
        expected = load_scene(scene, undistort=True)
    assert_same_views(undistorted, expected, check_images=True)
    np.testing.assert_array_equal(undistorted.points, expected.points)
    assert expected.test_views[0].camera[2:8] != expected.train_views[1].camera[2:8]  # the frame with its own k1
    assert json.loads((tmp_path / "out" / "transforms.json").read_text())["aabb_scale"] == 4


def test_undistort_what_colmap_does_not_write(tmp_path, rng):
    """COLMAP leaves out WebP photographs and says nothing."""
    names = ["0.webp", "1.png", "2.webp"]
    scene = write_colmap(tmp_path / "scene", model="OPENCV", params=DISTORTED, names=names)
    alpha = np.where(rng.random((HEIGHT, WIDTH)) < 0.5, 255, 0).astype(np.uint8)
    write_image(scene / "images" / "2.webp", np.dstack([colored_image(2), alpha]))
    assert main(["undistort", str(scene), "--out", str(tmp_path / "out")]) == 0
    undistorted, expected = load_scene(tmp_path / "out"), load_scene(scene, undistort=True)
    assert_same_views(undistorted, expected, check_images=False)
    for view, same in zip(undistorted.train_views, expected.train_views, strict=True):
        assert np.abs(view.image.astype(int) - same.image).mean() < WEBP_LEVELS
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == names
    assert [path.name for path in (tmp_path / "out" / "masks").iterdir()] == ["2.webp.png"]


def test_undistort_names_what_colmap_leaves_out(tmp_path, capsys, monkeypatch):
    scene = write_colmap(tmp_path / "scene", model="OPENCV", params=DISTORTED)
    pycolmap = import_pycolmap()
    original = pycolmap.undistort_images

    def without_the_second(out, *arguments, **named):
        original(out, *arguments, **named)
        model = pycolmap.Reconstruction(Path(out, "sparse"))
        (image,) = (image for image in model.images.values() if image.name == "0001.png")
        model.deregister_frame(image.frame_id)
        model.write(Path(out, "sparse"))

    monkeypatch.setattr(pycolmap, "undistort_images", without_the_second)
    code = main(["undistort", str(scene), "--out", str(tmp_path / "out")])
    assert_refused(capsys, tmp_path, code, "scene: COLMAP has not undistorted 0001.png; export the model again")


def test_undistort_refuses(tmp_path, capsys):
    pinhole = write_colmap(tmp_path / "pinhole")
    code = main(["undistort", str(pinhole), "--out", str(tmp_path / "out")])
    assert_refused(capsys, tmp_path, code, "all cameras are pinholes already, nothing to undistort; use")
    code = main(["undistort", str(tmp_path), "--out", str(tmp_path / "out")])
    assert_refused(capsys, tmp_path, code, "neither a COLMAP model nor a transforms.json; give the folder of a scene")
    scene = write_colmap(tmp_path / "scene", model="OPENCV", params=DISTORTED)
    code = main(["undistort", str(scene), "--out", str(pinhole)])
    assert_refused(capsys, tmp_path, code, "pinhole: already there and not empty; choose another name")
    (scene / "images" / "0003.png").unlink()
    code = main(["undistort", str(scene), "--out", str(tmp_path / "out")])
    assert_refused(capsys, tmp_path, code, "0003.png: missing")
    code = main(["undistort", str(scene), "--out", str(scene / "images" / "0001.png" / "out")])
    assert_refused(capsys, tmp_path, code, "out: cannot be made (")


def test_interruption_leaves_nothing(tmp_path, capsys, monkeypatch):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    scene = write_colmap(tmp_path / "scene", model="OPENCV", params=DISTORTED)
    monkeypatch.setattr(import_pycolmap(), "undistort_images", interrupt)
    assert main(["undistort", str(scene), "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "minisplat-ref: interrupted\n"
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_pycolmap_is_missing(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    scene = write_colmap(tmp_path / "scene", model="OPENCV", params=DISTORTED)
    code = main(["undistort", str(scene), "--out", str(tmp_path / "out")])
    assert_refused(capsys, tmp_path, code, "is not installed: pip install 'minisplat_ref[photos]'")


# scripts


@pytest.mark.parametrize("name", ["sfm", "undistort", "downscale", "synthetic"])
def test_script_is_the_command(name):
    """Of a checkout that nothing has been installed from: the package is found beside the script's folder."""
    command = [sys.executable, "-m", f"data_tools.{name}"]
    shown = subprocess.run([*command, "--help"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert shown.stdout.startswith(f"usage: minisplat-ref {name} ")
    refused = subprocess.run([*command, "--unknown"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stdout) == (2, "")
