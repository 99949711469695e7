"""LPIPS without torch: layers by hand, what a distance must do, files good and bad, and the way to the tables."""

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import run, scoring
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_ply, load_scene
from minisplat_ref.metrics import evaluate
from minisplat_ref.metrics import lpips as module
from minisplat_ref.metrics.lpips import (
    ALEXNET,
    VGG16,
    Network,
    convolve,
    expected_shapes,
    load_network,
    lpips,
    max_pool,
)
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.types import View
from networks import random_network, random_weights, write_network
from photo_scenes import write_colmap
from run_commands import in_process
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM, LPIPS_FLOAT32, PARITY_FLOAT64

SIDE = 33  # pixels; AlexNet needs 31


@pytest.fixture(scope="module")
def network():
    return random_network(np.random.default_rng(7))


@pytest.fixture
def pair(rng):
    return rng.random((SIDE, SIDE + 4, 3)), rng.random((SIDE, SIDE + 4, 3))


# Layers


def test_convolution_by_hand():
    """Two channels, a filter of 2 x 2, a border of one zero, every second window."""
    x = np.stack([[[1.0, 2, 3], [4, 5, 6], [7, 8, 9]], np.eye(3)], axis=2)  # [3, 3, 2]
    weight = np.array([[[[1.0, 10], [100, 1000]], [[0, 0], [0, 0.5]]]])  # [1, 2, 2, 2]
    y = convolve(x, weight, np.array([0.25]), stride=2, padding=1)
    expected = [[1000 * 1 + 0.5, 100 * 2 + 1000 * 3], [10 * 4 + 1000 * 7, 1 * 5 + 10 * 6 + 100 * 8 + 1000 * 9 + 0.5]]
    assert_allclose(y[..., 0], np.array(expected) + 0.25, rtol=CLOSED_FORM)


def test_convolution_in_bands_is_the_same(rng, monkeypatch):
    """Three rows of windows at a time, and then one that is longer than allowed."""
    x, weight, bias = rng.normal(size=(11, 7, 4)), rng.normal(size=(5, 4, 3, 3)), rng.normal(size=5)
    whole = convolve(x, weight, bias, 1, 1)
    for n_bytes in (3 * 7 * 36 * 8, 1):
        monkeypatch.setattr(module, "WINDOW_BYTES", n_bytes)
        assert_allclose(convolve(x, weight, bias, 1, 1), whole, rtol=0, atol=PARITY_FLOAT64 * np.abs(whole).max())


def test_pooling_by_hand():
    """What does not fill a window is left out; neighbouring windows of 3 overlap."""
    x = np.arange(30.0).reshape(5, 6, 1) * np.array([1, -1])  # [5, 6, 2]
    pooled = max_pool(x, 2, 2)
    assert_array_equal(pooled[..., 0], [[7, 9, 11], [19, 21, 23]])
    assert_array_equal(pooled[..., 1], [[0, -2, -4], [-12, -14, -16]])
    assert_array_equal(max_pool(x, 3, 2)[..., 0], [[14, 16], [26, 28]])


def test_one_pixel_by_hand():
    """AlexNet whose later layers are dead: equation (1) of the first layer, two of its channels alive.

    The first channel is constant; the second sees the blue of the pixel in the middle of each window, which differs in
    a single one. A pixel's features are divided by their length and 1e-10.
    """
    weights = {name: np.zeros(shape) for name, shape in expected_shapes(ALEXNET).items()}
    weights["net.slice1.0.bias"][:2] = 3, 4
    weights["net.slice1.0.weight"][1, 2, 5, 5] = 1.0
    weights["lin0.model.1.weight"][0, :2, 0, 0] = 0.5, 0.25
    blue, black = (0 + 0.188) / 0.450, (-1 + 0.188) / 0.450  # what 0.5 and 0 are to the network
    target, image = np.zeros((31, 31, 3)), np.zeros((31, 31, 3))
    image[11, 15, 2] = 0.5  # 4 i + 5 - 2 for i = 2 and j = 3
    a, b = np.array([3, 4 + blue]), np.array([3, 4 + black])
    difference = a / (np.linalg.norm(a) + 1e-10) - b / (np.linalg.norm(b) + 1e-10)
    expected = (0.5 * difference[0] ** 2 + 0.25 * difference[1] ** 2) / 7**2  # one of 7 x 7 features
    assert lpips(image, target, Network(ALEXNET, weights)) == pytest.approx(expected, rel=CLOSED_FORM, abs=0)


