"""Textured-GS: hits of rays on ellipsoids, gradients, fine-tuning end to end."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.kit import read_scene
from gradcheck import check_jacobian
from minisplat_ref import load_ply
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.textured.model import (
    LIMB,
    RESPONSE,
    TexturedFootprints,
    TexturedGaussians,
    add_textures,
    bounds,
    frames,
    frames_vjp,
    meet,
    meet_vjp,
)
from minisplat_ref.extensions.textured.recipe import TEXTURED_GAUSSIANS
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.hits import CONIC
from minisplat_ref.reference.pinhole import pinhole, pinhole_rays
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Model, Projection, view_from
from payloads import drawn, random_textures
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, PARITY_FLOAT64, TEXTURE_THIN_FLOAT32

RENDERER = TEXTURED_GAUSSIANS.renderer
DIRECTIONS = np.random.default_rng(5).normal(size=(4000, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def of_one(mean, scales, quat=(1.0, 0.2, -0.3, 0.4)):
    """Return frame and pixel of one Gaussian in front of the camera of the tests."""
    camera = make_camera()
    means, quats, deviations = np.array([mean]), np.array([quat]), np.array([scales])
    return frames(means, quats, deviations, camera), pinhole(means, camera), camera


# --- where rays arrive ---


@pytest.mark.parametrize(
    "mean", [(0.1, 0.05, 3.0), (-0.6, 0.4, 1.5), (0.02, 0.01, 0.2)], ids=["far", "aside", "inside"]
)
def test_they_enter_the_ellipsoid_where_the_quadratic_says(mean):
    """They enter at the smaller root of A t^2 + B t + C = 0 in the Gaussian's axes; the last camera is inside it."""
    scales, quat = np.array([0.5, 0.3, 0.4]), np.array([1.0, 0.2, -0.3, 0.4])
    frame, p, camera = of_one(mean, scales, quat)
    pixels = np.stack(np.meshgrid(np.arange(24) + 0.5, np.arange(18) + 0.5), axis=-1).reshape(-1, 2)
    R = rotation_matrices(quat[None])[0]
    o, d = -(R.T @ np.array(mean)) / scales, pinhole_rays(*pixels.T, camera) @ R / scales
    A, B, C = np.sum(d * d, axis=1), 2 * d @ o, o @ o - 1
    discriminant = B * B - 4 * A * C
    nearest = o - (B / (2 * A))[:, None] * d
    is_met = np.sum(nearest**2, axis=1) < 1 - LIMB**2
    t = (-B - np.sqrt(np.where(is_met, discriminant, 0))) / (2 * A)
    n = meet(frame, p, pixels).directions[0]
    assert is_met.sum() > 20
    assert_allclose(n[is_met], (o + t[:, None] * d)[is_met], atol=100 * CLOSED_FORM)  # B^2 - 4 A C loses two digits
    assert_allclose(np.linalg.norm(n, axis=1), 1, atol=CLOSED_FORM)
    is_missed = np.sum(nearest**2, axis=1) > 1
    if is_missed.any():  # n points to the nearest point, raised towards the camera by the blunt limb
        cosines = np.sum(n * nearest, axis=1) / np.linalg.norm(nearest, axis=1)
        assert cosines[is_missed].min() >= np.cos(np.arctan(LIMB)) - CLOSED_FORM


@pytest.mark.parametrize("reach", [0.2, 0.9, 3.0], ids=["round", "with limb", "beyond"])
def test_the_gradient_of_the_meeting(reach, rng):
    frame, p, _ = of_one((0.1, 0.05, 3.0), (0.5, 0.3, 0.4))
    pixels = p + reach * rng.uniform(-3, 3, size=(7, 2))
    check_jacobian(
        lambda frame, p: (meet(frame, p, pixels).directions,),
        lambda v: meet_vjp(frame, p, meet(frame, p, pixels), v),
        [frame, p],
        names=["frames", "means2d"],
    )


def test_the_gradient_of_frames(rng):
    camera = make_camera(rng=rng)
    inputs = [
        rng.normal(size=(3, 3)) + np.array([0, 0, 4]),
        rng.normal(size=(3, 4)),
        rng.uniform(0.1, 0.4, size=(3, 3)),
    ]
    pose = [camera.cam_from_world_R, camera.cam_from_world_t]

    def function(means, quats, scales, R, t):
        return (frames(means, quats, scales, camera._replace(cam_from_world_R=R, cam_from_world_t=t)),)

    check_jacobian(
        function, lambda v: tuple(frames_vjp(*inputs, camera, v)), [*inputs, *pose], names=["mean", "q", "s", "R", "t"]
    )


