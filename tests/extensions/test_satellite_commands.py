"""Satellite end to end: images with RPCs become a scene, which is trained like any; a surface model; bad input."""

import io
import json
import re
import shutil
import sys
import warnings
from contextlib import redirect_stdout

import numpy as np
import pytest
from test_satellite import make_rpc, text_of

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite import scene as reading
from minisplat_ref.extensions.satellite.rpc import localise, read_rpc
from minisplat_ref.extensions.satellite.utm import utm_from_degrees
from minisplat_ref.io import load_ply, load_scene, save_ply, write_image
from minisplat_ref.io.images import read_image
from minisplat_ref.io.label import Label
from minisplat_ref.mechanisms.cameras.affine import downward
from run_commands import in_process

SIZE = 24
TRAIN = ["--recipe", "satellite", "--iterations", "3", "--test-every", "3"]


def write_rpcs(folder, curve=0.0):
    """Write an RPC for each of three images, which heights shift differently."""
    half = np.full(2, SIZE / 2)
    for k, name in enumerate(("a", "b", "c")):
        numerators = make_rpc(curve).numerators.copy()
        numerators[0, 3] += 0.1 * k
        r = make_rpc(curve)._replace(pixel_offset=half, pixel_scale=half, numerators=numerators)
        (folder / f"{name}_RPC.TXT").write_text(text_of(r))


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Three images of noise with RPCs, and suns for two."""
    folder, rng = tmp_path_factory.mktemp("city"), np.random.default_rng(0)
    write_rpcs(folder)
    for name in ("a", "b", "c"):
        write_image(folder / f"{name}.png", rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8))
    (folder / "suns.json").write_text(json.dumps({"a": [90, 45], "b": [180, 30]}))
    return folder


def make_scene(images, out, *further):
    """Run the command; return its exit code and what it printed."""
    text = io.StringIO()
    with redirect_stdout(text):
        code = main(["satellite", "scene", str(images), "--altitudes", "20,80", "--out", str(out), *further])
    return code, text.getvalue()


@pytest.fixture(scope="module")
def scene(images, tmp_path_factory):
    """The scene of the images, and what the command printed."""
    folder = tmp_path_factory.mktemp("scenes") / "city"
    code, printed = make_scene(images, folder, "--points", "4000")
    assert code == 0
    return folder, printed


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A run of three iterations, made opaque afterwards as a long one is."""
    run = tmp_path_factory.mktemp("runs") / "run"
    assert main(["train", str(scene[0]), *TRAIN, "--out", str(run)]) == 0
    assert main(["satellite", "dsm", str(run), "--out", str(run / "none.npy")]) == 2  # nothing is opaque yet
    assert not (run / "none.npy").exists()
    g = load_ply(run / "point_cloud.ply")
    opaque = g._replace(opacity_logits=np.full_like(g.opacity_logits, 3.0), log_scales=g.log_scales + 0.7)
    save_ply(run / "point_cloud.ply", opaque, Label("satellite"))
    return run


def test_scene(images, scene):
    """Cameras are those of the RPCs, suns are turned to the grid's north, and points fill the volume."""
    folder, printed = scene
    assert "a.png: the affine camera is off by at most 0.0" in printed
    assert "3 images (8 bits; 2 with a sun), 4,000 points" in printed
    place = reading.read_frame(folder)
    assert place.zone == 33 and place.origin[2] == 20
    found = load_scene(folder, test_every=3, as_photographed=True)
    assert [view.name for view in (*found.test_views, *found.train_views)] == ["a", "b", "c"]
    z = found.points[:, 2] * place.scale + place.origin[2]
    assert 20 <= z.min() < 21 and 79 < z.max() <= 80 and len(z) == 4000
    for view in (*found.test_views, *found.train_views):
        assert np.array_equal(view.image, read_image(images / f"{view.name}.png"))
        rpc, pixel = read_rpc(images / f"{view.name}.png"), np.array([[5.0, 17.0]])
        [ground] = localise(rpc, pixel, np.array([50.0]))
        utm = utm_from_degrees(ground[:1], ground[1:2], 33, is_south=False)[0]
        camera = downward(view.camera)
        seen = camera.cam_from_world_R @ ((np.array([*utm, 50.0]) - place.origin) / place.scale)
        assert np.abs(seen + camera.cam_from_world_t - [5, 17, -30]).max() < 0.01
    suns = {view.name: view.camera.optics.coefficients[2:] for view in (*found.test_views, *found.train_views)}
    turned = np.radians(90 - place.convergence)
    assert suns["a"] == pytest.approx(0.5**0.5 * np.array([np.sin(turned), np.cos(turned), 1]))
    assert -1.7 < place.convergence < -1.6 and suns["c"] == (0, 0, 0)  # 12.5 E is 2.5 degrees west of the meridian
    assert found.extent == pytest.approx(1, abs=0.2)  # about half the diagonal of an image


