"""The direction that is up in a scene, which neither photographs nor structure from motion know.

Where photographs were turned, the mean of what is up in their images is nothing. Four sources are tried, in the order
in which they are trusted:

1. EXIF orientation, where a camera has a sensor for it: its photographs have been turned upright.
2. The photographs, where all were held alike: up is at a right angle to their horizontal edges.
3. The plane of the ground, or of a table: many points lie on it, hardly any below, and the cameras are above.
4. The edges of all images, each of which is horizontal or vertical where cameras were turned by quarters of a circle.

A camera that looks along a direction does not show whether that direction is up; it counts by the square of the sine of
the angle between both.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.json_file import as_array, read_json
from minisplat_ref.types import Bools, Camera, Floats

FILE = "up.json"  # in the folder of a scene
# Numbers of ours, chosen on banana, lund, buddha, fox and snowmiku with photographs turned by hand:
ROLL_MAX = np.radians(20.0)  # of a camera that was held level, more or less
ALIKE_MIN = 0.5  # share of the cameras, weighed by their evidence, that were held level, if all were held alike
EVIDENCE_MIN = 0.1  # of a camera, in the mean: less where all look along the direction
HELD_MIN = 0.8  # of the share if they may have been turned
WALL_EVIDENCE, UPSIDE_DOWN_MAX = 1 / 3, 0.2  # of a wall: less than of a ground, and hardly any camera upside down
ALONG = 0.9  # an axis that is so nearly vertical is not turned into the horizontal
TINY = 1e-9
MINUS_Y = np.array([0.0, -1.0, 0.0])  # what is up where nothing else is known
GROUND_SHARE_MIN = 0.05  # of the points, on the plane
BELOW_MAX = 0.15  # of the points
ABOVE_MIN = 0.9  # of the cameras
TOLERANCE = 0.03  # of the points' median distance from their middle
N_PLANES, N_POINTS = 2000, 4000  # planes that are tried, points by which they are judged
N_DIRECTIONS = 20_000  # on a sphere, a degree and a half apart
N_CAMERAS = 200  # by which directions are judged; of more, some
MEAN_UP_WEIGHT = 0.02  # against the spread of horizontal edges, which is 1/2 all around and 0.1 along 70 degrees
SIDES = {"top": 0, "right": 1, "bottom": 2, "left": 3}
"""Quarters of a circle, clockwise, from the top of an image."""


class Up(NamedTuple):
    """What is up, and how it was found."""

    direction: Floats
    """[3] unit vector, world frame."""
    source: str
    """In a few words."""


UNKNOWN = Up(MINUS_Y, "the y axis, which points down")


def find_up(cameras: Sequence[Camera], points: Floats, is_level: Bools | None = None) -> Up:
    """Find the direction that is up.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the photographs, at least one.
    points : ndarray of shape (P, 3)
        Of the scene, world frame; P may be 0.
    is_level : ndarray of shape (V,), optional
        Photographs of which a sensor says that they are upright.
    """
    rotations = np.array([camera.cam_from_world_R for camera in cameras], np.float64)  # [V, 3, 3]
    if is_level is not None and is_level.sum() >= 2:
        return Up(common_up(rotations[is_level]), f"EXIF orientation of {is_level.sum()} photographs")
    alike = common_up(rotations)
    as_held, as_turned = (_agreement(rotations, alike, is_turned=is_turned) for is_turned in (False, True))
    evidence = float(_evidence(rotations, alike[None], is_turned=False)[0].mean())
    if evidence >= EVIDENCE_MIN and as_held >= max(ALIKE_MIN, HELD_MIN * as_turned):
        return Up(alike, "the photographs, which were all held alike")
    centers = np.array([camera.center for camera in cameras], np.float64)  # [V, 3]
    by_edges = _find_by_edges(rotations)
    ground = _find_ground(points, centers, rotations)
    if ground is not None and not _is_wall(ground, by_edges, rotations):
        return Up(ground, "the plane of the ground among the points")
    return Up(by_edges, "the edges of the images")


def choose_up(given: str | None, recorded: Up | None, views: Sequence[Any], points: Floats) -> Up | None:
    """Return what is up: as a person gives it, or else as it was recorded, or as cameras and points show.

    Parameters
    ----------
    given : str, optional
        As for :func:`given_up`.
    recorded : Up, optional
    views : sequence
        Of photographs or viewpoints, with ``name`` and ``camera``.
    points : ndarray of shape (P, 3)
        World frame.

    Returns
    -------
    Up or None
        None where nothing is given or recorded and there are no cameras.

    Raises
    ------
    InputError
        ``given`` makes no sense.
    """
    names, cameras = [view.name for view in views], [view.camera for view in views]
    if given is not None:
        return given_up(given, names, cameras)
    return recorded or (find_up(cameras, points) if cameras else None)


def common_up(rotations: Floats) -> Floats:
    """Return the direction [3] at a right angle to the horizontal edges of all images [V, 3, 3]."""
    rights, mean_up = rotations[:, 0], -rotations[:, 1].mean(axis=0)  # [V, 3], [3]
    # The mean itself leans towards an arc of cameras that look down; it decides where all edges are parallel.
    spread = rights.T @ rights / len(rights) - MEAN_UP_WEIGHT * np.outer(mean_up, mean_up)  # [3, 3]
    up = np.linalg.eigh(spread)[1][:, 0]  # of the smallest eigenvalue
    return np.copysign(1.0, up @ mean_up) * up


def quarter_turns(rotations: Floats, up: Floats) -> Any:
    """Return how many quarters of a circle, clockwise, lead from the top of each image [V, 3, 3] to what is up."""
    local = rotations @ up  # [V, 3]; of an upright image, its y is below 0
    return np.rint(np.arctan2(local[:, 0], -local[:, 1]) / (0.5 * np.pi)).astype(int) % 4  # [V]


def turn_upright(camera: Camera, up: Floats) -> Camera:
    """Return the camera turned about its axis by as many quarters of a circle as make its image most nearly upright.

    It shows the same: width and height change places where it was on its side. A lens is left as it is.
    """
    turns = int(quarter_turns(np.asarray(camera.cam_from_world_R, np.float64)[None], up)[0])
    for _ in range(turns):  # a quarter counter-clockwise: the right edge becomes the top
        x, y, z = camera.cam_from_world_R
        tx, ty, tz = camera.cam_from_world_t
        camera = camera._replace(
            cam_from_world_R=np.stack([y, -x, z]),
            cam_from_world_t=np.array([ty, -tx, tz]),
            fx=camera.fy,
            fy=camera.fx,
            cx=camera.cy,
            cy=camera.width - camera.cx,
            width=camera.height,
            height=camera.width,
        )
    return camera


def upright_rotation(up: Floats) -> Floats:
    """Return a rotation [3, 3] after which -y is up, as in the frame of photographs: to that from the world's."""
    down = -np.asarray(up, np.float64)
    across = np.eye(3)[0] if abs(down[0]) < ALONG else np.eye(3)[2]
    right = across - (across @ down) * down
    right /= np.linalg.norm(right)
    return np.stack([right, down, np.cross(right, down)])


