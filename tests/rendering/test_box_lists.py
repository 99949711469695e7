"""Tile lists from boxes: by hand, on both backends."""

from dataclasses import replace

import numpy as np
import pytest

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.rendering.box_lists import list_boxes
from scenes import make_camera

ON_TILES_OF_KERNELS = replace(REFERENCE, tile_width=CPU.tile_width, tile_height=CPU.tile_height)


def lists_of(depths, boxes, camera, backend):
    boxes = np.array(boxes, np.int32)
    radii = np.where(boxes[:, :2] < boxes[:, 2:], 1, 0).astype(np.int32)
    bins = list_boxes(np.array(depths, float), radii, boxes, camera, GSPLAT_MAIN, backend)
    return [ids.tolist() for ids in np.split(bins.gaussian_ids, bins.tile_offsets[1:-1])]


@pytest.mark.parametrize("backend", [CPU, ON_TILES_OF_KERNELS], ids=["cpu", "reference"])
def test_four_boxes_by_hand(backend):
    """Two tiles, side by side: a box in both, one in the left, one culled, one in the right's last pixel."""
    width, height = backend.tile_width, backend.tile_height
    whole, corner = [0, 0, 2 * width, height], [2 * width - 1, height - 1, 2 * width, height]
    found = lists_of(
        [3, 2, 1, 3], [whole, [0, 0, width, 1], [0, 0, 0, 0], corner], make_camera(2 * width, height), backend
    )
    assert found == [[1, 0], [0, 3]]


def test_backends_list_the_same(rng):
    first = rng.integers(0, 140, (400, 2)) // [1, 2]
    boxes = np.hstack([first, np.minimum(first + rng.integers(0, 80, (400, 2)), [150, 90])])
    depths = rng.uniform(1, 2, 400).round(2)  # with equal ones
    found, expected = (lists_of(depths, boxes, make_camera(150, 90), b) for b in (CPU, ON_TILES_OF_KERNELS))
    assert sum(map(len, expected)) > 500 and found == expected
