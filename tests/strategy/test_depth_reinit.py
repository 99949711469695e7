"""Depth reinitialisation: where pixels have their points, which are drawn, and what other views say about them."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref import memory
from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.methods import get_recipe
from minisplat_ref.reference.pinhole import pinhole
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.depth_reinit import (
    PixelPoints,
    blend_points,
    centre_points,
    midpoint_points,
    reinitial_points,
    unproject,
)
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.strategy.ops import concat
from minisplat_ref.training.loop import train
from minisplat_ref.types import Camera, Gaussians, View, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64, SAMPLED_SHARE

ALL_KINDS = pytest.mark.parametrize("points_of", [midpoint_points, centre_points, blend_points])
DEPTH_TOLERANCE = 0.05


def round_gaussian(z, opacity, size=0.5):
    """One on the axis of :func:`make_camera`."""
    return Gaussians(
        means=np.array([[0.0, 0.0, z]]),
        quats=np.array([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=np.full((1, 3), np.log(size)),
        opacity_logits=np.array([np.log(opacity / (1 - opacity))]),
        sh_dc=np.zeros((1, 3)),
        sh_rest=np.zeros((1, 0, 3)),
    )


def views_of(cameras, rng):
    images = [rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8) for camera in cameras]
    return [View(f"view{i}", *pair, None) for i, pair in enumerate(zip(cameras, images, strict=True))]


def given(*pixel_points):
    """A ``points_of`` that answers with these depths and alphas, view by view, whatever the Gaussians."""
    answers = iter([PixelPoints(unproject(d, make_camera()), d, a) for d, a in pixel_points])
    return lambda *_: next(answers)


def draw(views, n_points, points_of, rng, *, gaussians=None, **guards):
    """As in the paper but for the guards given."""
    guards = {"min_alpha": 0.0, "depth_tolerance": None} | guards
    return reinitial_points(gaussians, views, n_points, points_of=points_of, rng=rng, **guards)


def pixel_ids(colors, view):
    """Which pixels these are, by their colours."""
    code = view.image.reshape(-1, 3) @ np.array([65536, 256, 1])
    assert len(np.unique(code)) == len(code)
    order = np.argsort(code)
    return order[np.searchsorted(code[order], colors @ np.array([65536, 256, 1]))]


# Closed form ----------------------------------------------------------------------------------------------------------


def test_midpoint_lies_on_a_sphere_and_centre_on_a_plane(backend):
    """Of a round Gaussian at (0, 0, 3) the densest point of the ray t (x, y, 1) is at t = 3 / (x^2 + y^2 + 1)."""
    camera, gaussians = make_camera(width=5, height=5), round_gaussian(3.0, 0.9)
    slopes = (np.arange(5) - 2) / np.array([[30.0], [28.0]])  # [2, 5]
    squared = slopes[0] ** 2 + slopes[1][:, None] ** 2
    midpoint = midpoint_points(gaussians, view_from(camera), RenderSettings(backend=backend))
    assert_allclose(midpoint.depths, 3 / (1 + squared), rtol=CLOSED_FORM)
    assert_allclose(midpoint.points[4, 1], midpoint.depths[4, 1] * np.array([-1 / 30, 2 / 28, 1]), rtol=CLOSED_FORM)
    assert midpoint.alpha[2, 2] == pytest.approx(0.9, rel=CLOSED_FORM)
    centre = centre_points(gaussians, view_from(camera), RenderSettings(backend=backend))
    assert_allclose(centre.depths, 3.0, rtol=CLOSED_FORM)
    assert_allclose(centre.points[4, 1], 3 * np.array([-1 / 30, 2 / 28, 1]), rtol=CLOSED_FORM)


def test_blended_depth_lies_between_surfaces(backend):
    """Opacities 0.5 and 0.8 at depths 2 and 4: weights 0.5 and 0.4, so the dominant is at 2, the mean at 2.6 / 0.9."""
    camera = make_camera(width=5, height=5)
    gaussians = concat(round_gaussian(4.0, 0.8), round_gaussian(2.0, 0.5))
    blended = blend_points(gaussians, view_from(camera), RenderSettings(backend=backend))
    assert blended.depths[2, 2] == pytest.approx(2.6 / 0.9, rel=CLOSED_FORM)
    assert blended.alpha[2, 2] == pytest.approx(0.9, rel=CLOSED_FORM)
    for points_of in (midpoint_points, centre_points):
        assert points_of(gaussians, view_from(camera), RenderSettings(backend=backend)).depths[2, 2] == pytest.approx(
            2.0, rel=CLOSED_FORM
        )


@ALL_KINDS
def test_points_fall_back_on_the_centres_of_their_pixels(points_of, backend, rng):
    camera = make_camera(rng=rng, cx=10.0, cy=11.0)
    points, depths, _ = points_of(make_gaussians(rng, 60), view_from(camera), RenderSettings(backend=backend))
    assert (depths > 0).any()
    assert not points[depths == 0].any()
    in_camera = points[depths > 0] @ camera.cam_from_world_R.T + camera.cam_from_world_t
    ys, xs = np.nonzero(depths > 0)
    assert_allclose(in_camera[:, 2], depths[depths > 0], rtol=PARITY_FLOAT64)
    assert_allclose(pinhole(in_camera, camera), np.column_stack([xs, ys]) + 0.5, rtol=PARITY_FLOAT64)


@ALL_KINDS
def test_principal_point_is_the_conventions(points_of, rng):
    """INRIA's rasteriser takes it for the image's centre, so the rays of its images go through there."""
    gaussians, moved, centred = make_gaussians(rng, 60), make_camera(cx=10.0, cy=11.0), make_camera()
    for of_moved, of_centred in zip(
        points_of(gaussians, view_from(moved), RenderSettings(conventions=INRIA)),
        points_of(gaussians, view_from(centred), RenderSettings(conventions=INRIA)),
        strict=True,
    ):
        assert_array_equal(of_moved, of_centred)


def test_points_on_rays_by_hand():
    """Pixel (1, 0) at depth 2, with f = (4, 1) and the middle in (1, 0.5), is at 2 (0.5 / 4, 0, 1) = (1/4, 0, 2).

    The camera looks along world x, and x - t = (-3/4, 2, 2) is (2, -3/4, 2) in the world. Pixel (0, 0) shows nothing.
    """
    looks_along_x = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    camera = Camera(looks_along_x, np.array([1.0, -2, 0]), 4.0, 1.0, 1.0, 0.5, 2, 1)
    output = SimpleNamespace(extras={"dominant_depth": np.array([[0.0, 2.0]])}, alpha=np.array([[0.3, 0.4]]))
    settings = SimpleNamespace(render_view=lambda *_, **__: (output, None), conventions=GSPLAT_MAIN)
    points, depths, alpha = centre_points(None, view_from(camera), settings)
    assert_allclose(points, [[[0, 0, 0], [2, -0.75, 2]]], atol=CLOSED_FORM)
    assert_array_equal(depths, [[0.0, 2.0]])
    assert_array_equal(alpha, [[0.3, 0.4]])


# Which pixels are drawn -----------------------------------------------------------------------------------------------


def test_probability_is_the_accumulated_opacity(rng):
    """4000 times one pixel of four, with alpha 0.1, 0.2, 0.3, 0.4."""
    camera = make_camera(width=2, height=2)
    views = views_of([camera], rng) * 4_000
    depths, alpha = np.ones((2, 2)), np.array([[0.1, 0.2], [0.3, 0.4]])
    _, colors = draw(views, 4_000, lambda *_: PixelPoints(np.zeros((2, 2, 3)), depths, alpha), rng)
    counts = np.bincount(pixel_ids(colors, views[0]), minlength=4)
    assert_allclose(counts / 4_000, alpha.ravel(), atol=SAMPLED_SHARE)


def test_drawing_is_without_replacement_and_spares_what_has_no_point(rng):
    views = views_of([make_camera()] * 2, rng)
    depths, alpha = rng.uniform(1, 2, (18, 24)), rng.uniform(0.1, 1, (18, 24))
    depths[:, :4], alpha[:2] = 0, 0
    points, colors = draw(views, 601, given((depths, alpha), (2 * depths, alpha)), rng)
    assert len(points) == len(colors) == 600  # 300 a view of 20 x 16 = 320
    assert points.dtype == np.float64 and colors.dtype == np.uint8
    for i, view in enumerate(views):
        ids = pixel_ids(colors[300 * i : 300 * (i + 1)], view)
        assert len(np.unique(ids)) == 300
        assert np.all((depths * alpha).ravel()[ids] > 0)
        expected = unproject((i + 1) * depths, make_camera()).reshape(-1, 3)[ids]
        assert_allclose(points[300 * i : 300 * (i + 1)], expected, rtol=PARITY_FLOAT64)


def test_more_than_there_are_takes_all(rng):
    views = views_of([make_camera()], rng)
    alpha = np.zeros((18, 24))
    alpha[3:5] = 0.7
    _, colors = draw(views, 10_000, given((np.ones((18, 24)), alpha)), rng)
    assert_array_equal(pixel_ids(colors, views[0]), np.arange(3 * 24, 5 * 24))


def test_opacity_floor_and_mask(rng):
    view = views_of([make_camera()], rng)[0]
    alpha = np.full((18, 24), 0.49)
    alpha[:10] = 0.5
    view = view._replace(mask=np.arange(24) < np.full((18, 1), 6))
    _, colors = draw([view], 10_000, given((np.ones((18, 24)), alpha)), rng, min_alpha=0.5)
    assert_array_equal(np.unique(pixel_ids(colors, view)), np.flatnonzero(view.mask & (alpha >= 0.5)))


def test_same_generator_same_points(rng):
    gaussians, views = as_dtype(make_gaussians(rng, 60), np.float32), views_of([make_camera()], rng)
    first, second = (draw(views, 50, midpoint_points, np.random.default_rng(7), gaussians=gaussians) for _ in range(2))
    assert_array_equal(first[0], second[0])
    assert_array_equal(first[1], second[1])


# What other views say -------------------------------------------------------------------------------------------------

WALL = 30.0 / 7.0  # depth that a row of cameras sees everywhere: 7 px of disparity between neighbours


def row_of_views(n, rng):
    """Cameras side by side, one unit apart, all looking along +z: 13 degrees of parallax between neighbours."""
    cameras = [make_camera()._replace(cam_from_world_t=np.array([-float(i), 0.0, 0.0])) for i in range(n)]
    return views_of(cameras, rng)


def kept_pixels(depth_maps, views, rng, tolerance=DEPTH_TOLERANCE):
    """[V, H, W] which pixels are drawn when all that can be are."""
    full = np.ones(depth_maps[0].shape)
    _, colors = draw(views, 10**9, given(*((d, full) for d in depth_maps)), rng, depth_tolerance=tolerance)
    is_drawn = [(view.image[:, :, None] == colors).all(axis=-1).any(axis=-1) for view in views]
    return np.array(is_drawn)


def walls(n):
    return [np.full((18, 24), WALL) for _ in range(n)]


def test_only_what_another_view_can_judge_is_refuted(rng):
    """The left view shows everything at depth 3, where the right one looks through it to the wall.

    The first 10 columns are not in the right image. What the right view shows, at the wall, stands behind the left's
    surface, which therefore says nothing of it.
    """
    depth_maps = walls(2)
    depth_maps[0][:] = 3.0
    left, right = kept_pixels(depth_maps, row_of_views(2, rng), rng)
    assert_array_equal(left, np.arange(24) < np.full((18, 1), 10))
    assert right.all()
    assert kept_pixels(walls(2), row_of_views(2, rng), rng).all()


@pytest.mark.parametrize(
    ("factor", "is_kept"), [(1.06, True), (1.04, True), (0.96, True), (0.953, True), (0.951, False), (0.94, False)]
)
def test_tolerance_is_relative(factor, is_kept, rng):
    """Of the left of three views, whose fellows agree with each other; what is behind their surface they cannot see.

    The tolerance is a part of the point's own depth: the step to the wall is 0.05 of it at a factor of 1 / 1.05.
    """
    depth_maps = walls(3)
    depth_maps[0] *= factor
    seen = kept_pixels(depth_maps, row_of_views(3, rng), rng)[0][:, 8:]  # by one of the others, or both
    assert seen.all() if is_kept else not seen.any()


def test_a_floater_is_outvoted(rng):
    """The left one of three views shows something at depth 3 in its last columns, where both others see the wall."""
    depth_maps = walls(3)
    depth_maps[0][:, 18:] = 3.0
    left = kept_pixels(depth_maps, row_of_views(3, rng), rng)[0]
    assert not left[:, 18:].any()
    assert left[:, 8:18].all()


def test_who_sees_something_nearer_has_no_vote(rng):
    """What stands in front of the middle camera hides the wall from it, and says nothing on what the left one sees."""
    depth_maps = walls(3)
    depth_maps[1][:] = 1.0
    left = kept_pixels(depth_maps, row_of_views(3, rng), rng)[0]
    assert left.all()


def test_a_tie_does_not_confirm(rng):
    """Of the two others, one has the left view's surface at depth 3, one sees through it."""
    depth_maps = walls(3)
    depth_maps[0][:], depth_maps[1][:] = 3.0, 3.0
    left = kept_pixels(depth_maps, row_of_views(3, rng), rng)[0]
    assert not left[:, 20:].any()  # seen by both: a shift of 2 units at depth 3 is 20 px
    assert left[:, 10:20].all()  # seen by the middle one


