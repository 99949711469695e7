"""Lens distortion: most renderers have only pinhole cameras, so pycolmap warps other photographs to a pinhole.

COLMAP chooses the pinhole: the same focal length, and the largest image without blank pixels. For renderers that
support the lens, :func:`lens_optics` describes it as :class:`minisplat_ref.types.Optics`.
"""

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import MASK_THRESHOLD
from minisplat_ref.types import Bools, Camera, Optics

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
POLYNOMIAL_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that are a pinhole if all distortion coefficients are zero."""


class Lens(NamedTuple):
    """A lens that is not a pinhole, in COLMAP's terms."""

    model: str
    """Name of a COLMAP camera model, or :data:`PARALLEL_MODEL`."""
    params: tuple[float, ...]
    """Its parameters in COLMAP's order, pixels."""

    @property
    def is_parallel(self) -> bool:
        """Whether its rays are parallel, so that no pinhole has its image."""
        return self.model == PARALLEL_MODEL


BROWN, FISHEYE, AFFINE = "brown", "fisheye", "affine"
PARALLEL_MODEL = "AFFINE"
"""The name of cameras with parallel rays in a transforms.json. Their parameters are fx, fy, cx, cy and those of optics.
"""
# Of each model the name of its optics, and where its parameters behind the focal lengths and the principal point go:
# k1 to k6, p1, p2, or k1 to k4.
COEFFICIENTS: Mapping[str, tuple[str, int, tuple[int, ...]]] = {
    "SIMPLE_RADIAL": (BROWN, 3, (0,)),
    "RADIAL": (BROWN, 3, (0, 1)),
    "OPENCV": (BROWN, 4, (0, 1, 6, 7)),
    "FULL_OPENCV": (BROWN, 4, (0, 1, 6, 7, 2, 3, 4, 5)),
    "OPENCV_FISHEYE": (FISHEYE, 4, (0, 1, 2, 3)),
    "SIMPLE_RADIAL_FISHEYE": (FISHEYE, 3, (0,)),
    "RADIAL_FISHEYE": (FISHEYE, 3, (0, 1)),
}
N_COEFFICIENTS = {BROWN: 8, FISHEYE: 4, "orthographic": 0, AFFINE: 5}


def lens_optics(lens: Lens, path: Path) -> Optics:
    """Return the optics of a lens of COLMAP; ``path`` is the photograph's, for the message.

    Raises
    ------
    InputError
        The model is not known.
    """
    if lens.is_parallel:
        return Optics(AFFINE, lens.params[4:])
    if lens.model not in COEFFICIENTS:
        raise InputError(
            f"{path}: camera model {lens.model} is not one of {', '.join(COEFFICIENTS)}, which are drawn as"
            " photographed; undistort the scene, or calibrate it with one of these"
        )
    name, n_pinhole, places = COEFFICIENTS[lens.model]
    coefficients = [0.0] * N_COEFFICIENTS[name]
    for place, value in zip(places, lens.params[n_pinhole:], strict=True):
        coefficients[place] = float(value)
    return Optics(name, tuple(coefficients))


def import_pycolmap() -> ModuleType:
    """Import pycolmap when it is first needed: it takes a while to load, and a few platforms have no wheel.

    Pillow must be loaded before, as it is by the imports of this module: pycolmap 4.2 exports its own zlib, and if
    it is loaded first, the system's zlib binds partly to it; the next PNG that Pillow writes then aborts the process.
    """
    try:
        import pycolmap
    except ImportError:
        raise InputError(
            "pycolmap, which reads COLMAP models and undistorts images, is not installed: pip install"
            " 'minisplat_ref[photos]', or describe the scene with a transforms.json"
        ) from None
    return pycolmap


def import_quiet_pycolmap() -> ModuleType:
    """Import pycolmap and switch off its log: errors come as exceptions or empty results."""
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    return pycolmap


def undistorted_pinhole(camera: Camera, lens: Lens) -> Camera:
    """Return the pinhole camera that :func:`undistort` gives, which does not depend on the photograph."""
    pycolmap = import_pycolmap()
    distorted = pycolmap.Camera(model=lens.model, width=camera.width, height=camera.height, params=lens.params)
    return _as_pinhole(camera, lens, pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), distorted))


def undistort(
    image: NDArray[np.uint8], mask: Bools | None, camera: Camera, lens: Lens
) -> tuple[NDArray[np.uint8], Bools | None, Camera]:
    """Warp a photograph and its mask to a pinhole camera with the same pose.

    Parameters
    ----------
    image : ndarray of shape (H, W, 3)
        uint8.
    mask : ndarray of shape (H, W) or None
        bool.
    camera : Camera
        Pose and size of the photograph.
    lens : Lens
        Its projection.

    Returns
    -------
    tuple
        Image [H', W', 3], mask [H', W'] or None, and the pinhole camera, of which H' and W' may differ from H and W.
    """
    pycolmap = import_pycolmap()
    distorted = pycolmap.Camera(model=lens.model, width=camera.width, height=camera.height, params=lens.params)
    options = pycolmap.UndistortCameraOptions()
    bitmap, pinhole = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(image), distorted)
    undistorted = _as_pinhole(camera, lens, pinhole)
    if mask is not None:
        white = pycolmap.Bitmap.from_array(mask.astype(np.uint8) * np.uint8(255))
        mask = pycolmap.undistort_image(options, white, distorted)[0].to_array() >= MASK_THRESHOLD
    return bitmap.to_array(), mask, undistorted


def _as_pinhole(camera: Camera, lens: Lens, pinhole: Any) -> Camera:
    """Return the camera with the intrinsics and the size of a ``pycolmap.Camera`` without distortion."""
    if pinhole.model.name not in PINHOLE_MODELS:
        raise InputError(
            f"camera model {lens.model} has no undistorted pinhole; cut pinhole views out of its images first"
        )
    return camera._replace(
        fx=pinhole.focal_length_x,
        fy=pinhole.focal_length_y,
        cx=pinhole.principal_point_x,
        cy=pinhole.principal_point_y,
        width=pinhole.width,
        height=pinhole.height,
    )
