"""Polygons: one ray and one octagon, triangles against planes, gradients, hard cases, training and drawing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.polygons import model
from minisplat_ref.extensions.polygons.kernels import build_tree as triangle_tree
from minisplat_ref.extensions.polygons.kernels import meet as meet_triangle
from minisplat_ref.extensions.polygons.model import (
    LOG_THICKNESS,
    TRACED,
    Polygons,
    make_fans,
    make_image_tracer,
    make_polygons,
    make_tracer,
    press_flat,
    spans_vjp,
    stages,
)
from minisplat_ref.mechanisms.meshes.fans import opacity_radii, rims
from minisplat_ref.mechanisms.rays import kernels
from minisplat_ref.mechanisms.rays.blending import sum_by_row
from minisplat_ref.mechanisms.rays.pixel_rays import Rays, pixel_rays
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Gaussians, Model, view_from
from scenes import as_dtype, balls, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
    PLANE_DEPTH,
)

ROOT = Path(__file__).parent.parent.parent
DRAW = TRACED.renderer
BLACK = np.zeros(3)


def rays_along(origins, directions):
    origins, directions = np.atleast_2d(np.array(origins, float)), np.atleast_2d(np.array(directions, float))
    n = max(len(origins), len(directions))
    origins, directions = (np.tile(array, (n // len(array), 1)) for array in (origins, directions))
    return Rays(origins, directions, np.full(n, 0.01), np.full(n, 1e10))


def one(mean, a, b, opacity=0.8, n_sides=8):
    """A polygon of the spans a and b around a mean."""
    radii = opacity_radii(np.array([np.log(opacity / (1 - opacity))]))
    return Polygons(
        np.array([mean], float), np.array([[a, b]], float).swapaxes(1, 2), radii, np.array([opacity]), n_sides
    )


def several(*some):
    fields = zip(*(polygons[:4] for polygons in some), strict=True)
    return Polygons(*(np.concatenate(field) for field in fields), some[0].n_sides)


def random_polygons(rng, n, n_sides=8):
    g = make_gaussians(rng, n)
    return make_polygons(g, 1 / (1 + np.exp(-g.opacity_logits)), n_sides)


def hits_of(polygons, rays, backend=CPU, conventions=GSPLAT_MAIN):
    return make_tracer(polygons, conventions, backend).list_hits(rays, conventions)


# --- one ray and one polygon ---


def test_an_octagon_that_faces_the_ray(backend):
    """Alpha is the Gaussian's at the place; the hit lies in the plane; beyond an edge there is none."""
    octagon = one([0.1, 0.2, 4], [0.5, 0, 0], [0, 0.25, 0])
    r = octagon.radii[0]
    edge = 0.5 * r * np.cos(np.pi / 8) * np.array([np.cos(np.pi / 8), 0.5 * np.sin(np.pi / 8)])  # middle of side 0
    places = np.array([[0, 0], [0.3, 0.1], [-0.2, 0.3], 0.999 * edge, 1.001 * edge, [0.999 * 0.5 * r, 0], [0, 0.9]])
    targets = np.column_stack([places[:, 0] + 0.1, places[:, 1] + 0.2, np.full(len(places), 4.0)])
    rays = rays_along([0, 0, 0], targets / 4)
    conventions = GSPLAT_MAIN._replace(alpha_min=1e-3)  # so that corners, where alpha is 1/291, are hit
    hits = hits_of(octagon, rays, backend, conventions)
    assert_array_equal(np.diff(hits.offsets), [1, 1, 1, 1, 0, 1, 0])
    hit = places[[0, 1, 2, 3, 5]] / [0.5, 0.25]
    assert_allclose(hits.unclamped, 0.8 * np.exp(-0.5 * np.sum(hit**2, axis=1)), rtol=CLOSED_FORM)
    assert_allclose(hits.depths, 4, rtol=CLOSED_FORM)


def test_an_inclined_polygon_is_met_where_its_plane_is(backend):
    """The plane z = 3 + x is met by the ray (t / 5, 0, t) at t = 15 / 4."""
    s = np.sqrt(0.5)
    inclined = one([0, 0, 3], [s, 0, s], [0, 1, 0])
    hits = hits_of(inclined, rays_along([0, 0, 0], [0.2, 0, 1]), backend)
    assert_allclose(hits.depths, [15 / 4], rtol=CLOSED_FORM)
    assert_allclose(hits.unclamped, [0.8 * np.exp(-0.5 * 2 * (3 / 4) ** 2)], rtol=CLOSED_FORM)