def test_those_who_look_from_the_side_are_asked_before_those_who_look_from_behind(rng):
    """Cameras around one point, which the first sees: eight that stand at 170 degrees to it, and eight at 100.

    Only eight are asked. Those at 170 degrees, who come first in the list, see through the point.
    """
    degrees = np.array([0.0, *([170.0] * 8), *([100.0] * 8)])
    cosines, sines = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    cameras = [
        make_camera(3, 3)._replace(
            cam_from_world_R=np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]), cam_from_world_t=np.array([0, 0, 5.0])
        )
        for c, s in zip(cosines, sines, strict=True)
    ]
    views, full = views_of(cameras, rng), np.ones((3, 3))
    answers = [(np.where(np.arange(9).reshape(3, 3) == 4, 5.0, 0.0), full)]
    answers += [(np.full((3, 3), 9.0 if angle == 170 else 5.0), full) for angle in degrees[1:]]
    points, _ = draw(views, 17 * 9, given(*answers), rng, depth_tolerance=DEPTH_TOLERANCE)
    assert np.any(np.all(np.abs(points) < CLOSED_FORM, axis=1))


def test_views_that_cannot_compare_keep_their_points(rng):
    """A single photograph, and a camera that turns about its own centre."""
    assert kept_pixels(walls(1), row_of_views(1, rng), rng).all()
    camera = make_camera()
    turned = camera._replace(cam_from_world_R=np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]]))
    assert kept_pixels([np.full((18, 24), d) for d in (4.0, 9.0)], views_of([camera, turned], rng), rng).all()


