"""Satellite end to end: images with RPCs are trained, and a surface model is written; bad input."""

import contextlib
import io
import json
import re
import sys
import warnings

import numpy as np
import pytest
from test_satellite import make_rpc, text_of

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite.cameras import read_rpc
from minisplat_ref.extensions.satellite.commands import read_images, read_suns
from minisplat_ref.io import save_ply, write_image
from minisplat_ref.io.images import read_image
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import load_ply

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


@pytest.fixture(scope="module")
def trained(images, tmp_path_factory):
    """A run of three iterations, made opaque afterwards as a long one is, and what the command printed."""
    run, text = tmp_path_factory.mktemp("runs") / "run", io.StringIO()
    settings = ["--altitudes", "0,80", "--iterations", "3", "--points", "4000", "--out", str(run)]
    with contextlib.redirect_stdout(text):
        assert main(["satellite", "train", str(images), *settings]) == 0
    assert main(["satellite", "dsm", str(run), "--out", str(run / "none.npy")]) == 2  # nothing is opaque yet
    assert not (run / "none.npy").exists()
    g = load_ply(run / "point_cloud.ply")
    opaque = g._replace(opacity_logits=np.full_like(g.opacity_logits, 3.0), log_scales=g.log_scales + 0.7)
    save_ply(run / "point_cloud.ply", opaque, Label("satellite"))
    return run, text.getvalue()


def test_train_and_surface_model(trained, tmp_path):
    (run, printed), out = trained, tmp_path / "dsm.npy"
    assert "a.png: the affine camera is off by at most 0.0" in printed
    frame = json.loads((run / "satellite.json").read_text())
    assert frame["zone"] == 33 and frame["origin"][2] == 0
    assert main(["satellite", "dsm", str(run), "--out", str(out), "--gsd", "40"]) == 0
    heights = np.load(out)
    assert heights.shape == (round(2 * frame["scale"] / 40),) * 2
    highest = load_ply(run / "point_cloud.ply").means[:, 2].max() * frame["scale"]
    assert 60 < np.nanmin(heights) and np.nanmax(heights) < highest  # what fills the volume is seen from above
    assert out.with_suffix(".png").exists()


def test_points_fill_the_volume(images):
    """From the lowest altitude, which is the origin, to the highest."""
    scene, frame = read_images(images, (20.0, 80.0), 2000, 0)
    z = scene.points[:, 2] * frame["scale"] + frame["origin"][2]
    assert 20 <= z.min() < 21 and 79 < z.max() <= 80 and frame["origin"][2] == 20


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


@pytest.fixture(scope="module")
def geotiffs(images, tmp_path_factory):
    """The same images as GeoTIFFs with their RPCs in the metadata; skips without rasterio."""
    rasterio = pytest.importorskip("rasterio")
    from rasterio.rpc import RPC

    folder = tmp_path_factory.mktemp("tiffs")
    for name in ("a", "b"):
        r, image = read_rpc(images / f"{name}.png"), read_image(images / f"{name}.png")
        centre = dict(zip(("long_off", "lat_off", "height_off"), r.ground_offset.tolist(), strict=True))
        scale = dict(zip(("long_scale", "lat_scale", "height_scale"), r.ground_scale.tolist(), strict=True))
        sensor = {"samp_off": r.pixel_offset[0], "line_off": r.pixel_offset[1]}
        sensor |= {"samp_scale": r.pixel_scale[0], "line_scale": r.pixel_scale[1]}
        cubics = {"samp_num_coeff": r.numerators[0], "line_num_coeff": r.numerators[1]}
        cubics |= {"samp_den_coeff": r.denominators[0], "line_den_coeff": r.denominators[1]}
        numbers = {key: [float(v) for v in values] for key, values in cubics.items()}
        rpcs = RPC(**centre, **scale, **{k: float(v) for k, v in sensor.items()}, **numbers)
        write_geotiff(rasterio, folder / f"{name}.tif", image, rpcs=rpcs)
    return folder


def write_geotiff(rasterio, path, image, **tags):
    """Write an image [H, W, 3] of 8 bits."""
    shape = {"width": image.shape[1], "height": image.shape[0], "count": 3, "dtype": "uint8"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it has no transform yet
        with rasterio.open(path, "w", driver="GTiff", **shape, **tags) as file:
            file.write(image.transpose(2, 0, 1))


def test_rpc_of_a_geotiff(images, geotiffs):
    """GDAL's tags hold the text's numbers, to the digits that it writes."""
    for name in ("a", "b"):
        for found, expected in zip(read_rpc(geotiffs / f"{name}.tif"), read_rpc(images / f"{name}.png"), strict=True):
            assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


def test_geotiffs_from_images_to_surface_model(images, geotiffs, trained, tmp_path):
    """GeoTIFFs are read like images with texts; a .tif has the cells of the .npy, in their place on earth."""
    rasterio = pytest.importorskip("rasterio")
    run, _ = trained
    altitudes = (0.0, 80.0)
    of_tiffs, frame = read_images(geotiffs, altitudes, 10, 0)
    of_texts, _ = read_images(images, altitudes, 10, 0)
    for a, b in zip(of_tiffs.train_views, of_texts.train_views, strict=True):
        assert np.array_equal(a.image, b.image)
        assert np.abs(a.camera.cam_from_world_R - b.camera.cam_from_world_R).max() < 1e-6
    assert main(["satellite", "dsm", str(run), "--out", str(tmp_path / "d.npy"), "--gsd", "40"]) == 0
    assert main(["satellite", "dsm", str(run), "--out", str(tmp_path / "d.tif"), "--gsd", "40"]) == 0
    with rasterio.open(tmp_path / "d.tif") as file:
        assert file.crs.to_epsg() == 32633 and np.isnan(file.nodata)
        assert np.array_equal(file.read(1), np.load(tmp_path / "d.npy"), equal_nan=True)
        b = file.bounds
        middle = np.array([b.left + b.right, b.bottom + b.top]) / 2
        assert np.abs(middle - frame["origin"][:2]).max() < 1e-6  # the centre of the world
        assert file.transform.e < 0 < file.transform.a  # north is up


def test_geotiff_without_an_rpc_is_refused(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    write_geotiff(rasterio, tmp_path / "x.tif", np.ones((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"metadata have no RPC; put x_RPC\.TXT beside it"):
        read_rpc(tmp_path / "x.tif")


def test_geotiff_without_rasterio_is_refused(images, trained, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    out = tmp_path / "d.tif"
    assert main(["satellite", "dsm", str(trained[0]), "--out", str(out)]) == 2
    assert "a GeoTIFF needs rasterio: pip install 'minisplat-ref[satellite]'" in capsys.readouterr().err
    assert not out.exists()


def test_curved_rpc_is_refused_with_its_residual(images, tmp_path, capsys):
    """An RPC that bends over the image leaves more than a pixel; the run is not begun."""
    for name in ("a", "b"):
        (tmp_path / f"{name}.png").write_bytes((images / f"{name}.png").read_bytes())
        half = np.full(2, SIZE / 2)
        curved = make_rpc(0.04)._replace(pixel_offset=half, pixel_scale=half)
        (tmp_path / f"{name}_RPC.TXT").write_text(text_of(curved))
    run = tmp_path / "run"
    assert main(["satellite", "train", str(tmp_path), "--altitudes", "0,80", "--out", str(run)]) == 2
    assert re.search(r"a\.png: the affine camera that fits best leaves \d.* pixels: crop", capsys.readouterr().err)
    assert not run.exists()
