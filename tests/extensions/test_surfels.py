"""The extension surfels: its losses by hand, its start, its recipe through the command line."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io.ply import load_ply
from minisplat_ref.mechanisms.surfels.discs import as_surfels
from minisplat_ref.mechanisms.surfels.losses import distortion, median_normal_consistency, normal_consistency
from minisplat_ref.mechanisms.surfels.renderer import CHANNELS, SURFELS
from minisplat_ref.rendering import Request
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import Camera, Gaussians, Model, RenderOutput, Scene, view_from
from scenes import make_gaussians
from tolerances import CLOSED_FORM

CAMERA = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 2.5, 2.0, 5, 4)


def rendered(alpha, **channels):
    """A view in which each channel is the same in all pixels, or an image."""
    slices = SURFELS.channels(frozenset(CHANNELS))
    image = np.zeros((4, 5, 10))
    for name, value in channels.items():
        image[..., slices[name]] = value
    output = RenderOutput(image, np.full((4, 5), alpha), None, None)
    scene = Scene("s", (), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
    return Rendered(output, slices, view_from(CAMERA), scene, Model(None), 1, Request(conventions=GSPLAT_MAIN))


def test_distortion_of_two_hits():
    """Weights 1/2 and 1/4 at z = 2 and z = 4: w_1 w_2 (m_1 - m_2)^2 with m = 100 / 99.8 (1 - 0.2 / z)."""
    q, w = np.array([1 / 2, 1 / 4]), np.array([0.5, 0.25])
    value, v = distortion(rendered(0.75, spread=np.stack([np.sum(w * q), np.sum(w * q * q)])))
    m = 100 / 99.8 * (1 - 0.2 * q)
    assert_allclose(value, 0.125 * (m[0] - m[1]) ** 2, rtol=CLOSED_FORM)
    b2 = (0.2 * 100 / 99.8) ** 2 / 20
    assert_allclose(v.alpha, b2 * np.sum(w * q * q), rtol=CLOSED_FORM)
    assert_allclose(
        v.channels["spread"], b2 * np.array([-2 * np.sum(w * q), 0.75]) * np.ones((4, 5, 2)), rtol=CLOSED_FORM
    )


def test_distortion_of_hits_at_one_depth_is_zero():
    value, _ = distortion(rendered(0.75, spread=np.array([0.75 / 3, 0.75 / 9])))
    assert abs(value) < 1e-18


def test_normals_that_agree_with_the_surface_cost_nothing_but_the_border():
    """A plane z = 3 has N = (0, 0, -1): a pixel of opacity A costs A - <n, N>, and the border has no N."""
    facing = np.array([0.0, 0.0, -0.8])
    turned = 0.8 * np.array([np.sin(0.3), 0.0, -np.cos(0.3)])
    for function, depth in ((normal_consistency, {"depth": 0.8 * 3}), (median_normal_consistency, {"median": 3})):
        same, _ = function(rendered(0.8, normal=facing, **depth))
        other, _ = function(rendered(0.8, normal=turned, **depth))
        assert_allclose(same, 0.8 * 14 / 20, rtol=CLOSED_FORM)  # 14 of 20 pixels are on the border
        assert_allclose(other - same, 0.8 * (1 - np.cos(0.3)) * 6 / 20, rtol=CLOSED_FORM)


def test_no_normal_beside_a_hole():
    scene = rendered(0.8, normal=np.array([0.0, 0.0, -0.8]), depth=2.4)
    scene.output.alpha[1, 2] = 0
    value, v = normal_consistency(scene)
    # The hole's own neighbours lose their N: (1, 1), (1, 3), (2, 2); the hole itself has opacity 0, but its N stays.
    assert_allclose(value, (0.8 * 19 - 0.8 * 3) / 20, rtol=CLOSED_FORM)
    assert v.channels["normal"][2, 2].sum() == 0 and v.channels["normal"][2, 1].sum() != 0


def test_surfels_start_flat_and_face_at_random(rng):
    g = make_gaussians(rng, 500)
    surfels = as_surfels(g, np.random.default_rng(3))
    assert (surfels.log_scales[:, 2] == -16).all() and (surfels.log_scales[:, :2] == g.log_scales[:, :2]).all()
    assert surfels.quats.min() >= 0 and surfels.quats.max() <= 1  # as torch.rand draws them
    assert surfels.quats.mean() == pytest.approx(0.5, abs=0.03) and surfels.quats.dtype == g.quats.dtype
    assert (surfels.means == g.means).all()


def test_a_setting_chooses_the_centre_of_the_low_pass():
    """3 is the released one; a small disc that is turned and beside the axis has another with 0."""
    recipe = find_recipe("surfels")
    camera = Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 10.0, 8.0, 20, 16)
    quat = np.array([[np.cos(0.4), 0, np.sin(0.4), 0]])
    disc = Gaussians(np.array([[0.5, 0, 3.0]]), quat, np.log(np.full((1, 3), 0.8)), np.zeros(1), np.zeros((1, 3)), None)
    disc = disc._replace(sh_rest=np.zeros((1, 0, 3)))
    centers = []
    for settings in ({}, {"low_pass_cutoff": 3.0}, {"low_pass_cutoff": 0.0}):
        render = configure(recipe, **settings).representation.renderer.render
        _, tape = render(Model(disc), view_from(camera), Request(conventions=GSPLAT_MAIN))
        centers.append(tape.seen.surfels.means2d[0])
    assert (centers[0] == centers[1]).all()
    assert_allclose(centers[2], [10 + 20 * 0.5 / 3, 8], rtol=CLOSED_FORM)
    assert abs(centers[0][0] - centers[2][0]) > 1


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("surfels")
    tiny = ("--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")
    assert main(["synthetic", "room", "--out", str(folder / "room"), *tiny]) == 0
    train = ["train", str(folder / "room"), "--recipe", "surfels", "--iterations", "60", "--out", str(folder / "run")]
    assert main([*train, "--set", "distortion=100", "--set", "median_normal_consistency=0.01"]) == 0
    return folder


def test_the_recipe_trains_and_its_file_says_how_it_is_drawn(run_folder, capsys):
    run = run_folder / "run"
    assert json.loads((run / "config.json").read_text())["recipe"]["name"] == "surfels"
    surfels = load_ply(run / "point_cloud.ply", Gaussians)
    assert surfels.log_scales[:, 2].max() < -15
    assert main(["info", str(run / "point_cloud.ply")]) == 0 and "surfels" in capsys.readouterr().out


def test_a_run_becomes_a_mesh_by_median_and_expected_depths(run_folder):
    for depth in ("median", "expected"):
        out = run_folder / f"{depth}.ply"
        assert main(["mesh", str(run_folder / "run"), "--out", str(out), "--depth", depth, "--voxel", "0.2"]) == 0
        assert out.stat().st_size > 1000


def test_a_depth_that_surfels_do_not_have_is_refused_in_one_line(run_folder, capsys):
    assert main(["mesh", str(run_folder / "run"), "--out", str(run_folder / "m.ply"), "--depth", "midpoint"]) == 2
    assert "renderer surfels gives no midpoint depth" in capsys.readouterr().err
    assert not (run_folder / "m.ply").exists()
