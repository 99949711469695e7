"""Coverage: how many photographs show a wall, a wall behind a screen, and nothing that sparse points say."""

import numpy as np

from data_tools.claims.kit.coverage import count_covering_views, interpolate_depths
from minisplat_ref.types import view_from
from scenes import make_camera

CAMERA = make_camera(40, 32, fx=20.0, fy=20.0)  # sees x from -1 to 1 and y from -0.8 to 0.8 times the depth


def wall(depth, half=3.0, n=9):
    """Points of a wall across the axis."""
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    return np.column_stack([x.ravel(), y.ravel(), np.full(n * n, depth)])


def view_at(x, points, ids=None):
    camera = CAMERA._replace(cam_from_world_t=np.array([-x, 0.0, 0.0]))
    return view_from(camera)._replace(point_ids=np.arange(len(points)) if ids is None else ids)


def test_half_of_a_wall():
    """A camera 2 to the right of one that sees x from -2 to 2 of a wall at depth 2 sees from 0 to 4: the right half."""
    points = wall(2.0, half=4.0)
    views = [view_at(2.0, points), view_at(0.0, points), view_at(20.0, points)]
    counts = count_covering_views(view_at(0.0, points), views, points)
    assert counts.shape == (32, 40)
    assert (counts[:, :18] == 1).all() and (counts[:, 21:] == 2).all()


def test_what_a_screen_hides():
    """A wall at depth 4, of which a neighbour sees only a screen at depth 1."""
    points = np.concatenate([wall(4.0, half=5.0), wall(1.0)])
    behind, before = np.arange(81), np.arange(81, 162)
    own = view_at(0.0, points, behind)
    assert (count_covering_views(own, [view_at(0.1, points, behind)], points)[:, 4:-4] == 1).all()
    assert (count_covering_views(own, [view_at(0.1, points, before)], points) == 0).all()
    nearer = np.concatenate([wall(4.0, half=5.0), wall(3.5)])  # 4 < 1.2 * 3.5: the surface, roughly
    assert (count_covering_views(own, [view_at(0.1, nearer, before)], nearer)[:, 4:-4] == 1).all()


def test_depths_between_points_are_linear_in_their_inverse():
    """On the plane z = 2 + x, 1/z is linear in the image: the interpolation is exact."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.9, 3, 12), np.linspace(-3, 3, 12)))
    points = np.column_stack([x, y, 2 + x])
    depths = interpolate_depths(view_at(0.0, points), points, np.array([[20.0, 16.0], [30.0, 10.0]]))
    np.testing.assert_allclose(depths, [2.0, 2 / (1 - 0.5)], rtol=1e-9)


def test_few_points_say_nothing():
    points = wall(2.0)
    assert count_covering_views(view_at(0.0, points, np.arange(7)), [view_at(0.0, points)], points) is None
    assert count_covering_views(view_at(0.0, points)._replace(point_ids=None), [], points) is None
    blind = view_at(0.0, points)._replace(point_ids=None)
    assert (count_covering_views(view_at(0.0, points), [blind], points) == 1).all()  # what is in its image counts
