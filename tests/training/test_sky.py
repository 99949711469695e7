"""A sky behind the scene: closed forms, gradients, and that a run keeps it from training to rendering."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref.app.cli import main
from minisplat_ref.constants import SH_C0, SH_C1
from minisplat_ref.io.images import read_image
from minisplat_ref.methods import get_recipe
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.calibration import with_exposures
from minisplat_ref.training.recipe_settings import match_calibrations
from minisplat_ref.training.sky import SKY, TRANSMITTANCE_MIN, clear_sky, with_sky
from minisplat_ref.types import Model, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, GRADIENT_STEP_IMAGE, PARITY_FLOAT32_IMAGE, REMOVAL

BACKGROUND = np.array([0.2, 0.5, 0.8])
DEPTH = frozenset({"depth"})
BEHIND = with_sky(SPLATTING)


@pytest.fixture
def view(rng):
    return view_from(make_camera(rng=rng))


@pytest.fixture
def model(rng):
    return Model(make_gaussians(rng, 12), {SKY: 0.3 * rng.normal(size=(16, 3))})


def drawn(renderer, model, view, backend=REFERENCE, wants=frozenset()):
    return renderer.render(model, view, Request(BACKGROUND, backend=backend, wants=wants))[0]


# Closed form ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_sky_of_zeros_and_none_change_no_byte(backend, rng, view, dtype):
    gaussians = as_dtype(make_gaussians(rng, 12), dtype)
    plain = drawn(SPLATTING, Model(gaussians), view, backend, DEPTH)
    assert plain.image.std() > 0.1
    for shared in ({}, clear_sky(7)):
        output = drawn(BEHIND, Model(gaussians, shared), view, backend, DEPTH)
        assert output.image.dtype == dtype and output.image.tobytes() == plain.image.tobytes()


def test_empty_scene_shows_the_sky_alone(view):
    """Looking along +z with R = 1: degree 0 is everywhere, Y_10 is proportional to z, Y_1-1 to -y."""
    camera = view.camera._replace(cam_from_world_R=np.eye(3))
    sky = np.zeros((16, 3))
    sky[0, 0], sky[2, 1], sky[1, 2] = 1.0, 1.0, 1.0
    model = Model(make_gaussians(np.random.default_rng(0), 0), {SKY: sky})
    image = drawn(BEHIND, model, view._replace(camera=camera)).image
    row, column = 3, 5
    ray = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
    _, y, z = ray / np.linalg.norm(ray)
    assert_allclose(image[row, column], BACKGROUND + np.array([SH_C0, SH_C1 * z, -SH_C1 * y]), rtol=CLOSED_FORM)


def test_sky_shows_as_much_as_is_transparent_and_depth_not_at_all(backend, model, view):
    plain = drawn(SPLATTING, model, view, backend, DEPTH)
    empty = drawn(BEHIND, model._replace(gaussians=make_gaussians(np.random.default_rng(0), 0)), view, backend)
    output = drawn(BEHIND, model, view, backend, DEPTH)
    transmittance = 1 - plain.alpha
    seen = np.where(transmittance >= TRANSMITTANCE_MIN, transmittance, 0.0)[..., None]
    expected = plain.image[..., :3] + seen * (empty.image - BACKGROUND)
    assert seen.min() < 0.5 < seen.max()
    assert_allclose(output.image[..., :3], expected, atol=1e3 * CLOSED_FORM)  # T = 1 - alpha, of few digits
    assert_array_equal(output.image[..., 3], plain.image[..., 3])


def test_a_direction_has_its_colour_wherever_the_camera_stands(view, model):
    nothing = model._replace(gaussians=make_gaussians(np.random.default_rng(0), 0))
    moved = view._replace(camera=view.camera._replace(cam_from_world_t=view.camera.cam_from_world_t + 5.0))
    image = drawn(BEHIND, nothing, view).image
    assert image.std() > 0.01
    assert_array_equal(image, drawn(BEHIND, nothing, moved).image)


def test_exposure_changes_the_sky_too(view, model):
    recipe = match_calibrations(get_recipe("3dgs"), Model(None, {SKY: 0, "exposures": 0}))
    assert [calibration.name for calibration in recipe.active_calibrations] == ["sky", "exposure"]
    twice = np.tile(2.0 * np.eye(3, 4), (1, 1, 1))
    exposed = model._replace(shared={**model.shared, "exposures": twice})
    seen = drawn(recipe.renderer, exposed, view._replace(view_id=0)).image
    assert recipe.renderer.name == with_exposures(BEHIND).name
    assert_allclose(seen, 2.0 * drawn(BEHIND, model, view).image, rtol=CLOSED_FORM)


def test_backends_agree_in_float32(model, view):
    narrow = Model(as_dtype(model.gaussians, np.float32), {SKY: model.shared[SKY].astype(np.float32)})
    cpu, reference = (drawn(BEHIND, narrow, view, backend).image for backend in (CPU, REFERENCE))
    assert cpu.dtype == np.float32
    assert_allclose(cpu, reference, atol=PARITY_FLOAT32_IMAGE)


# Gradient -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wants", [frozenset(), DEPTH], ids=["rgb", "rgb and depth"])
def test_gradient_through_the_whole_renderer(rng, model, view, wants):
    """Population, sky, and the rotation of the camera, which turns the sky; with a derivative of alpha and without."""
    names = [*model.gaussians._fields, SKY, "R"]
    inputs = [*model.gaussians, model.shared[SKY], view.camera.cam_from_world_R]

    def outputs(*values):
        turned = view._replace(camera=view.camera._replace(cam_from_world_R=values[-1]))
        changed = Model(model.gaussians._make(values[:-2]), {SKY: values[-2]})
        output, tape = BEHIND.render(changed, turned, Request(BACKGROUND, backend=REFERENCE, wants=wants))
        return (output.image, output.alpha), tape

    (image, alpha), tape = outputs(*inputs)
    for with_alpha in (1.0, 0.0):
        cotangents = [rng.normal(size=image.shape), with_alpha * rng.normal(size=alpha.shape)]
        v = BEHIND.render_vjp(tape, cotangents[0], cotangents[1] if with_alpha else None)
        check_inner_products(
            lambda *values: outputs(*values)[0],
            [*v.gaussians, v.shared[SKY], v.cam_from_world_R],
            inputs,
            cotangents,
            rng,
            names=names,
            step=GRADIENT_STEP_IMAGE,
        )


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=["reference", "cpu"])
def test_what_a_removal_changes_counts_the_sky_behind(model, view, backend):
    """Against the images without each Gaussian; a sky of TRANSMITTANCE_MIN is drawn or not, and tolerated."""
    whole = drawn(BEHIND, model, view, backend).image
    n = len(model.gaussians.means)
    expected = []
    for i in range(n):
        request = Request(BACKGROUND, backend=backend, is_visible=np.arange(n) != i)
        expected.append(np.sum((BEHIND.render(model, view, request)[0].image - whole) ** 2))
    output = BEHIND.render(model, view, Request(BACKGROUND, backend=backend, wants=frozenset({"removal_changes"})))[0]
    assert_allclose(output.extras["removal_changes"], expected, rtol=REMOVAL, atol=REMOVAL)
    assert np.count_nonzero(expected) >= n // 2
    without = drawn(SPLATTING, model, view, backend, frozenset({"removal_changes"})).extras["removal_changes"]
    assert np.abs(without - expected).max() > 0.1 * max(expected), "the sky makes a difference"


# Through the commands -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A training with a sky that was asked for."""
    folder = tmp_path_factory.mktemp("sky")
    options = ["--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "60"]
    assert main(["synthetic", "outdoor", "--out", str(folder / "scene"), *options]) == 0
    training = ["--recipe", "3dgs-accel", "--iterations", "12", "--set", "sky=true", "--test-every", "4"]
    assert main(["train", str(folder / "scene"), "--out", str(folder / "run"), *training]) == 0
    return folder / "run"


def test_training_says_that_the_ply_has_no_sky(tmp_path, capsys):
    options = ["--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "60"]
    assert main(["synthetic", "outdoor", "--out", str(tmp_path / "scene"), *options]) == 0
    training = ["--recipe", "3dgs-accel", "--iterations", "2", "--test-every", "4"]
    for name, wanted, words in (
        ("none", [], None),
        ("sky", ["--set", "sky=true"], "does not hold the sky, which"),
        (
            "both",
            ["--set", "sky=true", "--set", "antialiasing=true"],
            "the sky and the compensation of opacities, which",
        ),
    ):
        capsys.readouterr()
        run = tmp_path / name
        assert main(["train", str(tmp_path / "scene"), "--out", str(run), *training, *wanted]) == 0
        out = capsys.readouterr().out
        assert ("does not hold" in out) == (words is not None)
        assert words is None or (words in out and f"minisplat-ref render {run} has all" in out)


def test_a_run_keeps_its_sky(run, tmp_path, capsys):
    """Also one that was decided upon: ``config.json`` does not ask for it, the shared parameters are there."""
    with np.load(run / "shared.npz") as archive:
        assert archive[SKY].shape == (16, 3) and archive[SKY].any()
    config = json.loads((run / "config.json").read_text())
    config["settings"]["set"] = {}
    (run / "config.json").write_text(json.dumps(config))
    psnr = json.loads((run / "metrics.json").read_text())["psnr"]
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["psnr"] == psnr

    images = [tmp_path / name for name in ("sky", "ply")]
    assert main(["render", str(run), "--cameras", "test", "--out", str(images[0])]) == 0
    np.savez(run / "shared.npz", **{SKY: np.full((16, 3), 1.0, np.float32)})
    assert main(["render", str(run), "--cameras", "test", "--out", str(images[1])]) == 0
    first, second = (read_image(min(folder.glob("*.png"))).astype(float) for folder in images)
    assert np.abs(first - second).mean() > 1

    capsys.readouterr()
    assert main(["convert", str(run), str(tmp_path / "scene.ply")]) == 0
    assert "scene.ply, which has Gaussians alone: the sky\n" in capsys.readouterr().err