def test_a_training_is_a_run(scene, tmp_path, capsys):
    """It has a config, cameras, metrics and a report; it is measured again, rendered and continued."""
    run, other = tmp_path / "run", tmp_path / "other"
    assert main(["train", str(scene[0]), *TRAIN, "--out", str(run)]) == 0
    for name in ("config.json", "cameras.json", "metrics.json", "report.html", "shared.npz", "renders/a.png"):
        assert (run / name).is_file(), name
    assert main(["info", str(run)]) == main(["eval", str(run)]) == 0
    assert main(["render", str(run), "--cameras", str(run / "cameras.json"), "--out", str(tmp_path / "images")]) == 0
    again, first = read_image(tmp_path / "images" / "a.png"), read_image(run / "renders" / "a.png")
    assert np.array_equal(again, first[:, SIZE + 4 : 2 * SIZE + 4])  # beside the photograph; by cameras of a file
    half = [word if word != "3" else "2" for word in TRAIN[:4]] + TRAIN[4:]
    assert main(["train", str(scene[0]), *half, "--out", str(other)]) == 0
    assert main(["train", "--resume", str(other), "--iterations", "3"]) == 0
    assert json.loads((other / "metrics.json").read_text())["iterations"] == 3
    moved = tmp_path / "scene"
    shutil.copytree(scene[0], moved)
    content = json.loads((moved / "transforms.json").read_text())
    content["frames"][1]["sun"] = [0.1, 0.2, 1.0]
    (moved / "transforms.json").write_text(json.dumps(content))
    capsys.readouterr()
    assert main(["train", "--resume", str(other), "--iterations", "4", "--scene", str(moved)]) == 2
    assert "1 view (b) has moved" in capsys.readouterr().err


def test_other_commands_know_the_scene(scene, tmp_path, capsys, monkeypatch):
    """``info`` says what a focal length means, half the size is half the pixels, pinholes are refused."""
    folder, satellite = str(scene[0]), ["--recipe", "satellite"]
    assert main(["info", folder]) == 0
    assert "pixels per world unit" in capsys.readouterr().out
    whole, half = (load_scene(folder, downscale=d, as_photographed=True).train_views[0].camera for d in (1, 2))
    assert np.abs(downward(half).cam_from_world_R * [[2], [2], [1]] - downward(whole).cam_from_world_R).max() < 1e-9
    for command in (
        ["train", folder],
        ["train", folder, *satellite, "--undistort"],
        ["undistort", folder],
    ):
        assert main([*command, "--out", str(tmp_path / "none")]) == 2
        assert "train with --recipe satellite" in capsys.readouterr().err
        assert not (tmp_path / "none").exists()
    monkeypatch.setattr("minisplat_ref.app.comparison.runs.train_here", in_process)
    short = ["--iterations", "2", "--test-every", "3", "--out", str(tmp_path / "compared")]
    assert main(["compare", folder, "--recipes", "satellite", *short]) == 0