# A distance


@pytest.mark.parametrize("backbone", [ALEXNET, VGG16], ids=lambda b: b.name)
def test_equal_images_and_symmetry(rng, backbone):
    network = random_network(rng, backbone)
    x, y = rng.random((SIDE, SIDE, 3)), rng.random((SIDE, SIDE, 3))
    assert lpips(x, x, network) == 0.0
    assert lpips(x, y, network) == lpips(y, x, network) > 1e-3


def test_grows_with_noise(pair, network, rng):
    image, _ = pair
    noise = rng.normal(size=image.shape)
    distances = [lpips(np.clip(image + sigma * noise, 0, 1), image, network) for sigma in (0.02, 0.1, 0.3)]
    assert 0 < distances[0] < distances[1] < distances[2]


def test_bytes_and_float32(pair, network):
    image, target = pair
    pixels = np.round(255 * target).astype(np.uint8)
    expected = lpips(image, pixels / 255, network)
    assert lpips(image, pixels, network) == pytest.approx(expected, rel=PARITY_FLOAT64, abs=0)
    assert lpips(image.astype(np.float32), pixels, network) == pytest.approx(expected, rel=LPIPS_FLOAT32, abs=0)


def test_masked_pixels_do_not_count(pair, network):
    image, target = pair
    mask = np.ones(image.shape[:2], bool)
    assert lpips(image, target, network, mask) == lpips(image, target, network)
    mask[:, 20:] = False
    changed = np.where(mask[:, :, None], image, 0.5)
    assert lpips(image, target, network, mask) == lpips(changed, target, network, mask)
    painted = np.where(mask[:, :, None], image, target)
    expected = lpips(painted, target, network) * mask.size / mask.sum()
    assert lpips(image, target, network, mask) == pytest.approx(expected, rel=PARITY_FLOAT64, abs=0)
    with pytest.raises(InputError, match="mask leaves no pixel"):
        lpips(image, target, network, np.zeros_like(mask))


@pytest.mark.parametrize(("backbone", "least"), [(VGG16, 16), (ALEXNET, 31)], ids=["VGG16", "AlexNet"])
def test_smallest_image(rng, backbone, least):
    network = random_network(rng, backbone)
    x, y = rng.random((least, least, 3)), rng.random((least, least, 3))
    assert lpips(x, y, network) > 0
    with pytest.raises(InputError, match=rf"image is {least} x {least - 1} pixels.*{backbone.name} needs {least} x"):
        lpips(x[1:], y[1:], network)


# Files


@pytest.mark.parametrize("backbone", [ALEXNET, VGG16], ids=lambda b: b.name)
def test_file_of_the_package(rng, tmp_path, backbone):
    """A backbone is measured by its arrays; what else the package has in its state dict does not matter."""
    network = load_network(write_network(tmp_path / "weights.npz", np.random.default_rng(3), backbone))
    assert network.backbone is backbone
    expected = random_weights(np.random.default_rng(3), backbone)
    assert set(network.weights) == set(expected)
    for name, values in expected.items():
        assert_array_equal(network.weights[name], values)


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("net.slice3.6.weight", None, r"net.slice3.6.weight is missing, expected floats of shape \(384, 192, 3, 3\)"),
        ("lin4.model.1.weight", None, r"lin4.model.1.weight is missing, expected floats of shape \(1, 256, 1, 1\)"),
        ("net.slice1.0.weight", None, r"net.slice1.0.weight is missing, expected \(64, 3, 3, 3\) \(VGG16\) or"),
        (
            "net.slice1.0.weight",
            np.zeros((64, 3, 7, 7)),
            r"shape \(64, 3, 7, 7\), expected .* \(64, 3, 11, 11\) \(Alex",
        ),
        ("net.slice2.3.bias", np.zeros(191), r"net.slice2.3.bias is float64 of shape \(191,\), expected .*\(192,\)"),
        ("net.slice2.3.bias", np.zeros(192, int), r"net.slice2.3.bias is int64"),
        ("net.slice5.10.bias", np.full(256, np.nan), r"net.slice5.10.bias is nan at index \[0\]"),
        ("net.slice5.10.bias", np.full(256, None), r"not a readable .npz of arrays"),  # a pickle
    ],
)
def test_bad_arrays(rng, tmp_path, name, change, reason):
    weights = {**random_weights(rng), name: change}
    np.savez(tmp_path / "bad.npz", **{key: values for key, values in weights.items() if values is not None})
    with pytest.raises(InputError, match=reason) as error:
        load_network(tmp_path / "bad.npz")
    assert str(tmp_path / "bad.npz") in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["text", "npy", "truncated", "folder"])
