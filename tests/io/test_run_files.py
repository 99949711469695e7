"""A run or a PLY, the cameras beside it, and what is behind its scene."""

import json

import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.io.run_files import CAMERAS, CONFIG, POINT_CLOUD, model_file, read_background, read_cameras

CAMERA = {"img_name": "a", "width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "position": [0, 0, 0]}
CAMERA |= {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}


def test_a_run_and_a_file(tmp_path):
    assert model_file(tmp_path) == tmp_path / POINT_CLOUD == tmp_path / "point_cloud.ply"
    assert model_file(tmp_path / "a.ply") == tmp_path / "a.ply"


def test_cameras_are_those_beside_or_those_given(tmp_path):
    (tmp_path / CAMERAS).write_text(json.dumps([CAMERA]))
    given = tmp_path / "other.json"
    given.write_text(json.dumps([CAMERA | {"img_name": "b"}]))
    names = [read_cameras(tmp_path / "a.ply", path)[0].name for path in (None, given)]
    assert names == ["a", "b"] and CAMERAS == "cameras.json"


def test_no_cameras_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"a\.ply has no cameras\.json beside it: give --cameras JSON"):
        read_cameras(tmp_path / "a.ply")
    with pytest.raises(InputError, match=r"absent\.json: cannot be read"):
        read_cameras(tmp_path / "a.ply", tmp_path / "absent.json")


def test_the_background_is_the_given_one_that_of_the_run_or_black(tmp_path):
    assert list(read_background(tmp_path / "a.ply")) == [0, 0, 0]
    (tmp_path / CONFIG).write_text(json.dumps({"background": [1, 0.5, 0]}))
    assert list(read_background(tmp_path / "a.ply")) == [1, 0.5, 0]
    assert list(read_background(tmp_path / "a.ply", [0, 0.25, 1])) == [0, 0.25, 1]


@pytest.mark.parametrize("content", ["{}", "[]", "{", '{"background": [1, 2, 0]}', '{"background": [1, NaN, 0]}'])
def test_a_damaged_background_is_one_line(content, tmp_path):
    (tmp_path / CONFIG).write_text(content)
    with pytest.raises(InputError, match=r"config\.json") as caught:
        read_background(tmp_path / "a.ply")
    assert "\n" not in str(caught.value)
    assert list(read_background(tmp_path / "a.ply", [0, 0, 1])) == [0, 0, 1]