def test_surface_model(scene, trained, tmp_path):
    """Of what fills the volume the top is seen from above; the run says where its scene is, or the user does."""
    out, place = tmp_path / "dsm.npy", reading.read_frame(scene[0])
    assert main(["satellite", "dsm", str(trained), "--out", str(out), "--gsd", "40"]) == 0
    heights = np.load(out)
    assert heights.shape == (round(2 * place.scale / 40),) * 2
    highest = load_ply(trained / "point_cloud.ply").means[:, 2].max() * place.scale + 20
    assert 60 < np.nanmin(heights) and np.nanmax(heights) < highest
    assert out.with_suffix(".png").exists()
    content = json.loads((scene[0] / "transforms.json").read_text())
    content["utm"]["origin"][2] += 100
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    higher = ["--scene", str(tmp_path), "--out", str(tmp_path / "higher.npy")]
    assert main(["satellite", "dsm", str(trained), "--gsd", "40", *higher]) == 0
    assert np.allclose(np.load(tmp_path / "higher.npy"), heights + 100, equal_nan=True, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ([], "give the scene's altitudes, --altitudes LOW,HIGH"),
        (["--altitudes", "80,0"], "no range"),
        (["--altitudes", "1"], "give LOW,HIGH"),
        (["--altitudes", "0,80", "--bands", "1,2"], "give R,G,B"),
    ],
)
def test_altitudes_and_bands_are_asked_for(images, tmp_path, capsys, extra, message):
    out = tmp_path / "scene"
    assert main(["satellite", "scene", str(images), *extra, "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("suns", "message"),
    [
        ("[1]", "not {"),
        ('{"a": [90]}', "not {"),
        ('{"a": [90, 0]}', "the sun of a is not above the horizon"),
        ('{"a": [90, 91]}', "the sun of a is not above the horizon"),
        ('{"a.png": [90, 45]}', "there is no image a.png; names have no suffix: a, b"),
    ],
)
def test_bad_suns_are_refused(tmp_path, suns, message):
    (tmp_path / "suns.json").write_text(suns)
    with pytest.raises(InputError, match=re.escape(message)):
        reading.read_suns(tmp_path / "suns.json", ["a", "b"])


def test_bad_folders_are_refused(images, tmp_path, capsys):
    for command, message in (
        (["dsm", str(tmp_path), "--out", str(tmp_path / "x.npy")], "holds no run"),
        (["dsm", str(tmp_path), "--out", str(tmp_path / "x.png")], "a .npy or a .tif"),
        (
            ["dsm", str(tmp_path), "--scene", str(images), "--out", str(tmp_path / "x.npy")],
            "no scene of `satellite scene`",
        ),
        (["scene", str(tmp_path), "--altitudes", "0,1", "--out", str(tmp_path / "x")], "0 image(s)"),
        (["scene", str(tmp_path / "none"), "--altitudes", "0,1", "--out", str(tmp_path / "x")], "is not a folder"),
    ):
        assert main(["satellite", *command]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "transforms.json").write_text('{"frames": [], "utm": {"origin": [1, 2]}}')
    with pytest.raises(InputError, match="has no place on earth"):
        reading.read_frame(tmp_path)
    for name in ("a.png", "a.jpg", "b.png"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match="two images are called a"):
        reading.list_images(tmp_path)


def test_a_mirrored_image_is_named(images, tmp_path, capsys):
    shutil.copytree(images, tmp_path / "city")
    r = read_rpc(images / "b.png")
    (tmp_path / "city" / "b_RPC.TXT").write_text(text_of(r._replace(numerators=r.numerators * [[-1], [1]])))
    assert make_scene(tmp_path / "city", tmp_path / "scene")[0] == 2
    assert "b.png: an image is mirrored" in capsys.readouterr().err and not (tmp_path / "scene").exists()


# --- more than 8 bits ---


def test_levels_by_hand(monkeypatch):
    """Of 0 to 200 in two images, 1 and 199 are the percentiles; one line for both, to the nearest of 256 levels."""
    values = {k: np.repeat(np.arange(k, 201, 2, dtype=np.uint16)[:, None, None], 3, axis=2) for k in (0, 1)}
    monkeypatch.setattr(reading, "read_pixels", lambda path, bands: reading.Pixels(values[path], None))
    levels = reading.find_levels([0, 1], None)
    assert levels == (1, 199)
    found = reading.to_bytes(reading.Pixels(values[0], None), levels)[:, 0, 0]
    assert found.tolist() == [0] + [round(255 * (v - 1) / 198) for v in range(2, 200, 2)] + [255]


def test_of_large_images_every_so_many_values_count(monkeypatch):
    """Of 99 values, of which 10 are taken, every tenth: 0, 10 to 90; half a percent of 90 is 0.45."""
    values = np.arange(99, dtype=np.uint16).reshape(11, 3, 3)
    monkeypatch.setattr(reading, "N_SAMPLED", 10)
    monkeypatch.setattr(reading, "read_pixels", lambda *_: reading.Pixels(values, None))
    assert reading.find_levels(["x"], None) == pytest.approx((0.45, 89.55))


def test_pixels_without_data_do_not_count(monkeypatch):
    values = np.array([[[0.0], [5.0], [np.nan], [7.0]]]).repeat(3, axis=2)
    pixels = reading.Pixels(values, np.array([[False, True, False, True]]))
    monkeypatch.setattr(reading, "read_pixels", lambda *_: pixels)
    levels = reading.find_levels(["x"], None)
    assert levels == (5, 7)
    assert reading.to_bytes(pixels, levels)[0, :, 0].tolist() == [0, 0, 0, 255]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2, 3), np.uint16)), "x0 has 8 bits and x1 more"),
        ((np.ones((2, 2, 3), np.uint16),) * 2, "all pixels are 1"),
    ],
)
def test_bad_depths_are_refused(monkeypatch, tmp_path, values, message):
    paths = [tmp_path / f"x{k}" for k in (0, 1)]
    monkeypatch.setattr(reading, "read_pixels", lambda path, _: reading.Pixels(values[paths.index(path)], None))
    with pytest.raises(InputError, match=message):
        reading.find_levels(paths, None)


