"""Photographs of every suffix that Pillow opens, panoramas, and files that are torn."""

import json
import shutil
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from data_tools.foreign_files.building import NAMES, OPTIONS, camera_names, command, done, refused, room
from data_tools.foreign_files.leftovers import as_transforms
from minisplat_ref.datasets.photo_files import list_images
from minisplat_ref.datasets.sfm.photographs import prepare_photos
from minisplat_ref.errors import InputWarning
from minisplat_ref.io import load_scene, read_image

LOSSY = {".jfif": "JPEG", ".jpe": "JPEG", ".insp": "JPEG", ".mpo": "MPO", ".avif": "AVIF", ".JFIF": "JPEG"}
EXACT = {".ppm": "PPM", ".tga": "TGA", ".bmp": "BMP", ".tif": "TIFF", ".qoi": "QOI", ".sgi": "SGI", ".pcx": "PCX"}
OTHERS = {".jp2": "JPEG2000", ".j2k": "JPEG2000", ".gif": "GIF", ".webp": "WEBP"}
SUFFIXES = LOSSY | EXACT | OTHERS
LEVELS = 12.0  # of 255, on average between a photograph and its copy of 256 colours or a lossy one
XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" %b</rdf:RDF></x:xmpmeta>'
)
AS_ATTRIBUTE = b'GPano:ProjectionType="%b" GPano:UsePanoramaViewer="True"/>'
AS_ELEMENT = b"><GPano:ProjectionType>%b</GPano:ProjectionType></rdf:Description>"


def _convert(scene: Path, suffix: str) -> list[NDArray]:
    """Give every photograph of a scene another format; return the pixels of before."""
    images = scene / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(".png", suffix))
    before = []
    for name in NAMES:
        file = scene / "images" / f"{name}.png"
        with Image.open(file) as image:
            before.append(np.asarray(image.convert("RGB")))
            image.convert("RGB").save(file.with_suffix(suffix), format=SUFFIXES[suffix], quality=95)
        file.unlink()
    return before


def _used(folder: Path, suffix: str) -> None:
    """They are photographs for every command: a scene, its inventory, downscaling, and preparation for COLMAP."""
    scene = room(folder)
    before = _convert(scene, suffix)
    views = load_scene(scene, test_every=0).train_views
    errors = [np.abs(view.image.astype(int) - image).mean() for view, image in zip(views, before, strict=True)]
    assert max(errors) <= (0 if suffix in EXACT else LEVELS), errors
    assert "8 of 8 photographs have cameras" in done("info", scene).out
    assert len(list_images(scene / "images")) == 8
    done("downscale", scene, "--downscale", 2)
    small = [read_image(file) for file in sorted((scene / "images_2").iterdir())]
    assert len(small) == 8 and all(image.shape[:2] == (18, 24) for image in small)


def _beside_others(folder: Path, suffix: str) -> None:
    """One in a folder of PNGs is used as they are."""
    scene = room(folder)
    with Image.open(scene / "images" / f"{NAMES[3]}.png") as image:
        image.convert("RGB").save(scene / "images" / f"other{suffix}", format=SUFFIXES[suffix])
    assert "8 of 9 photographs have cameras; without a camera: other" in done("info", scene).out
    assert len(prepare_photos(scene / "images", folder / "work", 1600).originals) == 9


def _in_transforms(folder: Path, suffix: str) -> None:
    """Frames without a suffix find them."""
    scene = room(folder)
    content = as_transforms(load_scene(scene))
    _convert(scene, suffix)
    shutil.rmtree(scene / "sparse")
    for frame in content["frames"]:
        frame["file_path"] = f"images/{Path(frame['file_path']).stem}"
    (scene / "transforms.json").write_text(json.dumps(content))
    assert len(load_scene(scene, test_every=0).train_views) == 8
    assert "8 of 8 photographs" in done("info", scene).out


def _named(folder: Path, name: str, says: str) -> None:
    """What looks like a photograph and is not used is named."""
    scene = room(folder)
    content = (scene / "images" / f"{NAMES[0]}.png").read_bytes()
    (scene / "images" / name).write_bytes(content)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert len(list_images(scene / "images")) == 8
    (warning,) = (str(warning.message) for warning in caught if warning.category is InputWarning)
    assert name in warning and says in warning, warning


def distorted(folder: Path) -> Path:
    """Return the room with a lens."""
    scene = room(folder)
    model = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    for camera in reconstruction.cameras.values():
        fx, _, cx, cy = camera.params
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [fx, cx, cy, 0.05]
    for file in model.iterdir():
        file.unlink()
    reconstruction.write_text(str(model))
    return scene


