"""Linear motion: positions and their gradient, the static case, which equals 3DGS exactly, and runs by commands."""

import json
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.velocity import make_moving_gaussians, photographs
from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.extension import find_recipe, load_extension
from minisplat_ref.extensions.velocity.model import MOVING, MovingGaussians, move_means, move_means_vjp
from minisplat_ref.io import load_scene
from minisplat_ref.io.images import read_image, write_image
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.methods import gaussian_splatting
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import During, Every
from minisplat_ref.types import Gaussians, Model, Scene, View, view_from
from scenes import as_dtype, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

RENDERER = MOVING.renderer
SIX = Gaussians._fields


def moving(gaussians, velocities):
    return MovingGaussians(**gaussians._asdict(), velocities=np.asarray(velocities, gaussians.means.dtype))


def with_noise(gaussians, rng):
    return moving(gaussians, 0.3 * rng.normal(size=gaussians.means.shape))


def draw(gaussians, camera, time, **options):
    return RENDERER.render(Model(gaussians), view_from(camera, time=time), Request(**options))


# Closed form


def test_a_gaussian_is_where_it_should_be():
    """The image of one round Gaussian that crosses the optical axis at time 0.5 is known in closed form."""
    z, sigma, opacity = 4.0, 0.3, 0.9
    velocity = np.array([1.0, -0.6, 2.0])
    means = np.array([[0.0, 0.0, z]]) - 0.5 * velocity
    still = Gaussians(
        means,
        np.array([[1.0, 0, 0, 0]]),
        np.full((1, 3), np.log(sigma)),
        np.array([np.log(opacity / (1 - opacity))]),
        np.ones((1, 3)),
        np.zeros((1, 0, 3)),
    )
    camera = make_camera(16, 12, fx=20.0, fy=20.0)
    output, _ = draw(moving(still, velocity[None]), camera, 0.5, backend=REFERENCE)

    y, x = np.mgrid[:12, :16] + 0.5
    squared = (x - 8) ** 2 + (y - 6) ** 2  # pixels, from the axis
    variance = (20.0 * sigma / z) ** 2 + GSPLAT_MAIN.eps2d
    expected = opacity * np.exp(-squared / (2 * variance))  # [H, W]
    is_hit = output.alpha > 0
    assert is_hit.sum() > 40 and np.abs(output.alpha - expected)[is_hit].max() <= CLOSED_FORM
    elsewhere, _ = draw(moving(still, velocity[None]), camera, 0.0, backend=REFERENCE)
    assert np.abs(elsewhere.alpha - output.alpha).max() > 0.5


@pytest.mark.parametrize("time", [-0.5, 0.0, 0.25, 1.0])
def test_a_moment_is_a_still_scene(time, backend, rng):
    """At any time, the image of moving Gaussians is that of static ones at the same positions."""
    gaussians = as_dtype(make_gaussians(rng, 20), np.float32)
    velocities = (0.3 * rng.normal(size=(20, 3))).astype(np.float32)
    there = gaussians._replace(means=gaussians.means + np.float32(time) * velocities)
    camera = make_camera()
    output, _ = draw(moving(gaussians, velocities), camera, time, backend=backend)
    expected, _ = SPLATTING.render(Model(there), view_from(camera), Request(backend=backend))
    assert_array_equal(output.image, expected.image, strict=True)
    assert_array_equal(output.visible_ids, expected.visible_ids)


def test_velocities_begin_to_move_five_times_as_fast_as_the_means():
    """In a scene of extent 2, the first step of Adam, which has no bias correction: 0.1 g / sqrt(0.001 g^2) of a rate.

    That is 3.162 times 1.6e-4 times 2 for the means, wherever a Gaussian has a gradient.
    """
    camera = turned_camera()
    points = in_front_of(camera, [[0.3, 0.2, 3.0], [-0.4, 0.1, 3.5], [0.2, -0.3, 4.0], [0.6, 0.5, 3.2]])
    photograph = np.random.default_rng(0).integers(0, 256, (28, 40, 3), np.uint8)
    view = View("one", camera, photograph, None, time=0.5)
    scene = Scene("two", (view,), (), points, np.full((4, 3), 128, np.uint8), np.zeros(3), 2.0)
    after = train(scene, find_recipe("velocity")._replace(iterations=1), seed=0).gaussians
    moved = np.abs(after.means - points.astype(np.float32))
    assert_allclose(moved, np.sqrt(10) * 3.2e-4, rtol=1e-3)  # float32, and a part of 30,000 of the way to 1.6e-6
    assert_allclose(np.abs(after.velocities), np.sqrt(10) * 1.6e-3, rtol=1e-3)


# Gradients and backends


def test_the_gradient_of_the_motion(rng):
    check_jacobian(
        lambda means, velocities: (move_means(means, velocities, 0.7),),
        lambda v: move_means_vjp(0.7, v),
        [rng.normal(size=(3, 3)), rng.normal(size=(3, 3))],
        names=["means", "velocities"],
    )


