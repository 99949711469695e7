"""Anti-aliasing: sampling intervals, the 3D filter and its gradient, where it is 3DGS, training end to end."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from actions import act, scene_of, state_of
from gradcheck import check_jacobian
from minisplat_ref import load_ply, save_ply
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.antialiasing.model import (
    ANTIALIASING,
    EPS2D,
    FILTERED,
    MIP,
    FilteredGaussians,
    add_filters,
    apply_filters,
    measure_filters,
    reset_smoothed_opacity,
    reset_smoothed_opacity_on_white,
    smooth,
    smooth_vjp,
    with_3d_filter,
)
from minisplat_ref.io.label import Label
from minisplat_ref.mechanisms import sampling
from minisplat_ref.mechanisms.sampling import sampling_intervals, shrink_photographs
from minisplat_ref.methods.gaussian_splatting import clone_and_split
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.schedule import At, does, firing_steps, scale_recipe
from minisplat_ref.types import Gaussians, Model, View, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, COVERAGE_MIN, PARITY_FLOAT64, ROUNDED_TO_FLOAT32


def with_filters(gaussians, sigmas):
    return FilteredGaussians(**gaussians._asdict(), filter_sigmas=np.asarray(sigmas, gaussians.means.dtype))


# --- how finely a Gaussian was seen ---


def test_the_nearest_camera_that_sees_it_counts():
    near, far = make_camera(fx=30.0, fy=28.0), make_camera(fx=30.0, fy=45.0)
    far = far._replace(cam_from_world_t=np.array([0.0, 0.0, 6.0]))
    means = np.array([[0.0, 0, 3], [0, 0, -3], [5, 0, 3], [0, 0, 0.1], [100, 0, 3]])
    found = sampling_intervals(means, [near, far])
    assert_allclose(found[0], 3 / 30, rtol=CLOSED_FORM)
    assert_allclose(found[1], 3 / 45, rtol=CLOSED_FORM)  # behind the near one
    # The third is outside of the near image, and of the far one beyond the margin: 30 * 5 / 9 = 16.7 > 0.65 * 24.
    assert_allclose(found[[2, 4]], found[[0, 1, 3]].max(), rtol=CLOSED_FORM)
    assert_allclose(found[3], 6.1 / 45, rtol=CLOSED_FORM)  # nearer to the near one than 0.2
    assert_array_equal(sampling_intervals(means[4:], [near]), 0)
    assert sampling_intervals(np.zeros((0, 3)), [near]).shape == (0,)


# --- the filter ---


def test_a_filtered_gaussian_by_hand():
    """A filter of 4 makes deviations of 3, 4 and 12 become 5, sqrt(32) and sqrt(160); opacity keeps the integral."""
    scales, opacity = np.array([[3.0, 4, 12]]), 0.7
    found, logits = smooth(np.log(scales), np.log([opacity / (1 - opacity)]), np.array([4.0]))
    expected = np.sqrt([[25.0, 32, 160]])
    assert_allclose(np.exp(found), expected, rtol=CLOSED_FORM)
    assert_allclose(1 / (1 + np.exp(-logits)), opacity * scales.prod() / expected.prod(), rtol=CLOSED_FORM)


def test_the_gradient_of_the_filter(rng):
    inputs = [rng.normal(size=(5, 3)), 2 * rng.normal(size=5), rng.uniform(0.3, 2, 5)]
    check_jacobian(smooth, lambda *v: smooth_vjp(*inputs, *v), inputs, names=["log_scales", "logits", "sigmas"])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_filters_of_zero_change_no_bit(dtype, rng):
    log_scales, logits = rng.normal(size=(50, 3)).astype(dtype), (9 * rng.normal(size=50)).astype(dtype)
    v = rng.normal(size=(50, 3)).astype(dtype), rng.normal(size=50).astype(dtype)
    zeros = np.zeros(50, dtype)
    for found, expected in zip(smooth(log_scales, logits, zeros), (log_scales, logits), strict=True):
        assert found.tobytes() == expected.tobytes()
    for found, expected in zip(smooth_vjp(log_scales, logits, zeros, *v), v, strict=False):
        assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("log_scale", [-80.0, 0.0, 80.0])
@pytest.mark.parametrize("logit", [-200.0, 0.0, 200.0])
def test_extremes_stay_finite(log_scale, logit):
    arrays = np.full((1, 3), log_scale, np.float32), np.array([logit], np.float32), np.ones(1, np.float32)
    with np.errstate(over="raise", invalid="raise"):
        found = smooth(*arrays)
        v = smooth_vjp(*arrays, np.ones((1, 3), np.float32), np.ones(1, np.float32))
    assert all(np.isfinite(array).all() for array in (*found, *v))
    assert all(array.dtype == np.float32 for array in (*found, *v))


def test_the_image_keeps_its_mass_when_a_gaussian_is_filtered():
    """A filter of its own size doubles the area of a distant ball; the light in the image follows in closed form."""
    still = as_dtype(make_gaussians(np.random.default_rng(0), 1, sh_degree=0), np.float64)._replace(
        means=np.array([[0.0, 0, 10]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        log_scales=np.log(np.full((1, 3), 1.5)),
        opacity_logits=np.array([2.0]),
        sh_dc=np.ones((1, 3)),
    )
    camera, sums = make_camera(96, 96, fx=40.0, fy=40.0), []
    for sigma in (0.0, 1.5):
        request = Request(backend=REFERENCE, conventions=GSPLAT_MAIN._replace(alpha_min=1e-6))
        image = MIP.render(Model(with_filters(still, [sigma])), view_from(camera), request)[0].image
        sums.append(image.sum())
    # The 3D integral is kept, so what a ray collects sinks as the depth grows: by s / s' = 1 / sqrt(2).
    assert sums[1] / sums[0] == pytest.approx(np.sqrt(0.5), rel=1e-3)  # truncated at three and a half deviations


# --- the filters of the recipe ---


def test_the_recipe_measures_a_fifth_of_the_squared_interval():
    """At depth 5 a pixel of the camera with f = 40 is 1/8 wide, at depth 2 in the nearer one 1/20."""
    far, near = turned_camera(), turned_camera()
    near = near._replace(cam_from_world_t=near.cam_from_world_t - [0.0, 0.0, 3.0])
    # The second is behind the nearer camera.
    gaussians = balls(in_front_of(far, [[0.1, 0.2, 5.0], [0.0, 0.1, 2.5]]), [0.1, 0.1], [0.5, 0.5])
    state = state_of(with_filters(gaussians, [9.0, 9.0]))
    act(ANTIALIASING._replace(events=ANTIALIASING.events[-1:]), measure_filters, state, scene_of([far, near]))
    assert_allclose(state.gaussians.filter_sigmas, [0.05 * 0.4472135955, 0.0625 * 0.4472135955], rtol=1e-9)


def test_filters_are_measured_at_once_every_hundred_iterations_and_after_each_densification():
    assert firing_steps(ANTIALIASING, measure_filters) == [1, *range(100, 30_001, 100)]
    short = scale_recipe(ANTIALIASING, 3_000)
    assert firing_steps(short, measure_filters) == [1, *range(50, 3_001, 50)]
    for recipe in (ANTIALIASING, short):
        grows = firing_steps(recipe, clone_and_split)
        last = {step: [event for event in recipe.events if event.is_due(step)][-1] for step in grows}
        assert len(grows) > 10 and all(does(event, measure_filters) for event in last.values())


def test_a_reset_lowers_what_is_seen():
    """A filter of the ball's own size leaves an opacity of o / 2^1.5 of it; capped at 0.01 it is 0.0282843 in itself.

    A ball with an eighth of the filter's size is too faint to be capped: ``65^-1.5`` of its opacity is 0.0019.
    """
    filtered = with_filters(
        balls(np.zeros((4, 3)), [0.1, 0.1, 0.1, 0.0125], [0.9, 0.9, 0.02, 0.9]), [0.0, 0.1, 0.1, 0.1]
    )
    state = state_of(filtered)
    reset = ANTIALIASING._replace(events=(At(1, partial(reset_smoothed_opacity, ceiling=0.01)),))
    state.adam.first.opacity_logits[:] = 1.0
    act(reset, reset_smoothed_opacity, state, scene_of([turned_camera()]))
    opacities = 1 / (1 + np.exp(-state.gaussians.opacity_logits))
    assert_allclose(opacities, [0.01, 0.02828427, 0.02, 0.9], rtol=1e-6)
    seen = 1 / (1 + np.exp(-apply_filters(state.gaussians).opacity_logits))
    assert_allclose(seen, [0.01, 0.01, 0.02 / 2**1.5, 0.9 * 65**-1.5], rtol=1e-6)
    assert not state.adam.first.opacity_logits.any()


def test_resets_come_as_in_3dgs():
    """Every 3,000 iterations until 12,000, and once early on a white background."""
    assert firing_steps(ANTIALIASING, reset_smoothed_opacity) == [3000, 6000, 9000, 12_000]
    assert firing_steps(ANTIALIASING, reset_smoothed_opacity_on_white) == [500]
    for white, capped in ((1.0, 0.01), (0.5, 0.9)):
        state = state_of(with_filters(balls(np.zeros((1, 3)), [0.1], [0.9]), [0.0]))
        scene = scene_of([turned_camera()])._replace(background=np.full(3, white))
        event = At(1, partial(reset_smoothed_opacity_on_white, ceiling=0.01))
        act(ANTIALIASING._replace(events=(event,)), reset_smoothed_opacity_on_white, state, scene)
        assert_allclose(1 / (1 + np.exp(-state.gaussians.opacity_logits)), capped, rtol=1e-6)


def test_the_blur_is_a_tenth_of_a_squared_pixel_and_keeps_the_light():
    """A ball with deviations of 0.4 and 0.25 pixels, seen 0.3 to the right of its centre and 0.4 above.

    Variances of 0.16 and 0.0625 become 0.26 and 0.1625, so it is weaker by sqrt(0.16 * 0.0625 / (0.26 * 0.1625)), which
    is 0.4865, and falls off by exp(-(0.09 / 0.26 + 0.16 / 0.1625) / 2), which is 0.5141.
    """
    camera = turned_camera(cx=17.2, cy=11.9)
    ball = balls(in_front_of(camera, [0.0, 0.0, 5.0]), [0.05], [0.9])
    alpha = MIP.render(Model(with_filters(ball, [0.0])), view_from(camera), Request(backend=REFERENCE))[0].alpha
    assert alpha[11, 17] == pytest.approx(0.9 * 0.486504 * 0.514076, rel=2e-6)


# --- where it is 3DGS ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_without_filters_it_is_3dgs_exactly(backend, dtype, rng):
    """The 3D filter alone wraps 3DGS's renderer, and the 2D filter is 3DGS's compensation with another variance."""
    gaussians, view = as_dtype(make_gaussians(rng, 40), dtype), view_from(make_camera(rng=rng))
    zero = add_filters(gaussians, rng)
    mip = GSPLAT_MAIN._replace(eps2d=EPS2D, is_antialiased=True)
    for renderer, conventions in ((with_3d_filter(SPLATTING), GSPLAT_MAIN), (MIP, mip)):
        ours, tape = renderer.render(Model(zero), view, Request(backend=backend))
        theirs, other = SPLATTING.render(Model(gaussians), view, Request(backend=backend, conventions=conventions))
        assert ours.alpha.mean() > COVERAGE_MIN
        assert_array_equal(ours.image, theirs.image)
        v_image = rng.normal(size=ours.image.shape).astype(dtype)
        v, v_other = renderer.render_vjp(tape, v_image, None), SPLATTING.render_vjp(other, v_image, None)
        for name in Gaussians._fields:
            assert getattr(v.gaussians, name).tobytes() == getattr(v_other.gaussians, name).tobytes(), name


def test_filters_change_the_image(backend, rng):
    gaussians, view = make_gaussians(rng, 40), view_from(make_camera(rng=rng))
    images = [
        MIP.render(Model(with_filters(gaussians, np.full(40, sigma))), view, Request(backend=backend))[0].image
        for sigma in (0.0, 0.1)
    ]
    assert np.abs(images[1] - images[0]).max() > 0.05


def test_the_gradient_of_the_whole_model(small_proof):
    """On kernels; the reference's is checked for every extension by test_every_extension.py."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, FILTERED)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