def describe_up(up: Up) -> str:
    """Return the line that says what is up and how that was found."""
    x, y, z = up.direction
    return f"up is {x:.2f},{y:.2f},{z:.2f}, by {up.source} (--up says it otherwise)"


def _agreement(rotations: Floats, direction: Floats, *, is_turned: bool) -> float:
    """Return how far cameras agree that a direction is up, from 0 to 1: the share that was held level.

    Parameters
    ----------
    rotations : ndarray of shape (V, 3, 3)
    direction : ndarray of shape (3,)
        Unit vector, world frame.
    is_turned : bool
        Cameras may be turned by quarters of a circle.
    """
    weights, level = _evidence(rotations, direction[None], is_turned=is_turned)
    return float((weights * level).sum() / max(float(weights.sum()), TINY))


def _is_wall(plane: Floats, by_edges: Floats, rotations: Floats) -> bool:
    """Return whether the cameras looked straight at a plane whose normal [3] is not up: a wall, unlike a ground.

    The edges of their images then speak for another direction. They do so, too, where cameras looked down at a ground;
    but there some would have been held upside down.
    """
    of_plane, of_edges = (
        float(np.prod(_evidence(rotations, up[None], is_turned=True), axis=0).sum()) for up in (plane, by_edges)
    )
    is_upside_down = quarter_turns(rotations, by_edges) == 2
    return of_plane < WALL_EVIDENCE * of_edges and bool(is_upside_down.mean() < UPSIDE_DOWN_MAX)


def _evidence(rotations: Floats, directions: Floats, *, is_turned: bool) -> tuple[Floats, Floats]:
    """Return the weight of each camera for each direction, and how level it was held if that is up; both [D, V]."""
    local = np.einsum("vij,dj->dvi", rotations, directions)  # [D, V, 3]
    rolls = np.arctan2(local[..., 0], -local[..., 1])  # [D, V]
    if is_turned:
        quarter = 0.5 * np.pi
        rolls = (rolls + 0.5 * quarter) % quarter - 0.5 * quarter
    return local[..., 0] ** 2 + local[..., 1] ** 2, np.maximum(1.0 - np.abs(rolls) / ROLL_MAX, 0.0)


