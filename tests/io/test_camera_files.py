"""Camera files of other programs, by hand: places and directions that can be read off."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io.camera_files import read_cameras
from tolerances import CLOSED_FORM

SIZE = (40, 30)


def read(tmp_path, content):
    (tmp_path / "c.json").write_text(json.dumps(content))
    return read_cameras(tmp_path / "c.json", SIZE)


def axes(camera):
    """Right, down and forward, world frame."""
    return camera.cam_from_world_R


def test_a_path_of_nerfstudio_by_hand(tmp_path):
    """The identity at (1, 2, 3) looks along -z with y up; 90 degrees from top to bottom are half a height."""
    matrix = [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]
    content = {"camera_path": [{"camera_to_world": matrix, "fov": 90}], "render_width": 200, "render_height": 100}
    ((name, camera, _, _),) = read(tmp_path, content)
    assert name == "camera_0000" and (camera.width, camera.height) == (200, 100)
    assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [50, 50, 100, 50], rtol=CLOSED_FORM)
    assert_allclose(camera.center, [1, 2, 3])
    assert_allclose(axes(camera), [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    del content["render_width"], content["render_height"]
    assert read(tmp_path, content)[0].camera.height == SIZE[1]


def test_poses_of_supersplat_by_hand(tmp_path):
    """Its (-1, -2, 3) is our (1, 2, 3); a target further along z is straight ahead, and down is y."""
    poses = [
        {"position": [-1, -2, 3], "target": [-1, -2, 8]},
        {"position": [0, 0, 0], "target": [0, 5, 0], "name": "up"},
    ]
    (ahead, up) = read(tmp_path, {"poses": poses})
    assert_allclose(ahead.camera.center, [1, 2, 3], atol=CLOSED_FORM)
    assert_allclose(axes(ahead.camera), np.eye(3), atol=CLOSED_FORM)
    assert ahead.camera.fx == ahead.camera.fy == pytest.approx(20 * np.sqrt(3))  # 60 degrees of the longer side, 40
    assert up.name == "up_0001"
    assert_allclose(axes(up.camera)[2], [0, -1, 0], atol=CLOSED_FORM)  # its +y is our -y
    assert (
        read(tmp_path, poses)[0].name == ahead.name and len(read(tmp_path, {"poseSets": [{"poses": poses}] * 2})) == 4
    )


def test_a_path_of_instant_ngp_by_hand(tmp_path):
    """The middle of its cube is our origin, its x is our y; a camera without rotation looks along its z, our x."""
    content = {"path": [{"R": [0, 0, 0, 2], "T": [0.5 + 0.33 * 2, 0.5 + 0.33 * 3, 0.5 + 0.33], "fov": 90}]}
    ((_, camera, _, _),) = read(tmp_path, content)
    assert_allclose(camera.center, [1, 2, 3], rtol=CLOSED_FORM)
    assert_allclose(axes(camera), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=CLOSED_FORM)
    assert camera.fy == pytest.approx(15)


def test_a_lens_is_left_out_with_a_warning(tmp_path):
    frame = {"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist(), "time": 0.5}
    content = {"w": 40, "h": 30, "fl_x": 20, "k1": 0.1, "cx": 7, "frames": [frame]}
    with pytest.warns(InputWarning, match="1 cameras have lens distortion, which is left out"):
        ((name, camera, _, time),) = read(tmp_path, content)
    assert (name, time, camera.fx, camera.cx, camera.cy) == ("a", 0.5, 20, 7, 15)
    del content["w"]
    with pytest.raises(InputError, match=r"a\.jpg has no w and h, and is not there"):
        read(tmp_path, content)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "does not hold a list of cameras"),
        ({"poses": 3}, "does not hold a list of cameras: give 3DGS's cameras.json, nerfstudio's"),
        ({"poseSets": 3}, "does not hold a list of cameras"),
        ({"poseSets": [3]}, "does not hold a list of cameras"),
        ({"path": [3]}, "camera 0 is not an object"),
        ({"camera_path": []}, "has no cameras"),
        ({"camera_path": [{"camera_to_world": [[1, 0], [0, 1]]}]}, "camera 0: camera_to_world is not 4 x 4 numbers"),
        ({"camera_path": [{}], "render_width": "x"}, "no sizes in pixels"),
        ({"poses": [{"position": [0, 0, 0]}]}, "position and target must be 3 numbers each"),
        ({"poses": [{"position": [0, 0, 0], "target": [0, 0, 1], "fov": "wide"}]}, "fov is 'wide', not an angle"),
    ],
)
def test_what_makes_no_sense_is_refused(content, message, tmp_path):
    with pytest.raises(InputError, match=message):
        read(tmp_path, content)


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(InputError, match="no COLMAP model in it, neither cameras"):
        read_cameras(tmp_path, SIZE)
