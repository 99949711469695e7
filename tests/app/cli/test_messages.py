"""What a person is told of input that is odd but not broken: one line that says what it means for the run."""

import re
import shlex
import shutil
import struct
import warnings
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import ExifTags, Image

from minisplat_ref import Gaussians, io, save_ply
from minisplat_ref.app.cli import main, train_whole
from minisplat_ref.app.cli import sfm as sfm_command
from minisplat_ref.app.runs import first_use
from minisplat_ref.app.runs.notices import warn_of_model, warn_of_scene
from minisplat_ref.datasets import sfm
from minisplat_ref.datasets.photo_files import list_images
from minisplat_ref.datasets.sfm import attempts
from minisplat_ref.datasets.sfm.mapping import MAPPERS, Mapped
from minisplat_ref.datasets.sfm.photographs import Group
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io import images as images_module
from minisplat_ref.io import load_ply, load_scene, read_image
from minisplat_ref.io.images import PIXELS_MAX, image_size, is_turned, write_image
from minisplat_ref.io.upright import Up
from minisplat_ref.types import Model
from photo_scenes import HEIGHT, WIDTH, colored_image, write_colmap, write_transforms


def no_gaussians():
    zeros = np.zeros((0, 3))
    return Gaussians(zeros, np.zeros((0, 4)), zeros, zeros[:, 0], zeros, np.zeros((0, 0, 3)))


# photographs


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_turned_photograph(tmp_path, orientation):
    """The camera is of the upright image, the file holds it lying: turned, it would fit."""
    write_colmap(tmp_path)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    path = tmp_path / "images" / "0002.png"
    Image.fromarray(colored_image(2, HEIGHT, WIDTH)).save(path, exif=exif)
    assert is_turned(path) == (orientation in (6, 8))
    with pytest.raises(InputError, match=r"0002\.png: the image is 24x32 but its camera is 32x24[,;]") as caught:
        load_scene(tmp_path)
    assert ("EXIF data ask to turn it" in str(caught.value)) == is_turned(path)
    assert ("full-size" in str(caught.value)) != is_turned(path)


