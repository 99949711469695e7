"""Holograms from the command line: files and images, depths, and bad input."""

import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.app.cli import main
from minisplat_ref.extensions.wave.focus import load_hologram
from minisplat_ref.io import viewpoints
from minisplat_ref.io.images import read_image
from minisplat_ref.io.ply import save_ply
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.rendering import render
from scenes import as_dtype, make_gaussians
from wave_run import CAMERA, SURFELS, run  # noqa: F401  (a fixture)


@pytest.fixture(scope="module")
def hologram(run):
    assert main(["wave", "hologram", str(run), "--out", str(run / "h.npz"), "--phase", str(run / "phase.png")]) == 0
    return run / "h.npz"


def line_of(arguments, capsys):
    """The one line of an error."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_a_hologram_has_what_is_needed_to_look_at_it(hologram, run):
    found = load_hologram(hologram)
    assert found.fields.shape == (3, 32, 48) and found.fields.dtype == np.complex128
    assert_allclose([*found.wavelengths, found.pitch, found.thickness], [638e-9, 520e-9, 450e-9, 8e-6, 4e-3])
    near, far = found.depths
    assert 2 < near < far < 4
    assert_allclose(
        [found.z_of(near), found.z_of(far), found.z_of(2 / (1 / near + 1 / far))], [2e-3, -2e-3, 0], atol=1e-9
    )
    phases = read_image(run / "phase.png")
    assert phases.shape == (32, 48, 3) and phases.std() > 20


def test_a_camera_is_chosen_by_its_name(hologram, run, tmp_path):
    out = tmp_path / "beside.npz"
    assert main(["wave", "hologram", str(run), "--camera", "beside", "--out", str(out)]) == 0
    default, beside = (np.abs(load_hologram(path).fields) for path in (hologram, out))
    assert np.abs(default - beside).mean() > 0.05


def test_with_everything_in_focus_it_is_the_image(run, tmp_path):
    """A box that is thinner than a wavelength: the absolute values are what 3DGS draws, but for what is flat."""
    out, image = tmp_path / "thin.npz", tmp_path / "image.png"
    assert main(["wave", "hologram", str(run), "--thickness", "0.0001", "--out", str(out)]) == 0
    depth = str(load_hologram(out).depths.mean())
    assert main(["wave", "focus", str(out), "--depth", depth, "--out", str(image)]) == 0
    from minisplat_ref.io.ply import load_ply

    expected = render(load_ply(run / "point_cloud.ply"), CAMERA.astype(np.float32))[0].image
    difference = read_image(image) / 255 - np.clip(expected, 0, 1)
    assert np.sqrt(np.mean(difference**2)) < 0.02 and expected.std() > 0.1


def test_focus_changes_the_image_and_phases_alone_resemble_it(hologram, tmp_path):
    near, far = load_hologram(hologram).depths
    images = {}
    for name, depth, *further in (("near", near), ("far", far), ("phase", near, "--phase-only")):
        out = tmp_path / f"{name}.png"
        assert main(["wave", "focus", str(hologram), "--depth", f"{depth:.4f}", "--out", str(out), *further]) == 0
        images[name] = read_image(out) / 255
    assert 0.02 < np.sqrt(np.mean((images["near"] - images["far"]) ** 2)) < 0.3
    correlations = [np.corrcoef(images["phase"].ravel(), images[name].ravel())[0, 1] for name in ("near", "far")]
    assert 0.6 < correlations[0] < 0.999 and correlations[1] < correlations[0]


@pytest.mark.parametrize("blending", ["fast", "silhouette"])
def test_other_blending_resembles_exact_blending(blending, hologram, run, tmp_path):
    out = tmp_path / "other.npz"
    assert main(["wave", "hologram", str(run), "--camera", "test", "--blending", blending, "--out", str(out)]) == 0
    exact, other = (np.abs(load_hologram(path).fields) for path in (hologram, out))
    assert 1e-4 < np.sqrt(np.mean((exact - other) ** 2)) < 0.5 * np.sqrt(np.mean(exact**2))


def test_gaussians_are_flattened_and_it_is_said(run, tmp_path, capsys):
    g = make_gaussians(np.random.default_rng(3), 40, size=0.1)
    g.log_scales[:30] = np.log(0.1)
    save_ply(tmp_path / "point_cloud.ply", as_dtype(g, np.float32))
    arguments = ["--cameras", str(run / "cameras.json"), "--out", str(tmp_path / "h.npz")]
    assert main(["wave", "hologram", str(tmp_path / "point_cloud.ply"), *arguments]) == 0
    said = capsys.readouterr().out
    n_thick = int(re.search(r"flattened along their thinnest axes; (\d+) of them were no discs", said)[1])
    assert 25 < n_thick <= 40


def test_a_scene_of_millimetres_gives_the_same_hologram(hologram, run, tmp_path):
    g = make_gaussians(np.random.default_rng(3), 40, size=0.1, opacity_logit=2.0)
    g.log_scales[:, 2] = -12
    small = g._replace(means=g.means / 1024, log_scales=g.log_scales - np.log(1024))
    save_ply(tmp_path / "point_cloud.ply", as_dtype(small, np.float32), SURFELS)
    views = [Viewpoint("front", CAMERA, "test")]
    (tmp_path / "cameras.json").write_text(json.dumps(viewpoints.to_json(views)))
    assert main(["wave", "hologram", str(tmp_path), "--out", str(tmp_path / "h.npz")]) == 0
    large, found = load_hologram(hologram), load_hologram(tmp_path / "h.npz")
    assert_allclose(1024 * found.depths, large.depths, rtol=1e-5)
    assert np.abs(np.abs(found.fields) - np.abs(large.fields)).max() < 1e-3


# --- bad input ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--camera", "away"], "none of the 40 Gaussians is in front of the camera"),
        (["--camera", "nobody"], "has no camera 'nobody': choose from beside, test, away"),
        (["--wavelengths", "520"], "give three in nm, of red, green and blue light"),
        (["--pitch", "1"], r"light of 638 nm leave so steeply .* a pitch of [\d.]+ um fits"),
        (
            ["--pitch", "40", "--width", "0.384"],
            r"too coarse for the narrowest or steepest .* a pitch of [\d.]+ um fits",
        ),
        (["--width", "0.001"], "is less than a pixel of 8 um: give more"),
        (["--width", "1e6"], r"takes about .* --width [\d.]+ fits"),
    ],
)
def test_what_cannot_be_made_is_said_in_one_line(arguments, message, run, tmp_path, capsys):
    out = tmp_path / "none.npz"
    line = line_of(["wave", "hologram", run, "--out", out, *arguments], capsys)
    assert re.search(message, line), line
    assert not list(tmp_path.iterdir())


def test_the_pitch_that_fits_fits(run, tmp_path, capsys):
    """Both proposals, with the display's size as it was."""
    for pitch in ("1", "40"):
        arguments = ["wave", "hologram", run, "--out", tmp_path / "h.npz", "--width", "0.384"]
        line = line_of([*arguments, "--pitch", pitch, "--thickness", "6"], capsys)
        fits = re.search(r"a pitch of ([\d.]+) um fits", line)[1]
        assert main([str(a) for a in (*arguments, "--pitch", fits, "--thickness", "6")]) == 0


