"""The affine camera that fits a sensor best, and its error (EOGS, Sec. 3.1).

World coordinates are metres of UTM from a centre, over a scale. Pixels and altitude of the sensor are affine in them::

    (u, v, h) ~ A x + b

by least squares over a grid of 31 x 37 pixels and 29 altitudes. A sensor 500 km away is all but affine: rays through a
scene of 500 m diverge by 0.001 radians. From an aircraft they do not fit, which :func:`fit_affine` refuses.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite.rpc import RPC, localise
from minisplat_ref.extensions.satellite.utm import utm_from_degrees, zone_of
from minisplat_ref.types import Camera, Floats, Optics

GRID = (31, 37, 29)  # samples, lines, altitudes
MAX_RESIDUAL = 1.0  # pixels
AFFINE = "affine"  # the name of these optics


class Frame(NamedTuple):
    """World coordinates: ``x = (utm, altitude) - origin) / scale``."""

    origin: Floats
    """[3] easting, northing, altitude; metres."""
    scale: float
    """Metres per world unit."""
    zone: int
    """Of UTM."""
    is_south: bool


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


def frame_of(rpcs: list[RPC], size: tuple[int, int], altitudes: tuple[float, float]) -> Frame:
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
    zone, is_south = zone_of(ground[0, 0]), bool(ground[0, 1] < 0)
    places = utm_from_degrees(ground[:, 0], ground[:, 1], zone, is_south=is_south)
    scale = float(np.linalg.norm(places[2] - places[1]) / 2)
    return Frame(np.array([*places[0], altitudes[0]]), scale, zone, is_south)


def fit_rpc(rpc: RPC, frame: Frame, size: tuple[int, int], altitudes: tuple[float, float], name: str) -> Fit:
    """Fit an affine camera to an RPC; arguments as for :func:`frame_of` and :func:`fit_affine`, altitudes absolute."""

    def world_of(pixels: Floats, heights: Floats) -> Floats:
        ground = localise(rpc, pixels, heights + frame.origin[2])
        places = utm_from_degrees(ground[:, 0], ground[:, 1], frame.zone, is_south=frame.is_south)
        return (np.column_stack([places, ground[:, 2]]) - frame.origin) / frame.scale

    low, high = (altitude - frame.origin[2] for altitude in altitudes)
    return fit_affine(world_of, *size, (low, high), name)


def camera_of(A: Floats, b: Floats, width: int, height: int, sun: Floats | None = None) -> Camera:
    """Return a camera of the affine map to pixels and altitude; the depth that orders is the negative altitude.

    Parameters
    ----------
    A : ndarray of shape (3, 3)
        Pixels, pixels and altitude per world unit.
    b : ndarray of shape (3,)
    width, height : int
        Image, pixels.
    sun : ndarray of shape (3,), optional
        World direction towards the sun, of any length; without one there are no shadows.

    Raises
    ------
    InputError
        The sun does not shine from above.
    """
    down = np.array([1.0, 1.0, -1.0])
    slopes: tuple[float, ...] = ()
    if sun is not None:
        g = A @ np.asarray(sun, np.float64)
        if not g[2] > 1e-3 * np.abs(A[2]).max() * np.linalg.norm(sun):
            raise InputError("the sun is at the horizon or below: give a direction towards it, upwards")
        slopes = float(g[0] / g[2]), float(g[1] / g[2])
    return Camera(down[:, None] * A, down * b, 1.0, 1.0, 0.0, 0.0, width, height, Optics(AFFINE, slopes))
