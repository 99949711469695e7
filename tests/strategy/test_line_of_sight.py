"""Lines of sight, worked by hand: two Gaussians on the ray of one sparse point, and what lies before it."""

import numpy as np
import pytest

from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.line_of_sight import hidden_share, trace_sight_lines
from minisplat_ref.types import Gaussians, Model, view_from
from scenes import make_camera, make_gaussians

CAMERA = make_camera(33, 33, fx=30.0, fy=30.0)  # pixel (16, 16) has its centre on the axis
POINTS = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 2.0]])


def on_the_axis(depths, opacities):
    """Round Gaussians of standard deviation 0.1 on the axis of the camera."""
    n = len(depths)
    o = np.array(opacities, np.float64)
    return Gaussians(
        np.column_stack([np.zeros((n, 2)), depths]).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), np.log(0.1), np.float32),
        np.log(o / (1 - o)).astype(np.float32),
        np.zeros((n, 3), np.float32),
        np.zeros((n, 0, 3), np.float32),
    )


def view_of(*rows):
    return view_from(CAMERA)._replace(point_ids=np.array(rows))


@pytest.mark.parametrize(("margin", "expected"), [(0.1, 0.6), (0.01, 0.6 * 0.75)])
def test_transmittance_before_a_point(margin, expected):
    """0.4 at depth 1 is before the point at 5, 0.25 at 4.6 only with a margin below a twelfth, 0.9 is behind."""
    model = Model(on_the_axis([4.6, 1.0, 6.0], [0.25, 0.4, 0.9]))
    lines = trace_sight_lines(model, view_of(0), POINTS, RenderSettings(), margin)
    np.testing.assert_allclose(lines.transmittances, [expected], rtol=1e-5)
    assert list(lines.rows) == [1, 0, 2] and list(lines.rays) == [0, 0, 0]
    np.testing.assert_allclose(lines.weights, [0.4, 0.6 * 0.25, 0.6 * 0.75 * 0.9], rtol=1e-5)
    assert list(lines.is_before) == [True, margin < 0.08, False]


def test_each_point_has_its_ray():
    """A Gaussian beside the axis is on the ray of the second point alone."""
    points = np.array([[0.0, 0, 5], [1.0, 0, 5]])
    gaussians = on_the_axis([2.0], [0.8])
    gaussians.means[0] = [0.4, 0, 2]
    lines = trace_sight_lines(Model(gaussians), view_of(0, 1), points, RenderSettings(), 0.1)
    assert list(lines.rays) == [1] and lines.transmittances[0] == 1
    np.testing.assert_allclose(lines.transmittances[1], 0.2, rtol=1e-5)  # both are in the middle of pixel (22, 16)


def test_a_ray_has_the_alpha_of_its_pixel():
    """All weights of a ray together are the accumulated opacity that the renderer has there."""
    rng = np.random.default_rng(0)
    model = Model(make_gaussians(rng, 60, sh_degree=0)._replace())
    model = Model(type(model.gaussians)(*(f.astype(np.float32) for f in model.gaussians)))
    points = np.column_stack([rng.uniform(-0.8, 0.8, (20, 2)), np.full(20, 3.0)])
    view = view_from(CAMERA)._replace(point_ids=np.arange(20))
    settings = RenderSettings()
    lines = trace_sight_lines(model, view, points, settings, 0.1)
    alpha = settings.render_view(model, view)[0].alpha
    columns, rows = (30 * points[:, :2] / 3 + 16.5).astype(int).T
    sums = np.bincount(lines.rays, lines.weights, minlength=20)
    np.testing.assert_allclose(sums, alpha[rows, columns], atol=2e-4)  # the renderer ends a ray at T = 1e-4
    assert alpha[rows, columns].max() > 0.5


def test_share_of_hidden_points():
    """The first view shows both points, of which one is hidden; the second has no tracks, the third no point."""
    gaussians = on_the_axis([3.0], [0.9])
    views = [view_of(0, 1), view_from(CAMERA), view_from(CAMERA)._replace(point_ids=np.zeros(0, int))]
    assert hidden_share(gaussians, views, POINTS, RenderSettings()) == 0.5
    assert hidden_share(on_the_axis([3.0], [0.4]), views, POINTS, RenderSettings()) == 0
    assert hidden_share(gaussians, views[1:], POINTS, RenderSettings()) is None


def test_points_behind_the_camera_and_outside_the_image_have_no_ray():
    points = np.array([[0.0, 0, -5], [9.0, 0, 5], [0.0, 0, 5]])
    lines = trace_sight_lines(Model(on_the_axis([1.0], [0.5])), view_of(0, 1, 2), points, RenderSettings(), 0.1)
    np.testing.assert_allclose(lines.transmittances, [0.5], rtol=1e-6)
