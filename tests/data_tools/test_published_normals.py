"""Published normals: which are known, by hand, and the angles of a plane that a camera sees from above."""

from types import SimpleNamespace

import numpy as np
import pytest

from data_tools.published_normals import main, measure, read_normals
from minisplat_ref.errors import InputError
from minisplat_ref.io import write_image
from minisplat_ref.types import Camera, View

UP, SLANTED = (0, 0, 255), (0, 249, 153)  # of sRGB: (0, 0, 1) and (0, 0.947, 0.319)


def write_test_image(folder, name, normals, alpha=255):
    """A gray image of 8 x 6 pixels, and its normals: one for all pixels, or [6, 8, 3]."""
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / f"{name}.png", np.dstack([np.full((6, 8, 3), 128), np.full((6, 8), alpha)]).astype(np.uint8))
    write_image(folder / f"{name}_normal_0001.png", np.broadcast_to(normals, (6, 8, 3)).astype(np.uint8))
    return folder / f"{name}.png"


def test_a_normal_is_known_where_its_length_is_one(tmp_path):
    normals = np.zeros((6, 8, 3), int)
    normals[0, :5] = UP, SLANTED, (0, 218, 219), (255, 255, 255), (0, 200, 0)
    known = read_normals(write_test_image(tmp_path, "r_0", normals))
    assert known.is_known[0, :5].tolist() == [True, True, True, False, False] and not known.is_known[1:].any()
    np.testing.assert_allclose(known.normals[0, 1], [0, 0.9473, 0.3185], atol=1e-4)
    assert known.is_covered.all()
    assert not read_normals(write_test_image(tmp_path, "r_1", UP, alpha=254)).is_known.any()
    write_image(tmp_path / "r_1.png", np.zeros((6, 8, 3), np.uint8))
    with pytest.raises(InputError, match=r"r_1\.png has no alpha"):
        read_normals(tmp_path / "r_1.png")


def run_above_a_plane(opacity):
    """A run whose images show a plane 2 units below a camera that looks down, with the world's z axis upwards."""
    R = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    camera = Camera(
        cam_from_world_R=R, cam_from_world_t=np.zeros(3), fx=10.0, fy=10.0, cx=4.0, cy=3.0, width=8, height=6
    )
    alpha = np.full((6, 8), opacity)
    output = SimpleNamespace(image=np.dstack([np.zeros((6, 8, 3)), 2 * alpha]), alpha=alpha)
    settings = SimpleNamespace(render_view=lambda model, view, wants: (output, None))
    views = [View(name, camera, np.zeros((6, 8, 3), np.uint8), None) for name in ("test_r_0", "test_r_1")]
    scene = SimpleNamespace(test_views=views)
    return SimpleNamespace(scene=scene, render_settings=settings, model=None, folder="run")


def test_angles_of_a_plane(tmp_path, capsys):
    """24 of 48 pixels of each image are not on the border; one image is right, the other off by acos 0.3185."""
    write_test_image(tmp_path / "test", "r_0", UP)
    write_test_image(tmp_path / "test", "r_1", SLANTED)
    found = measure(run_above_a_plane(0.6), tmp_path)
    assert found.mean == pytest.approx(71.43 / 2, abs=0.05) and found.share == pytest.approx(24 / 48)
    write_test_image(tmp_path / "test", "r_1", UP)
    assert measure(run_above_a_plane(0.6), tmp_path).mean == pytest.approx(0, abs=1e-5)
    with pytest.raises(InputError, match="no pixel of run can be compared"):
        measure(run_above_a_plane(0.4), tmp_path)
    assert main([str(tmp_path / "no"), "--data", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("published_normals: error: ")