def _torn(folder: Path, share: float, is_colmap: bool) -> None:
    """A torn JPEG is refused by undistort as by train, which names it; nothing is left."""
    scene = distorted(folder)
    content = as_transforms(load_scene(scene, undistort=True), k1=0.05)
    _convert(scene, ".jpe")
    torn = scene / "images" / f"{NAMES[2]}.jpe"
    whole = torn.read_bytes()
    torn.write_bytes(whole[: int(share * len(whole))])
    if not is_colmap:
        shutil.rmtree(scene / "sparse")
        for frame in content["frames"]:
            frame["file_path"] = str(Path(frame["file_path"]).with_suffix(".jpe"))
        with Image.open(scene / "images" / f"{NAMES[1]}.jpe") as image:
            size = image.size
        (scene / "transforms.json").write_text(json.dumps({**content, "w": size[0], "h": size[1], "cx": 24, "cy": 18}))
    lines = [
        refused("train", scene, "--undistort", *OPTIONS, "--out", folder / "run", names=torn),
        refused("undistort", scene, "--out", folder / "flat", names=torn),
    ]
    assert lines[0] == lines[1] and not (folder / "flat").exists(), lines


def _undistorted(folder: Path, suffix: str) -> None:
    """An undistorted copy has photographs of every format, whether COLMAP writes it or not."""
    scene = distorted(folder)
    _convert(scene, suffix)
    expected = load_scene(scene, undistort=True, test_every=0).train_views
    done("undistort", scene, "--out", folder / "flat")
    found = load_scene(folder / "flat", test_every=0).train_views
    for view, other in zip(found, expected, strict=True):
        assert np.abs(view.image.astype(int) - other.image).mean() < LEVELS, view.name


def _panorama(folder: Path, projection: bytes, form: bytes, suffix: str) -> None:
    """A panorama is refused with the way out, by structure from motion and in a scene."""
    scene = room(folder)
    xmp = XMP % (form % projection)
    file = scene / "images" / f"{NAMES[1]}{suffix}"
    (scene / "images" / f"{NAMES[1]}.png").unlink()
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp.decode())
    Image.new("RGB", (96, 48)).save(file, **({"pnginfo": text} if suffix == ".png" else {"xmp": xmp}))
    line = refused("sfm", scene / "images", "--out", folder / "flat", names=file)
    assert "panorama" in line and "v360=e:flat" in line and not (folder / "flat").exists()
    images = scene / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(f"{NAMES[1]}.png", file.name))
    assert "panorama" in refused("train", scene, *OPTIONS, "--out", folder / "run", names=file)


def _flat_with_xmp(folder: Path) -> None:
    """A flat view that was cut out of a panorama, and says so, is a photograph."""
    scene = room(folder)
    for name in NAMES:
        with Image.open(scene / "images" / f"{name}.png") as image:
            image.convert("RGB").save(scene / "images" / f"{name}.jpg", xmp=XMP % (AS_ATTRIBUTE % b"rectilinear"))
        (scene / "images" / f"{name}.png").unlink()
    images = scene / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(".png", ".jpg"))
    done("train", scene, *OPTIONS, "--out", folder / "run")
    assert len(camera_names(folder / "run", "train")) == 6


def _masks(folder: Path) -> None:
    """Masks of other suffixes than .png are named as unused."""
    scene = room(folder)
    (scene / "images" / "masks").mkdir()
    for suffix in (".jpg", ".gif", ".bmp"):
        Image.new("L", (48, 36), 255).save(scene / "images" / "masks" / f"{NAMES[0]}{suffix}")
    said = command("sfm", scene / "images", "--out", folder / "scene")
    (warning,) = [warning for warning in said.warnings if "no photograph belongs to" in warning]
    assert all(f"{NAMES[0]}{suffix}" in warning for suffix in (".jpg", ".gif", ".bmp")), warning


CASES: dict[str, Callable[[Path], None]] = {
    **{f"photographs {suffix}": partial(_used, suffix=suffix) for suffix in SUFFIXES},
    **{f"one {suffix} beside .png": partial(_beside_others, suffix=suffix) for suffix in (".jfif", ".tga", ".gif")},
    **{f"frames {suffix}": partial(_in_transforms, suffix=suffix) for suffix in (".jpe", ".insp", ".jp2", ".ppm")},
    **{
        f"named: {name}": partial(_named, name=name, says=says)
        for name, says in (("a.jxl", "convert"), ("b.GPR", "convert"), ("c.img", "rename"), ("photo", "rename"))
    },
    **{
        f"torn at {share:g}, {'COLMAP' if is_colmap else 'transforms.json'}": partial(
            _torn, share=share, is_colmap=is_colmap
        )
        for share, is_colmap in ((0.7, True), (0.9, True), (0.98, True), (0.7, False))
    },
    **{f"undistorted {suffix}": partial(_undistorted, suffix=suffix) for suffix in (".jfif", ".insp", ".tga", ".gif")},
    **{
        f"panorama, {projection.decode()} in {suffix}": partial(
            _panorama, projection=projection, form=form, suffix=suffix
        )
        for projection, form, suffix in (
            (b"equirectangular", AS_ATTRIBUTE, ".jpg"),
            (b"Equirectangular", AS_ELEMENT, ".jpg"),
            (b"cylindrical", AS_ELEMENT, ".webp"),
            (b"equirectangular", AS_ATTRIBUTE, ".png"),
        )
    },
    "a flat view of a panorama": _flat_with_xmp,
    "masks of other suffixes": _masks,
}
