"""Tracing: one ray and one Gaussian, the tree against all pairs, gradients, hard cases, training end to end."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.rays import measures as claims
from gradcheck import check_jacobian
from minisplat_ref import load_ply
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.rays import model
from minisplat_ref.extensions.rays.kernels import whitening_maps, whitening_maps_vjp
from minisplat_ref.extensions.rays.model import (
    TRACED,
    Whitened,
    make_image_tracer,
    make_tracer,
    stages,
    whiten,
    whiten_model,
    whiten_vjp,
)
from minisplat_ref.mechanisms.rays import bvh as bvh
from minisplat_ref.mechanisms.rays.blending import sum_by_row
from minisplat_ref.mechanisms.rays.pixel_rays import Rays, pixel_rays, pixel_rays_vjp
from minisplat_ref.mechanisms.rays.traversal import limits_of
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Gaussians, Model, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    GRADIENT_REL,
    GRADIENT_STEP,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
    RAY_ORDER,
)

ROOT = Path(__file__).parent.parent.parent
DRAW = TRACED.renderer
BLACK = np.zeros(3)


def rays_along(origins, directions, near=0.01, far=1e10):
    origins, directions = np.atleast_2d(np.array(origins, float)), np.atleast_2d(np.array(directions, float))
    n = len(directions)
    return Rays(np.tile(origins, (n // len(origins), 1)), directions, np.full(n, near), np.full(n, far))


def one(mean, scales, opacity=0.8, quat=(1.0, 0.0, 0.0, 0.0)):
    scales, quat = np.array([scales], float), np.array([quat], float)
    return whiten(np.array([mean], float), quat, np.log(scales), np.array([opacity]))


def hits_of(gaussians, rays, backend=CPU, conventions=GSPLAT_MAIN):
    return make_tracer(gaussians, conventions, backend).list_hits(rays, conventions)


def random_whitened(rng, n, size=0.15):
    return whiten_model(Model(make_gaussians(rng, n, size=size)))


# --- one ray and one Gaussian ---


def test_a_ball_at_a_distance(backend):
    """Its value is that at the nearest point, ``o exp(-r^2 / 2 s^2)``, at the distance along the ray."""
    rays = rays_along([0, 0, 0], [[0, 0, 1], [0, 0, 2], [0.1, 0, 1]])
    hits = hits_of(one([0, 0.2, 4], [0.3] * 3), rays, backend)
    squared = 0.04 + 16 - 16 / 1.01  # of the distance of the last ray: |mu|^2 - (mu . d)^2 / d^2
    expected = 0.8 * np.exp(-0.5 * np.array([0.04, 0.04, squared]) / 0.09)
    assert_allclose(hits.unclamped, expected, rtol=CLOSED_FORM)
    assert_allclose(hits.depths, [4, 2, 4 / 1.01], rtol=CLOSED_FORM)
    assert_allclose(hits.transmittances, 1 - expected, rtol=CLOSED_FORM)


def test_an_ellipsoid_at_an_angle_is_the_largest_value_on_the_ray(backend, rng):
    gaussians, rays = random_whitened(rng, 1), rays_along([0.1, 0, 0], [[0.02, 0.01, 1]])
    rays.directions[0] = gaussians.means[0] + 0.05 - rays.origins[0]
    hits = hits_of(gaussians, rays, backend)
    t = np.linspace(0.5, 1.5, 200_001)
    points = rays.origins + t[:, None] * rays.directions - gaussians.means
    values = gaussians.opacities[0] * np.exp(-0.5 * np.sum((points @ gaussians.maps[0].T) ** 2, axis=1))
    assert hits.unclamped[0] == pytest.approx(values.max(), rel=1e-8)
    assert hits.depths[0] == pytest.approx(t[np.argmax(values)], abs=1e-5)


def test_the_gradient_of_pairs(rng):
    gaussians = random_whitened(rng, 3, size=0.5)
    rays = rays_along(0.1 * rng.normal(size=(4, 3)), gaussians.means[[0, 1, 2, 0]] + 0.2 * rng.normal(size=(4, 3)))
    rays_ids, ids = np.array([0, 0, 1, 2, 3]), np.array([0, 1, 1, 2, 0])
    inputs = [*gaussians, rays.origins, rays.directions]

    def forward(means, maps, opacities, origins, directions):
        moved = rays._replace(origins=origins, directions=directions)
        pairs = model.intersect(Whitened(means, maps, opacities), moved, rays_ids, ids)
        return pairs.unclamped, pairs.depths

    def vjp(v_unclamped, v_depths):
        parts = model.intersect_vjp(gaussians, rays, rays_ids, ids, v_unclamped, v_depths)
        rows = (ids, ids, ids, rays_ids, rays_ids)
        return tuple(sum_by_row(part, row, 3 + (row is rays_ids)) for part, row in zip(parts, rows, strict=True))

    check_jacobian(forward, vjp, inputs, names=["means", "maps", "opacities", "origins", "directions"])


def test_the_gradient_of_maps_and_of_pixels(rng):
    g, camera = make_gaussians(rng, 2), make_camera(4, 3, rng=rng)
    gaussians = whiten_model(Model(g))
    check_jacobian(
        lambda quats, log_scales: (whiten(g.means, quats, log_scales, gaussians.opacities).maps,),
        lambda v: whiten_vjp(g.quats, g.log_scales, gaussians, v),
        [g.quats, g.log_scales],
        names=["quats", "log_scales"],
    )
    check_jacobian(
        lambda R, t: pixel_rays(camera._replace(cam_from_world_R=R, cam_from_world_t=t), GSPLAT_MAIN)[:2],
        lambda *v: pixel_rays_vjp(camera, GSPLAT_MAIN, *v),
        [camera.cam_from_world_R, camera.cam_from_world_t],
        names=["R", "t"],
    )


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("n", [1, 21])
def test_maps_by_kernels(n, dtype, rng):
    """The same as in NumPy, also of a Gaussian without a finite size that no ray meets, and of a long quaternion."""
    g = as_dtype(make_gaussians(rng, n), dtype)
    g.quats[0] *= 1e20 if dtype == np.float64 else 1e10
    gaussians = whiten_model(Model(g))
    maps, v_maps = whitening_maps(g.quats, g.log_scales), rng.normal(size=(n, 3, 3))
    assert_allclose(maps, gaussians.maps, rtol=CLOSED_FORM, atol=CLOSED_FORM)
    for ours, theirs in zip(
        whitening_maps_vjp(g.quats, g.log_scales, maps, v_maps),
        whiten_vjp(g.quats, g.log_scales, gaussians, v_maps),
        strict=True,
    ):
        assert_allclose(ours, theirs, rtol=CLOSED_FORM, atol=CLOSED_FORM * np.abs(theirs).max())
    g.log_scales[0], v_maps[0] = [-2000, 2000, np.nan], 0
    infinite = whitening_maps(g.quats, g.log_scales)
    v = whitening_maps_vjp(g.quats, g.log_scales, infinite, v_maps)
    assert not np.isfinite(infinite[0]).all()
    assert all(np.isfinite(array).all() and not array[0].any() for array in v)


# --- many Gaussians ---


@pytest.mark.parametrize("n", [0, 1, 4, 5, 9, 300])
def test_the_tree_misses_nothing(n, rng):
    """Rays in any direction, from inside and outside, have the same hits in the same order as by all pairs."""
    gaussians = random_whitened(rng, n, size=0.3)
    directions = rng.normal(size=(200, 3))
    directions[:6] = np.vstack([np.eye(3), -np.eye(3)])  # parallel to the sides of every box
    rays = rays_along(rng.normal(size=(200, 3)) * [1, 1, 3], directions)
    ours, theirs = (hits_of(gaussians, rays, backend) for backend in (CPU, REFERENCE))
    assert n < 5 or len(theirs.ray_ids) >= 3 * n
    for name in ("offsets", "ray_ids", "gaussian_ids"):
        assert_array_equal(getattr(ours, name), getattr(theirs, name), name)
    for name in ("unclamped", "depths", "weights", "transmittances"):
        assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=PARITY_FLOAT64, err_msg=name)


def test_every_box_holds_what_is_below_it(rng):
    low = rng.normal(size=(50, 3))
    high = low + rng.uniform(0, 1, (50, 3))
    tree = bvh.build(low, high)
    assert_array_equal(np.sort(tree.rows), np.arange(50))

    def rows_below(node, side):
        first, count = tree.children[node, side]
        if count == bvh.IS_INNER:
            return np.concatenate([rows_below(first, 0), rows_below(first, 1)])
        assert count <= bvh.LEAF
        return tree.rows[first : first + count]

    for node in range(len(tree.boxes)):
        for side in range(2):
            rows = rows_below(node, side)
            assert (tree.boxes[node, side, :3] <= low[rows]).all() and (tree.boxes[node, side, 3:] >= high[rows]).all()


@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, INRIA, GSPLAT_MAIN._replace(alpha_min=0.0)])
def test_opaque_layers_end_a_ray_where_they_should(conventions, rng):
    """Of sixty layers in random order, most of them opaque, those behind the last one that counts are not tested."""
    n = 60
    gaussians = Whitened(
        np.column_stack([0.01 * rng.normal(size=(n, 2)), rng.permutation(np.linspace(2, 5, n))]),
        np.tile(np.eye(3) / 0.3, (n, 1, 1)),
        rng.uniform(0.3, 1.0, n),
    )
    rays = rays_along([0, 0, 0], np.column_stack([0.03 * rng.normal(size=(40, 2)), np.ones(40)]))
    ours, theirs = (hits_of(gaussians, rays, backend, conventions) for backend in (CPU, REFERENCE))
    assert_array_equal(ours.gaussian_ids, theirs.gaussian_ids)
    assert_allclose(ours.weights, theirs.weights, rtol=PARITY_FLOAT64)
    assert 3 < np.diff(theirs.offsets).mean() < 30


def test_copies_are_taken_in_the_order_of_their_rows(backend, rng):
    gaussians = random_whitened(rng, 5)
    twice = Whitened(*(np.concatenate([field, field[::-1]]) for field in gaussians))
    rays = rays_along([0, 0, 0], gaussians.means)
    hits = hits_of(twice, rays, backend)
    for r in range(5):
        ids = hits.gaussian_ids[hits.offsets[r] : hits.offsets[r + 1]].tolist()
        assert ids.index(r) < ids.index(9 - r)


def test_tracing_is_the_exact_order_of_every_pixel():
    gaussians = claims.random_gaussians(200, np.random.default_rng(1))
    assert claims.exact_order(gaussians, claims.demo.camera_of(64, 48)).mean() > COVERAGE_MIN
    assert claims.order_difference(200, 1) < RAY_ORDER
    assert claims.tree_against_brute_force(200, 1) < PARITY_FLOAT64


@pytest.mark.parametrize(
    ("dtype", "image_rel", "gradient_rel"),
    [
        (np.float64, PARITY_FLOAT64, PARITY_FLOAT64),
        (np.float32, PARITY_FLOAT32_IMAGE, PARITY_FLOAT32_GRADIENT),
    ],
)
def test_kernels_and_reference_agree(dtype, image_rel, gradient_rel, rng):
    gaussians, view = make_gaussians(rng, 60), view_from(make_camera(rng=rng))
    v_image, v_alpha = rng.normal(size=(18, 24, 4)), rng.normal(size=(18, 24))
    results = []
    for backend in (CPU, REFERENCE):
        request = Request(np.array([0.1, 0.2, 0.3]), backend=backend, wants=frozenset({"depth", "stats"}))
        output, tape = DRAW.render(Model(as_dtype(gaussians, dtype)), view, request)
        v = DRAW.render_vjp(tape, v_image.astype(dtype), v_alpha.astype(dtype))
        results.append((output, {**v.gaussians._asdict(), "t": v.cam_from_world_t, "R": v.cam_from_world_R}))
    (ours, v_ours), (theirs, v_theirs) = results
    assert ours.image.dtype == dtype and theirs.alpha.max() > COVERAGE_MIN
    assert np.abs(ours.image - theirs.image).max() <= image_rel * np.abs(theirs.image).max()
    assert_array_equal(ours.visible_ids, theirs.visible_ids)
    assert_array_equal(ours.stats.dominant_ids, theirs.stats.dominant_ids)
    for name, expected in v_theirs.items():
        found, scale = v_ours[name], np.abs(expected).max()
        assert found.dtype == dtype and scale > 0
        assert np.abs(found - expected).max() <= gradient_rel * scale, name


def test_means2d_move_a_gaussian_by_a_pixel_in_parallel_to_the_image(backend, rng):
    """By ``z / f_k`` along the camera's axis k, in a camera that is turned and has two focal lengths."""
    camera, v_image = turned_camera(), rng.normal(size=(28, 40, 3))
    gaussians = balls(in_front_of(camera, [[0.3, 0.2, 3.0], [-0.5, 0.1, 4.0]]), [0.15, 0.2], [0.8, 0.6])
    axes = camera.cam_from_world_R / np.array([[40.0], [25.0], [1.0]])  # world units at depth 1 for a pixel

    def loss(moved):
        output, tape = DRAW.render(Model(gaussians._replace(means=moved)), view_from(camera), Request(backend=backend))
        return np.sum(v_image * output.image), tape

    v = DRAW.render_vjp(loss(gaussians.means)[1], v_image, None).means2d
    for row, z in enumerate((3.0, 4.0)):
        for k in range(2):
            step = np.zeros((2, 3))
            step[row] = GRADIENT_STEP * z * axes[k]
            slope = (loss(gaussians.means + step)[0] - loss(gaussians.means - step)[0]) / (2 * GRADIENT_STEP)
            assert abs(slope) > 0.01 and v[row, k] == pytest.approx(slope, rel=GRADIENT_REL)


