"""Surfels against answers from elsewhere: planes, a sphere, sums over pairs; kernels against the reference."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.depth_maps.normals import central_normals
from minisplat_ref.mechanisms.surfels import ray_kernels, ray_measures
from minisplat_ref.mechanisms.surfels.disagreement import disagree
from minisplat_ref.mechanisms.surfels.projection import (
    GSPLAT,
    PAPER,
    RELEASED,
    choose_pivot,
    cut_disc_boxes,
    project,
)
from minisplat_ref.mechanisms.surfels.renderer import CHANNELS, SURFELS, list_tiles
from minisplat_ref.mechanisms.surfels.response import Layout, surfel_response
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import Request, activate
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import Camera, Gaussians, Model, Primitives, RenderOutput, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
    REMOVAL,
    SURFEL_FLOAT32_GRADIENT,
    SURFEL_HIT,
    SURFEL_PLANE,
    SURFEL_POINT,
    SURFEL_WIDE,
)

WANTS = frozenset(CHANNELS)
EDGE_ON = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
CAMERA = Camera(np.eye(3), np.zeros(3), 32.0, 30.0, 12.3, 9.1, 24, 18)


def surfels_at(means, quats, scales, opacities):
    """Gaussians of grey; a scale is that of both axes."""
    n = len(means)
    logits = np.log(np.asarray(opacities) / (1 - np.asarray(opacities)))
    log_scales = np.repeat(np.log(np.asarray(scales, float))[:, None], 3, axis=1)
    return Gaussians(
        np.asarray(means, float), np.asarray(quats, float), log_scales, logits, np.zeros((n, 3)), np.zeros((n, 0, 3))
    )


def drawn(gaussians, camera=CAMERA, backend=REFERENCE, wants=WANTS):
    output, tape = SURFELS.render(Model(gaussians), view_from(camera), Request(backend=backend, wants=wants))
    return output, tape, SURFELS.channels(wants)


def test_a_plane_has_the_depths_and_the_normal_of_a_plane(backend):
    """The plane n . x = d is hit by the ray r at z = d / (n . r)."""
    quat, mean = np.array([1.0, 0.2, -0.15, 0.4]), np.array([0.1, -0.2, 5.0])
    output, tape, channels = drawn(surfels_at([mean], [quat], [1e3], [0.8]), backend=backend)
    n = tape.shown.surfels.normals[0]
    rays = pinhole_rays(np.arange(24) + 0.5, np.arange(18)[:, None] + 0.5, CAMERA)
    z = (n @ mean) / (rays @ n)
    assert n @ mean < 0 and np.ptp(z) > 0.5
    alpha = output.alpha
    assert_allclose(alpha, 0.8, rtol=SURFEL_WIDE)
    assert_allclose(output.image[..., channels["depth"]][..., 0], alpha * z, rtol=SURFEL_PLANE)
    assert_allclose(output.image[..., channels["normal"]], alpha[..., None] * n, rtol=SURFEL_PLANE, atol=1e-15)
    assert_allclose(output.median_depth, z, rtol=SURFEL_PLANE)
    assert_allclose(
        central_normals(z, CAMERA)[1:-1, 1:-1], np.broadcast_to(n, (16, 22, 3)), rtol=SURFEL_HIT, atol=1e-12
    )


def test_a_sphere_of_tangent_surfels_has_its_depths_and_normals(backend):
    """A surfel where a pixel's ray meets the sphere, tangent there: depth and normal of the pixel are the sphere's."""
    rays = pinhole_rays(np.arange(24) + 0.5, np.arange(18)[:, None] + 0.5, CAMERA)
    center, radius = np.array([0.0, 0.0, 5.0]), 1.2
    a, b, c = np.sum(rays * rays, axis=2), rays @ center, center @ center - radius**2
    is_met = b * b > a * c
    is_met[np.arange(18) % 4 > 0], is_met[:, np.arange(24) % 4 > 0] = False, False  # neighbours do not overlap
    r, t = rays[is_met], ((b - np.sqrt(np.maximum(b * b - a * c, 0))) / a)[is_met]
    points = t[:, None] * r
    n = (points - center) / radius
    quats = np.column_stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))])  # rotate z to n
    quats[n[:, 2] < -1 + 1e-9] = (0, 1, 0, 0)
    scales, opacities = np.full(len(n), 0.02), np.full(len(n), 0.9)
    output, _, channels = drawn(surfels_at(points, quats, scales, opacities), backend=backend)
    shown = output.image[is_met]
    assert len(n) > 8 and np.ptp(t) > 0.4
    assert_allclose(output.alpha[is_met], 0.9, rtol=SURFEL_HIT)
    assert_allclose(shown[:, channels["depth"]][:, 0], 0.9 * t, rtol=SURFEL_HIT)
    assert_allclose(shown[:, channels["normal"]], 0.9 * n, rtol=SURFEL_HIT, atol=SURFEL_HIT)
    assert_allclose(output.median_depth[is_met], t, rtol=SURFEL_HIT)


def test_below_a_pixel_only_the_low_pass_is_left(backend):
    """At d pixels from the centre alpha is o exp(-d^2), and the depth that of the centre."""
    output, _, channels = drawn(surfels_at([[0.0, 0.0, 4.0]], [[1.0, 0.1, 0.2, 0]], [1e-7], [0.9]), backend=backend)
    dx, dy = np.arange(24) + 0.5 - 12.3, np.arange(18)[:, None] + 0.5 - 9.1
    alpha = 0.9 * np.exp(-(dx**2) - dy**2)
    assert_allclose(output.alpha, np.where(alpha >= 1 / 255, alpha, 0), rtol=SURFEL_POINT, atol=1e-15)
    assert_allclose(output.image[..., channels["depth"]][..., 0], 4 * output.alpha, rtol=CLOSED_FORM)


def test_seen_from_its_edge_a_disc_is_its_low_pass(backend):
    output, _, _ = drawn(surfels_at([[0.0, 0.0, 4.0]], [EDGE_ON], [0.5], [0.9]), backend=backend)
    y, x = 8, 11
    assert_allclose(output.alpha[y, x], 0.9 * np.exp(-((x + 0.5 - 12.3) ** 2) - (y + 0.5 - 9.1) ** 2), rtol=SURFEL_HIT)


@pytest.mark.parametrize("rules", [PAPER, RELEASED, GSPLAT])
def test_the_centre_of_the_low_pass_by_hand(rules):
    """A disc turned about y: its ends at u = -e and e are 5 - e sin and 5 + e sin away, and c is halfway between them.

    One that reaches behind the camera with its three standard deviations, or one, has no box, except in gsplat.
    """
    sine, cosine, f, e = 0.6, 0.8, 30.0, {PAPER: 0.0, RELEASED: 3.0, GSPLAT: 1.0}[rules]
    camera = Camera(np.eye(3), np.zeros(3), f, f, 12.0, 9.0, 24, 18)
    quats = [[np.cos(np.arcsin(sine) / 2), 0, np.sin(np.arcsin(sine) / 2), 0]] * 2
    g = surfels_at([[0.5, 0.2, 5.0]] * 2, quats, [0.7, 40.0], [0.9, 0.9])
    found = project(activate(g), camera, GSPLAT_MAIN, rules).means2d
    ends = [f * (0.5 + k * 0.7 * cosine) / (5.0 - k * 0.7 * sine) for k in (-e, e)]
    assert_allclose(found[0, 0], 12 + np.mean(ends), rtol=CLOSED_FORM)
    assert (abs(found[0, 0] - 15) > 0.1) == (e > 0)
    assert (abs(found[1, 0] - 15) < 1e-9) == (rules != GSPLAT)


@pytest.mark.parametrize("side", [-1, 1])
def test_either_side_of_the_switch(side, backend):
    """A disc that faces the camera: (u, v) = d z / (f s), and the low-pass is rho = 2 d^2; the smaller rho counts."""
    f, z, d = 32.0, 4.0, 0.7  # px
    s = z / (f * np.sqrt(2)) * (1 + 0.05 * side)  # world units: at the switch both are equal
    camera = CAMERA._replace(fy=f, cx=12.5 - d, cy=9.5)
    output, tape, _ = drawn(surfels_at([[0.0, 0.0, z]], [[1.0, 0, 0, 0]], [s], [0.9]), camera, backend)
    c = tape.shown.surfels.means2d[0]
    assert_allclose(c, (12.5 - d, 9.5), rtol=CLOSED_FORM)
    rho = min((d * z / (f * s)) ** 2, 2 * d * d)
    assert (rho < 2 * d * d) == (side == 1)
    assert_allclose(output.alpha[9, 12], 0.9 * np.exp(-rho / 2), rtol=SURFEL_HIT)


def test_nothing_behind_the_camera_is_drawn(backend):
    """The first disc lies behind; the plane of the second reaches behind, where the ray meets it at z < 0."""
    quats = [[1.0, 0, 0, 0], [np.cos(0.7), 0, np.sin(0.7), 0]]
    output, _, channels = drawn(
        surfels_at([[0, 0, -3.0], [0.5, 0, 0.5]], quats, [1.0, 3.0], [0.9, 0.9]), backend=backend
    )
    is_hit = output.alpha > 0
    depth = output.image[..., channels["depth"]][..., 0][is_hit] / output.alpha[is_hit]
    assert is_hit.any() and depth.min() > GSPLAT_MAIN.near_plane


def test_density_control_hears_of_the_centre_in_pixels(backend, rng):
    """Discs that face the camera move by z / f for a pixel: large ones are met, tiny ones only their low-pass."""
    means = np.column_stack([rng.uniform(-0.8, 0.8, (8, 2)), rng.uniform(3, 5, 8)])
    g = surfels_at(means, [[1.0, 0, 0, 0]] * 8, [0.5, 1e-6] * 4, [0.5] * 8)
    g = g._replace(sh_dc=rng.normal(size=(8, 3)))
    output, tape, _ = drawn(g, backend=backend, wants=frozenset())
    v = SURFELS.render_vjp(tape, rng.normal(size=output.image.shape))
    expected = v.gaussians.means[:, :2] * means[:, 2:] / (CAMERA.fx, CAMERA.fy)
    assert np.abs(expected).max(axis=1).min() > 1e-3
    assert_allclose(v.means2d, expected, rtol=SURFEL_POINT, atol=1e-10)


def test_hits_before_the_near_plane_are_dropped_one_by_one(backend):
    """A wall that recedes to the right is cut where it is nearer than the near plane, though its centre is not."""
    wall = surfels_at([[0, 0, 4.0]], [[np.cos(0.2), 0, np.sin(0.2), 0]], [1e3], [0.9])
    request = Request(conventions=GSPLAT_MAIN._replace(near_plane=3.95), backend=backend)
    output, tape = SURFELS.render(Model(wall), view_from(CAMERA), request)
    n = tape.shown.surfels.normals[0]
    rays = pinhole_rays(np.arange(24) + 0.5, np.arange(18)[:, None] + 0.5, CAMERA)
    z = 4 * n[2] / (rays @ n)
    assert (z < 3.9).any() and (z > 4).any()
    np.testing.assert_array_equal(output.alpha > 0, z > 3.95)


@pytest.mark.parametrize(
    ("size", "near", "part_cut"), [(0.5, 0.01, 0.0), (3.0, 0.01, 0.5), (3.0, 0.5, 0.5), (1.0, 0.0, 0.1)]
)
def test_a_box_holds_all_that_is_visible(size, near, part_cut, rng):
    """Alpha is below its least outside of every box; large discs reach behind the camera."""
    g = make_gaussians(rng, 40, size=size)
    camera = make_camera(rng=rng)
    surfels = project(activate(g), camera, GSPLAT_MAIN._replace(near_plane=near), PAPER)
    ys, xs = np.mgrid[: camera.height, : camera.width]
    found = surfel_response(Layout()).hit(surfels, np.arange(40), np.column_stack([xs.ravel(), ys.ravel()]) + 0.5)
    x0, y0, x1, y1 = surfels.boxes[:, :, None].swapaxes(0, 1)
    is_outside = ~((x0 <= xs.ravel()) & (xs.ravel() < x1) & (y0 <= ys.ravel()) & (ys.ravel() < y1))
    is_seen = surfels.radii[:, :1] > 0
    assert (is_outside & is_seen).any() and found.unclamped[is_outside & is_seen].max() < GSPLAT_MAIN.alpha_min
    M_w = surfels.transforms[:, 2]
    assert np.mean(3 * np.linalg.norm(M_w[:, :2], axis=1) > M_w[:, 2]) >= part_cut


def test_the_part_of_a_floor_beyond_the_near_plane_by_hand():
    """A disc of radius 3 at y = 1 around (0, 1, 2), cut at z = 0.5: it ends at z = 5, and is widest where it is cut.

    There x^2 = 9 - 1.5^2 and x / z = sqrt(27); x / z falls with z.
    """
    fx, fy, cx, cy = 32.0, 30.0, 12.3, 9.1
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    T = K @ np.array([[1.5, 0, 0], [0, 0, 1], [0, 1.5, 2]])  # two standard deviations of 1.5
    low, high = cut_disc_boxes(T[None], np.array([4.0]), 0.5)
    assert_allclose(low[0], (cx - fx * np.sqrt(27), cy + fy / 5), rtol=CLOSED_FORM)
    assert_allclose(high[0], (cx + fx * np.sqrt(27), cy + fy / 0.5), rtol=CLOSED_FORM)


def test_bounds_of_cut_discs_are_those_of_their_points(rng):
    """Against points of the circle and of the chord, which are never outside, and reach the bounds."""
    near, n = 0.3, 300
    A = rng.normal(size=(n, 3, 3))
    A[:, 2, 2] = near + np.abs(A[:, 2, 2])
    T, squares = np.array([[32.0, 0, 12], [0, 30.0, 9], [0, 0, 1]]) @ A, rng.uniform(1, 9, n)
    is_cut = T[:, 2, 2] - np.sqrt(squares) * np.linalg.norm(T[:, 2, :2], axis=1) < near
    T, e = T[is_cut], np.sqrt(squares[is_cut])
    low, high = cut_disc_boxes(T, e * e, near)
    n_wide = 0
    for one, radius, left, right in zip(T, e, low, high, strict=True):
        half = np.arccos((near - one[2, 2]) / (radius * np.hypot(*one[2, :2])))  # of the circle that is cut off
        angles = np.arctan2(one[2, 1], one[2, 0]) + np.linspace(-half, half, 20_001)
        points = np.vstack([radius * np.cos(angles), radius * np.sin(angles), np.ones_like(angles)])
        u_v_z = one @ points
        shown = u_v_z[:2] / u_v_z[2]
        assert_allclose(u_v_z[2, [0, -1]], near, rtol=1e-9)
        size = np.abs(np.stack([left, right])).max()
        assert (shown.min(axis=1) >= left - 1e-9 * size).all() and (shown.max(axis=1) <= right + 1e-9 * size).all()
        assert (shown.min(axis=1) <= left + 1e-4 * size).all() and (shown.max(axis=1) >= right - 1e-4 * size).all()
        n_wide += (shown.max(axis=1) - shown.min(axis=1)).min() > 100
    assert len(T) > 150 and n_wide > 20


@pytest.mark.parametrize(
    ("dtype", "image_rel", "gradient_rel"),
    [(np.float64, PARITY_FLOAT64, 10 * PARITY_FLOAT64), (np.float32, PARITY_FLOAT32_IMAGE, SURFEL_FLOAT32_GRADIENT)],
)
@pytest.mark.parametrize("size", [0.15, 0.6])
def test_kernels_and_reference_agree(dtype, image_rel, gradient_rel, size, rng):
    g, camera = make_gaussians(rng, 40, size=size), make_camera(rng=rng)
    (output, tape, _), (known, known_tape, _) = drawn(as_dtype(g, dtype), camera, CPU), drawn(g, camera)
    assert_allclose(output.image, known.image, atol=image_rel * np.abs(known.image).max())
    v_image, v_alpha = rng.normal(size=known.image.shape), rng.normal(size=known.alpha.shape)
    v = SURFELS.render_vjp(tape, v_image.astype(dtype), v_alpha.astype(dtype))
    expected = SURFELS.render_vjp(known_tape, v_image, v_alpha)
    pairs = [*zip(v.gaussians, expected.gaussians, strict=True), (v.means2d, expected.means2d)]
    for got, want in [*pairs, (v.cam_from_world_R, expected.cam_from_world_R)]:
        assert_allclose(got, want, atol=gradient_rel * np.abs(want).max())


@pytest.mark.parametrize("rules", [PAPER, GSPLAT])
@pytest.mark.parametrize("module", [ray_measures, ray_kernels])
def test_what_rays_measure_is_a_sum_over_pairs(rules, module, rng):
    """Pixel by pixel and pair by pair: distortion with |z_i - z_j|, hits in the order of their depths."""
    camera = CAMERA
    n = 12
    means = np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), np.linspace(3, 6, n)])
    p = Primitives(means, np.tile((1.0, 0.02, 0.01, 0), (n, 1)), np.full((n, 3), 0.4), rng.uniform(0.2, 0.9, n))
    surfels = project(p, camera, GSPLAT_MAIN, rules)
    bins = list_tiles(surfels, camera, GSPLAT_MAIN, REFERENCE)
    extra = (np.dtype(float),) if module is ray_kernels else ()
    measures = module.measure_rays(surfels, bins, GSPLAT_MAIN, *extra)
    n_looked_at = 0
    for tile in tile_hits(surfels, bins, GSPLAT_MAIN, surfel_response(Layout())):
        for k in range(0, len(tile.ys), 7):
            rows = np.flatnonzero(tile.alphas[:, k] > 0)
            T, w, z = np.ones(1), [], tile.hit.depths[rows, k]
            front = []
            for alpha in tile.alphas[rows, k]:
                front.append(T[0])
                w.append(T[0] * alpha)
                T = T * (1 - alpha)
            pairs = sum(w[i] * w[j] * abs(z[i] - z[j]) for i, j in itertools.product(range(len(w)), repeat=2))
            median = [z[i] for i in range(len(w)) if front[i] > 0.5][-1:] or [0.0]
            at = tile.ys[k], tile.xs[k]
            assert_allclose(measures.distortion[at], pairs, rtol=SURFEL_HIT, atol=1e-14)
            assert_allclose(measures.median[at], median[0], rtol=CLOSED_FORM)
            n_looked_at += len(rows) > 2
    assert n_looked_at > 5


def test_spread_gives_the_squared_distortion_whatever_the_offset(rng):
    """A S_2 - S_1^2 is the sum over pairs of w_i w_j (1 / z_i - 1 / z_j)^2."""
    output, tape, channels = drawn(make_gaussians(rng, 30, size=0.4), make_camera(rng=rng))
    S_1, S_2 = np.moveaxis(output.image[..., channels["spread"]], 2, 0)
    got = output.alpha * S_2 - S_1**2
    shown, n_looked_at = tape.shown, 0
    for tile in tile_hits(shown.surfels, shown.bins, shown.conventions, surfel_response(shown.layout)):
        w = tile.alphas * tile.transmittances[:-1]
        for k in range(0, w.shape[1], 11):
            q = 1 / tile.hit.depths[:, k]
            pairs = np.sum(w[:, None, k] * w[None, :, k] * (q[:, None] - q) ** 2) / 2
            assert_allclose(got[tile.ys[k], tile.xs[k]], pairs, rtol=SURFEL_HIT, atol=1e-14)
            n_looked_at += pairs > 1e-6
    assert n_looked_at > 10


def test_colors_are_those_of_the_harmonics_and_the_background_shines_through(backend):
    g = surfels_at([[0, 0, 4.0]], [[1.0, 0, 0, 0]], [1e3], [0.75])
    g = g._replace(sh_dc=np.array([[0.1, -0.2, 0.3]]))
    request = Request(np.array([0.2, 0.4, 0.6]), backend=backend)
    output, _ = SURFELS.render(Model(g), view_from(CAMERA), request)
    expected = 0.75 * (0.5 + SH_C0 * g.sh_dc[0]) + 0.25 * request.background
    assert_allclose(output.image[9, 12], expected, rtol=SURFEL_WIDE)


def test_what_surfels_do_not_have_is_refused(rng):
    model, view = Model(make_gaussians(rng, 3)), view_from(make_camera(rng=rng))
    with pytest.raises(InputError, match="without surface: train a recipe"):
        SURFELS.render(model, view, Request(wants=frozenset({"surface"})))
    with pytest.raises(InputError, match="those of colours alone"):
        SURFELS.render(model, view, Request(wants=frozenset({"removal_changes", "normal"})))
    with pytest.raises(InputError, match="leave the antialiased profile out"):
        SURFELS.render(model, view, Request(conventions=GSPLAT_MAIN._replace(is_antialiased=True)))


def test_statistics_are_those_of_the_reference(rng):
    g = make_gaussians(rng, 30, opacity_logit=1.0)
    view, wants = view_from(make_camera(rng=rng)), frozenset({"stats", "removal_changes"})
    of_kernels, expected = (
        SURFELS.render(Model(g), view, Request(backend=b, wants=wants))[0] for b in (CPU, REFERENCE)
    )
    for found, statistic in zip(of_kernels.stats, expected.stats, strict=True):
        assert_allclose(found, statistic, rtol=SURFEL_WIDE, atol=1e-12)
    changes = of_kernels.extras["removal_changes"]
    assert_allclose(changes, expected.extras["removal_changes"], rtol=SURFEL_WIDE, atol=1e-12)
    assert expected.stats.hit_count.sum() > 100


def test_what_a_removal_changes_is_what_is_missing_without_it(backend, rng):
    """The sum of squared differences between the image and one without the surfel, in front of a light."""
    g = make_gaussians(rng, 12, opacity_logit=1.0)
    camera = make_camera(rng=rng)
    behind = rng.uniform(size=(camera.height, camera.width, 3))
    request = Request(backend=backend, wants=frozenset({"removal_changes"}), behind=behind)
    output, _ = SURFELS.render(Model(g), view_from(camera), request)
    changes = output.extras["removal_changes"]
    n = int(np.argmax(changes))
    without, _ = SURFELS.render(Model(g), view_from(camera), Request(backend=backend, is_visible=np.arange(12) != n))
    lit, dark = (image.image + (1 - image.alpha[..., None]) * behind for image in (output, without))
    assert_allclose(changes[n], np.sum((lit - dark) ** 2), rtol=REMOVAL)
    assert changes[n] > 0.1


# --- rules of the projection, by hand ---


def projected(scales, opacity=0.5, quat=(1.0, 0, 0, 0), mean=(0.0, 0, 2.0), **settings):
    """One disc, which looks at the camera by default; at depth 2 a unit is 16 x 15 pixels."""
    disc = Primitives(np.array([mean]), np.array([quat]), np.array([[*scales, 1.0]]), np.full(1, opacity))
    return project(disc, CAMERA, GSPLAT_MAIN, **settings)


def test_gsplat_s_radii_are_3_33_deviations_rounded_up():
    """Of 0.12 units 1.92 and 1.8 pixels, so 6.39 and 5.99: the radii are 7 and 6."""
    assert projected((0.12, 0.12), rules=GSPLAT).radii.tolist() == [[7, 6]]


@pytest.mark.parametrize(("clip", "is_kept"), [(2.0, True), (21.9, True), (22.0, False)])
def test_a_radius_above_the_clip_is_enough(clip, is_kept):
    """The radii of 0.4 x 0.01 units, 6.4 x 0.15 pixels, are 22 and 1."""
    found = projected((0.4, 0.01), rules=GSPLAT, radius_clip=clip)
    assert found.radii.any() == is_kept
    assert not is_kept or found.radii.tolist() == [[22, 1]]


@pytest.mark.parametrize(("factor", "is_seen"), [(0.99, False), (1.01, True)])
def test_what_is_fainter_than_alpha_min_is_not_listed(factor, is_seen):
    assert projected((0.5, 0.5), opacity=factor * GSPLAT_MAIN.alpha_min).radii.any() == is_seen


def test_the_pivot_is_the_median_inverse_depth_in_three_bits():
    """0.3 is 0.6 x 2^-1, of which 5 / 8 x 2^-1 is the nearest."""
    assert choose_pivot(1 / np.array([0.01, 0.3, 7.0])) == 0.3125
    assert choose_pivot(np.zeros(0)) == 0


def test_a_disc_that_reaches_behind_the_camera_has_its_low_pass_at_its_centre():
    """By 60 degrees about y, 3 x 2 x sin 60 is more than its depth of 3; of a tenth of the size it is not."""
    quat, mean = (np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6), 0.0), (0.5, 0.0, 3.0)
    center = [32 * 0.5 / 3 + 12.3, 9.1]
    large, small = (projected((scale, scale), quat=quat, mean=mean).means2d[0] for scale in (2.0, 0.2))
    assert_allclose(large, center, rtol=CLOSED_FORM)
    assert abs(small[0] - center[0]) > 0.1


@pytest.mark.parametrize(("alpha", "counts"), [(0.02, True), (0.4 * GSPLAT_MAIN.alpha_min, False)])
def test_faint_pixels_have_a_normal_and_pixels_without_hits_have_none(alpha, counts):
    """A plane at depth 2 that all pixels show as faintly; in the middle of 3 x 3 is the only normal of depths."""
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 1.5, 1.5, 3, 3)
    normals = np.broadcast_to([0.0, 0.0, -alpha], (3, 3, 3))
    output = RenderOutput(normals, np.full((3, 3), alpha), None, None)
    request = Request(conventions=GSPLAT_MAIN)
    rendered = Rendered(output, {"normal": slice(0, 3)}, view_from(camera), None, None, 1, request)
    found = disagree(rendered, np.full((3, 3), 2.0))
    assert found.value == pytest.approx(alpha - alpha * counts / 9)
