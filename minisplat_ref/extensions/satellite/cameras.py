"""From rational polynomials (:mod:`.rpc`) to affine cameras: metres of UTM (:mod:`.utm`), and the best fit.

World coordinates are metres of UTM from a centre, over a scale. Pixels and altitude of the sensor are affine in them
(EOGS, Sec. 3.1)::

    (u, v, h) ~ A x + b

by least squares over a grid of 31 x 37 pixels and 29 altitudes. A sensor 500 km away is all but affine: rays through a
scene of 500 m diverge by 0.001 radians. From an aircraft they do not fit, which :func:`fit_affine` refuses.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite.rpc import RPC, localise
from minisplat_ref.extensions.satellite.utm import find_zone, grid_convergence, utm_from_degrees
from minisplat_ref.types import Camera, Floats, Optics

GRID = (31, 37, 29)  # samples, lines, altitudes
MAX_RESIDUAL = 1.0  # pixels
AWAY = 4.0  # world units from a camera to the origin
MIN_ELEVATION = 1e-3  # radians of the sun above the horizon


class Frame(NamedTuple):
    """World coordinates: ``x = (utm, altitude) - origin) / scale``."""

    origin: Floats
    """[3] easting, northing, altitude; metres."""
    scale: float
    """Metres per world unit."""
    zone: int
    """Of UTM."""
    is_south: bool
    convergence: float = 0.0
    """Degrees by which the grid's north is to the right of true north, in the middle."""

    def to_json(self) -> dict[str, Any]:
        """Return what :meth:`from_json` reads."""
        return {**self._asdict(), "origin": self.origin.tolist()}

    @classmethod
    def from_json(cls, entries: Any) -> "Frame":
        """Return the frame of its entries; raise KeyError, TypeError or ValueError where they are not those."""
        origin, scale = np.array(entries["origin"], np.float64), float(entries["scale"])
        if origin.shape != (3,) or not np.isfinite(origin).all() or not 0 < scale < np.inf:
            raise ValueError("the origin is not of three numbers, or the scale is not above 0")
        return cls(origin, scale, int(entries["zone"]), bool(entries["is_south"]), float(entries["convergence"]))


class Fit(NamedTuple):
    """An affine camera, and its largest and root mean square distance from the sensor in pixels."""

    A: Floats
    """[3, 3] to pixels, pixels and metres of altitude above the frame's origin."""
    b: Floats
    """[3]."""
    worst: float
    rms: float


def check_altitudes(altitudes: tuple[float, float] | None) -> tuple[float, float]:
    """Return a range of altitudes.

    Raises
    ------
    InputError
        There is none, or it is empty.
    """
    if altitudes is None:
        raise InputError("an RPC sees a line, not a point: give the scene's altitudes, --altitudes LOW,HIGH in metres")
    low, high = altitudes
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(f"altitudes {low:g},{high:g} are no range: give the lower one first, --altitudes LOW,HIGH")
    return low, high


def fit_residual(
    world_of: Callable[[Floats, Floats], Floats], width: int, height: int, altitudes: tuple[float, float]
) -> Fit:
    """Fit an affine camera to a sensor, however far it is off.

    Parameters
    ----------
    world_of : callable
        ``world_of(pixels, altitudes)``: world points [N, 3] that pixels [N, 2] see at altitudes [N].
    width, height : int
        Image, pixels.
    altitudes : (low, high)
        Metres above the frame's origin.
    """
    axes = [np.linspace(0, stop, n) for stop, n in zip((width, height), GRID[:2], strict=True)]
    grid = np.stack(np.meshgrid(*axes, np.linspace(*altitudes, GRID[2]), indexing="ij"), axis=-1).reshape(-1, 3)
    x = world_of(grid[:, :2], grid[:, 2])
    solved, *_ = np.linalg.lstsq(np.column_stack([x, np.ones(len(x))]), grid, rcond=None)
    A, b = solved[:3].T, solved[3]
    off = np.linalg.norm((x @ A.T + b - grid)[:, :2], axis=1)
    return Fit(A, b, float(off.max()), float(np.sqrt(np.mean(off**2))))


