"""MP-GS: the planes of its primitives by hand, depths and normals, the losses of surfels, and meshes of its runs."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.mixed.model import MIXED_GAUSSIANS, mix_kinds
from minisplat_ref.extensions.mixed.population import make_ellipses
from minisplat_ref.extensions.mixed.projection import KAPPA, Hulls, Planes, fit_planes, place_vertices, planes_vjp
from minisplat_ref.extensions.mixed.response import SURFACE_FIELDS, SurfaceFootprints, surface_response
from minisplat_ref.mechanisms.surfels.losses import distortion
from minisplat_ref.mechanisms.surfels.response import Layout
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.pinhole import pinhole, pinhole_rays
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import Model, Primitives, Projection, Scene, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

SHARP = GSPLAT_MAIN._replace(eps2d=0.0)  # without the low-pass
RENDERER = MIXED_GAUSSIANS.renderer
WANTS = frozenset({"depth", "normal", "spread"})


def hulls_at(camera, place, quat, scales, vertices=(0.0, 0, 0, 0), n_vertices=1):
    """One hull whose mean is at a place of the camera's frame."""
    primitives = Primitives(in_front_of(camera, place), np.array([quat]), np.array([scales]), np.ones(1))
    return Hulls(primitives, np.array([vertices], float), np.array([n_vertices]))


def found_planes(hulls, camera, conventions=SHARP):
    planes, normals = fit_planes(hulls, np.arange(len(hulls.n_vertices)), camera, conventions)
    return planes[0], normals[0]


# --- planes ---


@pytest.mark.parametrize(("vertices", "n_vertices"), [((0, 0, 0, 0), 1), ((1, 0.3, 0, 0), 2), ((1, 0.3, -0.2, 0.8), 3)])
def test_a_flat_primitive_has_the_depth_and_the_normal_of_its_plane(vertices, n_vertices):
    """A pixel's ray meets the plane of the first two axes, wherever the pixel is."""
    camera, quat = turned_camera(), [0.9, 0.3, -0.5, 0.1]
    hulls = hulls_at(camera, [0.4, -0.3, 4.0], quat, [0.3, 0.2, 1e-9], vertices, n_vertices)
    (w, *s), n = found_planes(hulls, camera)
    axis = camera.cam_from_world_R @ rotation_matrices(np.array([quat]))[0, :, 2]
    x = np.array([0.4, -0.3, 4.0])
    assert_allclose(n, -axis * np.sign(axis @ x), atol=1e3 * CLOSED_FORM)
    assert 0.2 < abs(n[2]) < 0.95 and n @ x < 0
    pixels = np.array([[3.0, 4.0], [22.0, 9.0], [31.5, 20.0]])
    z = axis @ x / (pinhole_rays(pixels[:, 0], pixels[:, 1], camera) @ axis)
    assert_allclose(w * (1 + (pixels - pinhole(x[None], camera)) @ s), 1 / z, rtol=1e3 * CLOSED_FORM)


def test_a_ball_faces_the_camera():
    """A A^T = f^2/z^2 (I + u u^T) and A e = -f/z u, so h = -z/f u / (1 + u^2) and m is along (u, 1)."""
    camera = make_camera(fx=30.0, fy=30.0)._replace(width=400, height=400)  # wide: slopes are not clamped
    place = np.array([1.0, -0.8, 4.0])
    u = place[:2] / place[2]
    (w, *s), n = found_planes(hulls_at(camera, place, [1.0, 0, 0, 0], [0.1] * 3), camera)
    assert w == pytest.approx(1 / 4)
    assert_allclose(s, u / (30 * (1 + u @ u)), rtol=CLOSED_FORM)
    assert_allclose(n, -place / np.linalg.norm(place), rtol=CLOSED_FORM)


def test_a_triangle_has_the_variance_of_all_its_points():
    """That of (0, 0), (1, 0), (0, 1) is 1/18 along each axis, the covariance -1/36; of a segment of 1 it is 1/12."""
    right, segment = np.array([[2 / 3, -1 / 3, -1 / 3, 2 / 3], [0.5, 0, 0, 0]]), np.array([3, 2])
    ab = place_vertices(right, segment)
    found = KAPPA[segment, None, None] * np.einsum("nki,nkj->nij", ab, ab)
    assert_allclose(found[0], [[1 / 18, -1 / 36], [-1 / 36, 1 / 18]], rtol=CLOSED_FORM)
    assert_allclose(found[1], [[1 / 12, 0], [0, 0]], rtol=CLOSED_FORM, atol=CLOSED_FORM)