def test_sixteen_bits_need_rasterio(tmp_path, monkeypatch):
    """Pillow would keep the upper byte of a PNG, of 11 bits the upper three; gray ones it has in full, but alike."""
    from PIL import Image

    Image.fromarray(np.full((4, 4), 1000, np.uint16)).save(tmp_path / "x.png")
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(InputError, match="16 bits need rasterio"):
        reading.read_pixels(tmp_path / "x.png", None)


def test_sixteen_bits_share_a_scale(images, tmp_path):
    """Of GeoTIFFs of 11 bits with a band of infrared first; one is half as bright, and stays so. Borders are masked."""
    rasterio = pytest.importorskip("rasterio")
    shutil.copytree(images, tmp_path / "deep", ignore=shutil.ignore_patterns("*.png"))
    for name, factor in (("a", 1), ("b", 2), ("c", 1)):
        image = read_image(images / f"{name}.png").astype(np.uint16) * 4 // factor + 200
        image[:3], image[10, 10, 0] = 0, 0  # dark in one band is no hole
        bands = np.concatenate([np.full((SIZE, SIZE, 1), 7, np.uint16), image], axis=2)
        write_geotiff(rasterio, tmp_path / "deep" / f"{name}.tif", bands, nodata=0)
    assert make_scene(tmp_path / "deep", tmp_path / "scene", "--bands", "2,3,4")[0] == 0
    low, high = json.loads((tmp_path / "scene" / "transforms.json").read_text())["levels"]
    assert low == pytest.approx(200, abs=10) and high == pytest.approx(200 + 4 * 254, abs=15)
    found = load_scene(tmp_path / "scene", test_every=0, as_photographed=True)
    for view, factor in zip(found.train_views, (1, 2, 1), strict=True):
        stored = read_image(images / f"{view.name}.png").astype(int) * 4 // factor + 200
        stored[10, 10, 0] = 0
        expected = np.rint(np.clip((stored - low) / (high - low), 0, 1) * 255)
        assert np.array_equal(view.image[3:], expected[3:]) and not view.image[:3].any()
        assert view.mask[3:].all() and not view.mask[:3].any()
    code, _ = make_scene(tmp_path / "deep", tmp_path / "none", "--bands", "3,4,5")
    assert code == 2 and not (tmp_path / "none").exists()


