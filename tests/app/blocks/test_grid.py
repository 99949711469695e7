"""Blocks on the ground, by hand: the plane, cores of equal numbers of cameras that cover it once, and their regions."""

import math

import numpy as np
import pytest

from minisplat_ref.app.blocks.grid import divide, ground_plane, widen
from minisplat_ref.app.runs.scene_part import Box, box_from_json
from minisplat_ref.errors import InputError
from tolerances import CLOSED_FORM

INF = math.inf


def test_the_plane_is_the_cameras():
    # Cameras on the floor y = 2 of a scene whose height is y: 6 along z, 2 along x.
    centers = np.array([[x, 2.0, z] for x in (-1.0, 1.0) for z in (-3.0, 0.0, 3.0)])
    plane = ground_plane(centers)
    np.testing.assert_allclose(plane.origin, [0, 2, 0], atol=CLOSED_FORM)
    np.testing.assert_allclose(plane.axes, [[0, 0, 1], [1, 0, 0]], atol=CLOSED_FORM)
    np.testing.assert_allclose(plane.coordinates(np.array([[0.5, 9.0, 2.0]])), [[2.0, 0.5]], atol=CLOSED_FORM)


def test_six_cameras_in_two_slabs_of_two():
    # Two slabs of three cameras, divided at x = 2.5; of the three, one is below and two are above.
    xy = np.array([[0.0, 0.0], [1.0, 4.0], [2.0, 8.0], [3.0, 1.0], [4.0, 2.0], [5.0, 9.0]])
    blocks = divide(xy, (2, 2))
    assert [block.name for block in blocks] == ["0-0", "0-1", "1-0", "1-1"]
    assert [block.core for block in blocks] == [
        Box((-INF, -INF), (2.5, 2.0)),
        Box((-INF, 2.0), (2.5, INF)),
        Box((2.5, -INF), (INF, 1.5)),
        Box((2.5, 1.5), (INF, INF)),
    ]
    assert [block.n_cameras for block in blocks] == [1, 2, 1, 2]


def test_cores_cover_the_plane_once():
    rng = np.random.default_rng(0)
    blocks = divide(rng.normal(size=(40, 2)), (3, 4))
    edges = np.array([edge for block in blocks for corner in block.core for edge in corner if math.isfinite(edge)])
    points = np.concatenate([rng.normal(scale=30, size=(500, 2)), np.stack([edges, edges], axis=1)])
    assert (sum(block.core.contains(points).astype(int) for block in blocks) == 1).all()
    assert sorted(block.n_cameras for block in blocks)[::11] == [3, 4]


def test_a_core_is_half_open():
    box = Box((0.0, -INF), (1.0, 2.0))
    assert box.contains(np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 2.0], [0.5, -9.0]])).tolist() == [
        True,
        False,
        False,
        True,
    ]
    assert box_from_json(box.to_json()) == box


def test_a_region_is_a_fifth_wider_on_each_side():
    # x: from the edge at 0 to the last camera, at 4; y: between edges at 0 and 10.
    region = widen(Box((0.0, 0.0), (INF, 10.0)), np.array([[1.0, 5.0], [4.0, 6.0]]))
    np.testing.assert_allclose(region, [[-0.8, -2.0], [INF, 12.0]], atol=CLOSED_FORM)


@pytest.mark.parametrize(
    ("xy", "shape", "why"),
    [
        ([[0.0, 0.0], [1.0, 1.0]], (3, 1), "2 cameras for 3 blocks"),
        ([[0.0, 0.0], [1.0, 1.0]], (5, 1), "2 cameras for 5 blocks"),
        ([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], (2, 2), "1 cameras for 2 blocks"),
        ([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]], (1, 2), "stand side by side"),
    ],
)
def test_what_cannot_be_divided(xy, shape, why):
    fewer = f"give fewer, such as {'2x1' if shape[0] > 3 else '1x1'}"
    with pytest.raises(InputError, match=rf"--blocks {shape[0]}x{shape[1]} cannot be made, .*{why}.*: {fewer}"):
        divide(np.array(xy), shape)