def test_a_thin_line_has_the_depths_of_its_length():
    """On the axis of a camera of focal length 30, from (-1, 0, 3) to (1, 0, 5): slopes follow it, not its low-pass.

    In the image the segment has the variance (30 / 4)^2 / 3, with depth the covariance (30 / 4) / 3.
    """
    camera, quat = make_camera(fx=30.0, fy=30.0), [np.cos(np.pi / 8), 0, -np.sin(np.pi / 8), 0]  # x towards (1, 0, 1)
    hulls = hulls_at(camera, [0.0, 0, 4], quat, [1e-9] * 3, [np.sqrt(2), 0, 0, 0], 2)
    (w, *s), n = found_planes(hulls, camera, GSPLAT_MAIN)
    h = (30 / 4 / 3) / ((30 / 4) ** 2 / 3 + GSPLAT_MAIN.eps2d)
    assert_allclose([w, *s], [1 / 4, -h / 4, 0], rtol=1e3 * CLOSED_FORM, atol=CLOSED_FORM)
    assert n[0] == pytest.approx(np.sqrt(0.5), abs=0.01)


def test_far_below_a_pixel_and_from_the_edge_planes_face_the_camera():
    camera = make_camera()
    speck = hulls_at(camera, [0.2, 0.1, 4], [0.9, 0.3, -0.5, 0.1], [1e-6, 1e-6, 1e-9], [1e-6, 0, 0, 1e-6], 3)
    edge_on = hulls_at(camera, [0.0, 0, 4], [np.sqrt(0.5), 0, np.sqrt(0.5), 0], [0.5, 0.5, 1e-9])
    for hulls in (speck, edge_on):
        (w, *s), _ = found_planes(hulls, camera, GSPLAT_MAIN)
        assert w == pytest.approx(1 / 4, rel=1e-6) and np.abs(s).max() < 1e-9


def test_depths_stay_within_the_deviations_of_the_primitive(rng):
    """Cauchy and Schwarz: |h . d| is at most the deviation of depth times the length of d in deviations of B."""
    camera, g = make_camera(rng=rng), mix_kinds(make_gaussians(rng, 40), rng)
    primitives = Primitives(g.means, g.quats, np.exp(g.log_scales), np.ones(40))
    kinds = g.n_vertices.astype(int)
    planes, _ = fit_planes(Hulls(primitives, g.vertices, kinds), np.arange(40), camera, GSPLAT_MAIN)
    reach = np.exp(g.log_scales).max(axis=1) ** 2 + np.sum(place_vertices(g.vertices, kinds) ** 2, axis=(1, 2)) / 6
    slopes = np.linalg.norm(planes[:, 1:] / planes[:, :1], axis=1)  # |h|; a pixel is at most 1 / sqrt(eps) deviations
    assert (slopes <= np.sqrt(reach / GSPLAT_MAIN.eps2d)).all() and slopes.max() > 0.01


def test_the_gradient_of_planes(rng):
    camera, kinds, scales = make_camera(rng=rng), np.array([3, 2, 1]), rng.uniform(0.1, 0.4, size=(3, 3))
    means, rows = rng.normal(size=(3, 3)) * [0.5, 0.4, 0.3] + [0, 0, 4], np.arange(3)

    def hulls_of(vertices, means, quats, scales):
        return Hulls(Primitives(means, quats, scales, np.ones(3)), vertices, kinds)

    def function(vertices, means, quats, scales, R, t):
        moved = camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        return tuple(fit_planes(hulls_of(vertices, means, quats, scales), rows, moved, GSPLAT_MAIN))

    inputs = [rng.normal(size=(3, 4)), means, rng.normal(size=(3, 4)), scales]
    check_jacobian(
        function,
        lambda *v: planes_vjp(hulls_of(*inputs), rows, camera, GSPLAT_MAIN, Planes(*v)),
        [*inputs, camera.cam_from_world_R, camera.cam_from_world_t],
        names=["vertices", "means", "quats", "scales", "R", "t"],
    )


# --- the response ---


def steep(n_vertices=3):
    """One triangle of depth 2 whose plane is 8 times as far away where r is 1/8: 17.5 pixels to the left."""
    vertices = np.array([[[-4.0, -3.0], [5.0, -1.0], [-1.0, 4.0]]])
    conics, box = np.array([[0.02, 0.004, 0.015]]), np.array([[0, 0, 64, 64]])
    projection = Projection(np.array([[30.0, 20.0]]), np.full(1, 2.0), conics, np.full(1, 0.9), np.full((1, 2), 9), box)
    planes = np.array([[0.5, 0.05, 0.0]])
    return SurfaceFootprints(projection, vertices, np.array([n_vertices]), planes, np.array([[0, 0, -1.0]]), 0.5)


