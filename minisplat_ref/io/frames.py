"""The frame in which a scene is trained: its files' own, unless float32 or the near plane would spoil it.

The renderer has constants in world units: Gaussians nearer than 0.01 or 0.2 are culled, and scales start from at least
3e-4. COLMAP's scenes are a few units large, and there these constants do no harm; in a scene of a few millimetres, in
metres, they cull everything. Parameters are float32: the last digit of a coordinate in UTM, at 5,000 km from the
origin, is half a metre. Such a scene is moved to the origin and scaled to a few units while it is in memory; all files
keep the coordinates of the scene. The unit is a power of two and the origin a whole number of units, so that nothing is
rounded on the way but float64's last digit, a nanometre in UTM. Scenes of ordinary size and place keep their frame, and
their bytes.
"""

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.io.json_file import as_array, as_number
from minisplat_ref.types import FILE_FRAME, Camera, Floats, Frame, Scene

EXTENT_MIN, EXTENT_MAX = 0.5, 1e4  # world units of ordinary scenes: 50 or 2.5 times the near planes, at least
EXTENT = 4.0  # others are scaled to these, within a factor of the square root of 2
# Extents from the origin to the cameras, in ordinary scenes. float32 has 24 bits: at 100 extents it resolves 6e-6 of
# an extent, a hundredth of a pixel of a photograph of 1,000.
DISTANCE_MAX = 100.0
SPREAD_MIN = 0.1  # like EXTENT_MIN, for Gaussians without a scene: their author knows the near plane


class Unit(Enum):
    """Transformation of an array's numbers with the frame."""

    PLACE = "coordinates"
    LENGTH = "lengths"
    LOG_LENGTH = "logarithms of lengths"


Units = Mapping[str, Unit]


def choose_frame(cameras: Sequence[Camera], extent: float) -> Frame:
    """Return the frame in which a scene is trained, :data:`FILE_FRAME` if it is of ordinary size and place.

    Parameters
    ----------
    cameras : sequence of Camera
        Training cameras.
    extent : float
        World units, as :attr:`Scene.extent`.
    """
    center = np.mean([camera.center for camera in cameras], axis=0)  # [3]
    return _frame(center, extent, EXTENT_MIN)


def frame_of_means(means: Floats) -> Frame:
    """Return the frame in which Gaussians without a scene are rendered.

    Their size is the distance from the median of the centres [N, 3] within which nine tenths of them are.
    """
    if not len(means):
        return FILE_FRAME
    means = means.astype(np.float64)
    center = np.median(means, axis=0)
    spread = float(np.quantile(np.linalg.norm(means - center, axis=1), 0.9))
    return _frame(center, spread, SPREAD_MIN)


def _frame(center: Floats, size: float, size_min: float) -> Frame:
    distance = float(np.linalg.norm(center))
    if not (0.0 < size < math.inf and distance < math.inf):
        return FILE_FRAME
    is_near, is_usual = distance <= DISTANCE_MAX * size, size_min <= size <= EXTENT_MAX
    unit = 1.0 if is_usual else 2.0 ** round(math.log2(size / EXTENT))
    if is_near:
        return FILE_FRAME._replace(unit=unit)
    x, y, z = (np.round(center / unit) * unit).tolist()
    return Frame((x, y, z), unit)


def describe_frame(frame: Frame) -> str:
    """Describe the place of a frame in half a sentence."""
    x, y, z = frame.origin
    moved = f"moved by ({-x:.10g}, {-y:.10g}, {-z:.10g})" if any(frame.origin) else ""
    scaled = f"scaled by {1.0 / frame.unit:g}" if frame.unit != 1.0 else ""
    return " and ".join(part for part in (moved, scaled) if part)


def place_camera(camera: Camera, frame: Frame) -> Camera:
    """Return a camera of the files in a frame: ``x_cam = R (o + u x') + t = u (R x' + (R o + t) / u)``."""
    if frame == FILE_FRAME:
        return camera
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    return camera._replace(cam_from_world_t=(R @ np.array(frame.origin) + t) / frame.unit)


def return_camera(camera: Camera, frame: Frame) -> Camera:
    """Return a camera of a frame as in the files."""
    if frame == FILE_FRAME:
        return camera
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    return camera._replace(cam_from_world_t=frame.unit * t - R @ np.array(frame.origin))