# --- what they find there ---


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_texture_adds_no_more_to_the_logit_than_its_bound(degree, rng):
    h = rng.normal(size=(5, (degree + 1) ** 2 - 1))
    x = sh_basis(DIRECTIONS, degree)[:, 1:] @ h.T  # [D, 5]
    assert (np.abs(x) <= bounds(h)).all()
    zonal = sh_basis(np.array([[0.0, 0.0, 1.0]]), degree)[:, 1:]  # a texture that is its own largest value
    assert bounds(zonal)[0] == pytest.approx(np.sum(zonal**2), rel=CLOSED_FORM)


def test_opacity_is_the_sigmoid_of_logit_and_texture(rng):
    frame, p, _ = of_one((0.1, 0.05, 3.0), (0.5, 0.3, 0.4))
    h, logit, conic = rng.normal(size=(1, 15)), np.array([-0.7]), np.array([[0.05, 0.01, 0.04]])
    box, ones = np.zeros((1, 4), np.int32), np.ones((1, 2), np.int32)
    projection = Projection(p, np.ones(1), conic, 1 / (1 + np.exp(-(logit + bounds(h)))), ones, box)
    pixels = p + rng.uniform(-6, 6, size=(9, 2))
    hit = RESPONSE.hit(TexturedFootprints(projection, logit, h, frame), np.zeros(1, int), pixels)
    x = sh_basis(meet(frame, p, pixels).directions[0], 3)[:, 1:] @ h[0]
    falloff = CONIC.hit(projection._replace(opacities=np.ones(1)), np.zeros(1, int), pixels).unclamped[0]
    assert np.ptp(x) > 0.5
    assert_allclose(hit.unclamped[0], falloff / (1 + np.exp(-(logit + x))), rtol=CLOSED_FORM)


def test_textures_of_zeros_have_a_gradient(rng):
    """So training changes them; that they change no image is tested for all payloads."""
    _, v = drawn(RENDERER, add_textures(make_gaussians(rng, 30), 3), view_from(make_camera(rng=rng)), REFERENCE)
    assert np.abs(v.gaussians.color_textures).max() > 0 and np.abs(v.gaussians.opacity_textures).max() > 0