def test_unconfirmed_points_go_behind_the_scene(rng):
    """Every pixel is drawn; those of the right view's floater at 50 units along their rays, others where they are."""
    depth_maps, views = walls(3), row_of_views(3, rng)
    depth_maps[2][:, :6] = 3.0
    answers = given(*((d, np.ones(d.shape)) for d in depth_maps))
    points, _ = draw(views, 10**9, answers, rng, depth_tolerance=DEPTH_TOLERANCE, backdrop_distance=50.0)
    right = points[2 * 18 * 24 :].reshape(18, 24, 3) - [2.0, 0.0, 0.0]  # from its camera
    assert_allclose(np.linalg.norm(right[:, :6], axis=-1), 50.0, rtol=CLOSED_FORM)
    rays = unproject(np.ones((18, 24)), make_camera())
    assert_allclose(right / right[..., 2:], rays, rtol=PARITY_FLOAT64, atol=PARITY_FLOAT64)
    assert_allclose(right[:, 6:16, 2], WALL, rtol=CLOSED_FORM)


@pytest.mark.parametrize("name", ["room", "plain-wall", "outdoor"])
def test_true_depths_are_confirmed_and_wrong_ones_are_not(name, rng):
    """Exact depths of a ring of views, one in five replaced by 0.3 to 0.8 of it, the sky by 2 m.

    Outdoors a part of what is wrong hangs in the air where no other view looks; nothing can be said of that.
    """
    truth = make_scene(name, n_views=16, width=80, height=60, supersampling=1, n_points=0, test_every=0)
    is_wrong = rng.random(truth.train_depths.shape) < 0.2
    depths = np.where(is_wrong, truth.train_depths * rng.uniform(0.3, 0.8, is_wrong.shape), truth.train_depths)
    depths = np.where(depths == 0, 2.0, depths)
    is_wrong |= truth.train_depths == 0
    number = np.arange(is_wrong.size, dtype=np.uint32).reshape(is_wrong.shape)  # a colour for each pixel of all views
    images = np.stack([number >> 16, number >> 8, number], axis=-1).astype(np.uint8)
    views = [view._replace(image=image) for view, image in zip(truth.scene.train_views, images, strict=True)]
    full = np.ones(depths.shape[1:])
    _, colors = draw(views, 10**9, given(*((d, full) for d in depths)), rng, depth_tolerance=DEPTH_TOLERANCE)
    is_kept = np.zeros(is_wrong.size, bool)
    is_kept[colors @ np.array([65536, 256, 1])] = True
    is_kept = is_kept.reshape(is_wrong.shape)
    assert is_kept[~is_wrong].mean() > 0.8
    is_sky = truth.train_depths == 0
    assert is_kept[is_wrong & ~is_sky].mean() < (0.2 if name == "outdoor" else 0.1)
    assert is_kept[is_sky].sum() <= 0.5 * is_sky.sum()


