"""A model with each observation several times: more to read, the same scene."""

import numpy as np
import pytest

from data_tools.measure_block_memory import enlarge_model
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.io import load_scene
from minisplat_ref.io.colmap import read_model

SETTINGS = {"n_views": 4, "width": 16, "height": 12, "n_points": 20, "test_every": 4}


@pytest.fixture
def scene_folder(tmp_path):
    write_scene(make_scene("room", supersampling=1, **SETTINGS), tmp_path / "room", SETTINGS)
    return tmp_path / "room"


def n_observations(folder):
    return sum(len(point.track.elements) for point in read_model(folder).points3D.values())


def test_the_scene_stays_the_same(scene_folder, tmp_path):
    copy, n = tmp_path / "copy", n_observations(scene_folder)
    assert enlarge_model(scene_folder, copy, 2 * n + 1) == 3 * n == n_observations(copy)
    images = read_model(copy).images.values()
    assert sum(len(image.points2D) for image in images) == 3 * n
    listed = set()
    for point_id, point in read_model(copy).points3D.items():
        for element in point.track.elements:  # a track and its images agree, and nothing is listed twice
            listed.add((element.image_id, element.point2D_idx))
            image = next(image for image in images if image.image_id == element.image_id)
            assert image.points2D[element.point2D_idx].point3D_id == point_id
    assert len(listed) == 3 * n
    ours, theirs = load_scene(scene_folder), load_scene(copy)
    np.testing.assert_array_equal(ours.points, theirs.points)
    for one, other in zip(ours.train_views, theirs.train_views, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.point_ids, other.point_ids)
