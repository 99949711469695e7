"""Scenes of LLFF: axes, sizes and the box of random points by hand-worked values; files that are none."""

import re

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io import load_scene, write_image
from minisplat_ref.io.inventory import take_inventory
from tolerances import CLOSED_FORM

WIDTH, HEIGHT, FOCAL = 40, 30, 50.0
CENTERS = np.array([[1.0, 2.0, 3.0], [-1.0, 2.0, 3.0], [1.0, -2.0, 3.0]])


def write_llff(path, folder="images", factor=1, n=3, **changes):
    """Write cameras that look along +y with z up: right is x, down is -z, backward is -y."""
    down, right, backward = [0.0, 0, -1], [1.0, 0, 0], [0.0, -1, 0]
    rows = []
    for center in CENTERS:
        pose = np.column_stack([down, right, backward, center, [HEIGHT, WIDTH, FOCAL]])
        rows.append([*pose.ravel(), 2.0, 10.0])
    rows = np.array(rows)
    for (row, column), value in changes.get("values", {}).items():
        rows[row, column] = value
    (path / folder).mkdir(parents=True)
    np.save(path / "poses_bounds.npy", rows)
    rng = np.random.default_rng(0)
    for k in range(n):
        shape = HEIGHT // factor, WIDTH // factor, 3
        write_image(path / folder / f"{k}.png", rng.integers(0, 256, shape).astype(np.uint8))
    return path


def test_a_point_in_front_of_a_camera(tmp_path):
    """(1, 2, 3) + 5 y + 1 x + 0.5 z lies 5 before the first camera, 10 px to the right and 5 px up."""
    scene = load_scene(write_llff(tmp_path), test_every=0)
    camera = scene.train_views[0].camera
    point = CENTERS[0] + [1.0, 5.0, 0.5]
    x, y, z = camera.cam_from_world_R @ point + camera.cam_from_world_t
    assert (x, y, z) == pytest.approx((1, -0.5, 5), rel=CLOSED_FORM)
    assert camera.fx * x / z + camera.cx == pytest.approx(WIDTH / 2 + 10, rel=CLOSED_FORM)
    assert camera.fy * y / z + camera.cy == pytest.approx(HEIGHT / 2 - 5, rel=CLOSED_FORM)
    np.testing.assert_allclose([view.camera.center for view in scene.train_views], CENTERS, rtol=CLOSED_FORM)
    assert np.linalg.det(camera.cam_from_world_R) == pytest.approx(1)


def test_reduced_photographs_have_reduced_focal_lengths(tmp_path):
    """Of images_2 alone; and --downscale of whole ones says the same."""
    reduced = load_scene(write_llff(tmp_path / "a", "images_2", 2), test_every=0)
    whole = load_scene(write_llff(tmp_path / "b"), test_every=0, downscale=2)
    for scene in (reduced, whole):
        camera = scene.train_views[0].camera
        assert camera[2:8] == pytest.approx((25.0, 25.0, 10.0, 7.5, 20, 15), rel=CLOSED_FORM)


def test_every_eighth_is_held_out(tmp_path):
    scene = load_scene(write_llff(tmp_path), test_every=2, offset=1)
    assert [view.name for view in scene.train_views] == ["0", "2"]
    assert [view.name for view in scene.test_views] == ["1"]
    assert take_inventory(tmp_path, scene).line == "3 of 3 photographs have cameras"


def test_random_points_lie_where_photographs_look(tmp_path):
    """At depths 2 and 10 half the width is 0.4 of the depth, half the height 0.3, around x = -1, 1 and z = 3."""
    box = load_scene(write_llff(tmp_path), test_every=0).random_box
    np.testing.assert_allclose(box, [[-1 - 4, -2 + 2, 3 - 3], [1 + 4, 2 + 10, 3 + 3]], rtol=1e-9)


def test_masks_are_not_used(tmp_path):
    write_llff(tmp_path)
    (tmp_path / "masks").mkdir()
    write_image(tmp_path / "masks" / "0.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.warns(InputWarning, match="masks/ has 1 files, 0 fit"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no array", "poses_bounds.npy is no array of NumPy"),
        (np.zeros((3, 16)), "an array of shape (3, 16); give 17 numbers per photograph"),
        (np.zeros(17), "an array of shape (17,)"),
        (np.full((3, 17), np.nan), "photograph 0 has a number that is not finite"),
        (np.zeros((3, 17)), "depths are positive, the nearer first"),
        (np.array([{"a": 1}], dtype=object), "poses_bounds.npy is no array of NumPy"),
    ],
)
def test_files_that_are_none(tmp_path, content, message):
    write_llff(tmp_path)
    file = tmp_path / "poses_bounds.npy"
    file.write_bytes(content) if isinstance(content, bytes) else np.save(file, content, allow_pickle=True)
    with pytest.raises(InputError, match=re.escape(message)):
        load_scene(tmp_path)


def test_missing_photographs(tmp_path):
    write_llff(tmp_path / "few", n=2)
    with pytest.raises(InputError, match=r"has 3 rows, and .*images has 2 photographs"):
        load_scene(tmp_path / "few")
    write_llff(tmp_path / "none", n=0)
    with pytest.raises(InputError, match="no photographs in images, images_2"):
        load_scene(tmp_path / "none")


def test_trained_from_the_command_line(tmp_path, capsys):
    """It begins with random points, and has a held-out photograph."""
    write_llff(tmp_path / "fern")
    command = ["train", str(tmp_path / "fern"), "--recipe", "3dgs-accel", "--iterations", "3", "--test-every", "3"]
    assert main([*command, "--out", str(tmp_path / "run")]) == 0
    assert "2 training and 1 test views" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "fern")]) == 0
    assert "3 of 3 photographs have cameras" in capsys.readouterr().out