# A scene with sky -----------------------------------------------------------------------------------------------------

N_PER_VIEW = 300


@pytest.fixture(scope="module")
def outdoor():
    return make_scene("outdoor", n_views=16, width=80, height=60, supersampling=1, n_points=600, test_every=0)


@pytest.fixture(scope="module")
def trained(outdoor):
    """150 steps, in which the sky has been painted onto Gaussians anywhere between the cameras and the trees."""
    return train(outdoor.scene, get_recipe("3dgs-accel", 150), seed=0).gaussians


def wrong_and_sky_shares(gaussians, truth, points_of=midpoint_points, **guards):
    """Shares of the drawn points: more than 5 % in depth off what their pixel shows, and on the sky."""
    views = truth.scene.train_views
    points, _ = draw(views, N_PER_VIEW * len(views), points_of, np.random.default_rng(0), gaussians=gaussians, **guards)
    assert len(points) == N_PER_VIEW * len(views)
    is_wrong, is_sky = [], []
    for view, true_depth, own in zip(views, truth.train_depths, np.split(points, len(views)), strict=True):
        in_camera = own @ view.camera.cam_from_world_R.T + view.camera.cam_from_world_t
        x, y = np.floor(pinhole(in_camera, view.camera)).astype(int).T
        is_wrong.append(np.abs(in_camera[:, 2] - true_depth[y, x]) > 0.05 * true_depth[y, x])
        is_sky.append(true_depth[y, x] == 0)
    return np.mean(is_wrong), np.mean(is_sky)


