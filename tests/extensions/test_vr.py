"""VR: acuity and zones by hand, foveated images against whole ones, gradients, from end to end."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.__main__ import main as measure_claim
from minisplat_ref import load_ply, save_ply
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.vr import foveation
from minisplat_ref.extensions.vr.foveation import Gaze, eccentricities, render_foveated, zone_begins, zone_weights
from minisplat_ref.extensions.vr.model import BUFFER, HEADSET, stages
from minisplat_ref.io.ply import read_label
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Model, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM

CAMERA = make_camera(80, 60, fx=60.0, fy=60.0)
SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
REQUEST = Request(np.array([0.2, 0.4, 0.6]), backend=REFERENCE)


def whole(model):
    return HEADSET.renderer.render(model, view_from(CAMERA), REQUEST)[0].image


# --- zones by hand ---


def test_eccentricities_are_angles_to_the_gaze():
    angles = eccentricities(CAMERA, 40.0, 30.5)
    assert angles[30, 39] == pytest.approx(np.degrees(np.arctan(0.5 / 60)), rel=0.1)
    assert_allclose(angles[30, 79], np.degrees(np.arctan2(39.5, 60) - np.arctan2(0, 60)), rtol=1e-3)
    corner = eccentricities(CAMERA, 0.5, 30.0)[29, 79]
    assert corner == pytest.approx(np.degrees(np.arctan2(39.5, 60) + np.arctan2(39.5, 60)), abs=0.1)


def test_zones_begin_where_the_resolved_angle_has_doubled():
    _, second, third = zone_begins(6.0)
    at_full = foveation.resolved_angles(np.array(6.0))
    assert second == pytest.approx(6.0, rel=CLOSED_FORM)
    assert foveation.resolved_angles(np.array(third)) == pytest.approx(2 * at_full, rel=CLOSED_FORM)


def test_weights_add_up_and_never_draw_too_coarsely():
    angles = np.linspace(0, 60, 601)
    weights = zone_weights(angles, 6.0)
    assert_allclose(np.sum(weights, axis=0), 1, rtol=CLOSED_FORM)
    for weight, begins in zip(weights, zone_begins(6.0), strict=True):
        assert not weight[angles < begins].any() and weight.max() == 1


def test_the_acuity_by_hand():
    """Guenter et al. 2012: 1/48 of a degree in the fovea, and 0.0275 degrees more per degree."""
    assert_allclose(foveation.resolved_angles(np.array([0.0, 10.0])), [0.0208333333, 0.2958333333], rtol=1e-8)
    # From 6 degrees on it doubles: 2 (1/48 + 0.165) = 1/48 + 0.0275 e at e = 12.7575...
    assert_allclose(zone_begins(6.0), [0, 6, 12.757575757], rtol=1e-9)


def test_a_ring_is_a_fifth_of_the_eccentricity_wide():
    """Half way through it is half of each image; a quarter of the way, 3/16 - 2/64 of the coarser one."""
    weights = np.array(zone_weights(np.array([6.0, 6.3, 6.6, 7.19, 7.2, 12.757575757 * 1.1]), 6.0))
    quarter = 3 / 16 - 2 / 64
    assert_allclose(weights[:, :3], [[1, 1 - quarter, 0.5], [0, quarter, 0.5], [0, 0, 0]], atol=1e-12)
    assert 0 < weights[0, 3] < 1e-3 and weights[0, 4] == 0
    assert_allclose(weights[:, 5], [0, 0.5, 0.5], atol=1e-8)


def test_a_pixel_needs_its_block_and_those_around_it():
    """Of 5 x 7 pixels in blocks of 2 x 2; a border has no blocks beyond it."""
    is_needed = np.zeros((5, 7), bool)
    is_needed[0, 6] = True
    assert_array_equal(foveation._find_needed_samples(is_needed, 2), [[0, 0, 1, 1], [0, 0, 1, 1], [0, 0, 0, 0]])
    is_needed[:], is_needed[2, 3] = False, True
    assert_array_equal(foveation._find_needed_samples(is_needed, 2), [[1, 1, 1, 0]] * 3)
    assert_array_equal(foveation._find_needed_samples(is_needed, 1), is_needed)
    assert_array_equal(foveation._find_needed_samples(np.zeros((5, 7), bool), 2), np.zeros((3, 4), bool))


# --- images ---


def test_a_coarse_zone_shows_the_footprint_of_the_display():
    """A ball of angular deviation s on its tangent plane: ``o exp(-tan(angle)^2 / (2 (s^2 + 0.3 / (fx fy))))``.

    That is the low-pass of the whole image, though the rays are those of blocks of 4 x 4 pixels, whose middles are at
    38 and 42 in x, at 22 and 26 in y. The pixels in between are interpolated.
    """
    camera = turned_camera(80, 60, fx=60.0, fy=45.0, cx=35.0, cy=28.0)
    towards = np.array([(40 - 35) / 60, (24 - 28) / 45, 1.0])
    r = 3.0 * np.linalg.norm(towards)
    ball = balls(in_front_of(camera, 3.0 * towards), [0.02 * r], [0.9], [[1.0, 1.0, 1.0]])
    image, _ = render_foveated(Model(ball), camera, Request(backend=REFERENCE), Gaze(2.0, 58.0, 0.0), BUFFER)

    def sample(x, y):
        d = np.array([(x - 35) / 60, (y - 28) / 45, 1.0])
        tangent = np.linalg.norm(np.cross(d, towards)) / (d @ towards)
        alpha = 0.9 * np.exp(-(tangent**2) / (2 * (0.02**2 + 0.3 / (60 * 45))))
        return alpha if alpha >= 1 / 255 else 0.0

    for x, y in ((40, 24), (39, 25), (38, 22)):
        right, down = (x + 0.5 - 38) / 4, (y + 0.5 - 22) / 4
        upper = (1 - right) * sample(38, 22) + right * sample(42, 22)
        lower = (1 - right) * sample(38, 26) + right * sample(42, 26)
        expected = (1 - down) * upper + down * lower
        assert expected > 0.02
        assert_allclose(image[y, x], expected, rtol=1e-10)


def test_all_in_full_is_the_whole_image(rng):
    model = Model(make_gaussians(rng, 25))
    image, zones = render_foveated(model, CAMERA, REQUEST, Gaze(40, 30, 180.0), BUFFER)
    assert_array_equal(image, whole(model))
    assert [zone.n_samples for zone in zones] == [80 * 60, 0, 0]


def test_the_fovea_is_drawn_in_full_and_the_rest_is_near(rng):
    model, gaze = Model(make_gaussians(rng, 25, size=0.3)), Gaze(20, 30, 8.0)
    image, zones = render_foveated(model, CAMERA, REQUEST, gaze, BUFFER)
    expected, angles = whole(model), eccentricities(CAMERA, gaze.x, gaze.y)
    assert_array_equal(image[angles <= 8.0], expected[angles <= 8.0])
    error = np.abs(image - expected)
    assert 0 < error[angles > 20].max() < 0.3 and error.mean() < 0.02
    assert [zone.block for zone in zones] == [1, 2, 4] and all(zone.n_tiles > 0 for zone in zones)
    assert sum(zone.n_samples for zone in zones) < 0.8 * 80 * 60


@pytest.mark.parametrize("size", [(80, 60), (77, 53)])
def test_zones_are_images_of_cameras_with_larger_pixels(size, rng):
    """One projection for all zones, and lists of their tiles alone, draw what projecting for each camera draws."""
    camera, gaze = make_camera(*size, fx=60.0, fy=50.0, rng=rng), Gaze(20, 30, 5.0)
    model = Model(make_gaussians(rng, 60, size=0.2))
    image, zones = render_foveated(model, camera, REQUEST, gaze, BUFFER)
    expected = np.zeros_like(image)
    for k, weight in enumerate(zone_weights(eccentricities(camera, gaze.x, gaze.y), gaze.full)):
        block, n_pairs = 2**k, 0
        coarse = foveation._coarser(camera, block)
        low_pass = GSPLAT_MAIN._replace(eps2d=GSPLAT_MAIN.eps2d / block**2)  # of the whole image's pixels
        output, tape = HEADSET.renderer.render(model, view_from(coarse), REQUEST._replace(conventions=low_pass))
        expected += weight[:, :, None] * foveation._interpolate(output.image, block, weight.shape)
        is_needed = foveation._find_needed_samples(weight > 0, block)
        tiles = foveation._find_needed_tiles(is_needed, tape.bins.grid)
        n_pairs = int(np.diff(tape.bins.tile_offsets)[tiles].sum())
        assert zones[k].n_tiles == tiles.sum() > 0 and n_pairs <= zones[k].n_pairs <= 1.3 * n_pairs + 5
    assert_allclose(image, expected, rtol=0, atol=1e-12)


def test_what_is_smooth_is_interpolated_exactly():
    """A plane of light: bilinear between the middles of blocks, wherever four of them lie around."""
    coarse = np.add.outer(np.arange(5.0), 2 * np.arange(7.0))[:, :, None] * np.ones(3)
    fine = foveation._interpolate(coarse, 2, (10, 14))
    ys, xs = (np.arange(10) + 0.5) / 2 - 0.5, (np.arange(14) + 0.5) / 2 - 0.5
    assert_allclose(fine[1:-1, 1:-1, 0], np.add.outer(ys, 2 * xs)[1:-1, 1:-1], rtol=CLOSED_FORM)


@pytest.mark.parametrize("gaze", [Gaze(0, 0, 0), Gaze(80, 60, 180), Gaze(70, 5, 8)])
def test_a_gaze_anywhere_in_the_image_is_accepted(gaze):
    foveation.check_gaze(gaze, CAMERA)


def test_blocks_at_the_edges_extend_beyond_the_image():
    camera = make_camera(77, 53, fx=60.0, fy=50.0)
    coarse = foveation._coarser(camera, 4)
    assert (coarse.width, coarse.height, coarse.fx, coarse.fy) == (20, 14, 15, 12.5)
    assert (coarse.cx, coarse.cy) == (camera.cx / 4, camera.cy / 4)


@pytest.mark.parametrize("gaze", [Gaze(-1, 5, 8), Gaze(81, 5, 8), Gaze(5, 60.5, 8), Gaze(np.nan, 5, 8), Gaze(5, 5, -1)])
def test_a_gaze_outside_is_refused(gaze, rng):
    with pytest.raises(InputError, match=r"gaze .* lies outside image|--full is -1 degrees"):
        render_foveated(Model(make_gaussians(rng, 2)), CAMERA, REQUEST, gaze, BUFFER)


def test_the_gradient_of_the_whole_model(small_proof):
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, HEADSET, stages)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


# --- fine-tuning ---


def test_fine_tuning_starts_where_the_model_is_and_keeps_its_number(tmp_path):
    """Mini-Splatting's own run, then the paper's fine-tuning of it with this renderer."""
    write_scene(make_scene("room", supersampling=1, **SCENE), tmp_path / "nook", SCENE)
    train = ["train", str(tmp_path / "nook"), "--test-every", "4"]
    few, out = tmp_path / "few", tmp_path / "out"
    assert main([*train, "--recipe", "mini-splatting2", "--iterations", "60", "--out", str(few)]) == 0
    options = ["--recipe", "vr-fine-tuning", "--init", str(few), "--iterations", "30"]
    assert main([*train, *options, "--out", str(out)]) == 0
    before, after = (load_ply(folder / "point_cloud.ply") for folder in (few, out))
    assert len(before.means) == len(after.means) and 0 < np.abs(before.means - after.means).max() < 0.05
    assert read_label(out / "point_cloud.ply").extension == "vr"
    losses = [json.loads(line)["loss"] for line in (out / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]


# --- from end to end ---


def test_trains_renders_and_measures(tmp_path, capsys):
    scene, run = tmp_path / "nook", tmp_path / "run"
    write_scene(make_scene("room", supersampling=1, **SCENE), scene, SCENE)
    options = ["--recipe", "vr", "--test-every", "4", "--iterations", "30", "--out", str(run)]
    assert main(["train", str(scene), *options]) == 0
    ply, images = str(run / "point_cloud.ply"), tmp_path / "images"
    assert main(["vr", "render", ply, "--gaze", "10,12", "--full", "4", "--out", str(images)]) == 0
    assert len(list(images.glob("*.png"))) == 2 and "1 for 4 x 4" in capsys.readouterr().out
    study = ["--ply", ply, "--repeats", "1", "--out", str(tmp_path / "study")]
    assert measure_claim(["vr/foveation", str(scene), *study]) == 0
    rows = json.loads((tmp_path / "study" / "result.json").read_text())["rows"]
    assert rows[0]["n_samples"] > rows[1]["n_samples"] and "weighted PSNR" in capsys.readouterr().out
    capsys.readouterr()
    assert measure_claim(["vr/queues", "--ply", ply, "--out", str(tmp_path / "queues")]) == 0
    assert "| queues of 4 x 4, 2 x 2 and pixel" in capsys.readouterr().out
    assert measure_claim(["vr/yaw", "--ply", ply, "--steps", "2", "--out", str(tmp_path / "yaw")]) == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--gaze", "99,12"], "gaze 99,12 lies outside"),
        (["--gaze", "1"], "not a pixel"),
        (["--gaze", "1,2", "--full", "200"], "--full is 200 degrees"),
    ],
)
def test_bad_input_is_one_line(arguments, says, tmp_path, rng, capsys):
    save_ply(tmp_path / "a.ply", as_dtype(make_gaussians(rng, 3), np.float32))
    camera = {"img_name": "v", "position": [0, 0, 0], "rotation": np.eye(3).tolist()}
    camera |= {"width": 24, "height": 18, "fx": 30, "fy": 30}
    (tmp_path / "cameras.json").write_text(json.dumps([camera]))
    out = tmp_path / "out"
    try:
        code = main(["vr", "render", str(tmp_path / "a.ply"), *arguments, "--out", str(out)])
    except SystemExit as stop:
        code = stop.code
    assert code == 2 and says in capsys.readouterr().err and not out.exists()


def test_kernels_draw_what_the_reference_draws(rng):
    model, gaze = Model(make_gaussians(rng, 25)), Gaze(20, 30, 8.0)
    images = [
        render_foveated(model, CAMERA, REQUEST._replace(backend=backend), gaze, BUFFER)[0]
        for backend in (CPU, REFERENCE)
    ]
    assert_allclose(images[0], images[1], atol=1e-11)