def test_sheets_before_a_camera_are_plain_3dgs(rng):
    """Flat Gaussians in parallel to the image, without the low-pass: projection is affine in such a plane, and so EWA
    is exact, also its gradient. Alpha is cut at 1/100, inside of every polygon."""
    g = make_gaussians(rng, 40)
    angle = rng.uniform(0, np.pi, 40)
    g = g._replace(
        quats=np.column_stack([np.cos(angle / 2), np.zeros((40, 2)), np.sin(angle / 2)]),
        log_scales=np.column_stack([g.log_scales[:, :2], np.full(40, -400.0)]),
        opacity_logits=np.maximum(g.opacity_logits, -1.0),
    )
    conventions = GSPLAT_MAIN._replace(eps2d=0.0, alpha_min=0.01)
    view, v_image = view_from(make_camera()), rng.normal(size=(18, 24, 3))
    results = []
    for renderer in (SPLATTING, DRAW):
        output, tape = renderer.render(Model(g), view, Request(conventions=conventions, backend=REFERENCE))
        results.append((output, renderer.render_vjp(tape, v_image, None).gaussians))
    (plain, v_plain), (ours, v_ours) = results
    assert plain.alpha.max() > COVERAGE_MIN
    assert_allclose(ours.image, plain.image, atol=PARITY_FLOAT64)
    for name in ("opacity_logits", "sh_dc", "sh_rest"):
        assert_allclose(getattr(v_ours, name), getattr(v_plain, name), atol=PARITY_FLOAT64, err_msg=name)
    assert_allclose(v_ours.means[:, :2], v_plain.means[:, :2], atol=1e2 * PARITY_FLOAT64)
    assert_allclose(v_ours.log_scales[:, :2], v_plain.log_scales[:, :2], atol=1e2 * PARITY_FLOAT64)
    assert_array_equal(v_ours.log_scales[:, 2], 0)


def test_many_sides_are_an_ellipse(rng):
    """With ever more sides nothing of an ellipse of alpha 1/255 is cut off; eight cut some, and never add any."""
    rays, alphas = pixel_rays(make_camera(), GSPLAT_MAIN), {}
    for n_sides in (3, 8, 64):
        blended = make_tracer(random_polygons(np.random.default_rng(3), 1, n_sides), GSPLAT_MAIN, REFERENCE).blend(
            np.ones((1, 3)), rays, BLACK, GSPLAT_MAIN
        )
        alphas[n_sides] = 1 - blended.transmittances
    full = make_tracer(
        random_polygons(np.random.default_rng(3), 1)._replace(radii=np.array([1e3])), GSPLAT_MAIN, REFERENCE
    )
    expected = 1 - full.blend(np.ones((1, 3)), rays, BLACK, GSPLAT_MAIN).transmittances
    assert_array_equal(alphas[64], expected)
    lost = [np.count_nonzero((alphas[n] == 0) & (expected > 0)) for n in (3, 8)]
    assert lost[0] > lost[1] > 0 and all((alphas[n] <= expected).all() for n in (3, 8))


def test_the_gradient_of_a_meeting(rng):
    polygons = random_polygons(rng, 3)._replace(radii=np.full(3, 50.0))
    targets = polygons.means[[0, 1, 2, 0]] + 0.2 * np.einsum(
        "nij,nj->ni", polygons.spans[[0, 1, 2, 0]], rng.normal(size=(4, 2))
    )
    rays = rays_along(np.zeros(3), targets)._replace(origins=0.1 * rng.normal(size=(4, 3)))
    ray_ids, ids = np.array([0, 0, 1, 2, 3]), np.array([0, 1, 1, 2, 0])

    def forward(means, spans, opacities, origins, directions):
        moved = polygons._replace(means=means, spans=spans, opacities=opacities)
        pairs = model.meet(moved, rays._replace(origins=origins, directions=directions), ray_ids, ids)
        return pairs.unclamped, pairs.depths

    def vjp(v_unclamped, v_depths):
        parts = model.meet_vjp(polygons, rays, ray_ids, ids, v_unclamped, v_depths)
        rows = (ids, ids, ids, ray_ids, ray_ids)
        return tuple(sum_by_row(part, row, 3 + (row is ray_ids)) for part, row in zip(parts, rows, strict=True))

    inputs = [polygons.means, polygons.spans, polygons.opacities, rays.origins, rays.directions]
    check_jacobian(forward, vjp, inputs, names=["means", "spans", "opacities", "origins", "directions"])


