"""VDGS: opacities by hand, gradients, the network of zero output, which is 3DGS exactly, and a run with its files."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.vdgs import floats as floats_study
from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.vdgs.model import (
    CENTER,
    MODES,
    NAME,
    RADIUS,
    TABLE,
    VIEW_DEPENDENT,
    both_plus,
    both_times,
    find_levels,
    modulate,
    modulate_model,
    modulate_vjp,
    modulated_logits,
    modulated_logits_vjp,
    n_outputs,
    small_shared,
    stages,
)
from minisplat_ref.io.ply import load_ply, read_label
from minisplat_ref.mechanisms.networks.directions import directions, directions_vjp
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.gradients import jacobian_case
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import Gaussians, Model, Scene, view_from
from scenes import as_dtype, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, PARITY_FLOAT64

RENDERER = VIEW_DEPENDENT.renderer
ALL_MODES = (*floats_study.MODES, both_times, both_plus)


def logit(o):
    return np.log(o / (1 - o))


# By hand


def test_opacities_by_hand():
    """0.5 doubled meets the bound of 0.99, 0.4 halved is 0.2; 0.995 stays, as does what has no output."""
    logits = logit(np.array([0.5, 0.4, 0.995, 0.3, 0.2, 0.995]))
    y = np.array([1.0, -0.5, 0.2, 0.0, -1.5, -0.4])
    found = modulated_logits(logits, y, False)
    assert_allclose(found.seen, [0.99, 0.2, 0.995, 0.3, 1e-4, 0.597], rtol=CLOSED_FORM)
    assert_allclose(1 / (1 + np.exp(-found.logits)), found.seen, rtol=1e-10)  # through the logit of 1e-4
    assert found.logits[[2, 3]].tobytes() == logits[[2, 3]].tobytes()
    assert_allclose(modulated_logits(logits[1:2], y[1:2] / 2, True).seen, [0.15], rtol=CLOSED_FORM)
    v, v_y = modulated_logits_vjp(found, y, False, np.ones(6))
    assert_allclose(v[[0, 2, 4]], [0, 1, 0], rtol=CLOSED_FORM)
    assert_array_equal(v_y[[0, 2, 4]], 0)
    assert_allclose(v_y[1], 0.4 / (0.2 * 0.8), rtol=CLOSED_FORM)


def test_a_mode_says_how_many_outputs_there_are():
    assert [n_outputs(mode()) for mode in ALL_MODES] == [1, 1, 48, 48, 49, 49]


@pytest.mark.parametrize("modulation", ALL_MODES, ids=lambda mode: mode.__name__)
def test_outputs_arrive_where_they_belong(modulation, rng):
    """A network without weights has its biases as outputs: 0.01 for the first, 0.02 for the second, and so on."""
    g, name, mode = make_gaussians(rng, 4, sh_degree=1), modulation.__name__, modulation()
    assert mode == (not name.startswith("colors"), not name.startswith("opacity"), name.endswith("plus"))
    shared = small_shared(modulation, 12, rng)
    shared = {name: 0 * array if "weights" in name else array for name, array in shared.items()}
    y = 0.01 * np.arange(1, 1 + mode.opacity + 12 * mode.colors)
    shared[f"{NAME}_biases_1"] = y
    seen, _ = modulate_model(Model(g, shared), turned_camera(), mode, IN_NUMPY)
    o = 1 / (1 + np.exp(-g.opacity_logits))
    if mode.opacity:
        raw = o + 0.01 if mode.is_sum else 1.01 * o
        assert_allclose(1 / (1 + np.exp(-seen.opacity_logits)), np.minimum(raw, 0.99), rtol=1e-10)
    else:
        assert seen.opacity_logits is g.opacity_logits
    if mode.colors:
        of_colors = y[int(mode.opacity) :].reshape(4, 3)
        for found, own, change in ((seen.sh_dc, g.sh_dc, of_colors[0]), (seen.sh_rest, g.sh_rest, of_colors[1:])):
            assert_allclose(found, own + change if mode.is_sum else own * (1 + change), rtol=CLOSED_FORM)
    else:
        assert seen.sh_dc is g.sh_dc and seen.sh_rest is g.sh_rest


# Gradients and backends


def test_gradients_of_the_formulas(rng):
    camera = turned_camera()
    means, x, y = rng.normal(size=(3, 3)), rng.normal(size=4), rng.normal(size=4)
    d, distances = directions(means, camera)

    def of_pose(means, R, t):
        return (directions(means, camera._replace(cam_from_world_R=R, cam_from_world_t=t))[0],)

    check_jacobian(
        of_pose,
        lambda v: directions_vjp(d, distances, camera, v),
        [means, camera.cam_from_world_R, camera.cam_from_world_t],
        names=["means", "R", "t"],
    )
    logits, small = logit(np.array([0.3, 0.5, 0.7, 0.2])), 0.2 * np.tanh(y)
    for is_sum in (False, True):
        check_jacobian(
            lambda x, y, s=is_sum: (modulate(x, y, s),),
            lambda v, s=is_sum: modulate_vjp(x, y, s, v),
            [x, y],
            names=["x", "y"],
        )
        found = modulated_logits(logits, small, is_sum)
        assert found.is_free.sum() >= 3
        check_jacobian(
            lambda a, b, s=is_sum: (modulated_logits(a, b, s).logits,),
            lambda v, s=is_sum, found=found: modulated_logits_vjp(found, small, s, v),
            [logits, small],
            names=["logits", "y"],
        )


def test_the_gradient_of_the_renderer(rng):
    """Of one mode that has everything; ``oracle gradients --extension vdgs`` checks the others."""
    chosen = stages(REFERENCE, tiny_setting(GSPLAT_MAIN), rng)[MODES.index(both_times)]
    assert {TABLE, f"{NAME}_weights_0", "means", "cam_from_world_t"} <= chosen.inputs.keys()
    assert not {CENTER, RADIUS} & chosen.inputs.keys()
    case = jacobian_case(chosen)
    assert case.passed, case


def test_backends_agree(rng):
    g, shared = make_gaussians(rng, 20, sh_degree=1), small_shared(both_plus, 12, rng)
    renderer = configure(find_recipe("vdgs"), modulation=both_plus).representation.renderer
    v_image, view = rng.normal(size=(18, 24, 3)), view_from(make_camera())
    results = []
    for backend in (CPU, REFERENCE):
        output, tape = renderer.render(Model(g, shared), view, Request(backend=backend))
        v = renderer.render_vjp(tape, v_image, None)
        results.append([output.image, *v.gaussians, *(v.shared[name] for name in sorted(v.shared))])
    assert len(results[0]) == 1 + 6 + 5
    for ours, theirs in zip(*results, strict=True):
        assert_allclose(ours, theirs, atol=PARITY_FLOAT64 * np.abs(theirs).max())


# What equals 3DGS


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=6, width=32, height=24, n_points=60).scene


@pytest.mark.parametrize("modulation", ALL_MODES, ids=lambda mode: mode.__name__)
def test_at_the_start_it_is_3dgs_to_the_byte(modulation, scene, rng):
    g = as_dtype(make_gaussians(rng, 30, sh_degree=3), np.float32)
    representation = configure(find_recipe("vdgs"), modulation=modulation).representation
    shared = representation.shared(scene, rng)
    view, request = view_from(make_camera()), Request(backend=CPU)
    (ours, tape), (theirs, plain) = (
        renderer.render(Model(g, arrays), view, request)
        for renderer, arrays in ((representation.renderer, shared), (SPLATTING, {}))
    )
    assert ours.image.tobytes() == theirs.image.tobytes()
    v_image = np.ones_like(ours.image)
    v = representation.renderer.render_vjp(tape, v_image, None)
    v_plain = SPLATTING.render_vjp(plain, v_image, None)
    assert v.gaussians.sh_dc.tobytes() == v_plain.gaussians.sh_dc.tobytes()
    assert np.abs(v.shared[f"{NAME}_biases_1"]).max() > 0  # it will learn


def test_without_a_rate_a_training_is_that_of_3dgs(scene):
    recipe = find_recipe("vdgs")._replace(iterations=12)
    still = {name: 0.0 for name in recipe.representation.rates.of}
    still = recipe._replace(learning_rates=recipe.learning_rates.change(**still))
    ours = train(scene, still, seed=1).gaussians
    theirs = train(scene, GS_ACCEL._replace(iterations=12), seed=1).gaussians
    # The way through o' (1 - o') and back rounds the gradient of the logits differently.
    for name in Gaussians._fields:
        assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-4, err_msg=name)
    moved = train(scene, recipe, seed=1)
    assert np.abs(moved.shared[f"{NAME}_weights_1"]).max() > 0


def test_the_place_of_a_scene_without_points(rng):
    nothing = Scene("a", (), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), extent=4.0)
    shared = VIEW_DEPENDENT.shared(nothing, rng)
    assert shared[RADIUS].tolist() == [4.0] and shared[CENTER].tolist() == [0, 0, 0]
    x = np.array([*range(-5, 5), 1000.0])  # the median is 0; eight of ten others are within 4, a ninth at 5
    points = np.stack([x, np.zeros(11), np.full(11, 2.0)], axis=1)
    shared = VIEW_DEPENDENT.shared(nothing._replace(points=points), rng)
    assert shared[CENTER].tolist() == [0, 0, 2] and shared[RADIUS].tolist() == [5.0]


def test_cells_from_16_to_128():
    assert find_levels(np.zeros((4, 2**12, 2))).resolutions == (16, 32, 64, 128)


# Runs


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("vdgs")
    sizes = ["--views", "6", "--width", "32", "--height", "24", "--points", "60"]
    assert main(["synthetic", "room", "--out", str(folder / "room"), *sizes]) == 0
    options = ["--iterations", "30", "--set", "modulation=both_plus", "--out", str(folder / "run")]
    assert main(["train", str(folder / "room"), "--recipe", "vdgs", "--test-every", "3", *options]) == 0
    return folder / "run"


def test_a_file_says_that_it_lacks_the_network(run_folder, capfd):
    label = read_label(run_folder / "point_cloud.ply")
    assert label.extension == "vdgs" and label.lacks == ("network",) and label.set == ("modulation=both_plus",)
    with np.load(run_folder / "shared.npz") as stored:
        assert {TABLE, CENTER, RADIUS, f"{NAME}_weights_1"} <= set(stored)
        assert np.abs(stored[f"{NAME}_weights_1"]).max() > 0
    before = json.loads((run_folder / "metrics.json").read_text())["psnr"]
    assert main(["eval", str(run_folder)]) == 0
    assert json.loads((run_folder / "metrics.json").read_text())["psnr"] == before


def test_a_baked_view_is_that_view(run_folder, tmp_path, capfd):
    out = tmp_path / "seen.ply"
    view = json.loads((run_folder / "cameras.json").read_text())[0]["img_name"]
    assert main(["vdgs", "bake", str(run_folder), "--view", view, "--out", str(out)]) == 0
    baked, plain = load_ply(out), load_ply(run_folder / "point_cloud.ply")
    assert_array_equal(baked.means, plain.means)
    assert np.abs(baked.sh_dc - plain.sh_dc).max() > 0 and np.abs(baked.opacity_logits - plain.opacity_logits).max() > 0
    capfd.readouterr()
    for arguments, expected in (
        ([str(run_folder), "--view", "nowhere"], "no view nowhere: choose from"),
        ([str(run_folder / "point_cloud.ply"), "--view", view], "a PLY alone has no network"),
    ):
        assert main(["vdgs", "bake", *arguments, "--out", str(tmp_path / "no.ply")]) == 2
        assert expected in capfd.readouterr().err and not (tmp_path / "no.ply").exists()
