"""Scenes of another size, or far from the origin: the same photographs, in other units and coordinates."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from data_tools.foreign_files.building import NAMES, done, metrics_of, refused, room
from minisplat_ref.io import load_ply, load_points, load_scene, read_image, save_ply
from minisplat_ref.io.ply_file import read_vertices, write_vertices
from minisplat_ref.types import Floats

ITERATIONS = 40
OPTIONS = ("--recipe", "3dgs-accel", "--iterations", ITERATIONS, "--test-every", "4")
ZERO = (0.0, 0.0, 0.0)
UTM = (4.5e5, 5.41e6, 260.0)
ECEF = (4.0753e6, 9.317e5, 4.80136e6)  # metres from the centre of the Earth
PSNR = 0.5  # dB between trainings that differ in the rounding of their points
LEVELS = 2  # of 255, between renders in frames whose float32 rounds differently


def moved(folder: Path, scale: float, shift: tuple[float, float, float]) -> Path:
    """Return the room in other coordinates, ``scale x + shift``, as a binary model."""
    scene = room(folder)
    model = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    reconstruction.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.array(shift)))
    for file in model.iterdir():
        file.unlink()
    reconstruction.write_binary(str(model))
    return scene


def _trained(folder: Path, *options: object) -> dict[str, Any]:
    done("train", folder / "room", *OPTIONS, *options, "--out", folder / "run")
    return metrics_of(folder / "run")


def _plain(folder: Path) -> tuple[dict[str, Any], Path]:
    """Train the room where it is."""
    plain = folder / "plain"
    room(plain)
    return _trained(plain), plain / "run"


def _centers(cameras: Path) -> Floats:
    return np.array([camera["position"] for camera in json.loads(cameras.read_text())])


def _elsewhere(folder: Path, scale: float, shift: tuple[float, float, float]) -> None:
    """As good as at the origin, and every file is in the coordinates of the scene."""
    expected, plain = _plain(folder)
    scene, run = moved(folder, scale, shift), folder / "run"
    assert "files keep its coordinates" in done("info", scene).out
    metrics = _trained(folder)
    assert abs(metrics["psnr"] - expected["psnr"]) < PSNR, (metrics["psnr"], expected["psnr"])
    there = scale * _centers(plain / "cameras.json") + shift
    np.testing.assert_allclose(
        _centers(run / "cameras.json"), there, rtol=1e-12, atol=1e-9 * scale + 1e-15 * max(shift)
    )
    loaded = load_scene(scene)
    means = load_ply(run / "point_cloud.ply").means
    assert np.abs(np.median(means, axis=0) - np.median(loaded.points, axis=0)).max() < 0.3 * loaded.extent

    done("eval", run)
    np.testing.assert_allclose(metrics_of(run)["psnr"], metrics["psnr"], atol=1e-3)
    done("render", run, "--out", folder / "views")
    done("render", run, "--cameras", run / "cameras.json", "--out", folder / "all")
    done("render", run / "point_cloud.ply", "--cameras", run / "cameras.json", "--out", folder / "of_ply", "--depth")
    for name in (NAMES[0], NAMES[4]):
        image = read_image(folder / "views" / f"{name}.png")
        np.testing.assert_array_equal(read_image(folder / "all" / f"{name}.png"), image)
        again = read_image(folder / "of_ply" / f"{name}.png").astype(int)
        assert np.quantile(np.abs(again - image), 0.99) <= LEVELS
        depth = np.load(folder / "of_ply" / f"{name}_depth.npy")
        assert 0.01 < np.median(depth[depth > 0]) / loaded.extent < 10

    done("convert", run / "checkpoint.npz", folder / "of_checkpoint.ply")
    np.testing.assert_array_equal(load_ply(folder / "of_checkpoint.ply").means, means)
    done("convert", folder / "of_checkpoint.ply", folder / "again.ply")
    np.testing.assert_array_equal(load_ply(folder / "again.ply").means, means)
    done("train", "--resume", run, "--iterations", ITERATIONS + 5)


def _powers_of_two(folder: Path, powers: tuple[int, int]) -> None:
    """Scenes that differ by a power of two in size are trained alike to the last bit."""
    metrics, columns = [], []
    for power in powers:
        there = folder / str(power)
        moved(there, 2.0**power, ZERO)
        metrics.append(_trained(there))
        columns.append(read_vertices(there / "run" / "point_cloud.ply"))
    assert metrics[0]["per_view"] == metrics[1]["per_view"]
    ratio = 2.0 ** (powers[1] - powers[0])
    for name in ("x", "y", "z"):
        assert columns[0][name].dtype == np.float32  # as every viewer takes it
        np.testing.assert_array_equal(columns[1][name], np.float32(ratio) * columns[0][name])
    for name in ("scale_0", "scale_2"):
        np.testing.assert_allclose(columns[1][name] - columns[0][name], np.log(ratio), atol=1e-5)
    for name in ("f_dc_0", "opacity", "rot_1"):
        np.testing.assert_array_equal(columns[1][name], columns[0][name])


def _ordinary(folder: Path, scale: float, shift: tuple[float, float, float]) -> None:
    """A scene of ordinary size near the origin keeps its frame, and files of a run say nothing of one."""
    moved(folder, scale, shift)
    _trained(folder)
    assert "frame" not in json.loads((folder / "run" / "config.json").read_text())


def _started(folder: Path) -> None:
    """The points of --init are in the coordinates of the scene."""
    scene = moved(folder, 1e-3, UTM)
    loaded = load_scene(scene)
    names = ("x", "y", "z", "red", "green", "blue")
    write_vertices(folder / "cloud.ply", dict(zip(names, [*loaded.points.T, *loaded.point_colors.T], strict=True)))
    assert load_points(folder / "cloud.ply").points.dtype == np.float64
    with_init = _trained(folder, "--init", folder / "cloud.ply")
    done("train", scene, *OPTIONS, "--out", folder / "without")
    assert with_init["psnr"] == metrics_of(folder / "without")["psnr"]


def _simplified(folder: Path) -> None:
    """What simplify writes, and a compact file of it, are in the coordinates of the scene, too."""
    moved(folder, 1e-3, (0.0, 0.0, 0.0))
    _trained(folder)
    done("simplify", folder / "run", "--out", folder / "small", "--budget", 100, "--fine-tune", 5)
    means = load_ply(folder / "run" / "point_cloud.ply").means
    small = load_ply(folder / "small" / "point_cloud.ply").means
    assert np.abs(small).max() < 2 * np.abs(means).max()
    before = metrics_of(folder / "small")["psnr"]
    done("eval", folder / "small")
    np.testing.assert_allclose(metrics_of(folder / "small")["psnr"], before, atol=1e-3)
    said = done("convert", folder / "small", folder / "small.msz", "--max-drop", "0.5")
    assert "dB lost" in said.out
    done("render", folder / "small", "--cameras", "orbit", "--frames", 2)


def _packed_far(folder: Path) -> None:
    """Compact files hold float32, which has no room for coordinates in UTM: refused with the distance."""
    moved(folder, 1.0, UTM)
    _trained(folder)
    for suffix in (".spz", ".msz", ".omg"):
        line = refused("convert", folder / "run", folder / f"far{suffix}", names=f"far{suffix}")
        assert "5.41e+06 from the origin, where float32 has steps of 0.5; write a PLY" in line, line
    done("convert", folder / "run", folder / "far.ply")


def _extension(folder: Path, recipe: str) -> None:
    """Fields of an extension that are lengths are in the unit of the scene; files of float32 alone are refused."""
    scene = moved(folder, 1e-3, ZERO)
    options = ("--recipe", recipe, "--iterations", 30, "--test-every", "4")
    done("train", scene, *options, "--out", folder / "run")
    before = metrics_of(folder / "run")["psnr"]
    assert before > 10
    done("eval", folder / "run")
    np.testing.assert_allclose(metrics_of(folder / "run")["psnr"], before, atol=1e-3)


def _far_extension(folder: Path) -> None:
    scene = moved(folder, 1.0, UTM)
    line = refused("train", scene, "--recipe", "fans", "--iterations", 5, "--out", folder / "run", names=scene)
    assert "5.429e+06 from the origin" in line and "subtract" in line


def _packed_small(folder: Path) -> None:
    """SPZ of a small scene: its fixed point has as many digits as it needs, scales that it cannot hold are counted."""
    moved(folder, 2e-3, (0.0, 0.0, 0.0))
    _trained(folder)
    done("convert", folder / "run", folder / "small.spz")
    done("convert", folder / "small.spz", folder / "back.ply")
    gaussians, back = (load_ply(path) for path in (folder / "run" / "point_cloud.ply", folder / "back.ply"))
    size = np.exp(np.median(gaussians.log_scales.max(axis=1)))
    assert np.abs(back.means - gaussians.means).max() <= 0.05 * size < 2.0**-13  # half a step of 12 bits


def _alone(folder: Path) -> None:
    """A PLY of a small scene without its run is drawn as the run draws it."""
    moved(folder, 1e-4, (0.0, 0.0, 0.0))
    _trained(folder)
    gaussians = load_ply(folder / "run" / "point_cloud.ply")
    save_ply(folder / "alone.ply", gaussians)
    done("render", folder / "alone.ply", "--frames", 2, "--size", "40x30", "--out", folder / "orbit")
    images = [read_image(path) for path in sorted((folder / "orbit").glob("*.png"))]
    assert all(image.max() > 50 for image in images)


CASES: dict[str, Callable[[Path], None]] = {
    **{f"scaled by {scale:g}": partial(_elsewhere, scale=scale, shift=ZERO) for scale in (1e-3, 1e-6, 1e6)},
    "UTM": partial(_elsewhere, scale=1.0, shift=UTM),
    "ECEF": partial(_elsewhere, scale=1.0, shift=ECEF),
    "UTM in kilometres": partial(_elsewhere, scale=1e-3, shift=(450.0, 5410.0, 0.26)),
    "scaled by powers of two": partial(_powers_of_two, powers=(-10, 17)),
    **{f"scaled by {scale:g}, ordinary": partial(_ordinary, scale=scale, shift=ZERO) for scale in (0.5, 10)},
    "moved a little, ordinary": partial(_ordinary, scale=1.0, shift=(20.0, -30.0, 5.0)),
    "--init": _started,
    "simplify": _simplified,
    "compact files of UTM": _packed_far,
    **{f"recipe {recipe}": partial(_extension, recipe=recipe) for recipe in ("antialiasing", "velocity")},
    "fans in UTM": _far_extension,
    "SPZ of a small scene": _packed_small,
    "PLY alone": _alone,
}