def test_the_gradient_of_spans(rng):
    g = make_gaussians(rng, 3)
    o = 1 / (1 + np.exp(-g.opacity_logits))
    polygons = make_polygons(g, o)
    check_jacobian(
        lambda quats, log_scales: (make_polygons(g._replace(quats=quats, log_scales=log_scales), o).spans,),
        lambda v: spans_vjp(g, polygons, v),
        [g.quats, g.log_scales],
        names=["quats", "log_scales"],
    )


# --- many polygons ---


@pytest.mark.parametrize(("n", "n_sides"), [(0, 8), (1, 3), (5, 7), (200, 8)])
def test_polygons_triangles_and_the_reference_agree(n, n_sides, rng):
    """Rays from anywhere to anywhere: whole polygons and their triangles are hit alike, and in the same order."""
    polygons = random_polygons(rng, n, n_sides)
    targets = np.concatenate([polygons.means, rng.normal((0, 0, 3), 1, (100, 3))])  # also straight at the centres
    origins = rng.normal(size=(len(targets), 3))
    rays = rays_along(origins, targets - origins)
    triangles = kernels.tracer_of(meet_triangle, triangle_tree(make_fans(polygons), GSPLAT_MAIN))
    theirs = hits_of(polygons, rays, REFERENCE)
    assert len(theirs.ray_ids) >= n
    for ours in (hits_of(polygons, rays, CPU), triangles.list_hits(rays, GSPLAT_MAIN)):
        for name in ("offsets", "ray_ids", "gaussian_ids"):
            assert_array_equal(getattr(ours, name), getattr(theirs, name), name)
        for name in ("unclamped", "depths", "weights", "transmittances"):
            assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=PLANE_DEPTH, err_msg=name)