def place_points(points: Floats, frame: Frame) -> Floats:
    """Return points [P, 3] of the files in a frame; unchanged in :data:`FILE_FRAME`, else float64."""
    return points if frame == FILE_FRAME else (points.astype(np.float64) - np.array(frame.origin)) / frame.unit


def return_points(points: Floats, frame: Frame) -> Floats:
    """Return points [P, 3] of a frame as in the files, float64: ``origin + unit x``."""
    return np.array(frame.origin) + frame.unit * points.astype(np.float64)


def place_scene(scene: Scene, frame: Frame | None = None) -> Scene:
    """Return a scene in another frame.

    Parameters
    ----------
    scene : Scene
        In the frame of its files, as it was loaded.
    frame : Frame, optional
        By default the one that :func:`choose_frame` chooses.
    """
    assert scene.frame == FILE_FRAME, "the scene has been placed already"
    if frame is None:
        frame = choose_frame([view.camera for view in scene.train_views], scene.extent)
    if frame == FILE_FRAME:
        return scene
    train_views, test_views = (
        tuple(view._replace(camera=place_camera(view.camera, frame)) for view in views)
        for views in (scene.train_views, scene.test_views)
    )
    return scene._replace(
        train_views=train_views,
        test_views=test_views,
        points=place_points(scene.points, frame),
        extent=scene.extent / frame.unit,
        frame=frame,
        random_box=None if scene.random_box is None else place_points(scene.random_box, frame),
    )


def place_fields(fields: Mapping[str, Floats], units: Units, frame: Frame) -> dict[str, Floats]:
    """Return arrays of the files in a frame, float32 where they are or can be; the units of others do not matter."""
    return {name: _place(array, units.get(name), frame) for name, array in fields.items()}


def _place(array: Floats, unit: Unit | None, frame: Frame) -> NDArray:
    if unit is None or frame == FILE_FRAME:
        return array
    values = array.astype(np.float64)
    if unit is Unit.PLACE:
        values = (values - np.array(frame.origin)) / frame.unit
    elif unit is Unit.LENGTH:
        values = values / frame.unit
    else:
        values = values - math.log(frame.unit)
    return values.astype(array.dtype)


def return_fields(fields: Mapping[str, Floats], units: Units, frame: Frame) -> dict[str, Floats]:
    """Return arrays of a frame as in the files; coordinates in float64 if the origin has moved."""
    return {name: _return(array, units.get(name), frame) for name, array in fields.items()}


def _return(array: Floats, unit: Unit | None, frame: Frame) -> NDArray:
    if unit is None or frame == FILE_FRAME:
        return array
    values = array.astype(np.float64)
    if unit is Unit.PLACE:
        values = np.array(frame.origin) + frame.unit * values
        return values if any(frame.origin) else values.astype(array.dtype)
    if unit is Unit.LENGTH:
        return (frame.unit * values).astype(array.dtype)
    return (values + math.log(frame.unit)).astype(array.dtype)


def place_population(population: Any, units: Units, frame: Frame) -> Any:
    """Return a population of the files in a frame, in one precision: float32 unless the frame is the files' own.

    Parameters
    ----------
    population : NamedTuple of ndarray of shape (N, ...)
    units : mapping
        Of its fields; those that are not named do not change.
    frame : Frame
    """
    if frame == FILE_FRAME:
        return population
    placed = place_fields(population._asdict(), units, frame)
    return type(population)(**{name: array.astype(np.float32) for name, array in placed.items()})


def return_population(population: Any, units: Units, frame: Frame) -> Any:
    """Return a population of a frame as in the files; its centres are float64 if the origin has moved."""
    return type(population)(**return_fields(population._asdict(), units, frame))


def frame_to_json(frame: Frame) -> dict[str, Any]:
    """Return a frame as JSON holds it."""
    return {"origin": list(frame.origin), "unit": frame.unit}


def frame_from_json(value: Any) -> Frame | None:
    """Return the frame that :func:`frame_to_json` wrote, :data:`FILE_FRAME` for None; None if it is no frame."""
    if value is None:
        return FILE_FRAME
    entries = value if isinstance(value, dict) else {}
    origin, unit = as_array(entries.get("origin"), (3,)), as_number(entries.get("unit"))
    if origin is None or not np.isfinite(origin).all() or not 0 < unit < math.inf:
        return None
    x, y, z = origin.tolist()
    return Frame((x, y, z), unit)