def test_bad_files(rng, tmp_path, kind):
    path = tmp_path / "bad.npz"
    if kind == "text":
        path.write_text("no archive")
    elif kind == "npy":
        with open(path, "wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "truncated":
        path.write_bytes(write_network(tmp_path / "good.npz", rng).read_bytes()[:100_000])
    else:
        path.mkdir()
    with pytest.raises(InputError, match=r"bad.npz: not a readable .npz of arrays.*lpips.LPIPS"):
        load_network(path)


def test_damaged_file(rng, tmp_path):
    """A bit that has changed is found by the archive's checksum."""
    content = bytearray(write_network(tmp_path / "good.npz", rng).read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "bad.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"bad.npz: not a readable .npz"):
        load_network(tmp_path / "bad.npz")


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"none.npz: no such file; say with --lpips-weights where"):
        load_network(tmp_path / "none.npz")


# The tables


def test_evaluation(rng, network):
    views = [
        View(
            f"view{i}", make_camera(SIDE, SIDE + i, rng=rng), rng.integers(0, 256, (SIDE + i, SIDE, 3), np.uint8), None
        )
        for i in range(2)
    ]
    seen = {}
    result = evaluate(
        make_gaussians(rng, 20),
        views,
        RenderSettings(np.zeros(3)),
        network=network,
        on_view=lambda view, image, _: seen.update({view.name: lpips(image, view.image, network)}),
    )
    assert {view.name: view.lpips for view in result.per_view} == seen
    assert result.lpips == pytest.approx(np.mean(list(seen.values())), rel=CLOSED_FORM, abs=0)
    assert (result.lpips_reason, result.lpips_network) == (None, "AlexNet")


def test_small_view_is_found_before_anything_is_rendered(rng, network):
    views = [
        View(name, make_camera(width, 40), np.zeros((40, width, 3), np.uint8), None)
        for name, width in (("fine", 40), ("narrow", 30))
    ]
    with pytest.raises(InputError, match="view narrow is 30 x 40 pixels"):
        evaluate(make_gaussians(rng, 3), views, RenderSettings(np.zeros(3)), network=network, on_view=pytest.fail)


SCENE = {"n_views": 8, "width": 40, "height": 36, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return write_network(tmp_path_factory.mktemp("weights") / "alex.npz", np.random.default_rng(7))


def read_metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def train(scene_folder, out, *options):
    schedule = ["--recipe", "3dgs-accel", "--iterations", "8"]
    return main(["train", str(scene_folder), *schedule, "--test-every", "4", "--out", str(out), *options])


@pytest.fixture(scope="module")
def run_folder(scene_folder, weights, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(weights.parent)
        assert train(scene_folder, folder, "--lpips-weights", weights.name) == 0
    return folder


def test_train_measures_lpips(run_folder, scene_folder, weights, network):
    metrics = read_metrics(run_folder)
    assert json.loads((run_folder / "config.json").read_text())["settings"]["lpips_weights"] == str(weights.resolve())
    scene = load_scene(scene_folder, test_every=4)
    gaussians = load_ply(run_folder / "point_cloud.ply")
    expected = evaluate(gaussians, scene.test_views, RenderSettings(scene.background), network=network)
    assert metrics["lpips"] == pytest.approx(expected.lpips, rel=LPIPS_FLOAT32, abs=0)
    assert metrics["lpips_reason"] is None and metrics["lpips_network"] == "AlexNet"
    assert [view["lpips"] for view in metrics["per_view"]] == [view.lpips for view in expected.per_view]


def copy_of(run_folder, folder):
    folder.mkdir()
    for path in run_folder.glob("*.*"):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def move_weights(folder, to):
    config = json.loads((folder / "config.json").read_text())
    config["settings"]["lpips_weights"] = to
    (folder / "config.json").write_text(json.dumps(config))


def test_eval_uses_the_weights_of_the_run_or_those_given(run_folder, weights, tmp_path, capsys):
    folder = copy_of(run_folder, tmp_path / "run")
    before = read_metrics(folder)
    assert main(["eval", str(folder)]) == 0
    assert read_metrics(folder) == before
    out = capsys.readouterr().out
    assert f"LPIPS {before['lpips']:.4f} by AlexNet" in out
    assert all(f"{view['lpips']:.4f}" in out for view in before["per_view"])

    move_weights(folder, None)
    assert main(["eval", str(folder)]) == 0
    after = read_metrics(folder)
    assert after["lpips"] is None and after["lpips_network"] is None and "--lpips-weights" in after["lpips_reason"]
    assert "LPIPS" not in capsys.readouterr().out
    assert main(["eval", str(folder), "--lpips-weights", str(weights)]) == 0
    assert read_metrics(folder) == before


@pytest.mark.parametrize("command", [["eval"], ["train", "--iterations", "9", "--resume"]])
def test_weights_that_are_gone(run_folder, weights, tmp_path, capfd, monkeypatch, command):
    """One line before anything is trained; the option says where they are now."""
    folder = copy_of(run_folder, tmp_path / "run")
    move_weights(folder, str(tmp_path / "gone.npz"))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__enter__", lambda progress: pytest.fail("trains"))
        assert main([*command, str(folder)]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert str(tmp_path / "gone.npz") in line and "--lpips-weights" in line
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert main([*command, str(folder), "--lpips-weights", str(weights)]) == 0
    assert read_metrics(folder)["lpips"] > 0


def test_weights_may_vanish_while_training(scene_folder, weights, tmp_path, monkeypatch):
    copy = tmp_path / "weights.npz"
    copy.write_bytes(weights.read_bytes())
    report_step = Progress.__call__

    def remove(progress, report):
        report_step(progress, report)
        copy.unlink(missing_ok=True)

    monkeypatch.setattr(Progress, "__call__", remove)
    assert train(scene_folder, tmp_path / "run", "--lpips-weights", str(copy)) == 0
    assert read_metrics(tmp_path / "run")["lpips"] > 0 and not copy.exists()


@pytest.mark.parametrize("command", [["train"], ["compare", "--recipes", "3dgs"]])
@pytest.mark.parametrize(("case", "reason"), [("no file", "none.npz: no such file"), ("small", "needs 31 x 31")])
def test_refused_before_training(weights, tmp_path, capfd, command, case, reason):
    scene = write_colmap(tmp_path / "scene", n=6)  # of 32 x 24 pixels
    file = tmp_path / "none.npz" if case == "no file" else weights
    options = ["--test-every", "3", "--lpips-weights", str(file), "--out", str(tmp_path / "out")]
    assert main([*command, str(scene), *options]) == 2
    captured = capfd.readouterr()
    assert (captured.out, len(captured.err.splitlines())) == ("", 1) and reason in captured.err
    assert not (tmp_path / "out").exists()


def test_compare_shows_lpips(scene_folder, weights, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr("minisplat_ref.app.comparison.runs.train_here", in_process)
    options = ["--recipes", "3dgs-accel", "--iterations", "6", "--test-every", "4", "--lpips-weights", str(weights)]
    assert main(["compare", str(scene_folder), *options, "--out", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out" / "compare.json").read_text())
    value = read_metrics(tmp_path / "out" / "3dgs-accel-seed0")["lpips"]
    assert content["recipes"][0]["mean"]["lpips"] == value > 0
    assert (content["lpips_reason"], content["lpips_network"]) == (None, "AlexNet")
    assert content["settings"]["lpips_weights"] == str(weights)
    for text in (capfd.readouterr().out, (tmp_path / "out" / "report.html").read_text()):
        assert f"{value:.4f}" in text and "LPIPS by AlexNet" in text and "LPIPS null" not in text


def test_curve_goes_without(scene_folder, weights, tmp_path, monkeypatch):
    """On the way PSNR and SSIM are enough: LPIPS is measured once for each test view."""
    calls = []
    evaluate_views = scoring.evaluate
    for user in (run, scoring):
        monkeypatch.setattr(user, "evaluate", lambda *a, **k: calls.append(k.get("network")) or evaluate_views(*a, **k))
    options = ["--eval-every", "4", "--lpips-weights", str(weights)]
    assert train(scene_folder, tmp_path / "run", *options) == 0
    assert [network is not None for network in calls] == [False, True]
    assert math.isfinite(read_metrics(tmp_path / "run")["lpips"])