def fit_affine(
    world_of: Callable[[Floats, Floats], Floats], width: int, height: int, altitudes: tuple[float, float], name: str
) -> Fit:
    """Fit an affine camera to a sensor; arguments as for :func:`fit_residual`, and the image's name for the message.

    Raises
    ------
    InputError
        A pixel of the grid is more than 1 pixel off.
    """
    fit = fit_residual(world_of, width, height, altitudes)
    if not fit.worst <= MAX_RESIDUAL:
        raise InputError(
            f"{name}: the affine camera that fits best leaves {fit.worst:.3g} pixels: crop the image, narrow the"
            " altitudes, or treat it as a perspective camera"
        )
    return fit


def choose_frame(rpcs: list[RPC], size: tuple[int, int], altitudes: tuple[float, float]) -> Frame:
    """Return the frame of a scene: centred on the middle of the first image, with a half diagonal of 1.

    The origin is at the lowest altitude, which the renderer assigns to nearly transparent pixels.

    Parameters
    ----------
    rpcs : list of RPC
        Of the images; the first is the reference.
    size : (width, height)
        Of the first image, pixels.
    altitudes : (low, high)
        Metres.
    """
    middle = sum(altitudes) / 2
    corners = np.array([[0.5, 0.5], [0, 0], [1, 1]]) * size
    ground = localise(rpcs[0], corners, np.full(3, middle))
    zone, is_south = find_zone(ground[0, 0]), bool(ground[0, 1] < 0)
    places = utm_from_degrees(ground[:, 0], ground[:, 1], zone, is_south=is_south)
    scale = float(np.linalg.norm(places[2] - places[1]) / 2)
    convergence = grid_convergence(ground[0, 0], ground[0, 1], zone)
    return Frame(np.array([*places[0], altitudes[0]]), scale, zone, is_south, convergence)


def fit_rpc(rpc: RPC, frame: Frame, size: tuple[int, int], altitudes: tuple[float, float], name: str) -> Fit:
    """Fit an affine camera to an RPC; arguments of :func:`choose_frame` and :func:`fit_affine`, altitudes absolute."""

    def world_of(pixels: Floats, heights: Floats) -> Floats:
        ground = localise(rpc, pixels, heights + frame.origin[2])
        places = utm_from_degrees(ground[:, 0], ground[:, 1], frame.zone, is_south=frame.is_south)
        return (np.column_stack([places, ground[:, 2]]) - frame.origin) / frame.scale

    low, high = (altitude - frame.origin[2] for altitude in altitudes)
    return fit_affine(world_of, *size, (low, high), name)


def make_affine_camera(A: Floats, b: Floats, scale: float, size: tuple[int, int], sun: Floats | None = None) -> Camera:
    """Return the camera of an affine map to pixels, with a rotation for its pose, as all cameras have one.

    With rows ``a_0`` and ``a_1`` of A, r of the rotation, and a shear s::

        f_x r_0 = a_0,   f_y (r_1 + s r_0) = a_1,   r_2 = r_0 x r_1, down

    The rays do not say how far away the camera is: it is :data:`AWAY` from the origin.

    Parameters
    ----------
    A : ndarray of shape (2, 3)
        Pixels per world unit.
    b : ndarray of shape (2,)
        Pixels.
    scale : float
        Metres per world unit; the world's z is up.
    size : (width, height)
        Image, pixels.
    sun : ndarray of shape (3,), optional
        World direction towards the sun, of any length; without one there are no shadows.

    Raises
    ------
    InputError
        The image is mirrored, or the sun does not shine from above.
    """
    fx = float(np.linalg.norm(A[0]))
    r0 = A[0] / fx
    across = A[1] - (A[1] @ r0) * r0
    fy = float(np.linalg.norm(across))
    R = np.stack([r0, across / fy, np.cross(r0, across / fy)])
    if not R[2, 2] < 0:  # True for NaN
        raise InputError("an image is mirrored, or not seen from above: flip it, together with its RPC")
    direction = np.zeros(3) if sun is None else np.asarray(sun, np.float64)
    if sun is not None and not direction[2] > MIN_ELEVATION * np.linalg.norm(direction):
        raise InputError("the sun is at the horizon or below: give a direction towards it, upwards")
    optics = Optics("affine", (float(A[1] @ r0) / fy, float(scale), *direction.tolist()))
    return Camera(R, np.array([0.0, 0.0, AWAY]), fx, fy, float(b[0]), float(b[1]), *size, optics)