def test_cameras_are_needed(run, tmp_path, capsys):
    (tmp_path / "alone.ply").write_bytes((run / "point_cloud.ply").read_bytes())
    line = line_of(["wave", "hologram", tmp_path / "alone.ply", "--out", tmp_path / "h.npz"], capsys)
    assert "has no cameras.json beside it: give --cameras JSON" in line


def test_a_file_that_is_no_hologram(hologram, run, tmp_path, capsys):
    with np.load(hologram) as file:
        arrays = dict(file)
    np.savez(tmp_path / "short.npz", **{name: arrays[name] for name in ("real", "pitch")})
    np.savez(tmp_path / "flat.npz", **arrays | {"real": arrays["real"][0]})
    np.savez(tmp_path / "turned.npz", **arrays | {"depths": arrays["depths"][::-1]})
    wrong = {"short": "lacks imaginary, wavelengths", "flat": "is no hologram", "turned": "is no hologram"}
    for name, message in wrong.items():
        line = line_of(["wave", "focus", tmp_path / f"{name}.npz", "--depth", 3, "--out", tmp_path / "x.png"], capsys)
        assert message in line and "give a file of minisplat-ref wave hologram" in line
    line = line_of(["wave", "focus", hologram, "--depth", 0.05, "--out", tmp_path / "x.png"], capsys)
    assert "where light wraps around: the scene is between" in line
    assert not (tmp_path / "x.png").exists()