@pytest.mark.parametrize(
    ("dtype", "image_rel", "gradient_rel"),
    [(np.float64, PARITY_FLOAT64, PARITY_FLOAT64), (np.float32, PARITY_FLOAT32_IMAGE, PARITY_FLOAT32_GRADIENT)],
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


def test_the_gradient_of_the_whole_model(small_proof):
    report = check_model_gradients(CPU, GSPLAT_MAIN, TRACED, stages)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


# --- hard cases ---


def test_rays_through_the_centre_and_along_the_spokes_hit_once(backend):
    """Of points that several triangles share, one has each."""
    octagon = one([0, 0, 3], [0.5, 0, 0], [0, 0.25, 0])
    corners = rims(octagon.means, octagon.spans, octagon.radii)[0]
    targets = np.concatenate(
        [octagon.means, *(octagon.means + k * (corners - octagon.means) for k in (1e-9, 0.3, 0.7))]
    )
    hits = hits_of(octagon, rays_along([0, 0, 0], targets), backend)
    assert_array_equal(np.diff(hits.offsets), 1)


def test_a_camera_in_the_plane_of_a_polygon_does_not_see_it(backend):
    """The plane y = 0, seen from within: rays in it are parallel to it, all others start on it."""
    flat = one([0, 0, 3], [0, 0, 0.5], [0.5, 0, 0])
    rays = rays_along([0, 0, 0], [[0, 0, 1], [0.1, 0, 1], [0, 1e-9, 1], [0, 0.2, 1]])
    assert_array_equal(hits_of(flat, rays, backend).offsets, 0)


def test_grazing_rays_meet_the_polygon_while_they_can(backend):
    """At a slope of 1e-6 the ray enters the plane within the polygon, and t is known to what is left of 16 digits."""
    flat = one([0, 0, 3], [0, 0, 0.5], [0.5, 0, 0])
    rays = rays_along([[0, 3e-6, 0], [0, 6e-6, 0], [0, 3e-6, 0]], [[0, -1e-6, 1], [0, -1e-6, 1], [0, 1e-6, 1]])
    hits = hits_of(flat, rays, backend)
    assert_array_equal(np.diff(hits.offsets), [1, 0, 0])
    assert hits.depths[0] == pytest.approx(3, rel=1e-9) and hits.unclamped[0] == pytest.approx(0.8, rel=1e-9)


def test_a_needle_of_a_millionth_is_hit_where_it_is():
    """A polygon 10^6 times as long as wide: rays in its middle, at its edges and beside it."""
    needle = one([0, 0.05, 3], [0.2, 0, 0], [0, 2e-7, 0])
    y = (0.05 + 2e-7 * np.array([0, 1, 3.0, 3.5])) / 3
    rays = rays_along([0, 0, 0], np.column_stack([np.full(4, 0.02), y, np.ones(4)]))
    ours, theirs = (hits_of(needle, rays, backend) for backend in (CPU, REFERENCE))
    assert_array_equal(np.diff(ours.offsets), [1, 1, 1, 0])
    assert_array_equal(ours.offsets, theirs.offsets)
    assert_allclose(ours.unclamped, theirs.unclamped, rtol=1e-7)  # a place is known to 1e-16 over 2e-7 of its width
    assert_allclose(ours.unclamped, 0.8 * np.exp(-0.5 * (0.09 + np.array([0, 1, 9.0]))), rtol=1e-7)


def test_copies_are_taken_in_the_order_of_their_rows(backend, rng):
    polygons = random_polygons(rng, 5)
    twice = several(polygons, Polygons(*(field[::-1] for field in polygons[:4])))
    hits = hits_of(twice, rays_along([0, 0, 0], polygons.means), backend)
    for r in range(5):
        ids = hits.gaussian_ids[hits.offsets[r] : hits.offsets[r + 1]].tolist()
        assert ids.index(r) < ids.index(9 - r)


def test_what_cannot_be_drawn_is_left_out(rng):
    """A faint Gaussian, whose polygon is empty; sizes of 0 and infinity; no number; an opacity of 0; one behind."""
    good = random_polygons(rng, 6)
    bad = Polygons(*(np.repeat(field[:1], 6, axis=0) for field in good[:4]))
    bad.radii[0], bad.spans[1], bad.spans[2], bad.means[3], bad.opacities[4] = 0, 0, np.inf, np.nan, 0
    bad.means[5] = [0, 0, -3]
    both, rays = several(good, bad), pixel_rays(make_camera(), GSPLAT_MAIN)
    for backend in (CPU, REFERENCE):
        images = []
        for polygons in (good, both):
            tracer = make_image_tracer(polygons, make_camera(), GSPLAT_MAIN, backend)
            ones = np.ones((len(polygons.means), 3))
            blended = tracer.blend(ones, rays, BLACK, GSPLAT_MAIN)
            v = tracer.blend_vjp(ones, rays, BLACK, GSPLAT_MAIN, blended, (blended.image, rays.near, rays.near))
            assert all(np.isfinite(array).all() for array in (*blended[:5], *v))
            images.append(blended.image)
        assert images[0].max() > COVERAGE_MIN
        assert_array_equal(images[0], images[1])


@pytest.mark.parametrize("n_sides", [3, 8])
def test_lists_of_tiles_hold_polygons_on_all_sides_of_a_camera(n_sides, rng):
    """Polygons beside, around and partly behind the camera, some in a plane with it, are hit as in the reference."""
    g = make_gaussians(rng, 200, size=0.6)._replace(means=rng.normal(0, 1.5, (200, 3)))
    polygons, camera = make_polygons(g, 1 / (1 + np.exp(-g.opacity_logits)), n_sides), make_camera(29, 21)
    polygons.spans[:5, :, 1] = polygons.means[:5] / 3  # the camera is at the origin
    rays, colors, found = pixel_rays(camera, GSPLAT_MAIN), rng.uniform(size=(200, 3)), []
    v_blended = tuple(rng.normal(size=(len(rays.near), *shape)) for shape in ((3,), (), ()))
    for backend in (CPU, REFERENCE):
        tracer = make_image_tracer(polygons, camera, GSPLAT_MAIN, backend)
        blended = tracer.blend(colors, rays, BLACK, GSPLAT_MAIN)
        v = tracer.blend_vjp(colors, rays, BLACK, GSPLAT_MAIN, blended, v_blended)
        found.append((tracer.list_hits(rays, GSPLAT_MAIN), v))
    (ours, v_ours), (theirs, v_theirs) = found
    assert len(theirs.ray_ids) > 1000
    assert_array_equal(ours.offsets, theirs.offsets)
    assert_array_equal(ours.gaussian_ids, theirs.gaussian_ids)
    assert_allclose(ours.weights, theirs.weights, rtol=PLANE_DEPTH)
    for name, expected in v_theirs._asdict().items():
        assert np.abs(getattr(v_ours, name) - expected).max() <= PLANE_DEPTH * np.abs(expected).max(), name


def test_hidden_rows_are_not_drawn_and_too_much_is_refused(backend, rng):
    g, view = make_gaussians(rng, 6), view_from(make_camera())
    is_visible = np.arange(6) < 3
    some = DRAW.render(Model(Gaussians(*(field[:3] for field in g))), view, Request(backend=backend))[0]
    hidden = DRAW.render(Model(g), view, Request(backend=backend, is_visible=is_visible))[0]
    assert_array_equal(some.image, hidden.image)
    with pytest.raises(InputError, match="polygons does not give surface"):
        DRAW.render(Model(g), view, Request(backend=backend, wants=frozenset({"surface"})))


def test_training_starts_flat_and_facing_everywhere():
    """Balls as training begins with, all of the same axes: the mean of n n^T over uniform directions is a third.

    The variance of n_x^2 is 4/45, so of 3000 normals the mean is off by 0.0054, and four times that is allowed.
    """
    n = 3000
    flat = press_flat(balls(np.zeros((n, 3)), np.full(n, 0.3), np.full(n, 0.5)), np.random.default_rng(0))
    assert_allclose(np.exp(np.sort(flat.log_scales, axis=1)), [[1e-5, 0.3, 0.3]] * n, rtol=1e-9)
    spans = make_polygons(flat, np.ones(n)).spans
    normals = np.cross(spans[:, :, 0], spans[:, :, 1]) / 0.09
    assert_allclose(normals.T @ normals / n, np.eye(3) / 3, atol=0.022)


def test_what_has_a_shape_keeps_its_direction(rng):
    g = make_gaussians(rng, 50)
    flat = press_flat(g, np.random.default_rng(0))
    assert_array_equal(flat.quats, g.quats)
    assert_allclose(flat.log_scales.min(axis=1), LOG_THICKNESS)
    assert_array_equal(np.sort(flat.log_scales, axis=1)[:, 1:], np.sort(g.log_scales, axis=1)[:, 1:])
    again = press_flat(flat, np.random.default_rng(1))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(flat, again, strict=True))


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


def test_trains_evaluates_and_renders(room, tmp_path):
    run = tmp_path / "run"
    options = ["--recipe", "polygons", "--test-every", "4", "--iterations", "30", "--out", str(run)]
    assert main(["train", str(room), *options]) == 0
    losses = [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]
    assert main(["eval", str(run)]) == 0
    ply, cameras = str(run / "point_cloud.ply"), ["--cameras", str(run / "cameras.json")]
    assert main(["render", ply, *cameras, "--depth", "--out", str(tmp_path / "out")]) == 0
    assert len(sorted((tmp_path / "out").glob("*.png"))) == 16


def test_same_bytes_at_one_and_two_threads(room, tmp_path):
    found = set()
    for n_threads in ("1", "2"):
        out = tmp_path / n_threads
        command = [
            sys.executable,
            "-m",
            "minisplat_ref",
            "train",
            str(room),
            "--recipe",
            "polygons",
            "--iterations",
            "8",
        ]
        environment = os.environ | {"NUMBA_NUM_THREADS": n_threads}
        subprocess.run([*command, "--out", str(out)], cwd=ROOT, env=environment, check=True, capture_output=True)
        found.add((out / "point_cloud.ply").read_bytes())
    assert len(found) == 1
