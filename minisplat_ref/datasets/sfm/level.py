"""What is up in a scene that structure from motion has made: recorded beside it, for whatever shows it.

Copies of photographs are upright as far as their EXIF orientation says so. A camera without a sensor writes the same
value, or none, however it is held; its orientation counts only if one of its photographs was turned.
"""

import json
from pathlib import Path

import numpy as np
from PIL import ExifTags

from minisplat_ref.datasets.sfm.photographs import CAMERA_TAGS, Photographs
from minisplat_ref.io import list_scene
from minisplat_ref.io.images import open_image
from minisplat_ref.io.upright import FILE, Up, find_up, given_up, up_to_json

AS_STORED = 1  # the orientation of a photograph that needs no turning


def record_up(scene: Path, photographs: Photographs, given: str | None) -> Up:
    """Find what is up, write it into the folder of a scene, and return it.

    Parameters
    ----------
    scene : Path
        The undistorted scene.
    photographs : Photographs
        Of which it was made.
    given : str, optional
        What a person says is up (:func:`minisplat_ref.io.upright.given_up`).

    Raises
    ------
    InputError
        ``given`` makes no sense.
    """
    listing = list_scene(scene, 0)
    photos = listing.train_photos
    names, cameras = [photo.file for photo in photos], [photo.camera for photo in photos]
    if given is not None:
        up = given_up(given, names, cameras)
    else:
        level = upright_by_sensor(photographs)
        up = find_up(cameras, listing.points, np.array([name in level for name in names]))
    (scene / FILE).write_text(json.dumps(up_to_json(up), indent=2) + "\n", encoding="utf-8")
    return up


def upright_by_sensor(photographs: Photographs) -> frozenset[str]:
    """Return the names of the copies that are upright by the sensor of their camera."""
    orientations: dict[str, tuple[str, int]] = {}
    for name, original in photographs.originals.items():
        with open_image(photographs.source / original) as image:
            exif = image.getexif()
            camera = " ".join(str(exif.get(tag, "")) for tag in CAMERA_TAGS)
            orientations[name] = camera, exif.get(ExifTags.Base.Orientation, AS_STORED)
    with_sensor = {camera for camera, orientation in orientations.values() if orientation != AS_STORED}
    return frozenset(name for name, (camera, _) in orientations.items() if camera in with_sensor)