def test_depths_are_the_planes_and_at_most_eight_times_the_means():
    centers = np.array([[30.0, 20.0], [20.0, 7.0], [12.5, 20.0], [5.0, 20.0], [50.0, 20.0]])
    found = surface_response(Layout(3)).hit(steep(), np.zeros(1, int), centers)
    assert_allclose(found.depths[0], [2, 4, 16, 16, 1], rtol=CLOSED_FORM)


def test_the_gradient_of_the_response_with_depths(rng):
    """Of alpha and of the channels depth, 1 / z and its square, on both sides of the bound."""
    footprints, one = steep(), np.zeros(1, int)
    centers = np.array([[31.0, 21.0], [24.0, 12.0], [40.0, 22.0], [8.0, 19.0]])
    response, colors = surface_response(Layout(0, 1)), np.zeros((1, 3))

    def moved(means2d, conics, opacities, vertices, planes):
        projection = footprints.projection._replace(means2d=means2d, conics=conics, opacities=opacities)
        return SurfaceFootprints(projection, vertices, footprints.n_vertices, planes, footprints.normals, 0.5)

    def function(*args):
        found = response.hit(moved(*args), one, centers)
        return found.unclamped, response.shading.shade(colors, found.place)

    def vjp(v, v_channels):
        found = response.hit(footprints, one, centers)
        _, v_depths = response.shading.shade_vjp(colors, found.place, v_channels)
        return response.hit_vjp(footprints, one, found, v, v, v_depths)

    assert response.hit(footprints, one, centers).place.is_bounded.any()
    check_jacobian(function, vjp, [getattr(footprints, name) for name in SURFACE_FIELDS], names=list(SURFACE_FIELDS))


# --- the renderer ---


def test_colours_are_the_same_with_depths_and_without(backend, rng):
    """Of all kinds, and of ellipses alone, which 3DGS renders."""
    g, view = make_gaussians(rng, 40), view_from(make_camera(rng=rng))
    for population in (mix_kinds(g, rng), make_ellipses(g)):
        alone, more = (
            RENDERER.render(Model(population), view, Request(backend=backend, wants=wants))[0]
            for wants in (frozenset(), WANTS)
        )
        assert alone.alpha.max() > 0.5 and more.image.shape[2] == 9
        assert_allclose(more.image[..., :3], alone.image, atol=PARITY_FLOAT64)


def test_depths_and_normals_of_one_triangle_in_an_image(backend):
    """Without the low-pass each pixel shows the plane: w z, w n, w (1/z - q_0) and its square, w the opacity 0.9."""
    camera = turned_camera()
    one = make_ellipses(balls(in_front_of(camera, [0.4, -0.3, 4.0]), [0.3], [0.9]))
    one.log_scales[0, 2] = np.log(1e-9)
    one = one._replace(
        quats=np.array([[0.9, 0.3, -0.5, 0.1]]), vertices=np.array([[1.0, 0.3, -0.2, 0.8]]), n_vertices=np.full(1, 3.0)
    )
    request = Request(backend=backend, conventions=SHARP, wants=WANTS)
    output, slices = RENDERER.render(Model(one), view_from(camera), request)[0], RENDERER.channels(WANTS)
    axis = camera.cam_from_world_R @ rotation_matrices(one.quats)[0, :, 2]
    x = np.array([0.4, -0.3, 4.0])
    ys, xs = np.nonzero(np.isclose(output.alpha, 0.9, rtol=CLOSED_FORM))  # inside
    z = axis @ x / (pinhole_rays(xs + 0.5, ys + 0.5, camera) @ axis)
    assert len(z) > 10 and np.ptp(z) > 0.3
    shown = output.image[ys, xs] / 0.9
    assert_allclose(shown[:, slices["depth"]][:, 0], z, rtol=1e4 * CLOSED_FORM)
    assert_allclose(shown[:, slices["normal"]], np.tile(-axis * np.sign(axis @ x), (len(z), 1)), atol=1e4 * CLOSED_FORM)
    q, squares = shown[:, slices["spread"]].T
    assert_allclose(squares, q * q, rtol=1e4 * CLOSED_FORM, atol=1e4 * CLOSED_FORM)
    assert_allclose(q - q[0], 1 / z - 1 / z[0], atol=1e4 * CLOSED_FORM)