@pytest.fixture(scope="module")
def geotiffs(images, tmp_path_factory):
    """The same images as GeoTIFFs with their RPCs in the metadata; skips without rasterio."""
    rasterio = pytest.importorskip("rasterio")
    from rasterio.rpc import RPC

    folder = tmp_path_factory.mktemp("tiffs")
    shutil.copy(images / "suns.json", folder)
    for name in ("a", "b", "c"):
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
    """Write an image [H, W, D]."""
    shape = {"width": image.shape[1], "height": image.shape[0], "count": image.shape[2], "dtype": image.dtype.name}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it has no transform yet
        with rasterio.open(path, "w", driver="GTiff", **shape, **tags) as file:
            file.write(image.transpose(2, 0, 1))


def test_rpc_of_a_geotiff(images, geotiffs):
    """GDAL's tags hold the text's numbers, to the digits that it writes."""
    for name in ("a", "b", "c"):
        for found, expected in zip(read_rpc(geotiffs / f"{name}.tif"), read_rpc(images / f"{name}.png"), strict=True):
            assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


def test_geotiffs_from_images_to_surface_model(geotiffs, scene, trained, tmp_path):
    """GeoTIFFs are read like images with texts; a .tif has the cells of the .npy, in their place on earth."""
    rasterio = pytest.importorskip("rasterio")
    assert make_scene(geotiffs, tmp_path / "scene", "--points", "10")[0] == 0
    read = (load_scene(folder, test_every=0, as_photographed=True) for folder in (tmp_path / "scene", scene[0]))
    for a, b in zip(*(found.train_views for found in read), strict=True):
        assert np.array_equal(a.image, b.image)
        assert np.abs(a.camera.cam_from_world_R - b.camera.cam_from_world_R).max() < 1e-6
    for name in ("d.npy", "d.tif"):
        assert main(["satellite", "dsm", str(trained), "--out", str(tmp_path / name), "--gsd", "40"]) == 0
    with rasterio.open(tmp_path / "d.tif") as file:
        assert file.crs.to_epsg() == 32633 and np.isnan(file.nodata)
        assert np.array_equal(file.read(1), np.load(tmp_path / "d.npy"), equal_nan=True)
        box = file.bounds
        middle = np.array([box.left + box.right, box.bottom + box.top]) / 2
        assert np.abs(middle - reading.read_frame(scene[0]).origin[:2]).max() < 1e-6  # the centre of the world
        assert file.transform.e < 0 < file.transform.a  # north is up


def test_geotiff_without_an_rpc_is_refused(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    write_geotiff(rasterio, tmp_path / "x.tif", np.ones((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"metadata have no RPC; put x_RPC\.TXT beside it"):
        read_rpc(tmp_path / "x.tif")


def test_geotiff_without_rasterio_is_refused(trained, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    out = tmp_path / "d.tif"
    assert main(["satellite", "dsm", str(trained), "--out", str(out)]) == 2
    assert "need rasterio: pip install 'minisplat-ref[satellite]'" in capsys.readouterr().err
    assert not out.exists()


def test_curved_rpc_is_refused_with_its_residual(images, tmp_path, capsys):
    """An RPC that bends over the image leaves more than a pixel; no scene is written."""
    shutil.copytree(images, tmp_path / "city")
    write_rpcs(tmp_path / "city", 0.04)
    assert make_scene(tmp_path / "city", tmp_path / "scene")[0] == 2
    assert re.search(r"a\.png: the affine camera that fits best leaves \d.* pixels: crop", capsys.readouterr().err)
    assert not (tmp_path / "scene").exists()
