"""Pixel order: closed forms, gradients, parity, rotation, orders, hard cases, from end to end."""

import json
from functools import partial

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims import pixel_order as clouds
from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.bench import extension_times
from minisplat_ref.bench.extension_times import extension_cases
from minisplat_ref.bench.workloads import synth5k
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe, load_extension
from minisplat_ref.extensions.pixel_order.model import ORDERED, stages
from minisplat_ref.mechanisms.tangent import planes as planes
from minisplat_ref.mechanisms.tangent.rays import color_changes, tangent_hits, yaw_camera
from minisplat_ref.mechanisms.tangent.renderer import RESPONSE
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.oracle.tolerances import BENCH_FLOAT64
from minisplat_ref.reference.projection import project as project_ewa
from minisplat_ref.rendering import SPLATTING, Request, activate
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.recipe_settings import configure, settings_of
from minisplat_ref.training.schedule import describe
from minisplat_ref.types import Gaussians, Model, Primitives, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    GRADIENT_REL,
    GRADIENT_STEP,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
)

DRAW = ORDERED.renderer
# A fixed ray seen by cameras that differ by a rotation: dozens of roundings of 1e-16, in exponents of up to 5.5.
ROTATED = 1e-12
BARE = GSPLAT_MAIN._replace(eps2d=0.0)


def drawing(buffer_size=None):
    return DRAW._replace(render=partial(DRAW.render, buffer_size=buffer_size))


def one(mean, scales, opacity=0.9, quat=(1.0, 0.0, 0.0, 0.0)):
    return Primitives(*(np.array([field], float) for field in (mean, quat, scales, opacity)))


def as_gaussians(primitives, rng):
    n = len(primitives.means)
    logits = np.log(primitives.opacities / (1 - primitives.opacities))
    sh = rng.normal(size=(n, 3)), np.zeros((n, 0, 3))
    return Gaussians(primitives.means, primitives.quats, np.log(primitives.scales), logits, *sh)


# --- closed form ---


def test_a_round_gaussian_off_the_axis_is_round_on_its_tangent_plane():
    """A ball of deviation s at distance r is exp(-tan(angle)^2 r^2 / 2 s^2) in any direction."""
    ball, camera = one([1.5, 0.8, 2.0], [0.2, 0.2, 0.2]), make_camera(90, 60, fx=40.0, fy=44.0)
    footprints = planes.project(ball, camera, BARE)
    pixels = np.array([[75.5, 40.5], [80.5, 50.5], [70.5, 45.5]])
    found = planes.hit(footprints, np.zeros(1, int), pixels)
    rays = np.column_stack([(pixels[:, 0] - camera.cx) / 40, (pixels[:, 1] - camera.cy) / 44, np.ones(3)])
    r, cosines = np.linalg.norm(ball.means[0]), rays @ ball.means[0] / np.linalg.norm(rays, axis=1)
    tangents = np.sqrt(r**2 / cosines**2 - 1)
    assert_allclose(found.unclamped[0], 0.9 * np.exp(-((tangents * r / 0.2) ** 2) / 2), rtol=1e-11)
    # a ball is densest where the ray comes nearest to its centre
    assert_allclose(found.depths[0], rays @ ball.means[0] / np.sum(rays**2, axis=1), rtol=CLOSED_FORM)


def test_on_the_axis_it_is_3dgs():
    """Footprint and low-pass agree with EWA where the tangent plane is the image plane, to first order in the angle."""
    ball, camera = one([0.0, 0.0, 3.0], [0.05, 0.03, 0.2], quat=[1, 0.2, 0.1, 0.4]), make_camera(fx=30.0, fy=30.0)
    footprints = planes.project(ball, camera, GSPLAT_MAIN)
    projection = project_ewa(*ball, camera, GSPLAT_MAIN)
    K = footprints.conics[0, :2, :2] / 30.0**2
    assert_allclose(K[[0, 0, 1], [0, 1, 1]], projection.conics[0], rtol=1e-12)
    assert footprints.conics[0, 2].any() == 0