def test_a_wrong_gradient_is_found():
    def wrong(tape, v_image, v_alpha):
        v = MIP.render_vjp(tape, v_image, v_alpha)
        return v._replace(gaussians=v.gaussians._replace(log_scales=(1 + 1e-6) * v.gaussians.log_scales))

    spoilt = FILTERED._replace(renderer=MIP._replace(render_vjp=wrong))
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, spoilt)
    assert report.n_failed == 2 and "log_scales is wrong" in report.cases[0].note


# --- measures ---


def test_blocks_and_cameras_fit():
    """An image at a third of the size is the mean over blocks of what the camera with a third of the pixels sees."""
    image = np.arange(7 * 10 * 3, dtype=float).reshape(7, 10, 3)
    small = sampling.block_means(image, 3)
    assert small.shape == (2, 3, 3)
    assert_allclose(small[1, 2], image[3:6, 6:9].mean(axis=(0, 1)), rtol=PARITY_FLOAT64)
    camera = sampling.zoom_camera(make_camera(10, 7, fx=30.0, fy=28.0), 1 / 3)
    assert (camera.width, camera.height) == (3, 2)
    assert_allclose([camera.fx, camera.cx], [10, 5 / 3], rtol=CLOSED_FORM)


def test_a_photograph_cannot_shrink_to_nothing():
    scene = make_scene("room", n_views=2, width=32, height=24, supersampling=1, n_points=10).scene
    with pytest.raises(InputError, match="lower --downscale"):
        shrink_photographs(scene, 2)
    bigger = shrink_photographs(scene._replace(train_views=(View("a", make_camera(64, 48), BLACK, None),)), 3)
    assert bigger.train_views[0].image.shape == (16, 21, 3)


