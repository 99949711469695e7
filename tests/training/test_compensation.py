"""Compensated opacities as a property of a model: closed form, the command line, and when ``adaptive`` has them."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from adaptive_states import iteration_of, state_of
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.io.scene import half_size
from minisplat_ref.methods.adaptive.numbers import GAIN_MIN
from minisplat_ref.methods.adaptive.switches import switch_antialiasing_on
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.compensation import COMPENSATION, compensation, with_compensation
from minisplat_ref.training.pace import Pace
from minisplat_ref.types import Gaussians, Model, Scene, View, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM

N_VIEWS = 12
BLACK = np.zeros(3)
COMPENSATED = with_compensation(SPLATTING)


def drawn(model, camera, conventions=GSPLAT_MAIN):
    return COMPENSATED.render(model, view_from(camera), Request(BLACK, conventions=conventions, backend=CPU))


@pytest.fixture(scope="module")
def truth():
    """Gaussians that are hardly wider than a pixel."""
    gaussians = as_dtype(make_gaussians(np.random.default_rng(5), 150, size=0.02, opacity_logit=2), np.float32)
    return gaussians._replace(sh_dc=np.abs(gaussians.sh_dc) + 0.5, sh_rest=0 * gaussians.sh_rest)


# The model ------------------------------------------------------------------------------------------------------------


def test_closed_form():
    """A sphere of 0.5 px in the middle of a pixel: S = 0.25 I, so its alpha is o 0.25 / (0.25 + 0.3)."""
    camera = make_camera(9, 9, fx=50, fy=50, rng=None)
    camera = camera._replace(cx=4.5, cy=4.5, cam_from_world_R=np.eye(3), cam_from_world_t=np.zeros(3))
    sphere = Gaussians(
        np.array([[0.0, 0.0, 5.0]]),
        np.array([[1.0, 0, 0, 0]]),
        np.full((1, 3), np.log(0.05)),
        np.array([0.0]),
        np.ones((1, 3)),
        np.zeros((1, 0, 3)),
    )
    plain, compensated = (drawn(Model(sphere, s), camera)[0].alpha[4, 4] for s in ({}, compensation(1)))
    assert_allclose([plain, compensated], [0.5, 0.5 * 0.25 / 0.55], rtol=CLOSED_FORM)


def test_the_gradient_is_that_of_the_conventions(truth, rng):
    camera, v_image = make_camera(24, 16, rng=rng), rng.normal(size=(16, 24, 3)).astype(np.float32)
    asked = GSPLAT_MAIN._replace(is_antialiased=True)
    (output, tape), (expected, other) = drawn(Model(truth, compensation(1)), camera), drawn(Model(truth), camera, asked)
    assert_array_equal(output.image, expected.image)
    ours, theirs = (COMPENSATED.render_vjp(t, v_image, None).gaussians for t in (tape, other))
    for name in truth._fields:
        assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    assert np.abs(output.image - drawn(Model(truth), camera)[0].image).max() > 0.05


def test_a_run_keeps_it(tmp_path, capsys):
    options = ["--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "60"]
    assert main(["synthetic", "room", "--out", str(tmp_path / "scene"), *options]) == 0
    training = ["--recipe", "3dgs-accel", "--iterations", "12", "--set", "antialiasing=true", "--test-every", "4"]
    run = tmp_path / "run"
    assert main(["train", str(tmp_path / "scene"), "--out", str(run), *training]) == 0
    psnr = json.loads((run / "metrics.json").read_text())["psnr"]
    config = json.loads((run / "config.json").read_text())
    config["settings"]["set"] = {}  # as if it had been decided upon
    (run / "config.json").write_text(json.dumps(config))
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["psnr"] == psnr
    capsys.readouterr()
    assert main(["convert", str(run), str(tmp_path / "scene.ply")]) == 0
    assert "Gaussians alone: the compensation of opacities\n" in capsys.readouterr().err
    assert main(["convert", str(run), str(tmp_path / "scene.html")]) == 0
    said = "minisplat-ref: the page shows plain 3DGS, without the compensation of opacities\n"
    assert capsys.readouterr().err == said, "each part once"


# The decision ---------------------------------------------------------------------------------------------------------


def scene_of(truth, has_two_sizes):
    """Photographs of the truth with compensated opacities; of two sizes, every second one has half the size."""
    rng, views = np.random.default_rng(1), []
    for i in range(N_VIEWS):
        view = View(f"view{i}", make_camera(48, 32, rng=rng), np.zeros((32, 48, 3), np.uint8), None, view_id=i)
        view = half_size(view) if has_two_sizes and i % 2 else view
        image = drawn(Model(truth, compensation(1)), view.camera)[0].image
        views.append(view._replace(image=np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)))
    colors = np.full((len(truth.means), 3), 128, np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, BLACK, 3.0)


def decided(truth, scene):
    """Where the Gaussians are a little weaker than in truth, as if they had learned what the low-pass adds."""
    state = state_of(scene, truth._replace(opacity_logits=truth.opacity_logits - 1))
    return state, switch_antialiasing_on(state, iteration_of(scene), min_antialiasing_gain=GAIN_MIN)


def test_two_sizes_ask_for_it(truth):
    scene = scene_of(truth, has_two_sizes=True)
    state, note = decided(truth, scene)
    assert (
        "improve the other half by" in note
        and state.pace.switched_on == ("antialiasing",)
        and COMPENSATION in state.shared
    )
    assert state.pace.decisions[0].gain > GAIN_MIN
    again = switch_antialiasing_on(state, iteration_of(scene), min_antialiasing_gain=GAIN_MIN)
    assert again == "nothing done: opacities are compensated"


def test_one_size_does_not(truth):
    state, note = decided(truth, scene_of(truth, has_two_sizes=False))
    assert (
        note.startswith("nothing done: opacities compensated by amounts")
        and state.pace == Pace()
        and state.shared == {}
    )