def test_away_from_the_axis_it_is_ewa_with_a_denominator(rng):
    """EWA's exp(-d^T Q d / 2) becomes exp(-d^T Q d / (2 (1 + h . d)^2)), which is derived independently."""
    gaussians, camera = make_gaussians(rng, 12), make_camera(60, 44, fx=30.0, fy=33.0)
    primitives = activate(gaussians)
    projection, footprints = project_ewa(*primitives, camera, BARE), planes.project(primitives, camera, BARE)
    ids = np.flatnonzero((projection.radii[:, 0] > 0) & (footprints.radii[:, 0] > 0))
    pixels = rng.uniform((5, 5), (55, 39), (9, 2))
    found = planes.hit(footprints, ids, pixels).unclamped
    x, focal = primitives.means[ids], np.array([30.0, 33.0])
    h = x[:, :2] * x[:, 2:] / np.sum(x**2, axis=1, keepdims=True) / focal
    offsets = pixels - projection.means2d[ids, None]
    Q = projection.conics[ids][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    squares = np.einsum("gpi,gij,gpj->gp", offsets, Q, offsets) / (1 + np.einsum("gi,gpi->gp", h, offsets)) ** 2
    assert len(ids) > 8
    assert_allclose(found, primitives.opacities[ids, None] * np.exp(-squares / 2), atol=1e-11)


def test_boxes_hold_what_is_seen_and_little_more(rng):
    camera = make_camera(120, 90, fx=30.0, fy=30.0)  # 127 degrees wide
    primitives = Primitives(
        *activate(
            make_gaussians(rng, 60, size=0.3)._replace(means=rng.normal(size=(60, 3)) * [4, 3, 2] + [0, 0, 1.5]), None
        )
    )
    footprints = planes.project(primitives, camera, GSPLAT_MAIN)
    everywhere = clouds.grid_centers(camera, 1)
    unculled = np.flatnonzero(np.linalg.norm(primitives.means, axis=1) > 0)
    found = planes.hit(footprints, unculled, everywhere).unclamped >= GSPLAT_MAIN.alpha_min
    x0, y0, x1, y1 = footprints.boxes[unculled, :, None].swapaxes(0, 1)
    x, y = everywhere.T
    inside = (x0 < x) & (x < x1) & (y0 < y) & (y < y1)
    assert not (found & ~inside).any() and found.any(axis=1).sum() > 20
    tight = found.any(axis=1) & (x1 - x0 < 120)[:, 0] & (y1 - y0 < 90)[:, 0]
    assert tight.sum() > 10
    slacks = [(x[found[row]].min() - x0[row, 0], x1[row, 0] - x[found[row]].max()) for row in np.flatnonzero(tight)]
    assert np.median(slacks) < 2  # a tip may pass between the rows of pixels


# --- rotation ---


def test_turning_changes_no_colour(rng):
    """The whole renderer draws images of one pixel with a camera whose principal point follows a ray."""
    primitives, _ = clouds.cloud(40, rng)
    model = Model(as_gaussians(primitives, rng))
    eye = clouds.wide_camera()
    for backend in (CPU, REFERENCE):
        for buffer_size in (None, 4):
            for ray in ([0.1, -0.05, 1.0], [-0.2, 0.15, 1.0]):
                colors, alphas = [], []
                for yaw in np.radians([-35, -10, 0, 20, 40]):
                    seen = yaw_camera(eye, yaw)
                    d = seen.cam_from_world_R @ ray
                    pixel = seen._replace(
                        width=1, height=1, cx=0.5 - seen.fx * d[0] / d[2], cy=0.5 - seen.fy * d[1] / d[2]
                    )
                    output, _ = drawing(buffer_size).render(model, view_from(pixel), Request(backend=backend))
                    colors.append(output.image[0, 0])
                    alphas.append(output.alpha[0, 0])
                assert np.ptp(colors, axis=0).max() < ROTATED and min(alphas) > COVERAGE_MIN
    d = seen.cam_from_world_R @ ray
    by_3dgs = SPLATTING.render(model, view_from(pixel), Request(backend=REFERENCE))[0].image[0, 0]
    assert np.abs(by_3dgs - colors[0]).max() > 1e-3  # which does change


# --- gradients ---


def test_the_gradient_of_the_whole_model(small_proof):
    """On kernels; the reference's is checked for every extension by test_every_extension.py."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, ORDERED, stages)
    assert len(report.cases) == 4 and report.n_failed == 0, report.cases


def test_a_wrong_gradient_is_found(monkeypatch, small_proof):
    true = planes.hit_vjp

    def wrong(*args):
        v_normals, v_conics, v_opacities = true(*args)
        return v_normals, 1.001 * v_conics, v_opacities

    path = "minisplat_ref.mechanisms.tangent.renderer.RESPONSE"
    monkeypatch.setattr(path, RESPONSE._replace(hit_vjp=wrong))
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, ORDERED, lambda *args: stages(*args)[:1])
    assert report.n_failed == 2 and "is wrong" in report.cases[0].note


def test_means2d_move_a_footprint_in_the_image(backend, rng):
    """A ball that keeps its distance while its direction moves by a pixel keeps its shape on the sphere.

    It is 40 degrees off the axis of a turned camera, where a direction moves by ``n_z / f`` times a part of a pixel.
    """
    camera, v_image = turned_camera(48, 36, fx=40.0, fy=25.0, cx=12.0, cy=14.0), rng.normal(size=(36, 48, 3))
    place, r = np.array([41.0, 22.0]), 3.0

    def model_at(x, y):
        d = np.array([(x - 12) / 40, (y - 14) / 25, 1.0])
        return Model(balls(in_front_of(camera, r * d / np.linalg.norm(d)), [0.15], [0.8], [[0.9, 0.6, 0.3]]))

    def loss(x, y):
        output, tape = DRAW.render(model_at(x, y), view_from(camera), Request(backend=backend))
        return np.sum(v_image * output.image), tape

    v = DRAW.render_vjp(loss(*place)[1], v_image, None).means2d[0]
    for k, step in enumerate(GRADIENT_STEP * np.eye(2)):
        slope = (loss(*(place + step))[0] - loss(*(place - step))[0]) / (2 * GRADIENT_STEP)
        assert abs(slope) > 0.01 and v[k] == pytest.approx(slope, rel=GRADIENT_REL)


def test_the_gradient_of_alpha(rng):
    """It is right with respect to opacities and, in the tangent plane, to conics."""
    primitives = activate(make_gaussians(rng, 3))
    footprints = planes.project(primitives, make_camera(), GSPLAT_MAIN)
    ids, pixels = np.arange(3), rng.uniform((4, 4), (20, 14), (5, 2))

    def hit(conics, opacities):
        return planes.hit(footprints._replace(conics=conics, opacities=opacities), ids, pixels)

    inputs = [footprints.conics, footprints.opacities]
    check_jacobian(
        lambda *moved: (hit(*moved).unclamped,),
        lambda v: planes.hit_vjp(footprints, ids, hit(*inputs), v, v, None)[1:],
        inputs,
        names=["conics", "opacities"],
    )


# --- parity and order ---


@pytest.mark.parametrize("buffer_size", [None, 4, 1], ids=["exact", "buffer", "list"])
def test_kernels_and_reference_agree(buffer_size, rng):
    gaussians, view = make_gaussians(rng, 60), view_from(make_camera(rng=rng))
    v_image, v_alpha = rng.normal(size=(18, 24, 3)), rng.normal(size=(18, 24))
    results = []
    for backend in (CPU, REFERENCE):
        output, tape = drawing(buffer_size).render(Model(gaussians), view, Request(backend=backend))
        results.append((output, DRAW.render_vjp(tape, v_image, v_alpha)))
    (ours, v_ours), (theirs, v_theirs) = results
    assert theirs.alpha.max() > COVERAGE_MIN
    assert_allclose(ours.image, theirs.image, rtol=0, atol=PARITY_FLOAT64 * np.abs(theirs.image).max())
    parts = {**v_theirs.gaussians._asdict(), "R": v_theirs.cam_from_world_R, "means2d": v_theirs.means2d}
    found = {**v_ours.gaussians._asdict(), "R": v_ours.cam_from_world_R, "means2d": v_ours.means2d}
    for name, expected in parts.items():
        scale = np.abs(expected).max()
        assert scale > 0 and np.abs(found[name] - expected).max() <= 10 * PARITY_FLOAT64 * scale, name


def test_float32(rng):
    gaussians, view = make_gaussians(rng, 60), view_from(make_camera(rng=rng))
    gaussians = as_dtype(as_dtype(gaussians, np.float32), np.float64)
    narrow = as_dtype(gaussians, np.float32)
    v_image = rng.normal(size=(18, 24, 3)).astype(np.float32)
    expected, tape = DRAW.render(Model(gaussians), view, Request(backend=CPU))
    v_expected = DRAW.render_vjp(tape, v_image.astype(np.float64), None).gaussians
    output, tape = DRAW.render(Model(narrow), view, Request(backend=CPU))
    v = DRAW.render_vjp(tape, v_image, None).gaussians
    assert output.image.dtype == np.float32
    assert np.abs(output.image - expected.image).max() <= PARITY_FLOAT32_IMAGE
    for name, value in v_expected._asdict().items():
        assert getattr(v, name).dtype == np.float32
        assert np.abs(getattr(v, name) - value).max() <= PARITY_FLOAT32_GRADIENT * np.abs(value).max(), name


def test_a_buffer_as_large_as_the_list_is_exact(backend, rng):
    gaussians, view = make_gaussians(rng, 30), view_from(make_camera(rng=rng))
    images = {
        k: drawing(k).render(Model(gaussians), view, Request(backend=backend))[0].image for k in (None, 30, 29, 4, 1)
    }
    assert_array_equal(images[30], images[None])
    assert np.abs(images[1] - images[None]).max() > 1e-4  # or nothing was out of order
    assert np.abs(images[4] - images[None]).mean() < np.abs(images[1] - images[None]).mean()


def test_two_crossed_gaussians_change_places_from_pixel_to_pixel(backend, rng):
    """Of two plates that cross along a vertical line, one is in front on the left, the other on the right."""
    turn = np.array([np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0])
    plates = Gaussians(
        means=np.array([[0.0, 0, 3], [0.0, 0, 3.01]]),
        quats=np.array([turn, turn * [1, 1, -1, 1]]),
        log_scales=np.log([[0.8, 0.8, 0.01]] * 2),
        opacity_logits=np.full(2, 4.0),
        sh_dc=np.array([[1.7, -1.7, 0], [-1.7, 1.7, 0]]),
        sh_rest=np.zeros((2, 0, 3)),
    )
    image = DRAW.render(Model(plates), view_from(make_camera()), Request(backend=backend))[0].image
    red_over_green = image[9, :, 0] - image[9, :, 1]
    assert np.sign(red_over_green[6]) == -np.sign(red_over_green[17]) != 0
    listed = SPLATTING.render(Model(plates), view_from(make_camera()), Request(backend=backend))[0].image
    assert np.sign(listed[9, 6, 0] - listed[9, 6, 1]) == np.sign(listed[9, 17, 0] - listed[9, 17, 1])


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_bytes_do_not_depend_on_threads(rng):
    model, view = Model(as_dtype(make_gaussians(rng, 80), np.float32)), view_from(make_camera(70, 45, fx=80.0, fy=80.0))
    v_image = rng.normal(size=(45, 70, 3)).astype(np.float32)
    threads, results = numba.get_num_threads(), []
    try:
        for n in (1, 2):
            numba.set_num_threads(n)
            output, tape = DRAW.render(model, view, Request(backend=CPU))
            results.append((output.image, *DRAW.render_vjp(tape, v_image, None).gaussians))
    finally:
        numba.set_num_threads(threads)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(*results, strict=True))


# --- hard cases ---


@pytest.mark.parametrize(
    ("mean", "scales"),
    [
        ([0.05, 0.02, 0.1], [0.5, 0.4, 0.6]),  # the camera is inside
        ([0.3, 0.0, -0.05], [1.0, 1.0, 1.0]),  # its mean is behind the image plane, and it is seen
        ([0.0, 0.4, 3.0], [5.0, 1e-4, 5.0]),  # a plate seen along its edge
        ([0.2, 0.1, 3.0], [1e-6, 1e-6, 2.0]),  # a needle along the ray
        ([0.0, 0.0, 3.0], [4.0, 1e-6, 1e-6]),  # a needle across
        ([0.0, 0.0, 1e4], [1e-3, 1e-3, 1e-3]),  # far and tiny
    ],
    ids=["inside", "behind", "grazing", "along", "across", "far"],
)
def test_hard_gaussians_are_finite_and_the_same_in_both(mean, scales, rng):
    gaussians = as_gaussians(one(mean, scales, 0.8), rng)
    view, v_image = view_from(make_camera()), rng.normal(size=(18, 24, 3))
    results = []
    for backend in (CPU, REFERENCE):
        output, tape = DRAW.render(Model(gaussians), view, Request(backend=backend))
        v = DRAW.render_vjp(tape, v_image, None).gaussians
        assert all(np.isfinite(array).all() for array in (output.image, *v))
        results.append((output.alpha, *v))
    assert results[0][0].max() > 0.01
    for ours, theirs in zip(*results, strict=True):
        assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max(initial=1))


def test_what_cannot_be_drawn_is_culled(backend, rng):
    for mean in ([0, 0, 0], [0, 0, 5e11], [0, 0, -3]):
        gaussians = as_gaussians(one(mean, [0.1] * 3, 0.8), rng)
        output, tape = DRAW.render(Model(gaussians), view_from(make_camera()), Request(backend=backend))
        assert output.alpha.max() == 0 and len(output.visible_ids) == 0
        assert not DRAW.render_vjp(tape, np.ones((18, 24, 3)), None).gaussians.means.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_infinite_scale_counts_as_the_largest_number_and_covers_everything(backend, dtype, rng):
    gaussians = as_dtype(as_gaussians(one([0, 0, 3], [np.inf] * 3, 0.8), rng), dtype)
    output, tape = DRAW.render(Model(gaussians), view_from(make_camera()), Request(backend=backend))
    assert_allclose(output.alpha, 0.8, rtol=1e-6)
    v = DRAW.render_vjp(tape, np.ones((18, 24, 3), dtype), None).gaussians
    assert all(np.isfinite(field).all() for field in v)


def test_no_gaussians(backend, rng):
    none = make_gaussians(rng, 0)
    assert DRAW.render(Model(none), view_from(make_camera()), Request(backend=backend))[0].image.max() == 0


def test_depth_and_statistics(backend, rng):
    """Weights add up to this renderer's own alpha; a removed Gaussian changes its own image by what is said."""
    some, view = Model(make_gaussians(rng, 20)), view_from(make_camera())
    wants = frozenset({"depth", "stats", "surface", "dominant_depth", "median_depth"})
    output, splatted = (
        renderer.render(some, view, Request(backend=backend, wants=wants))[0] for renderer in (DRAW, SPLATTING)
    )
    assert output.image.shape == (18, 24, 4) and np.abs(output.image - splatted.image).max() > 1e-3
    assert_allclose(output.stats.blend_weight_sum.sum(), output.alpha.sum(), rtol=CLOSED_FORM)
    assert np.abs(output.stats.blend_weight_sum - splatted.stats.blend_weight_sum).max() > 1e-3
    is_hit = output.stats.dominant_ids >= 0
    assert ((output.extras["dominant_depth"] > 0) == is_hit).all() and 0.2 < is_hit.mean() < 1
    assert_array_equal(output.stats.dominant_count, np.bincount(output.stats.dominant_ids[is_hit], minlength=20))

    request = Request(np.ones(3), backend=backend, wants=frozenset({"removal_changes"}))
    whole, _ = DRAW.render(some, view, request)
    g = int(np.argmax(whole.extras["removal_changes"]))
    gone = some.gaussians._replace(opacity_logits=np.where(np.arange(20) == g, -50.0, some.gaussians.opacity_logits))
    without = DRAW.render(Model(gone), view, request)[0].image
    assert_allclose(whole.extras["removal_changes"][g], np.sum((without - whole.image) ** 2), rtol=1e-9)


def test_what_is_in_front_on_the_ray_dominates(backend):
    """A long Gaussian slants away from the camera; a ball is nearer than its mean, but behind its near end.

    Sorted by the means' depths the ball of alpha 0.6 comes first everywhere, and dominates. On the ray through the
    ball's middle the needle, of some 0.66, is in front, and takes T below one half.
    """
    camera = make_camera(40, 40, fx=40.0, fy=40.0)
    slant = np.pi / 8  # half of the turn about y that takes the long axis from x to (1, 0, -1)
    needle, ball = (0.0, 0.0, 4.0), (1.0, 0.0, 3.6)
    gaussians = Gaussians(
        means=np.array([needle, ball]),
        quats=np.array([[np.cos(slant), 0, np.sin(slant), 0], [1.0, 0, 0, 0]]),
        log_scales=np.log([[2.0, 0.3, 0.05], [0.3, 0.3, 0.3]]),
        opacity_logits=np.log([0.9 / 0.1, 0.6 / 0.4]),
        sh_dc=np.zeros((2, 3)),
        sh_rest=np.zeros((2, 0, 3)),
    )
    request = Request(backend=backend, wants=frozenset({"stats", "median_depth"}))
    view = view_from(camera)
    ours, theirs = (renderer.render(Model(gaussians), view, request)[0] for renderer in (DRAW, SPLATTING))
    row, column = int(camera.cy), int(camera.cx + 40 * ball[0] / ball[2])  # the ray through the ball's middle
    assert theirs.stats.dominant_ids[row, column] == 1 and ours.stats.dominant_ids[row, column] == 0
    # Its densest point there lies near x + z = 4, where z = 4 / (1 + 1 / 3.6).
    assert_allclose(ours.median_depth[row, column], 4 / (1 + 1 / 3.6), rtol=0.03)
    assert theirs.median_depth[row, column] == pytest.approx(ball[2])


@pytest.mark.parametrize("buffer_size", [0, -3, 2.5, 4096])
def test_a_bad_buffer_is_refused(buffer_size, rng):
    with pytest.raises(InputError, match=r"buffer_size is .*: give 1 to 1024 hits"):
        drawing(buffer_size).render(Model(make_gaussians(rng, 2)), view_from(make_camera()), Request())


def test_compensated_opacities_are_refused(rng):
    request = Request(conventions=GSPLAT_MAIN._replace(is_antialiased=True))
    with pytest.raises(InputError, match="leave the antialiased profile out"):
        DRAW.render(Model(make_gaussians(rng, 2)), view_from(make_camera()), request)


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


def test_trains_evaluates_and_renders(tmp_path, capsys):
    write_scene(make_scene("room", supersampling=1, **SCENE), tmp_path / "nook", SCENE)
    run, options = tmp_path / "run", ["--recipe", "pixel-order", "--test-every", "4", "--iterations", "12"]
    assert main(["train", str(tmp_path / "nook"), *options, "--set", "buffer_size=8", "--out", str(run)]) == 0
    config = json.loads((run / "config.json").read_text())
    assert '"buffer_size": 8' in json.dumps(config)
    assert main(["eval", str(run)]) == 0
    assert main(["render", str(run / "point_cloud.ply"), "--frames", "1", "--size", "24x18"]) == 0
    capsys.readouterr()
    for text, message in (("0", "buffer_size is 0: give 1"), ("many", "buffer_size")):
        bad = tmp_path / "bad"
        arguments = ["train", str(tmp_path / "nook"), *options, "--set", f"buffer_size={text}", "--out", str(bad)]
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert (
            message in error
            and len([line for line in error.splitlines() if line.startswith("minisplat-ref: error")]) <= 1
        )


def test_changes_by_hand(monkeypatch):
    """A ray whose colour goes evenly from 0 to 0.4, and one that jumps by 0.4 in the third of four steps."""
    colors = np.array([[0.0, 0.1, 0.2, 0.3, 0.4], [0, 0, 0, 0.4, 0.4]])
    shown = iter(np.repeat(colors.T[:, :, None], 3, axis=2))
    monkeypatch.setattr("minisplat_ref.mechanisms.tangent.rays.ray_colors", lambda *_: next(shown))
    found = color_changes("", None, None, [None] * 5, [None] * 5, None)
    assert_allclose(found.largest, [0.1, 0.1, 0.4, 0.1])
    assert_allclose(found.mean, [0.05, 0.05, 0.25, 0.05])
    assert found.flicker == pytest.approx(0.8 / 2)


def test_hits_of_a_rotated_camera_are_those_of_the_ray(rng):
    primitives, _ = clouds.cloud(20, rng)
    rays = clouds.rays_ahead(3, 10.0)
    first, second = (
        tangent_hits(primitives, camera, rays @ camera.cam_from_world_R.T, GSPLAT_MAIN)
        for camera in (clouds.wide_camera(), yaw_camera(clouds.wide_camera(), 0.4))
    )
    both, a, b = np.intersect1d(first.ids, second.ids, return_indices=True)
    assert len(both) > 10
    assert_allclose(first.hit.unclamped[a], second.hit.unclamped[b], atol=ROTATED)


# --- what the core has for it ---


def test_settings_of_a_renderer_are_set_and_recorded():
    recipe = find_recipe("pixel-order", 100)
    assert settings_of(recipe)["buffer_size"] is None
    changed = configure(recipe, buffer_size=4)
    assert changed.representation.renderer.render.keywords == {"buffer_size": 4}
    assert describe(changed)["representation"]["renderer"] == {"buffer_size": 4} != describe(recipe)["representation"]
    assert "renderer" not in describe(find_recipe("3dgs-accel"))["representation"]


def test_the_bench_times_the_renderer_and_finds_a_wrong_one(monkeypatch, capsys):
    extension = load_extension("pixel-order")
    cases = {case.name: case for case in extension_cases(extension, synth5k(150), 1)}
    assert len(cases) == 7 and all(case.passed for case in cases.values()), cases
    ours = cases["synth5k: pixel-order, cpu float64"].figures
    assert 0 < ours["image max"] < BENCH_FLOAT64 and ours["forward (ms)"] > 0 and ours["gradient"] < BENCH_FLOAT64
    true = extension_times._Steps.answer

    def dimmed(steps):
        found = true(steps)
        return found._replace(image=found.image * 1.001) if steps._request.backend is CPU else found

    monkeypatch.setattr(extension_times._Steps, "answer", dimmed)
    wrong = [case.name for case in extension_cases(extension, synth5k(150), 1) if not case.passed]
    assert "synth5k: pixel-order, cpu float64" in wrong and "synth5k: pixel-order, cpu float32" in wrong
    assert main(["bench", "--extension", "none"]) == 2 and "does not exist" in capsys.readouterr().err