BLACK = np.zeros((48, 64, 3), np.uint8)

# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
TRAIN = ["--recipe", "antialiasing", "--test-every", "4", "--seed", "3", "--iterations", "30"]


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "finished"
    assert main(["train", str(scene_folder), *TRAIN, "--out", str(folder)]) == 0
    return folder


def test_training_measures_filters_and_the_ply_keeps_them(run_folder, tmp_path, capsys):
    gaussians = load_ply(run_folder / "point_cloud.ply", FilteredGaussians)
    assert (gaussians.filter_sigmas > 0).all()
    save_ply(tmp_path / "again.ply", gaussians, Label("antialiasing"))
    assert (tmp_path / "again.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()
    assert main(["info", str(run_folder / "point_cloud.ply")]) == 0
    assert "filter_sigmas" in capsys.readouterr().out


def test_interrupted_then_resumed_gives_the_same_bytes(scene_folder, run_folder, tmp_path, monkeypatch):
    report_step = Progress.__call__

    def interrupt(progress, report):
        report_step(progress, report)
        if report.step == 17:
            raise KeyboardInterrupt

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", interrupt)
        assert main(["train", str(scene_folder), *TRAIN, "--out", str(folder)]) == 130
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()


def test_a_ply_is_drawn_with_its_filters_and_one_without_is_refused(run_folder, tmp_path, capsys):
    ply, options = str(run_folder / "point_cloud.ply"), ["--cameras", str(run_folder / "cameras.json")]
    for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
        assert main(["render", ply, *options, *extension, "--out", str(tmp_path / name)]) == 0
    images = [{p.name: p.read_bytes() for p in (tmp_path / name).glob("*.png")} for name in ("ours", "theirs")]
    assert images[0].keys() == images[1].keys() and images[0] != images[1]
    save_ply(tmp_path / "plain.ply", load_ply(ply))
    assert main(["render", str(tmp_path / "plain.ply"), "--extension", "antialiasing"]) == 2
    assert "no property filter_sigmas" in capsys.readouterr().err


def test_a_recipe_of_the_core_is_filtered_too(scene_folder, tmp_path):
    """With the representation alone no event measures filters: they are zero, and a column in the PLY."""
    options = ["--extension", "antialiasing", "--test-every", "4", "--iterations", "5", "--out", str(tmp_path / "run")]
    assert main(["train", str(scene_folder), *options]) == 0
    assert_array_equal(load_ply(tmp_path / "run" / "point_cloud.ply", FilteredGaussians).filter_sigmas, 0)


def test_it_trains_on_photographs(shared_data, tmp_path):
    fox = str(shared_data / "fox")
    options = ["--downscale", "4", "--recipe", "antialiasing", "--iterations", "20", "--out", str(tmp_path / "fox")]
    assert main(["train", fox, *options]) == 0
    sigmas = load_ply(tmp_path / "fox" / "point_cloud.ply", FilteredGaussians).filter_sigmas
    assert sigmas.min() > 0 and np.ptp(sigmas) > ROUNDED_TO_FLOAT32