def _find_ground(points: Floats, centers: Floats, rotations: Floats) -> Floats | None:
    """Return the upward normal [3] of the plane of the ground; None where no plane is one."""
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)
    sample = points[rng.permutation(len(points))[:N_POINTS]].astype(np.float64)  # [Q, 3]
    tolerance = TOLERANCE * float(np.median(np.linalg.norm(sample - np.median(sample, axis=0), axis=1)))
    corners = sample[rng.integers(0, len(sample), (N_PLANES, 3))]  # [N_PLANES, 3 corners, 3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # [N_PLANES, 3]
    best, best_score = None, 0.0
    for place, normal in zip(corners[:, 0], normals, strict=True):
        if not (normal**2).sum() > 0:
            continue
        near = np.abs((sample - place) @ (normal / np.linalg.norm(normal))) < tolerance  # [Q]
        if near.mean() < 0.5 * GROUND_SHARE_MIN:
            continue
        middle = sample[near].mean(axis=0)
        fitted = np.linalg.svd(sample[near] - middle, full_matrices=False)[2][2]
        above = (centers - middle) @ fitted  # [V]
        fitted, above = (fitted, above) if np.median(above) > 0 else (-fitted, -above)
        heights = (sample - middle) @ fitted  # [Q]
        share = float((np.abs(heights) < tolerance).mean())
        is_ground = share >= GROUND_SHARE_MIN and (heights < -tolerance).mean() <= BELOW_MAX
        if share <= best_score or not is_ground or (above > 0).mean() < ABOVE_MIN:
            continue
        turns = quarter_turns(rotations, fitted)
        is_ceiling = (turns == 2).sum() > (turns == 0).sum()  # from below, photographs would be upside down
        score = share * (TINY + _agreement(rotations, fitted, is_turned=True))
        if score > best_score and not is_ceiling:
            best, best_score = fitted, score
    return best


def _find_by_edges(rotations: Floats) -> Floats:
    """Return the direction [3] to which the edges of most images are parallel or at a right angle."""
    rotations = rotations[:: -(-len(rotations) // N_CAMERAS)]
    directions = _sphere(N_DIRECTIONS)
    weights, level = _evidence(rotations, directions, is_turned=True)
    # Not the share: all cameras may look along a direction, which then has no evidence against it.
    up = directions[(weights * level).sum(axis=1).argmax()]
    turns = quarter_turns(rotations, up)
    n_upright, n_upside_down = (turns == 0).sum(), (turns == 2).sum()
    return up if n_upright >= n_upside_down else -up


def _sphere(n: int) -> Floats:
    """Return directions [n, 3] spread evenly over a sphere: a spiral whose steps are the golden angle."""
    k = np.arange(n) + 0.5
    z, angle = 1.0 - 2.0 * k / n, np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def given_up(text: str, names: Sequence[str], cameras: Sequence[Camera]) -> Up:
    """Return what a person says is up.

    Parameters
    ----------
    text : str
        X,Y,Z in the world frame; or the name of a photograph that was held upright; or that with the side that is up,
        such as ``IMG_2041:left``.
    names : sequence of str
        Of the photographs.
    cameras : sequence of Camera
        Theirs.

    Raises
    ------
    InputError
        It is neither.
    """
    parts = text.split(",")
    if len(parts) == 3:
        try:
            direction = np.array([float(part) for part in parts])
        except ValueError:
            direction = np.zeros(3)
        length = float(np.linalg.norm(direction))
        if not 0 < length < np.inf:
            raise InputError(f"--up {text} is no direction: give three numbers such as 0,-1,0, not all 0")
        return Up(direction / length, f"--up {text}")
    name, _, side = text.partition(":")
    stems = [Path(known).stem for known in names]
    if Path(name).stem not in stems or side not in ("", *SIDES):
        raise InputError(
            f"--up {text} is neither X,Y,Z nor one of the photographs, such as {', '.join(stems[:3]) or 'none'}; the"
            f" side that is up may follow it, as in NAME:left ({', '.join(SIDES)})"
        )
    rotations = np.array([camera.cam_from_world_R for camera in cameras], np.float64)  # [V, 3, 3]
    x, y, forward = rotations[stems.index(Path(name).stem)]
    upward = (-y, x, y, -x)[SIDES[side or "top"]]  # [3] in the image
    pitches = np.radians(np.arange(-75.0, 75.5, 0.5))
    directions = np.cos(pitches)[:, None] * upward + np.sin(pitches)[:, None] * forward  # [D, 3]
    weights, level = _evidence(rotations, directions, is_turned=True)
    return Up(directions[(weights * level).sum(axis=1).argmax()], f"--up {text}")


def up_to_json(up: Up) -> dict[str, Any]:
    """Return the content of a file."""
    return {"up": up.direction.tolist(), "source": up.source}


def up_from_json(value: Any, where: object) -> Up:
    """Return what :func:`up_to_json` has written; raise an InputError that names the place of anything else."""
    direction = as_array(value.get("up"), (3,)) if isinstance(value, Mapping) else None
    if direction is None or not 0 < float(np.linalg.norm(direction)) < np.inf:
        raise InputError(f"{where}: up is not a direction, three finite numbers: repair or remove it")
    return Up(direction / np.linalg.norm(direction), str(value.get("source", "a file")))


def read_up(scene: Path) -> Up | None:
    """Return what is recorded in the folder of a scene; None where nothing is.

    Raises
    ------
    InputError
        The file is damaged.
    """
    path = scene / FILE
    return up_from_json(read_json(path, "remove it"), path) if path.is_file() else None
