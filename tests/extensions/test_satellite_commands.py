"""Satellite end to end: images with RPCs are trained, and a surface model is written; bad input."""

import json

import numpy as np
import pytest
from test_satellite import make_rpc, text_of

from minisplat_ref.cli import main
from minisplat_ref.extensions.satellite.claims import perspective_residual
from minisplat_ref.extensions.satellite.training import read_suns
from minisplat_ref.io import write_image

SIZE = 24


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Two images of noise with RPCs, and suns."""
    folder, rng = tmp_path_factory.mktemp("city"), np.random.default_rng(0)
    half = np.full(2, SIZE / 2)
    for k, name in enumerate(("a", "b")):
        write_image(folder / f"{name}.png", rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8))
        numerators = make_rpc().numerators.copy()
        numerators[0, 3] += 0.1 * k
        r = make_rpc()._replace(pixel_offset=half, pixel_scale=half, numerators=numerators)
        (folder / f"{name}_RPC.TXT").write_text(text_of(r))
    (folder / "suns.json").write_text(json.dumps({"a": [90, 45], "b": [180, 30]}))
    return folder


def test_train_and_surface_model(images, tmp_path, capsys):
    run, out = tmp_path / "run", tmp_path / "dsm.npy"
    settings = ["--altitudes", "0,80", "--iterations", "3", "--points", "4000", "--out", str(run)]
    assert main(["satellite", "train", str(images), *settings]) == 0
    assert "a.png: the affine camera is off by at most 0.0" in capsys.readouterr().out
    frame = json.loads((run / "satellite.json").read_text())
    assert frame["zone"] == 33 and frame["origin"][2] == 40
    assert main(["satellite", "dsm", str(run), "--out", str(out), "--gsd", "40"]) == 0
    heights = np.load(out)
    assert heights.shape == (round(2 * frame["scale"] / 40),) * 2
    assert 0 < np.nanmin(heights) and np.nanmax(heights) < 80
    assert out.with_suffix(".png").exists()


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ([], "give the scene's altitudes, --altitudes LOW,HIGH"),
        (["--altitudes", "80,0"], "no range"),
        (["--altitudes", "1"], "give LOW,HIGH"),
    ],
)
def test_altitudes_are_asked_for(images, tmp_path, capsys, extra, message):
    run = tmp_path / "run"
    assert main(["satellite", "train", str(images), *extra, "--out", str(run)]) == 2
    assert message in capsys.readouterr().err
    assert not run.exists()


def test_bad_models_and_suns(tmp_path, capsys):
    assert main(["satellite", "dsm", str(tmp_path), "--out", str(tmp_path / "x.npy")]) == 2
    assert "give the folder that `satellite train` wrote" in capsys.readouterr().err
    assert main(["satellite", "dsm", str(tmp_path), "--out", str(tmp_path / "x.png")]) == 2
    assert "a .npy or a .tif" in capsys.readouterr().err
    (tmp_path / "suns.json").write_text('{"a": [0, 90], "b": [90, 0]}')
    suns = read_suns(tmp_path / "suns.json")
    assert np.abs(suns["a"] - [0, 0, 1]).max() < 1e-12 and np.abs(suns["b"] - [1, 0, 0]).max() < 1e-12


def test_residuals_grow_as_the_distance_shrinks():
    """Ten times nearer, ten times worse; 11.8 pixels from 5 km, and three times that at a slant."""
    near, far = (perspective_residual(distance, 0.0) for distance in (5e3, 50e3))
    assert near == pytest.approx(10 * far, rel=0.02) and near == pytest.approx(11.8, abs=0.1)
    assert perspective_residual(5e3, 25.0) > 2 * near
