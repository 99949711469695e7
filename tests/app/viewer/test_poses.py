"""Poses of the viewer without a viewer: the vertical field of view, by hand."""

import math

import numpy as np
import pytest

from minisplat_ref.app.viewer.poses import camera_from_pose, pose_from_camera
from minisplat_ref.types import Camera


def test_the_field_of_view_is_that_of_the_vertical():
    """A height of 60 at fy = 30 is seen under 2 atan(1), whatever fx is; the pixels of a pose are square."""
    camera = Camera(np.eye(3), np.array([0.0, 0.0, 4.0]), 90.0, 30.0, 40.0, 30.0, 80, 60)
    pose = pose_from_camera(camera)
    assert pose.fov == pytest.approx(math.pi / 2)
    assert pose.position == pytest.approx((0.0, 0.0, -4.0))
    again = camera_from_pose(pose, 80, 60)
    assert (again.fx, again.fy) == pytest.approx((30.0, 30.0))
