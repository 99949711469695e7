"""Names from scene files: what is read lies with the scene, what is written stays where it was asked to be written."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from minisplat_ref import Gaussians, save_ply
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import scoring
from minisplat_ref.datasets.undistort import undistort_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene, read_image, viewpoints
from minisplat_ref.io.images import write_image
from minisplat_ref.io.names import file_names, name_inside, nearby_path
from minisplat_ref.metrics import ViewMetrics
from minisplat_ref.types import number_views
from photo_scenes import PINHOLE, colored_image, edit_transforms, write_colmap, write_transforms

NASTY = ("/abs", "../up", "a/../../b", "C:\\x", "a\0b", "a\nb", "..", "", "x" * 300, "é" * 200, "nul", "A", "a")


@pytest.fixture
def nothing_outside(tmp_path):
    """The folder of the test, of which nothing may change but what is below ``out``."""

    def files():
        return {
            path: path.read_bytes()
            for path in tmp_path.rglob("*")
            if path.is_file() and not path.is_relative_to(tmp_path / "deep" / "out")
        }

    before = {}
    (tmp_path / "deep").mkdir()
    yield lambda: before.update(files())
    assert before and files() == before


# what is read


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("images/a.png", "scene/images/a.png"),
        ("./images//a.png", "scene/images/a.png"),
        ("images\\a.png", "scene/images/a.png"),
        ("images/../a.png", "scene/a.png"),
        ("../images/a.png", "scene/../images/a.png"),
        ("images/../../up/a.png", "scene/../up/a.png"),
        ("{here}/scene/a.png", "{here}/scene/a.png"),
        ("{here}/other/a.png", "{here}/other/a.png"),
    ],
)
def test_path_beside_a_file(tmp_path, name, expected, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, expected = (text.format(here=tmp_path) for text in (name, expected))
    assert str(nearby_path(Path("scene/transforms.json"), name)) == expected


@pytest.mark.parametrize(
    "name", ["../../a.png", "images/../../../a.png", "/etc/a.png", "{here}/../a.png", "..\\..\\a.png"]
)
def test_path_that_leads_elsewhere(tmp_path, name):
    with pytest.raises(InputError, match="lies neither in the folder of this file nor in one next to it; move it"):
        nearby_path(tmp_path / "scene" / "transforms.json", name.format(here=tmp_path))


def test_absolute_path_below_a_folder_that_was_reached_through_a_link(tmp_path):
    (tmp_path / "disk" / "scene").mkdir(parents=True)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "scene").symlink_to(tmp_path / "disk" / "scene")
    path = tmp_path / "disk" / "scene" / "a.png"
    assert nearby_path(tmp_path / "home" / "scene" / "transforms.json", str(path)) == path


def test_names_inside_a_folder():
    for name in ("a.png", "left/a.png", "a b.png", "..a.png", "a..png", "é.png"):
        assert name_inside(name, "scene") == name
    for name in ("/a.png", "../a.png", "left/../../a.png", "left/../a.png", "", "..", ".", "a\0.png"):
        with pytest.raises(InputError, match=r"scene: the image name '.*' leads out of images/; put the image there"):
            name_inside(name, "scene")


@pytest.mark.parametrize("name", ["/{here}/up/0.png", "../../up/0.png"])
def test_colmap_names_that_leave_the_scene_are_refused(tmp_path, name):
    write_colmap(tmp_path / "scene")
    (tmp_path / "up").mkdir()
    write_image(tmp_path / "up" / "0.png", colored_image(0))
    images = tmp_path / "scene" / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("0002.png", name.format(here=tmp_path)))
    with pytest.raises(InputError, match=r"0\.png' leads out of images/"):
        load_scene(tmp_path / "scene")


def test_linked_folders_of_images_are_read(tmp_path):
    write_colmap(tmp_path / "a" / "b" / "disk", names=["x/0.png", "1.png", "2.png"])
    (tmp_path / "colmap").mkdir()
    for name in ("images", "sparse"):
        (tmp_path / "colmap" / name).symlink_to(tmp_path / "a" / "b" / "disk" / name)
    assert len(load_scene(tmp_path / "colmap", test_every=0).train_views) == 3
    write_transforms(tmp_path / "a" / "b" / "nerf", fl_x=40.0)
    (tmp_path / "nerf").mkdir()
    (tmp_path / "nerf" / "images").symlink_to(tmp_path / "a" / "b" / "nerf" / "images")
    (tmp_path / "a" / "b" / "nerf" / "transforms.json").rename(tmp_path / "nerf" / "transforms.json")
    assert len(load_scene(tmp_path / "nerf", test_every=0).train_views) == 4


@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path"])
def test_transforms_that_name_files_elsewhere_are_refused(tmp_path, key):
    write_transforms(tmp_path / "deep" / "scene", fl_x=40.0)
    write_image(tmp_path / "a.png", colored_image(0))

    def change(content):
        entries = content if key == "ply_file_path" else content["frames"][1]
        entries[key] = "../../a.png"

    edit_transforms(tmp_path / "deep" / "scene" / "transforms.json", change)
    with pytest.raises(InputError, match=r"'../../a\.png' lies neither in the folder of this file nor"):
        load_scene(tmp_path / "deep" / "scene")


# what is written


def test_file_names():
    assert file_names(["0001", "DSC_1.a", "é-x", "front/left 1"]) == ["0001", "DSC_1.a", "é-x", "front_left_1"]
    assert file_names(["a/b", "a_b"]) == ["0000_a_b", "0001_a_b"]
    assert file_names(["a", "A"]) == ["0000_a", "0001_A"]  # one file to some systems
    assert file_names(["con", "x"]) == ["0000_con", "0001_x"]
    assert file_names([".."]) == ["0000_.."]
    names = file_names(NASTY)
    assert len(set(names)) == len(NASTY)
    for name in names:
        assert os.path.basename(name) == name and len(f"{name}_depth.png".encode()) < 256 and "\0" not in name


def test_scores_stay_in_their_folder(tmp_path, nothing_outside, monkeypatch):
    """As an image at the root of the file system did not, of a COLMAP model with absolute names."""
    scene = load_scene(write_transforms(tmp_path / "deep" / "scene", fl_x=40.0), test_every=0)
    view = scene.train_views[0]
    views = tuple(view._replace(name=name) for name in (str(tmp_path / "deep" / "image"), *NASTY))

    def measure(model, views, settings, on_view, network):
        for view in views:
            on_view(view, np.zeros(view.image.shape), ViewMetrics(view.name, 0.0, 0.0))

    monkeypatch.setattr(scoring, "evaluate", measure)
    (tmp_path / "deep" / "out").mkdir()
    nothing_outside()
    scoring.score(tmp_path / "deep" / "out", number_views(views), None, None)
    assert len(list((tmp_path / "deep" / "out" / "renders").iterdir())) == len(views)


DISTORTED = {**dict(zip(("fl_x", "fl_y", "cx", "cy"), PINHOLE, strict=True)), "k1": 0.1}


def test_undistorted_images_stay_in_their_folder(tmp_path, nothing_outside):
    """A path with ``..`` inside was written beside --out; images of one name in two folders replaced each other."""
    scene = write_transforms(tmp_path / "deep" / "scene", **DISTORTED)
    paths = ["images/../../up/0.png", "../other/0.png", str(tmp_path / "deep" / "up" / "1.png"), "images/./0003.png"]

    def change(content):
        for i, frame in enumerate(content["frames"]):
            frame["file_path"] = paths[i]
            path = scene / paths[i]
            path.parent.mkdir(exist_ok=True)
            write_image(path, colored_image(i))

    edit_transforms(scene / "transforms.json", change)
    nothing_outside()
    undistort_scene(scene, tmp_path / "deep" / "out")
    written = json.loads((tmp_path / "deep" / "out" / "transforms.json").read_text())
    names = [frame["file_path"] for frame in written["frames"]]
    assert names == ["outside/up_0.png", "outside/other_0.png", "outside/up_1.png", "images/0003.png"]
    for i, name in enumerate(names):
        assert (read_image(tmp_path / "deep" / "out" / name) == colored_image(i)[0, 0]).all()


def test_undistorted_masks_of_images_of_one_name_are_two(tmp_path):
    for split, columns in (("train", 8), ("test", 16)):
        write_transforms(tmp_path / "scene", name=f"transforms_{split}.json", images=split, n=2, **DISTORTED)
        mask = np.zeros(colored_image(0).shape[:2], bool)
        mask[:, :columns] = True
        write_image(tmp_path / "scene" / f"{split}.png", mask)
        edit_transforms(
            tmp_path / "scene" / f"transforms_{split}.json",
            lambda content, split=split: content["frames"][0].update(mask_path=f"{split}.png"),
        )
    undistort_scene(tmp_path / "scene", tmp_path / "out")
    scene, expected = load_scene(tmp_path / "out"), load_scene(tmp_path / "scene", undistort=True)
    assert scene.train_views[0].mask.sum() < scene.test_views[0].mask.sum()
    pairs = zip(scene.train_views + scene.test_views, expected.train_views + expected.test_views, strict=True)
    for view, other in pairs:
        assert view.name == other.name
        np.testing.assert_array_equal(view.mask, other.mask)


def test_undistort_refuses_one_image_twice(tmp_path):
    write_transforms(tmp_path / "scene", **DISTORTED)
    edit_transforms(
        tmp_path / "scene" / "transforms.json", lambda content: content["frames"].append(content["frames"][0])
    )
    with pytest.raises(InputError, match=r"2 frames would be written to images/0000\.png; remove"):
        undistort_scene(tmp_path / "scene", tmp_path / "out")


def test_cameras_of_a_file_are_rendered_into_their_folder(tmp_path, nothing_outside):
    cameras, out = tmp_path / "cameras.json", tmp_path / "deep" / "out"
    entry = {"width": 8, "height": 6, "fx": 9, "fy": 9, "position": [0, 0, -3], "rotation": np.eye(3).tolist()}
    names = [str(tmp_path / "deep" / "image"), *NASTY]
    cameras.write_text(json.dumps([{**entry, "img_name": name} for name in names]))
    zeros = np.zeros((1, 3))
    save_ply(tmp_path / "a.ply", Gaussians(zeros, np.eye(1, 4), zeros, zeros[:, 0], zeros, np.zeros((1, 0, 3))))
    nothing_outside()
    assert main(["render", str(tmp_path / "a.ply"), "--cameras", str(cameras), "--out", str(out)]) == 0
    assert [view.name for view in viewpoints.read(cameras)] == names
    assert sorted(path.stem for path in out.glob("*.png")) == sorted(file_names(names))