def test_photograph_beyond_the_limit_of_pillow(tmp_path, monkeypatch):
    """Pillow speaks of a bomb from 179 million pixels on, of which telephones take 200; here with a smaller limit."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 50)
    write_image(tmp_path / "a.png", colored_image(1))
    assert read_image(tmp_path / "a.png").shape == (HEIGHT, WIDTH, 3)
    assert Image.MAX_IMAGE_PIXELS == 50
    with pytest.raises(Image.DecompressionBombError):  # so that the limit is one
        Image.open(tmp_path / "a.png")


def png_that_claims(path, width, height):
    """Write a small PNG with another size in its header, its checksum to match."""
    write_image(path, colored_image(1))
    content = path.read_bytes()
    header = b"IHDR" + struct.pack(">II", width, height) + content[24:29]
    path.write_bytes(content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:])


def test_photograph_of_300_megapixels(tmp_path, monkeypatch):
    png_that_claims(tmp_path / "a.png", 20_000, 15_000)
    with pytest.raises(InputError, match=r"a\.png: 20000 x 15000 pixels cannot be in \d+ bytes; copy or export"):
        image_size(tmp_path / "a.png")
    monkeypatch.setattr(images_module, "PIXELS_PER_BYTE", 10**9)
    assert image_size(tmp_path / "a.png") == (20_000, 15_000)
    png_that_claims(tmp_path / "a.png", 40_000, 15_000)
    with pytest.raises(InputError, match=rf"40000 x 15000 pixels, more than the {PIXELS_MAX:,} that are read; make it"):
        image_size(tmp_path / "a.png")


def test_damaged_exif_data_are_no_warning(tmp_path):
    exif = b"II*\0\x08\0\0\0\xff\xff" + bytes(range(40))
    Image.fromarray(colored_image(1)).save(tmp_path / "a.jpg", exif=b"Exif\0\0" + exif)
    assert read_image(tmp_path / "a.jpg").shape == (HEIGHT, WIDTH, 3)  # a warning would be an error here
    assert not is_turned(tmp_path / "a.jpg")


def test_heic_is_read_where_pillow_heif_is_installed(tmp_path, monkeypatch):
    heif = pytest.importorskip("pillow_heif")
    photos = tmp_path / "photos"
    photos.mkdir()
    write_image(photos / "a.jpg", colored_image(1))
    heif.from_pillow(Image.fromarray(colored_image(2))).save(photos / "b.HEIC", quality=100)
    assert list_images(photos) == [photos / "a.jpg", photos / "b.HEIC"]
    assert np.abs(read_image(photos / "b.HEIC").astype(int) - colored_image(2)).max() <= 8  # it is not lossless
    monkeypatch.setattr(images_module, "find_spec", lambda name: None)
    with pytest.warns(
        InputWarning, match=r"leaving out 1 HEIC photographs \(b\.HEIC\): pip install 'minisplat_ref\[heic\]'"
    ):
        assert list_images(photos) == [photos / "a.jpg"]


def test_raw_photographs_are_named(tmp_path, capsys):
    for name in ("b.CR2", "c.dng", "notes.txt"):
        (tmp_path / "photos" / "d").mkdir(parents=True, exist_ok=True)
        (tmp_path / "photos" / name).write_bytes(b"raw")
    (tmp_path / "photos" / "d" / "e.nef").write_bytes(b"raw")
    message = r"but 3 photographs of formats that are not read \(b\.CR2, c\.dng, d/e\.nef\): convert them to JPEG"
    with pytest.raises(InputError, match=message):
        list_images(tmp_path / "photos")
    write_image(tmp_path / "photos" / "a.jpg", colored_image(1, 40, 32))
    with pytest.warns(InputWarning, match=r"leaving out 3 photographs of formats .* \(b\.CR2, c\.dng, d/e\.nef\): "):
        assert list_images(tmp_path / "photos") == [tmp_path / "photos" / "a.jpg"]
    assert main(["downscale", str(tmp_path / "photos")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("minisplat-ref: warning: ") and "b.CR2" in line
    for i in range(30):
        (tmp_path / "photos" / f"{i:02d}.arw").write_bytes(b"raw")
    with pytest.warns(InputWarning, match=r"leaving out 33 photographs .*, 19\.arw and 13 more\): convert"):
        list_images(tmp_path / "photos")


# scenes


def test_missing_frames_are_one_line_of_the_command(tmp_path, capsys):
    """Not Python's own form, which shows a line of our source."""
    write_transforms(tmp_path / "scene", n=5, fl_x=40.0)
    (tmp_path / "scene" / "images" / "0003.png").unlink()
    assert main(["info", str(tmp_path / "scene")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("minisplat-ref: warning: ")
    assert line.endswith("transforms.json: 1 of 5 images are missing and skipped: images/0003.png")


def test_other_warnings_keep_their_form(tmp_path, capsys, monkeypatch):
    def warn(path, *_):
        warnings.warn("of a library", UserWarning, stacklevel=1)
        warnings.warn("of ours", InputWarning, stacklevel=1)
        raise InputError(f"{path}: enough")

    shown = []
    monkeypatch.setattr(io, "list_scene", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", lambda message, *_: shown.append(str(message)))
        assert main(["info", str(tmp_path)]) == 2
    assert shown == ["of a library"]
    ours, last = capsys.readouterr().err.splitlines()
    assert ours == "minisplat-ref: warning: of ours" and last.endswith("enough")


def test_scene_without_points(tmp_path, recwarn):
    scene = load_scene(write_transforms(tmp_path, fl_x=40.0))
    with pytest.warns(InputWarning, match=r"has 0 sparse points: training begins with 100,000 random ones .* ply_file"):
        warn_of_scene(scene)
    with pytest.warns(InputWarning, match=r"has 0 sparse points: training begins with those that stereo finds"):
        warn_of_scene(scene, is_dense=True)
    points = np.random.default_rng(0).normal(size=(20, 3))
    with pytest.warns(InputWarning, match=r"has 4 sparse points: training begins with 4 Gaussians and has to find"):
        warn_of_scene(scene._replace(points=points[:4]))
    recwarn.clear()
    warn_of_scene(scene._replace(points=points))
    assert not recwarn.list


def test_photographs_of_a_few_pixels(tmp_path):
    scene = load_scene(write_colmap(tmp_path), downscale=1000)
    scene = scene._replace(points=np.zeros((20, 3)))
    with pytest.warns(InputWarning, match="are 1 x 1 pixels: give larger ones; from fewer than 16 x 16 hardly any"):
        warn_of_scene(scene)


def test_training_says_so(tmp_path, capsys, monkeypatch):
    scene = write_transforms(tmp_path / "scene", fl_x=40.0)
    monkeypatch.setattr(train_whole, "complete", lambda *_: 0)
    options = ["--recipe", "3dgs-accel", "--out", str(tmp_path / "out"), "--backend", "reference"]
    assert main(["train", str(scene), *options]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert all(line.startswith("minisplat-ref: warning: ") for line in lines)
    assert "sparse points" in lines[0]


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--downscale", "4"], "--downscale 4 leaves 8 x 6 pixels of a photograph, .*: give at most 1$"),
        (["--downscale", "1000"], "--downscale 1000 leaves 1 x 1 pixels of a photograph"),
        (["--set", "photometric=-1"], "--set photometric=-1: a weight of the loss is at least 0"),
    ],
)
def test_training_refuses(options, cause, tmp_path, capsys):
    scene = write_transforms(tmp_path / "scene", fl_x=40.0)
    assert main(["train", str(scene), *options, "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(cause, line) and not (tmp_path / "out").exists()


# Gaussians


def test_mesh(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    body = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    (tmp_path / "mesh.ply").write_text(f"{header}{faces}end_header\n{body}")
    with pytest.raises(InputError, match=r"no property f_dc_0.*; it is a mesh of 1 faces, which is not rendered: "):
        load_ply(tmp_path / "mesh.ply")
    (tmp_path / "cloud.ply").write_text(f"{header}end_header\n{body}")
    with pytest.raises(InputError, match="it is a point cloud: give it as a scene's points"):
        load_ply(tmp_path / "cloud.ply")


def test_no_gaussians(tmp_path, capsys):
    with pytest.warns(InputWarning, match=r"here holds no Gaussians: every image shows the background alone"):
        warn_of_model(Model(no_gaussians()), "here")
    save_ply(tmp_path / "a.ply", no_gaussians())
    options = ["--frames", "1", "--size", "8x6", "--background", "255,0,0", "--out", str(tmp_path / "out")]
    assert main(["render", str(tmp_path / "a.ply"), *options]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("minisplat-ref")]
    assert line.startswith(f"minisplat-ref: warning: {tmp_path / 'a.ply'} holds no Gaussians")
    (image,) = (tmp_path / "out").glob("*.png")
    assert (read_image(image) == [255, 0, 0]).all()


# kernels


def test_kernels_that_cannot_be_kept(tmp_path, monkeypatch, recwarn):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    with pytest.warns(InputWarning, match=r"file cannot be written: compiled kernels are not kept, .*; set NUMBA"):
        first_use.compile_kernels("cpu")
    first_use.warn_if_not_kept("reference")  # which has none
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    first_use.warn_if_not_kept("cpu")
    assert not recwarn.list


# structure from motion

GROUP = Group(1024, 768, "Maker A", 4.3, 35.0)
RESULT = sfm.SfmResult(
    n_photos=15,
    left_out=tuple(f"{i}.jpg" for i in range(7)),
    n_points=1234,
    error=0.5,
    kept=Mapped("global", "dense", None, 8, 1234, (4, 3), 990),
    others=(Mapped("incremental", "standard", None, 5, 800, (2,), 500), Mapped("global", "standard", None, 0, 0, ())),
    n_matches=1000,
    groups={GROUP: [f"{i}.jpg" for i in range(9)], Group(768, 1024, "", None, None): list("abcdef")},
    n_masks=2,
    sizes=((1600, 1200),) * 7 + ((1200, 1600),),
    up=Up(np.array([0.0, 0.0, 1.0]), "the plane of the ground among the points"),
)


def printed(capsys):
    """Return the lines but for one that depends on the PATH."""
    return [line for line in capsys.readouterr().out.splitlines() if not line.startswith("in a new terminal")]


def test_summary_of_a_scene_from_photographs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sfm, "run_sfm", lambda *_, **__: RESULT)
    monkeypatch.setattr(sfm_command, "_describe_exposures", lambda out: f"exposures of {out}")
    assert main(["sfm", "photos", "--out", "my scene"]) == 0
    *lines, advice, cameras, masks, up, exposures, sizes, following = printed(capsys)
    assert lines == [
        "my scene: 8 of 15 photographs (53%), 1234 points, reprojection error 0.50 px",
        "kept: global mapper with dense features: 8 photographs, 1234 points; explains 99% of the matches",
        "not kept: incremental mapper with standard features: 5 photographs, 800 points; explains 50% of the matches",
        "not kept: global mapper with standard features, which places no photographs",
        "without a place: 0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg, 5.jpg, 6.jpg",
        "groups that fit together, but not with the scene: of 4 and of 3 photographs",
    ]
    assert advice.startswith("what usually helps: more photographs between")
    assert cameras == (
        "one camera for each size, camera and focal length: 9 of 1024 x 768, Maker A, 4.3 mm, 35 mm on 35 mm film;"
        " 6 of 768 x 1024"
    )
    assert masks == "masks: of 2 photographs; no features were looked for where they are black"
    assert up == "up is 0.00,0.00,1.00, by the plane of the ground among the points (--up says it otherwise)"
    assert exposures == "exposures of my scene"
    assert sizes == (
        "photographs of 1600 x 1200 (7 of them) and 1200 x 1600 (1 of them) pixels; begin at 533 x 400, which a laptop"
        " trains in minutes"
    )
    folder = str(tmp_path / "my scene"), str(tmp_path / "runs" / "my scene")
    assert following.startswith("next: ")
    assert following.endswith(f" train {shlex.quote(folder[0])} --downscale 3 --out {shlex.quote(folder[1])}")


def test_summary_names_only_what_is_there(tmp_path, capsys, monkeypatch):
    plain = RESULT._replace(
        left_out=(), groups={GROUP: [f"{i}.jpg" for i in range(15)]}, n_masks=0, sizes=((480, 320),) * 15
    )
    monkeypatch.setattr(sfm, "run_sfm", lambda *_, **__: plain)
    monkeypatch.setattr(sfm_command, "_describe_exposures", lambda out: "exposures")
    assert main(["sfm", "photos", "--out", str(tmp_path / "scene")]) == 0
    first, kept, *others, _, _, sizes, following = printed(capsys)
    assert ": 15 of 15 photographs (100%), " in first
    assert kept.startswith("kept: ") and len(others) == 2
    assert sizes == "photographs of 480 x 320 pixels"
    assert "--downscale" not in following


@pytest.mark.parametrize("matching", sfm_command.MATCHINGS)
@pytest.mark.parametrize("n", [2, 3])
def test_hardly_any_photograph_finds_a_place(tmp_path, capsys, monkeypatch, matching, n):
    monkeypatch.setattr(attempts, "find_features", lambda *_: None)
    monkeypatch.setattr(attempts, "match_features", lambda *_: None)
    monkeypatch.setattr(attempts, "read_matches", lambda *_: [])
    results = [Mapped(name, "standard", SimpleNamespace(images={}), n, 9, ()) for name in MAPPERS]
    monkeypatch.setattr(attempts, "map_photographs", lambda *_: iter(results))
    (tmp_path / "photos").mkdir()
    for i in range(15):
        write_image(tmp_path / "photos" / f"{i}.png", colored_image(i))
    out = tmp_path / "out"
    options = ["--matching", matching, "--features", "standard"]
    assert main(["sfm", str(tmp_path / "photos"), "--out", str(out), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"photos: {n} of 15 photographs ({n / 15:.0%}) found a place, too few for a scene; " in line
    assert ("use --matching exhaustive" in line) == (matching == "sequential")
    assert not out.exists()


def test_photographs_of_two_places(shared_data, tmp_path, capsys):
    """Two of another scene among four that overlap: they find no place, and are named as they are called."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in (23, 24, 25, 38):
        shutil.copy(shared_data / "banana" / "images" / f"DSC_04{i}.jpg", photos)
    for i, name in enumerate(sorted((shared_data / "fox" / "images").iterdir())[:50:49]):
        shutil.copy(name, photos / f"fox{i}.JPEG")
    assert main(["sfm", str(photos), "--out", str(tmp_path / "scene"), "--long-side", "512"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert ": 4 of 6 photographs (67%), " in lines[0]
    assert "without a place: fox0.JPEG, fox1.JPEG" in lines
    assert sfm.advice("exhaustive") in lines
    assert len(load_scene(tmp_path / "scene", test_every=0).train_views) == 4