def test_the_gradient_of_the_whole_model(small_proof):
    """On kernels; the reference's is checked for every extension by test_every_extension.py."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, TRACED, stages)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


def test_a_wrong_gradient_is_found(monkeypatch, small_proof):
    correct = model.intersect_vjp

    def wrong(*args):
        v = correct(*args)
        return v._replace(means=1.001 * v.means)

    monkeypatch.setattr(model, "intersect_vjp", wrong)
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, TRACED, stages)
    assert report.n_failed == 2 and "is wrong" in report.cases[0].note


def test_statistics_account_for_all_light(backend, rng):
    gaussians, view = make_gaussians(rng, 40), view_from(make_camera(rng=rng))
    output, _ = DRAW.render(Model(gaussians), view, Request(backend=backend, wants=frozenset({"stats"})))
    stats = output.stats
    assert stats.blend_weight_sum.sum() == pytest.approx(output.alpha.sum(), rel=PARITY_FLOAT64)
    assert stats.hit_count.sum() == output.n_pairs and (stats.hit_count > 0).sum() == len(output.visible_ids)
    assert stats.dominant_count.sum() == (stats.dominant_ids >= 0).sum() > 0
    assert (stats.blend_weight_max <= 0.99).all() and stats.blend_weight_max.max() > 0.1
    with pytest.raises(InputError, match="rays does not give surface"):
        DRAW.render(Model(gaussians), view, Request(backend=backend, wants=frozenset({"surface"})))


# --- where splatting agrees, and hard cases ---


@pytest.fixture
def bare(rng):
    """Return a function that draws Gaussians from the origin by either backend, 24 x 18 pixels."""
    camera = make_camera(fx=30.0, fy=30.0)

    def draw(gaussians, conventions=GSPLAT_MAIN):
        rays = pixel_rays(camera, conventions)
        images = []
        for backend in (CPU, REFERENCE):
            tracer = make_image_tracer(gaussians, camera, conventions, backend)
            ones = np.ones((len(gaussians.means), 3))
            blended = tracer.blend(ones, rays, BLACK, conventions)
            v = tracer.blend_vjp(ones, rays, BLACK, conventions, blended, (blended.image, rays.near, rays.near))
            assert all(np.isfinite(array).all() for array in (*blended[:5], *v))
            images.append((1 - blended.transmittances).reshape(18, 24))
        assert_allclose(images[0], images[1], atol=PARITY_FLOAT64)
        return images[0]

    return draw


def test_a_camera_inside_a_gaussian_sees_what_peaks_in_front(bare):
    """If the centre lies just ahead, forward rays find the peak in front; if just behind, no ray finds it."""
    assert bare(one([0, 0, 0.1], [0.5] * 3)).min() > 0.7
    assert bare(one([0, 0, -0.1], [0.5] * 3)).max() == 0


def test_a_needle_of_a_millionth_is_hit_where_it_is(bare):
    alpha = bare(one([0, 1 / 60, 1], [0.2, 1e-6, 1e-6]))  # in the middle of the row of pixels below the axis
    assert (alpha[9] > 0.05).sum() > 8 and np.delete(alpha, 9, axis=0).max() == 0


def test_rays_parallel_to_a_flat_gaussian():
    """A ray in its plane hits it; one beside it, even by a thousandth, does not."""
    flat = one([0, 0, 3], [0.5, 1e-5, 0.5])
    for backend in (CPU, REFERENCE):
        hits = hits_of(flat, rays_along([[0, 0, 0], [0, 1e-3, 0]], [[0, 0, 1], [0, 0, 1]]), backend)
        assert_array_equal(np.diff(hits.offsets), [1, 0])
        assert hits.depths[0] == pytest.approx(3) and hits.unclamped[0] == pytest.approx(0.8)


def test_grazing_rays_are_found_to_the_last_digit(rng):
    """For rays that touch the ellipsoid of ``alpha_min`` or miss it by 1e-9, the tree decides as all pairs do."""
    s, opacity = 0.2, 0.9
    radius = s * np.sqrt(2 * np.log(255 * opacity))
    nudges = np.array([-1e-9, -1e-12, 0, 1e-12, 1e-9])
    ball = one([0, 0, 3], [s] * 3, opacity)
    rays = rays_along(np.column_stack([radius * (1 + nudges), np.zeros(5), np.zeros(5)]), np.tile([0.0, 0, 1], (5, 1)))
    counts = [np.diff(hits_of(ball, rays, backend).offsets) for backend in (CPU, REFERENCE)]
    assert_array_equal(counts[0], counts[1])
    assert counts[0][0] == 1 and counts[0][-1] == 0


def test_what_cannot_be_drawn_is_left_out(bare, rng):
    """Sizes of 0 and infinity, a NaN centre, an opacity of 0 and a Gaussian behind the camera are left out."""
    good = random_whitened(rng, 6)
    bad = Whitened(*(np.repeat(field[:1], 6, axis=0) for field in good))
    bad.maps[0], bad.maps[1], bad.maps[2] = np.inf, 0, np.nan
    bad.means[3], bad.opacities[4], bad.means[5] = np.nan, 0, [0, 0, -3]
    both = Whitened(*(np.concatenate(fields) for fields in zip(good, bad, strict=True)))
    with np.errstate(all="ignore"):
        assert_array_equal(bare(both), bare(good))


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture(scope="module")
def run_folder(room, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    options = ["--recipe", "rays", "--test-every", "4", "--iterations", "30", "--out", str(folder)]
    assert main(["train", str(room), *options]) == 0
    return folder


def test_trains_evaluates_and_renders(run_folder, tmp_path):
    losses = [json.loads(line)["loss"] for line in (run_folder / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]
    assert main(["eval", str(run_folder)]) == 0
    ply, cameras = str(run_folder / "point_cloud.ply"), ["--cameras", str(run_folder / "cameras.json")]
    for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
        assert main(["render", ply, *cameras, *extension, "--depth", "--out", str(tmp_path / name)]) == 0
    ours, theirs = (sorted((tmp_path / name).glob("*.png")) for name in ("ours", "theirs"))
    assert len(ours) == 16 and all(a.read_bytes() != b.read_bytes() for a, b in zip(ours, theirs, strict=True))
    assert type(load_ply(ply)) is Gaussians


def test_same_bytes_at_one_and_two_threads(room, tmp_path):
    found = set()
    for n_threads in ("1", "2"):
        out = tmp_path / n_threads
        command = [sys.executable, "-m", "minisplat_ref", "train", str(room), "--recipe", "rays", "--iterations", "8"]
        environment = os.environ | {"NUMBA_NUM_THREADS": n_threads}
        subprocess.run([*command, "--out", str(out)], cwd=ROOT, env=environment, check=True, capture_output=True)
        found.add((out / "point_cloud.ply").read_bytes())
    assert len(found) == 1


def test_the_degenerate_case_is_one_gaussian_on_the_axis(rng):
    """In the direction of its centre a Gaussian has its opacity, whether splatted or traced."""
    g = make_gaussians(rng, 1)._replace(means=np.array([[0.0, 0.0, 3.0]]))
    view = view_from(make_camera(25, 17))
    bare = GSPLAT_MAIN._replace(eps2d=0.0)
    for renderer in (SPLATTING, DRAW):
        alpha = renderer.render(Model(g), view, Request(conventions=bare))[0].alpha
        assert alpha[8, 12] == pytest.approx(1 / (1 + np.exp(-g.opacity_logits[0])), rel=CLOSED_FORM)


def test_limits_hold_every_hit_that_counts():
    """With nothing to stop a ray there is room for all Gaussians."""
    assert limits_of(GSPLAT_MAIN, 10).capacity == 12
    assert limits_of(GSPLAT_MAIN, 10**6).capacity < 2500
    assert limits_of(GSPLAT_MAIN._replace(transmittance_min=0.0), 10**6).capacity > 10**6