@pytest.mark.parametrize("backend", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_where_a_texture_makes_a_colour_negative_it_is_black_and_has_no_gradient(backend):
    """The camera looks along (0.8, 0, 0.6), so a ball on its axis is entered at n = (-0.8, 0, -0.6).

    With ``Y_1 = C (-y, z, -x)`` the last coefficient counts 0.8 C = 0.3908820. Of a colour of 0.1, a coefficient of -2
    takes 0.78, which leaves nothing, and 2 adds as much.
    """
    C, o, camera = 0.4886025119029199, 0.9, turned_camera(cx=17.5, cy=12.5)
    ball = add_textures(balls(in_front_of(camera, [0, 0, 3.0]), [0.2], [o], [[0.1, 0.1, 0.1]]), 3)
    ball.color_textures.reshape(1, 3, 15)[0, :2, 2] = [-2, 2]
    ball.opacity_textures[0, 14] = 1e-300  # else it has no texture, and is a plain Gaussian
    output, tape = RENDERER.render(Model(ball), view_from(camera), Request(backend=backend))
    assert_allclose(output.image[12, 17], o * np.array([0, 0.1 + 1.6 * C, 0.1]), atol=1e-12)
    v_image = np.zeros_like(output.image)
    v_image[12, 17] = 1
    v = RENDERER.render_vjp(tape, v_image, None).gaussians
    assert_allclose(v.sh_dc, [[0, 0.28209479177387814 * o, 0.28209479177387814 * o]], rtol=1e-12)
    v_textures = v.color_textures.reshape(3, 15)
    assert_array_equal(v_textures[0], 0)
    assert_allclose(v_textures[1:, :3], [[0, -0.6 * C * o, 0.8 * C * o]] * 2, atol=1e-12)


# --- whole images ---


def thin(rng):
    """A needle a thousandth as wide as it is long, a sheet seen edge on, and a Gaussian with the camera inside."""
    return random_textures(rng, make_gaussians(rng, 3))._replace(
        means=np.array([[0.1, 0.0, 3.0], [-0.3, 0.2, 2.5], [0.05, 0.02, 0.3]]),
        quats=np.array([[1.0, 0.0, 0.0, 0.3], [1.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.2, 0.0]]),
        log_scales=np.log([[0.8, 8e-4, 8e-4], [3e-7, 0.3, 0.5], [0.6, 0.5, 0.7]]),
        opacity_logits=np.array([1.0, 1.0, -1.5]),
    )


def test_needles_sheets_and_a_camera_inside(rng):
    population, view = thin(rng), view_from(make_camera())
    for dtype, rel in ((np.float64, 100 * PARITY_FLOAT64), (np.float32, TEXTURE_THIN_FLOAT32)):
        theirs, v_theirs = drawn(RENDERER, population, view, REFERENCE, compared_to=dtype)
        ours, v_ours = drawn(RENDERER, as_dtype(population, dtype), view, CPU)
        assert (ours.visible_ids == np.arange(3)).all()
        assert np.abs(ours.image - theirs.image).max() <= rel
        assert all(np.isfinite(field).all() for field in v_ours.gaussians)
    assert all(np.isfinite(field).all() for field in v_theirs.gaussians)


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "plain"
    options = ["--recipe", "3dgs-accel", "--test-every", "4", "--iterations", "60", "--out", str(folder)]
    assert main(["train", str(scene_folder), *options]) == 0
    return folder


@pytest.mark.parametrize("form", [[], ["--frozen"]])
def test_a_run_gets_textures(form, scene_folder, run_folder, tmp_path, capsys):
    """A step of Adam is at most a few times the rate, 1.6e-6 of the scene's extent for positions."""
    out, plain = tmp_path / "textured.ply", run_folder / "point_cloud.ply"
    options = ["--iterations", "40", "--degree", "2", "--out", str(out), *form]
    assert main(["textured", "fine-tune", str(scene_folder), str(plain), *options]) == 0
    assert "Gaussians, 59 numbers each: test PSNR" in capsys.readouterr().out
    ours, theirs = load_ply(out, TexturedGaussians), load_ply(plain)
    assert ours.color_textures.shape == (len(theirs.means), 24) and np.abs(ours.color_textures).max() > 0
    assert np.abs(ours.opacity_textures).max() > 0
    for name in ("means", "quats", "log_scales"):
        moved = np.abs(getattr(ours, name) - getattr(theirs, name)).max()
        assert (moved == 0) == bool(form)
        if name == "means":
            assert moved < 40 * 2 * 1.6e-6 * read_scene(str(scene_folder), 1).extent
    cameras = ["--cameras", str(run_folder / "cameras.json")]
    for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
        assert main(["render", str(out), *cameras, *extension, "--out", str(tmp_path / name)]) == 0
    ours, theirs = (sorted((tmp_path / name).glob("*.png")) for name in ("ours", "theirs"))
    assert all(a.read_bytes() != b.read_bytes() for a, b in zip(ours, theirs, strict=True))


def test_the_recipe_trains_and_evaluates(scene_folder, tmp_path):
    run = tmp_path / "run"
    options = ["--recipe", "textured", "--test-every", "4", "--iterations", "30", "--out", str(run)]
    assert main(["train", str(scene_folder), *options]) == 0
    losses = [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]
    assert main(["eval", str(run)]) == 0


def test_textures_are_trained_before_the_background(scene_folder, run_folder, tmp_path, capsys):
    before = {}
    for name, given in (("its own", []), ("black", ["--background", "0,0,0"]), ("red", ["--background", "255,0,0"])):
        command = ["textured", "fine-tune", str(scene_folder), str(run_folder / "point_cloud.ply"), "--iterations", "1"]
        capsys.readouterr()
        assert main([*command, *given, "--out", str(tmp_path / "t.ply")]) == 0
        before[name] = capsys.readouterr().out.partition("test PSNR ")[2].partition(",")[0]
    assert before["its own"] == before["black"] != before["red"]


@pytest.mark.parametrize("option", ["--degree=4", "--iterations=0", "--downscale=0"])
def test_bad_input_is_one_line(scene_folder, run_folder, tmp_path, capsys, option):
    out = tmp_path / "t.ply"
    command = ["textured", "fine-tune", str(scene_folder), str(run_folder / "point_cloud.ply"), "--out", str(out)]
    assert exit_code([*command, option]) == 2
    error = capsys.readouterr().err.strip()
    assert option.partition("=")[0] in error and "\n" not in error and not out.exists()


def exit_code(command):
    """Return the exit code, whether the arguments are refused where they are parsed or later."""
    try:
        return main(command)
    except SystemExit as refused:
        return refused.code