def test_the_gradient_of_the_whole_model(small_proof):
    """On kernels; the reference's is checked for every extension by test_every_extension.py."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, MOVING)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


def test_a_wrong_gradient_is_found(small_proof):
    def wrong(tape, v_image, v_alpha):
        v = RENDERER.render_vjp(tape, v_image, v_alpha)
        return v._replace(gaussians=v.gaussians._replace(velocities=(1 + 1e-6) * v.gaussians.velocities))

    spoilt = MOVING._replace(renderer=RENDERER._replace(render_vjp=wrong))
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, spoilt)
    assert report.n_failed == 2 and "velocities is wrong" in report.cases[0].note


@pytest.mark.parametrize(
    ("dtype", "image_rel", "gradient_rel"),
    [(np.float64, PARITY_FLOAT64, PARITY_FLOAT64), (np.float32, PARITY_FLOAT32_IMAGE, PARITY_FLOAT32_GRADIENT)],
)
def test_backends_agree(dtype, image_rel, gradient_rel, rng):
    gaussians = as_dtype(with_noise(make_gaussians(rng, 30), rng), dtype)
    v_image = rng.normal(size=(18, 24, 3)).astype(dtype)
    (image, v), (expected, v_expected) = (
        (output.image, RENDERER.render_vjp(tape, v_image, None).gaussians)
        for output, tape in (draw(gaussians, make_camera(), 0.7, backend=backend) for backend in (CPU, REFERENCE))
    )
    assert image.dtype == dtype and np.abs(image - expected).max() <= image_rel * np.abs(expected).max()
    for name, reference in v_expected._asdict().items():
        field, size = getattr(v, name), np.abs(reference).max()
        assert field.dtype == dtype and size > 0
        assert np.abs(field - reference).max() <= gradient_rel * size, name


# Standing still


def tiny_scene(rng, times):
    """Return views of static Gaussians, with their centres as points."""
    truth = as_dtype(make_gaussians(rng, 30), np.float32)
    views = []
    for i, time in enumerate(times):
        camera = make_camera(24, 16, rng=rng)
        image = SPLATTING.render(Model(truth), view_from(camera), Request(backend=REFERENCE))[0].image
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), None, time=time))
    colors = rng.integers(0, 256, (30, 3), np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, np.zeros(3), 1.0)


# Every kind of event of 3DGS within 40 iterations.
EVENTS = (
    During(gaussian_splatting.collect_gradients, stop=30),
    Every(10, partial(gaussian_splatting.clone_and_split, threshold=2e-3, size_fraction=0.15), start=5, stop=30),
    Every(10, partial(gaussian_splatting.prune_faint, min_opacity=0.005), start=5, stop=30),
    Every(10, partial(gaussian_splatting.prune_large, size_fraction=2.0), start=15, stop=30),
    Every(25, partial(gaussian_splatting.reset_opacity, ceiling=0.05)),
)


def _keep_image(images, report):
    images.append(report.output.image)


@pytest.mark.parametrize("case", ["no times", "no rate"])
def test_standing_still_is_3dgs_to_the_byte(case, backend, rng):
    """In a training of 40 iterations with every event, the six fields, their moments and every image agree."""
    times = [0.0] * 4 if case == "no times" else [0.0, 0.3, 0.6, 1.0]
    scene = tiny_scene(rng, times)
    recipe = find_recipe("velocity")._replace(iterations=40, events=EVENTS)
    if case == "no rate":
        recipe = recipe._replace(learning_rates=recipe.learning_rates.change(velocities=0.0))
    results = []
    for each in (recipe, find_recipe("3dgs-accel")._replace(iterations=40, events=EVENTS)):
        images = []
        keep_image = partial(_keep_image, images)
        state = train(scene, each, seed=1, on_step=keep_image, backend=backend)
        results.append((state, images))
    (state, images), (plain, plain_images) = results
    assert not state.gaussians.velocities.any() and len(state.gaussians.velocities) == len(state.gaussians.means)
    for ours, theirs in ((state.gaussians, plain.gaussians), *zip(state.adam[:2], plain.adam[:2], strict=True)):
        for name in SIX:
            assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), name
    assert len(images) == 40 and all(a.tobytes() == b.tobytes() for a, b in zip(images, plain_images, strict=True))
    assert len(state.gaussians.means) != 30  # rows have come or gone


# From a folder of photographs to images


@pytest.fixture(scope="module")
def truth():
    return make_moving_gaussians(np.random.default_rng(3))


@pytest.fixture(scope="module")
def scene_folder(truth, tmp_path_factory):
    """Return the folder of the moving scene, a transforms.json with times, and its points at time 0."""
    folder = tmp_path_factory.mktemp("scenes") / "moving"
    (folder / "images").mkdir(parents=True)
    frames = []
    for view in photographs(truth):
        write_image(folder / "images" / f"{view.name}.png", view.image)
        R, t = view.camera.cam_from_world_R, view.camera.cam_from_world_t
        matrix = np.column_stack([R.T * [1.0, -1.0, -1.0], -R.T @ t]).tolist()  # world_from_camera, OpenGL axes
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": matrix, "time": view.time})
    save_ply(folder / "points.ply", Gaussians(*truth[:6]))
    content = {"fl_x": 50.0, "fl_y": 50.0, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "moving"
    options = ("--recipe", "velocity", "--iterations", "60", "--set", "exposure=learned", "--test-every", "6")
    assert main(["train", str(scene_folder), *options, "--out", str(folder)]) == 0
    return folder


def test_the_scene_has_its_times(scene_folder, truth):
    scene = load_scene(scene_folder, test_every=6)
    times = {view.name: view.time for view in photographs(truth)}
    assert len(scene.train_views) == 20 and len(scene.test_views) == 4
    for view in (*scene.train_views, *scene.test_views):
        assert view.time == times[view.name.rpartition("_")[2]]


def test_training_moves_what_moves(run_folder, truth):
    """Sixty iterations are few: the velocities point the right way, and other readers skip their columns."""
    trained = load_ply(run_folder / "point_cloud.ply", MovingGaussians)
    assert trained.velocities.shape == truth.velocities.shape and trained.velocities.any(axis=1).all()
    assert np.vdot(trained.velocities, truth.velocities) > 0
    plain = load_ply(run_folder / "point_cloud.ply")
    assert type(plain) is Gaussians
    assert_array_equal(plain.means, trained.means)
    assert (run_folder / "shared.npz").exists()  # of the exposures, which wrap the extension's renderer


def test_images_are_of_their_times(run_folder, tmp_path, capsys):
    """One camera at two times: the images differ; and a still population gives the same twice."""
    entry = json.loads((run_folder / "cameras.json").read_text())[0]
    cameras = [{**entry, "img_name": name, "time": time} for name, time in (("early", 0.0), ("late", 1.0))]
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    differences = []
    for options in ([], ["--extension", "core"]):
        out = tmp_path / f"out{len(options)}"
        ply = str(run_folder / "point_cloud.ply")
        assert main(["render", ply, "--cameras", str(tmp_path / "cameras.json"), "--out", str(out), *options]) == 0
        early, late = (read_image(out / f"{name}.png").astype(int) for name in ("early", "late"))
        assert early.max() > 50
        differences.append(np.abs(early - late).max())
    assert differences[0] > 3 and differences[1] == 0


def test_resuming_is_not_noticed(run_folder, scene_folder, tmp_path, monkeypatch):
    """Interrupted at 25 of 60 iterations and continued: the same bytes."""
    out = tmp_path / "interrupted"
    options = ("--recipe", "velocity", "--iterations", "60", "--set", "exposure=learned", "--test-every", "6")
    original = Progress.__call__

    def interrupting(self, report):
        original(self, report)
        if report.step == 25:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Progress, "__call__", interrupting)
        assert main(["train", str(scene_folder), *options, "--out", str(out)]) == 130
    assert main(["train", "--resume", str(out)]) == 0
    for name in ("point_cloud.ply", "shared.npz"):
        assert (out / name).read_bytes() == (run_folder / name).read_bytes(), name


def test_evaluating_again_gives_the_same(run_folder, scene_folder, capsys):
    before = json.loads((run_folder / "metrics.json").read_text())
    assert before["psnr"] > 15
    assert main(["eval", str(run_folder)]) == 0
    assert json.loads((run_folder / "metrics.json").read_text())["psnr"] == before["psnr"]


def test_info_says_that_they_move(run_folder, capsys):
    assert main(["info", str(run_folder / "point_cloud.ply")]) == 0
    assert "velocities_0, velocities_1, velocities_2" in capsys.readouterr().out
    assert main(["info", str(run_folder / "checkpoint.npz")]) == 0
    out = capsys.readouterr().out
    assert "velocities [12, 3]" in out and "exposures [20, 3, 4]" in out


def test_a_frozen_scene_is_the_moment(run_folder, tmp_path, capsys):
    out = tmp_path / "still.ply"
    ply = str(run_folder / "point_cloud.ply")
    assert main(["velocity", "freeze", ply, "--time", "0.5", "--out", str(out)]) == 0
    assert "12 Gaussians at time 0.5" in capsys.readouterr().out
    trained, still = load_ply(ply, MovingGaussians), load_ply(out)
    assert_array_equal(still.means, trained.means + np.float32(0.5) * trained.velocities)
    assert_array_equal(still.sh_dc, trained.sh_dc)
    assert main(["velocity", "freeze", str(out), "--out", str(tmp_path / "again.ply")]) == 2
    assert "no property velocities" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["velocity"])
    assert "minisplat-ref velocity --help" in capsys.readouterr().err


def test_a_still_ply_is_refused(run_folder, tmp_path, capsys):
    plain = load_ply(run_folder / "point_cloud.ply")
    save_ply(tmp_path / "plain.ply", plain)
    assert main(["render", str(tmp_path / "plain.ply"), "--extension", "velocity"]) == 2
    assert "no property velocities" in capsys.readouterr().err


def test_it_is_found_by_its_folder(capsys):
    extension = load_extension("velocity")
    assert [recipe.name for recipe in extension.recipes] == ["velocity"] and extension.representation is MOVING
    assert main(["extensions", "velocity"]) == 0
    assert "mu(t) = mu + t nu" in capsys.readouterr().out
