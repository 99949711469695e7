"""Metres instead of degrees, and the grid's axes: the universal transverse Mercator projection (UTM) of WGS 84.

By Krueger's series: with the third flattening n, the conformal latitude gives ``t = sinh(...)``, and::

    xi' = atan2(t, cos(dl)),   eta' = atanh(sin(dl) / sqrt(1 + t^2))
    E = E0 + k0 A (eta' + sum_j a_j cos(2 j xi') sinh(2 j eta'))
    N = N0 + k0 A (xi'  + sum_j a_j sin(2 j xi') cosh(2 j eta'))

dl is the longitude from the zone's central meridian. Terms to n^4 leave less than a micrometre within a zone.
"""

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats

RADIUS, FLATTENING, K0 = 6_378_137.0, 1 / 298.257223563, 0.9996  # of WGS 84 in metres, and of UTM
_N = FLATTENING / (2 - FLATTENING)
_A = RADIUS / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_SERIES = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440,
    61 * _N**3 / 240 - 103 * _N**4 / 140,
    49561 * _N**4 / 161280,
)


def grid_convergence(longitude: float, latitude: float, zone: int) -> float:
    """Return how far the grid's north is to the right of true north, degrees: ``atan(tan(dl) sin(phi))``.

    This is of a sphere, and off by less than 0.001 degrees within a zone.
    """
    dl, phi = np.radians(longitude - (6 * zone - 183)), np.radians(latitude)
    return float(np.degrees(np.arctan(np.tan(dl) * np.sin(phi))))


def sun_direction(azimuth: float, elevation: float, convergence: float) -> Floats:
    """Return the unit vector [3] towards the sun by the axes of the grid: east, north, up.

    Parameters
    ----------
    azimuth : float
        Degrees clockwise from true north; by the grid it is less by the convergence.
    elevation : float
        Degrees above the horizon.
    convergence : float
        From :func:`grid_convergence`.
    """
    a, e = np.radians(azimuth - convergence), np.radians(elevation)
    return np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])


def find_zone(longitude: float) -> int:
    """Return the zone, 1 to 60, of a longitude in degrees; the exceptions of Norway and Svalbard are left out."""
    return int((longitude + 180) // 6) % 60 + 1


def utm_from_degrees(longitudes: Floats, latitudes: Floats, zone: int, *, is_south: bool) -> Floats:
    """Return eastings and northings [N, 2] in metres.

    Parameters
    ----------
    longitudes, latitudes : ndarray of shape (N,)
        Degrees, WGS 84.
    zone : int
        1 to 60; points outside it are projected too, less exactly.
    is_south : bool
        Whether northings begin 10,000 km south of the equator.

    Raises
    ------
    InputError
        A latitude is not between -84 and 84 degrees, where UTM ends.
    """
    if not np.all(np.abs(latitudes) <= 84):
        raise InputError("a latitude is beyond 84 degrees, where UTM ends: satellite needs scenes in between")
    phi, dl = np.radians(latitudes), np.radians(longitudes - (6 * zone - 183))
    e = 2 * np.sqrt(_N) / (1 + _N)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(dl)), np.arctanh(np.sin(dl) / np.sqrt(1 + t * t))
    easting, northing = eta.copy(), xi.copy()
    for j, a in enumerate(_SERIES, start=1):
        easting += a * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
        northing += a * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
    return np.column_stack([500_000 + K0 * _A * easting, (1e7 if is_south else 0.0) + K0 * _A * northing])
