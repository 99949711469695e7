"""Lens: peaks along true rays, gradients, parity, the pinhole as the degenerate case, training as photographed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.lens.model import OPTICS, THROUGH_LENS, stages
from minisplat_ref.io import load_scene, viewpoints
from minisplat_ref.mechanisms.cameras.gsplat_call import rasterization, rasterization_vjp
from minisplat_ref.mechanisms.cameras.models import model_of
from minisplat_ref.mechanisms.cameras.ray_footprints import RESPONSE, are_reached, hit, list_tiles, project
from minisplat_ref.oracle.gradients import jacobian_case
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.reference.covariance import covariances, rotation_matrices
from minisplat_ref.rendering import SPLATTING, Request, activate
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.types import Gaussians, Model, Optics, Primitives, Scene, view_from
from photo_scenes import DISTORTED, assert_refused, write_colmap
from scenes import ANTIALIASED, as_dtype, balls, make_camera, make_gaussians
from tolerances import PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

DRAW = THROUGH_LENS.renderer
BARE = Optics("brown", (0.0,) * 8)


def draw(gaussians, camera, backend, wants=frozenset(), v=None):
    request = Request(np.full(3, 0.2), backend=backend, wants=wants)
    output, tape = DRAW.render(Model(gaussians), view_from(camera), request)
    return output if v is None else (output, DRAW.render_vjp(tape, v, None))


# --- the response ---


@pytest.mark.parametrize("optics", OPTICS, ids=str)
def test_alpha_is_the_maximum_along_the_ray(optics):
    """The quadratic along the ray is minimised in another way: by its coefficients with the inverse covariance."""
    camera = make_camera(rng=np.random.default_rng(2))._replace(optics=optics)
    primitives = activate(make_gaussians(np.random.default_rng(0), 12))
    footprints = project(primitives, camera, GSPLAT_MAIN)
    ids = np.flatnonzero(footprints.radii[:, 0] > 0)
    pixels = np.stack(np.meshgrid(np.arange(24) + 0.5, np.arange(18) + 0.5), axis=-1).reshape(-1, 2)
    _, d = model_of(camera).rays(pixels, camera)
    d = d @ camera.cam_from_world_R
    P, offsets = np.linalg.inv(covariances(primitives.quats, primitives.scales)), primitives.means - camera.center
    a = np.einsum("pi,nij,pj->np", d, P, d)
    b, c = np.einsum("pi,nij,nj->np", d, P, offsets), np.einsum("ni,nij,nj->n", offsets, P, offsets)
    peaks = primitives.opacities[:, None] * np.exp(-(c[:, None] - b * b / a) / 2)
    assert len(ids) > 8
    assert_allclose(hit(footprints, ids, pixels).unclamped, peaks[ids], atol=1e-12)


@pytest.mark.parametrize("optics", OPTICS, ids=str)
def test_bounds_contain_what_reaches_alpha_min(optics):
    camera = make_camera(64, 48, fx=60.0, fy=60.0)._replace(optics=optics)
    primitives = activate(make_gaussians(np.random.default_rng(1), 40, size=0.05))
    footprints = project(primitives, camera, GSPLAT_MAIN)
    ids = np.flatnonzero(footprints.radii[:, 0] > 0)
    xs, ys = (grid.ravel() for grid in np.meshgrid(np.arange(64), np.arange(48)))
    alphas = hit(footprints, ids, np.stack([xs, ys], axis=1) + 0.5).unclamped
    x0, y0, x1, y1 = footprints.boxes[ids, :, None].swapaxes(0, 1)
    is_outside = (xs < x0) | (xs >= x1) | (ys < y0) | (ys >= y1)
    assert len(ids) > 20 and is_outside.mean() > 0.5
    assert np.where(is_outside, alphas, 0).max() < 2 * GSPLAT_MAIN.alpha_min


def test_gaussians_behind_thin_or_partly_out_of_sight():
    camera = make_camera()._replace(optics=BARE)
    means = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.3], [0.0, 0.0, np.inf]])
    scales = np.full((4, 3), 0.05)
    scales[1, 0], scales[2] = 1e-14, 3.0
    found = project(Primitives(means, np.tile([1.0, 0, 0, 0], (4, 1)), scales, np.full(4, 0.9)), camera, GSPLAT_MAIN)
    assert (found.radii[:, 0] > 0).tolist() == [False, False, True, False]
    assert found.boxes[2].tolist() == [0, 0, 24, 18]
    with pytest.raises(InputError, match="no compensated opacities"):
        project(Primitives(means, np.ones((4, 4)), scales, np.ones(4)), camera, ANTIALIASED)
    with pytest.raises(InputError, match="parallel rays"):
        draw(balls([[0, 0, 2]], [0.1], [0.5]), camera._replace(optics=Optics("orthographic")), CPU)


def test_what_no_ray_reaches_is_culled_by_hand():
    """Rays up to 45 degrees from the axis. At 90 degrees and 2 units a ball of 2 sin(45 degrees) touches the cone.

    Alpha is alpha_min at two standard deviations, so 0.707 is the standard deviation that decides.
    """
    rays = np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 1.0]]) / np.array([[1.0, np.sqrt(2)]])
    x, limit = np.array([[2.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, 2.0], [0.0, -2.0, 2.0], [0.1, 0.0, -0.1]]), np.sqrt(0.5)
    scales, ratio = np.array([0.999 * limit, 1.001 * limit, 2.0, 1e-9, 1e-9, 0.1]), np.exp(2.0)
    found = are_reached(x, scales, np.full(6, ratio), rays)
    assert found.tolist() == [False, True, True, True, True, True]
    assert not are_reached(x[1:2], scales[1:2], np.array([0.5]), rays)


@pytest.mark.parametrize("optics", OPTICS, ids=str)
def test_nothing_that_a_ray_meets_is_culled_beside_the_camera(optics):
    """Large and small Gaussians around the plane of the camera, their alphas at every pixel; most are out of sight."""
    rng = np.random.default_rng(8)
    camera = make_camera(36, 28, fx=40.0, fy=40.0)._replace(optics=optics)
    means = np.column_stack([rng.uniform(-2, 2, (200, 2)), rng.uniform(0.02, 0.3, 200)])
    scales = rng.uniform(0.02, 0.4, (200, 3))
    p = Primitives(means, rng.normal(size=(200, 4)), scales, rng.uniform(0.1, 0.99, 200))
    found = project(p, camera, GSPLAT_MAIN)
    R_g = rotation_matrices(p.quats)
    everywhere = found._replace(
        positions=means, whitenings=np.swapaxes(R_g, 1, 2) / scales[:, :, None], opacities=p.opacities
    )
    xs, ys = (grid.ravel() for grid in np.meshgrid(np.arange(36), np.arange(28)))
    largest = hit(everywhere, np.arange(200), np.stack([xs, ys], axis=1) + 0.5).unclamped.max(axis=1)
    ratios = p.opacities / GSPLAT_MAIN.alpha_min
    is_reached = are_reached(means, scales.max(axis=1), ratios, found.rays)
    assert is_reached[largest >= GSPLAT_MAIN.alpha_min].all()
    assert (largest >= GSPLAT_MAIN.alpha_min).sum() > 20 and (~is_reached).sum() > 20
    assert not found.radii[~is_reached].any()


def test_a_gaussian_with_a_sigma_point_out_of_sight_has_no_bounds():
    """A needle along the axis, half of which is behind the camera: one sigma point is 0.173 x 4 before 0.5, at -0.19.

    Its other sigma points are all in the pixel of the axis, so bounds of these would hold a few pixels.
    """
    camera = make_camera()
    needle = Primitives(
        np.array([[0, 0, 0.5]]), np.array([[1.0, 0, 0, 0]]), np.array([[0.01, 0.01, 4]]), np.full(1, 0.9)
    )
    found = project(needle, camera, GSPLAT_MAIN)
    assert found.boxes[0].tolist() == [0, 0, 24, 18] and found.radii[0].tolist() == [24, 18]
    short = project(needle._replace(scales=np.array([[0.01, 0.01, 0.5]])), camera, GSPLAT_MAIN)
    assert 0 < short.radii.max() < 9


# --- the renderer ---


def test_without_distortion_it_is_the_pinhole_with_exact_rays():
    gaussians, camera = make_gaussians(np.random.default_rng(3), 20), make_camera()
    for backend in (REFERENCE, CPU):
        exact, bent = draw(gaussians, camera, backend), draw(gaussians, camera._replace(optics=BARE), backend)
        assert_allclose(bent.image, exact.image, atol=1e-12)
    one = balls([[0.0, 0.0, 5.0]], [0.05], [0.8])  # small, on the axis, without low-pass: EWA is exact
    narrow = make_camera(fx=300.0, fy=300.0)
    request = Request(conventions=GSPLAT_MAIN._replace(eps2d=0.0), backend=CPU)
    ewa, _ = SPLATTING.render(Model(one), view_from(narrow), request)
    exact, _ = DRAW.render(Model(one), view_from(narrow), request)
    assert_allclose(exact.image, ewa.image, atol=2e-3)


@pytest.mark.parametrize(("backend", "n_lenses"), [(REFERENCE, 1), (CPU, 2)], ids=["reference", "cpu"])
def test_gradients(backend, n_lenses):
    """Every entry of the Jacobians; ``oracle gradients --extension lens`` checks a larger scene too."""
    of_lenses = stages(backend, tiny_setting(GSPLAT_MAIN), np.random.default_rng(0))
    cases = [jacobian_case(stage) for stage in of_lenses[1 : 1 + n_lenses]]
    assert len(cases) == n_lenses and len(of_lenses) == len(OPTICS)
    assert all(case.passed for case in cases), cases


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_kernels_are_the_reference(dtype):
    rng = np.random.default_rng(5)
    gaussians, camera = make_gaussians(rng, 60, size=0.2), make_camera(29, 23)._replace(optics=OPTICS[1])
    wants = frozenset({"depth", "stats", "median_depth", "dominant_depth"})
    v = rng.normal(size=(23, 29, 4))
    expected, v_expected = draw(gaussians, camera, REFERENCE, wants, v)
    is_wide = dtype == np.float64
    found, v_found = draw(as_dtype(gaussians, dtype), camera, CPU, wants, v.astype(dtype))
    assert_allclose(found.image, expected.image, atol=PARITY_FLOAT64 if is_wide else 10 * PARITY_FLOAT32_IMAGE)
    for name, ours, theirs in zip(Gaussians._fields, v_found.gaussians, v_expected.gaussians, strict=True):
        limit = np.abs(theirs).max() * (PARITY_FLOAT64 if is_wide else 10 * PARITY_FLOAT32_GRADIENT)
        assert_allclose(ours, theirs, atol=limit, err_msg=name)
    if is_wide:
        assert_array_equal(found.stats.dominant_ids, expected.stats.dominant_ids)
        assert_allclose(found.median_depth, expected.median_depth)
        assert_allclose(v_found.means2d, v_expected.means2d, atol=PARITY_FLOAT64 * np.abs(v_expected.means2d).max())


@pytest.mark.parametrize("optics", OPTICS, ids=str)
def test_kernels_list_the_tiles_that_the_reference_lists(optics):
    """All tiles under each box, on an image of several tiles, with Gaussians that are culled among them."""
    gaussians = make_gaussians(np.random.default_rng(6), 80, size=0.3)
    gaussians.means[::9, 2] *= -1
    camera = make_camera(150, 90, fx=170.0, fy=160.0)._replace(optics=optics)
    footprints = project(activate(gaussians), camera, GSPLAT_MAIN)
    found = list_tiles(footprints, camera, CPU, GSPLAT_MAIN)
    grid_of_kernels = replace(REFERENCE, tile_width=CPU.tile_width, tile_height=CPU.tile_height)
    expected = list_tiles(footprints, camera, grid_of_kernels, GSPLAT_MAIN)
    assert_array_equal(found.tile_offsets, expected.tile_offsets)
    assert_array_equal(found.gaussian_ids, expected.gaussian_ids)
    assert len(found.gaussian_ids) > 200 and (footprints.radii[:, 0] == 0).any()


def test_a_shift_by_a_pixel_is_what_means2d_says():
    """Where the response alone moves a ball across its ray, the derivative by its pixel is that of the image."""
    camera = make_camera()._replace(optics=OPTICS[2])
    one, step = balls([[0.2, 0.1, 3.0]], [0.2], [0.6]), 1e-5
    v = np.random.default_rng(0).normal(size=(18, 24, 3))
    _, gradient = draw(one, camera, REFERENCE, frozenset(), v)
    functions = model_of(camera)
    J = functions.jacobians(one.means, camera)[0]
    for k in (0, 1):
        move = step * (J.T @ np.linalg.inv(J @ J.T))[:, k]
        images = [draw(one._replace(means=one.means + sign * move), camera, REFERENCE).image for sign in (1, -1)]
        numeric = np.sum(v * (images[0] - images[1])) / (2 * step)
        assert gradient.means2d[0, k] == pytest.approx(numeric, rel=1e-5)


def test_other_renderers_refuse_the_camera_and_this_one_what_it_does_not_give():
    camera = make_camera()._replace(optics=BARE)
    with pytest.raises(InputError, match="draws pinholes, not brown cameras: train with --recipe lens"):
        SPLATTING.render(Model(balls([[0, 0, 2]], [0.1], [0.5])), view_from(camera), Request())
    with pytest.raises(InputError, match="lens does not give surface"):
        draw(balls([[0, 0, 2]], [0.1], [0.5]), camera, CPU, frozenset({"surface"}))


# --- from photographs to a rendering ---


def test_scenes_are_read_as_photographed(tmp_path):
    folder = write_colmap(tmp_path, model="OPENCV", params=DISTORTED)
    scene = load_scene(folder, as_photographed=True, downscale=2)
    camera = scene.train_views[0].camera
    assert (camera.width, camera.height, camera.fx) == (16, 12, 20.0)
    assert camera.optics == Optics("brown", (0.1, -0.05, 0.0, 0.0, 0.0, 0.0, 0.004, -0.003))
    with pytest.raises(InputError, match="leave out one of the two"):
        load_scene(folder, as_photographed=True, undistort=True)
    with pytest.raises(InputError, match="as photographed with --recipe lens"):
        load_scene(folder)


@pytest.mark.parametrize(
    ("optics", "message"),
    [(["brown", 1.0], "optics is not a list of 'brown' and 8 numbers"), ("brown", "optics is not a list")],
)
def test_cameras_keep_their_optics_and_refuse_wrong_ones(tmp_path, optics, message):
    camera = make_camera()._replace(optics=OPTICS[1])
    entries = viewpoints.to_json([viewpoints.Viewpoint("a", camera, "test")])
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps(entries))
    assert viewpoints.read(file)[0].camera.optics == camera.optics
    file.write_text(json.dumps([{**entries[0], "optics": optics}]))
    with pytest.raises(InputError, match=message):
        viewpoints.read(file)


def test_train_and_render_as_photographed(tmp_path):
    folder, run = write_colmap(tmp_path / "scene", n=9, model="OPENCV", params=DISTORTED), tmp_path / "run"
    assert main(["train", str(folder), "--recipe", "lens", "--iterations", "10", "--out", str(run)]) == 0
    cameras = json.loads((run / "cameras.json").read_text())
    assert cameras[0]["optics"][:3] == ["brown", 0.1, -0.05] and cameras[0]["width"] == 32
    assert main(["render", str(run), "--cameras", "test", "--out", str(tmp_path / "views")]) == 0
    assert len(list((tmp_path / "views").glob("*.png"))) == 2


def test_recipes_that_need_pinholes_say_so_in_a_line(tmp_path, capsys):
    folder = write_colmap(tmp_path / "scene", n=9, model="OPENCV", params=DISTORTED)
    code = main(["train", str(folder), "--extension", "lens", "--minutes", "1", "--out", str(tmp_path / "out")])
    assert_refused(capsys, tmp_path, code, "a brown camera is no pinhole, which this step needs")


@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("OPENCV", (20.0, 20.0, 16.0, 12.0, -0.9, 0.0, 0.0, 0.0), "folds inside the image"),
        ("FOV", (40.0, 40.0, 16.0, 12.0, 0.5), "camera model FOV is not one of"),
    ],
)
def test_lenses_that_cannot_be_drawn_are_refused_in_a_line(tmp_path, capsys, model, params, message):
    folder = write_colmap(tmp_path / "scene", model=model, params=params)
    code = main(["train", str(folder), "--recipe", "lens", "--iterations", "2", "--out", str(tmp_path / "out")])
    assert_refused(capsys, tmp_path, code, message)


def test_the_response_lists_what_it_differentiates():
    assert RESPONSE.fields == ("positions", "whitenings", "opacities")


# --- gsplat's call ---


ALONG_RAYS = {"with_ut": True, "with_eval3d": True}


def call_of(rng, camera):
    means, quats, scales, opacities = activate(make_gaussians(rng, 8, sh_degree=0))
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = camera.cam_from_world_R, camera.cam_from_world_t
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    views = {"viewmats": M[None], "Ks": K[None], "width": camera.width, "height": camera.height}
    primitives = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    return {**primitives, "colors": rng.uniform(size=(8, 3)), "backgrounds": rng.uniform(size=(1, 3)), **views}


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize(
    "lens",
    [
        {
            "radial_coeffs": np.array([[-0.2, 0.05, 0.01, 0.0, 0.01, 0.0]]),
            "tangential_coeffs": np.array([[0.01, -0.02]]),
            **ALONG_RAYS,
        },
        {"camera_model": "fisheye", "radial_coeffs": np.array([[0.05, -0.02, 0.01, 0.0]]), **ALONG_RAYS},
        {"camera_model": "ortho"},
    ],
    ids=["brown", "fisheye", "ortho"],
)
def test_gsplats_call_has_the_gradient_of_its_images(lens, backend):
    rng = np.random.default_rng(8)
    call = {**call_of(rng, make_camera(rng=rng)), **lens, "backend": backend}
    image, alpha, meta = rasterization(**call)
    assert (meta["radii"] > 0).any() and meta["means2d"].shape == (1, 8, 2) and meta["depths"].shape == (1, 8)
    v_image, v_alpha = rng.normal(size=image.shape), rng.normal(size=alpha.shape)
    v = rasterization_vjp(**call, v_render_colors=v_image, v_render_alphas=v_alpha)
    names = ["means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats"]

    def function(*arrays):
        return rasterization(**{**call, **dict(zip(names, arrays, strict=True))})[:2]

    inputs, gradient = [call[name] for name in names], [v[f"v_{name}"] for name in names]
    keep = names.index("viewmats")  # its last row is no variable; a rotation must stay one to the checks
    check_inner_products(
        lambda *moved: function(*moved, inputs[keep]),
        gradient[:keep],
        inputs[:keep],
        (v_image, v_alpha),
        rng,
        names=names[:keep],
        step=1e-8,
    )
    assert np.abs(v["v_viewmats"]).max() > 0


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_other_cameras_project_as_gsplats_own_statement(model):
    torch = pytest.importorskip("torch")
    pytest.importorskip("gsplat")
    from gsplat.cuda._torch_impl import _fisheye_proj, _ortho_proj

    camera = make_camera()
    x = np.random.default_rng(0).normal(size=(9, 3)) * [0.4, 0.4, 0.3] + [0, 0, 3]
    C = covariances(np.random.default_rng(1).normal(size=(9, 4)), np.full((9, 3), 0.1) * [1, 2, 3])
    K = torch.tensor([[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]])
    theirs = {"ortho": _ortho_proj, "fisheye": _fisheye_proj}[model](
        torch.tensor(x)[None], torch.tensor(C)[None], K, camera.width, camera.height
    )
    optics = Optics("orthographic") if model == "ortho" else Optics("fisheye", (0.0,) * 4)
    bent = camera._replace(optics=optics)
    functions = model_of(bent)
    J = functions.jacobians(x, bent)
    # gsplat adds 1e-7 to lengths, which moves a fisheye's pixels by about as much.
    assert_allclose(functions.project(x, bent), theirs[0][0].numpy(), atol=1e-5)
    assert_allclose(J @ C @ np.swapaxes(J, 1, 2), theirs[1][0].numpy(), rtol=1e-4, atol=1e-5)


def test_gsplats_call_refuses_what_it_cannot_draw():
    call = call_of(np.random.default_rng(0), make_camera())
    image, _, _ = rasterization(**call, camera_model="ortho")
    assert image.shape == (1, 18, 24, 3)
    for wrong, message in (
        ({"camera_model": "lidar"}, "is not computed: choose from"),
        ({"camera_model": "fisheye"}, "give with_ut=True and with_eval3d=True"),
        ({"camera_model": "ortho", **ALONG_RAYS}, "leave out with_ut"),
        ({**ALONG_RAYS, "radial_coeffs": np.zeros((1, 4))}, "radial_coeffs must be 1 x 6 finite numbers"),
        ({"camera_model": "ortho", "radial_coeffs": np.zeros((1, 6))}, "has no distortion"),
        ({**ALONG_RAYS, "camera_model": "fisheye", "tangential_coeffs": np.zeros((1, 2))}, "has no tangential_coeffs"),
        ({"sh_degree": 3}, "sh_degree is not computed"),
    ):
        with pytest.raises(InputError, match=message):
            rasterization(**{**call, **wrong})


def test_random_points_are_those_that_the_lens_shows(rng):
    """Of what is in front of a camera, in which a point that is not in the image would stay forever."""
    camera = make_camera()._replace(optics=Optics("brown", (-0.1,) + 7 * (0.0,)))
    view = view_from(camera)._replace(image=np.zeros((camera.height, camera.width, 3), np.uint8), view_id=0)
    scene = Scene("s", (view,), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 2.0)
    means = initial_state(scene, find_recipe("lens", 10), 0).gaussians.means.astype(np.float64)
    x = means @ camera.cam_from_world_R.T + camera.cam_from_world_t
    pixels = model_of(camera).project(x, camera)
    slack = 1e-3  # positions are float32
    assert (x[:, 2] > 0).all() and (np.abs(pixels - [12, 9]) < np.array([12, 9]) + slack).all()
    assert 1_000 < len(means) < 30_000  # in front there are half of 100,000
    assert (np.abs(x[:, 0]) > 0.402 * x[:, 2]).any()  # a pinhole shows up to 0.4, this lens up to 0.407
