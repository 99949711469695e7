"""Files in and out: scenes of photographs, Gaussians, images."""

from collections.abc import Sequence
from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.io.colmap import MODEL_FOLDERS, find_model, list_colmap, load_colmap
from minisplat_ref.io.images import read_image, write_image
from minisplat_ref.io.inventory import warn_of_unused
from minisplat_ref.io.llff import POSES_BOUNDS, is_llff, list_llff
from minisplat_ref.io.other_places import refuse_other_scene
from minisplat_ref.io.ply import load_ply, load_points, save_ply
from minisplat_ref.io.scene import TEST_EVERY, Listing, build_reading, build_scene
from minisplat_ref.io.transforms import (
    BLENDER_FILES,
    SINGLE_FILE,
    find_transforms,
    list_transforms,
    load_transforms,
)
from minisplat_ref.types import Floats, Scene

__all__ = [
    "load_colmap",
    "load_ply",
    "load_points",
    "load_scene",
    "load_transforms",
    "read_image",
    "save_ply",
    "write_image",
]


def load_scene(
    path: str | Path,
    *,
    downscale: int = 1,
    test_every: int = TEST_EVERY,
    background: Sequence[float] | Floats | None = None,
    undistort: bool = False,
    as_photographed: bool = False,
    model: str | None = None,
    offset: int = 0,
) -> Scene:
    """Load a scene of photographs with cameras, whichever way it is described.

    Parameters
    ----------
    path : str or Path
        Folder of a COLMAP scene, of a transforms.json or of LLFF's poses_bounds.npy (the first of these that is there),
        or a transforms.json file.
    downscale, test_every, background, undistort, as_photographed
        See :func:`load_colmap` and :func:`load_transforms`.
    model : str, optional
        Folder of a COLMAP model, relative to ``path``, where there are several.
    offset : int
        Number, below ``test_every``, of the first photograph that is held out.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If there is nothing to load, or it cannot be loaded.

    Warns
    -----
    InputWarning
        Of what is in the folder and not used: photographs without a camera, masks that fit none, a larger model.
    """
    listing = list_scene(Path(path), test_every, model, offset)
    reading = build_reading(downscale, background, undistort, listing.alpha_is_mask, as_photographed)
    scene = build_scene(listing, reading)
    warn_of_unused(Path(path), scene, model)
    return scene


def list_scene(path: Path, test_every: int, model: str | None = None, offset: int = 0) -> Listing:
    """Return everything that :func:`load_scene` reads but the photographs; arguments and errors are the same."""
    if not path.exists():
        raise InputError(f"{path}: no such folder; give the folder of a scene")
    if path.is_file():
        refuse_other_scene(path)
    if find_model(path, model) is not None:
        return list_colmap(path, test_every, model, offset)
    if find_transforms(path):
        return list_transforms(path, test_every, offset)
    if is_llff(path):
        return list_llff(path, test_every, offset)
    if path.is_dir():
        refuse_other_scene(path)
    models = [f"{folder}/cameras.bin or .txt" for folder in MODEL_FOLDERS]
    raise InputError(
        f"{path}: no scene here, looked for {', '.join([*models, BLENDER_FILES[0], SINGLE_FILE, POSES_BOUNDS])};"
        " to make one from photographs run `minisplat-ref sfm PHOTOS --out SCENE`"
    )