def test_paper_puts_points_off_the_surface_and_the_vote_fewer(outdoor, trained):
    paper, _ = wrong_and_sky_shares(trained, outdoor)
    asked, _ = wrong_and_sky_shares(trained, outdoor, depth_tolerance=DEPTH_TOLERANCE)
    assert paper > 0.5  # the failure: measured 0.62
    assert asked < 0.92 * paper  # measured 0.53 to 0.56 of 0.62 to 0.64 with four seeds, 150 and 200 steps each


def test_opacity_floor_spares_a_sky_that_is_not_painted(outdoor, rng):
    gaussians = initial_gaussians(outdoor.scene, 0, rng)
    _, paper = wrong_and_sky_shares(gaussians, outdoor)
    _, floored = wrong_and_sky_shares(gaussians, outdoor, min_alpha=0.9)
    assert paper > 0.15  # the failure: measured 0.20
    assert floored < 0.5 * paper  # measured 0.06


def test_blended_depth_is_worst(outdoor, trained):
    """Table 4 of the paper: mid-point and centre are close, blended depth fails. Measured 0.62, 0.69, 0.88."""
    midpoint, centre, blended = (
        wrong_and_sky_shares(trained, outdoor, points_of)[0]
        for points_of in (midpoint_points, centre_points, blend_points)
    )
    assert midpoint < centre < blended
    assert blended - centre > centre - midpoint


# Hard cases -----------------------------------------------------------------------------------------------------------


@ALL_KINDS
@pytest.mark.parametrize("depth_tolerance", [None, DEPTH_TOLERANCE])
def test_nothing_to_draw_is_one_clear_line(points_of, depth_tolerance, rng):
    views = views_of([make_camera()] * 3, rng)
    for gaussians, min_alpha in ((make_gaussians(rng, 0), 0.0), (round_gaussian(3.0, 0.5), 0.6)):
        with pytest.raises(InputError, match="lower min_alpha"):
            draw(
                views,
                100,
                points_of,
                rng,
                gaussians=gaussians,
                min_alpha=min_alpha,
                depth_tolerance=depth_tolerance,
            )


def test_fewer_points_than_views_is_one_clear_line(rng):
    with pytest.raises(InputError, match="2 points from 3 views"):
        draw(views_of([make_camera()] * 3, rng), 2, given(), rng)


def test_depths_that_do_not_fit_into_memory_are_one_clear_line(rng, monkeypatch):
    views = views_of([make_camera(24, 18)] * 3, rng)
    monkeypatch.setattr(memory, "free_bytes", lambda: 8.0 * 3 * 24 * 18 - 1)
    with pytest.raises(InputError, match=r"depths of all 3 views take 10 kB of memory, 10 kB are free: .*3dgs-accel"):
        draw(views, 100, given(), rng)
    monkeypatch.setattr(memory, "free_bytes", lambda: 8.0 * 3 * 24 * 18)
    with pytest.raises(InputError, match="lower min_alpha"):  # it continued
        draw(views, 100, midpoint_points, rng, gaussians=make_gaussians(rng, 0))