@pytest.mark.parametrize(("dtype", "rel"), [(np.float64, PARITY_FLOAT64), (np.float32, 10 * PARITY_FLOAT32_IMAGE)])
def test_kernels_and_reference_agree_in_all_channels(dtype, rel, rng):
    population, view = mix_kinds(make_gaussians(rng, 40), rng), view_from(make_camera(rng=rng))
    slices, wants = RENDERER.channels(WANTS), WANTS | {"median_depth"}
    ours, theirs = (
        RENDERER.render(Model(as_dtype(population, of)), view, Request(backend=backend, wants=wants))[0]
        for of, backend in ((dtype, CPU), (np.float64, REFERENCE))
    )
    for name in WANTS:
        expected = theirs.image[..., slices[name]]
        assert np.abs(expected).max() > 0.01
        assert np.abs(ours.image[..., slices[name]] - expected).max() <= rel * np.abs(expected).max(), name
    is_near = np.abs(ours.median_depth - theirs.median_depth) <= 10 * rel * theirs.median_depth.max()
    assert is_near.all() if dtype == np.float64 else is_near.mean() > 0.99
    seen = theirs.alpha > 0.5
    assert (np.linalg.norm(theirs.image[seen][:, slices["normal"]], axis=1) <= theirs.alpha[seen] + CLOSED_FORM).all()


def test_the_distortion_of_a_triangle_in_front_of_a_ball(backend):
    """Alphas 0.5 and 0.8 at z = 2 and z = 4: w_1 w_2 (m_1 - m_2)^2 with m = 100 / 99.8 (1 - 0.2 / z)."""
    camera = make_camera(24, 24, cx=12.5, cy=12.5)
    two = make_ellipses(balls(in_front_of(camera, [[0, 0, 2.0], [0, 0, 4.0]]), [0.2, 40.0], [0.5, 0.8]))
    two.log_scales[0, 2] = -16
    two = two._replace(vertices=np.array([[1.0, -1, 0, 1.5], [0] * 4]), n_vertices=np.array([3.0, 1]))
    view, request = view_from(camera), Request(backend=backend, conventions=GSPLAT_MAIN, wants=frozenset({"spread"}))
    output, _ = RENDERER.render(Model(two), view, request)
    middle = output._replace(image=output.image[12:13, 12:13], alpha=output.alpha[12:13, 12:13])
    scene = Scene("s", (), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
    slices = RENDERER.channels(request.wants)
    value, _ = distortion(Rendered(middle, slices, view, scene, Model(two), 1, request))
    m = 100 / 99.8 * (1 - 0.2 / np.array([2, 4]))
    assert value == pytest.approx(0.5 * 0.5 * 0.8 * (m[0] - m[1]) ** 2, rel=1e-6)


# --- from end to end ---


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs with the losses of surfels and without, 60 iterations each."""
    folder = tmp_path_factory.mktemp("mixed_surfaces")
    tiny = ("--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")
    assert main(["synthetic", "room", "--out", str(folder / "room"), *tiny]) == 0
    train = ["train", str(folder / "room"), "--recipe", "mixed", "--iterations", "60"]
    assert main([*train, "--out", str(folder / "with"), "--set", "distortion=100"]) == 0
    assert main([*train, "--out", str(folder / "without"), "--set", "normal_consistency=0"]) == 0
    return folder


def test_the_losses_act_from_their_dates_on(runs):
    """7,000 and 3,000 of 30,000 iterations are 14 and 6 of 60."""
    terms = {term.name: term for term in find_recipe("mixed", 60).losses}
    assert (terms["normal_consistency"].start, terms["distortion"].start) == (14, 6)
    with_losses, without = (
        [json.loads(line)["loss"] for line in (runs / name / "log.jsonl").read_text().splitlines()]
        for name in ("with", "without")
    )
    assert with_losses[0] == without[0] and with_losses[-1] != without[-1]


def test_a_run_becomes_a_mesh_by_median_and_expected_depths(runs, capsys):
    pytest.importorskip("skimage")
    for depth in ("median", "expected"):
        out = runs / f"{depth}.ply"
        assert main(["mesh", str(runs / "with"), "--out", str(out), "--depth", depth, "--voxel", "0.2"]) == 0
        assert out.stat().st_size > 1000
    capsys.readouterr()
    assert main(["mesh", str(runs / "with"), "--out", str(runs / "no.ply"), "--depth", "midpoint"]) == 2
    error = capsys.readouterr().err.strip()
    assert "renderer mixed gives no midpoint depth" in error and "\n" not in error and not (runs / "no.ply").exists()
