"""From the cameras of satellites to affine ones: rational polynomials (RPC00B), metres of UTM, and the best fit.

Longitude, latitude and height, each minus an offset and over a scale, are L, P, H. Line and sample of the image are
ratios of cubics of them::

    line = (a . m(P, L, H)) / (b . m(P, L, H)) LINE_SCALE + LINE_OFF,   sample likewise by c and d

m has 20 monomials, so a camera has 80 coefficients. They are in a GeoTIFF's metadata, in a text ``_RPC.TXT`` or in an
``.RPB`` of the same numbers. Pixel (0, 0) of an RPC is the centre of the first pixel; here its centre is at 0.5.

Metres instead of degrees are those of the universal transverse Mercator projection of WGS 84, by Krueger's series. With
the third flattening n, the conformal latitude gives ``t = sinh(...)``, and::

    xi' = atan2(t, cos(dl)),   eta' = atanh(sin(dl) / sqrt(1 + t^2))
    E = E0 + k0 A (eta' + sum_j a_j cos(2 j xi') sinh(2 j eta'))
    N = N0 + k0 A (xi'  + sum_j a_j sin(2 j xi') cosh(2 j eta'))

dl is the longitude from the zone's central meridian. Terms to n^4 leave less than a micrometre within a zone.

World coordinates are metres of UTM from a centre, over a scale. Pixels and altitude of the sensor are affine in them
(EOGS, Sec. 3.1)::

    (u, v, h) ~ A x + b

by least squares over a grid of 31 x 37 pixels and 29 altitudes. A sensor 500 km away is all but affine: rays through a
scene of 500 m diverge by 0.001 radians. From an aircraft they do not fit, which :func:`fit_affine` refuses.
"""

import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError, one_line
from minisplat_ref.types import Camera, Floats, Optics

# Powers of (L, P, H) of the 20 monomials, in the order of RPC00B.
_POWERS = np.array(
    [
        [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [2, 0, 0], [0, 2, 0], [0, 0, 2],
        [1, 1, 1], [3, 0, 0], [1, 2, 0], [1, 0, 2], [2, 1, 0], [0, 3, 0], [0, 1, 2], [2, 0, 1], [0, 2, 1], [0, 0, 3],
    ]
)  # fmt: skip
N_NEWTON = 20  # steps at most; four are usual
MAX_MISS = 1e-6  # pixels by which a localisation may miss

RASTERS = (".tif", ".tiff", ".jp2", ".ntf", ".nitf")  # whose metadata may hold an RPC, and which rasterio reads

_RPB_NAMES = {
    "lineOffset": "LINE_OFF",
    "sampOffset": "SAMP_OFF",
    "latOffset": "LAT_OFF",
    "longOffset": "LONG_OFF",
    "heightOffset": "HEIGHT_OFF",
    "lineScale": "LINE_SCALE",
    "sampScale": "SAMP_SCALE",
    "latScale": "LAT_SCALE",
    "longScale": "LONG_SCALE",
    "heightScale": "HEIGHT_SCALE",
    "lineNumCoef": "LINE_NUM_COEFF",
    "lineDenCoef": "LINE_DEN_COEFF",
    "sampNumCoef": "SAMP_NUM_COEFF",
    "sampDenCoef": "SAMP_DEN_COEFF",
}

RADIUS, FLATTENING, K0 = 6_378_137.0, 1 / 298.257223563, 0.9996  # of WGS 84 in metres, and of UTM
_N = FLATTENING / (2 - FLATTENING)
_A = RADIUS / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_SERIES = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440,
    61 * _N**3 / 240 - 103 * _N**4 / 140,
    49561 * _N**4 / 161280,
)

GRID = (31, 37, 29)  # samples, lines, altitudes
MAX_RESIDUAL = 1.0  # pixels
AWAY = 4.0  # world units from a camera to the origin
MIN_ELEVATION = 1e-3  # radians of the sun above the horizon


class RPC(NamedTuple):
    """A rational polynomial camera."""

    ground_offset: Floats
    """[3] longitude and latitude in degrees, height in metres above the ellipsoid."""
    ground_scale: Floats
    """[3] likewise."""
    pixel_offset: Floats
    """[2] sample and line."""
    pixel_scale: Floats
    """[2] likewise."""
    numerators: Floats
    """[2, 20] of sample and line."""
    denominators: Floats
    """[2, 20]."""


def project(rpc: RPC, ground: Floats) -> Floats:
    """Return pixels [N, 2] of points [N, 3] of longitude, latitude and height; pixel centres are at 0.5."""
    m, _ = _monomials((ground - rpc.ground_offset) / rpc.ground_scale)
    ratios = (m @ rpc.numerators.T) / (m @ rpc.denominators.T)
    pixels: Floats = ratios * rpc.pixel_scale + rpc.pixel_offset + 0.5
    return pixels


def localise(rpc: RPC, pixels: Floats, heights: Floats) -> Floats:
    """Return the points [N, 3] that pixels see at given heights: Newton's method, from the middle of the RPC.

    With ``f = p / q``, ``J = (J_p - f J_q) / q``, of which the columns of longitude and latitude are inverted.

    Parameters
    ----------
    rpc : RPC
    pixels : ndarray of shape (N, 2)
        Pixel centres at 0.5.
    heights : ndarray of shape (N,)
        Metres.

    Raises
    ------
    InputError
        A pixel has no such point, because the polynomials are used far outside their range.
    """
    wanted = (pixels - 0.5 - rpc.pixel_offset) / rpc.pixel_scale
    x = np.zeros((len(pixels), 3))
    x[:, 2] = (heights - rpc.ground_offset[2]) / rpc.ground_scale[2]
    with np.errstate(all="ignore"):  # points that do not converge are refused below
        for _ in range(N_NEWTON):
            m, dm = _monomials(x)
            q = m @ rpc.denominators.T  # [N, 2]
            f = (m @ rpc.numerators.T) / q
            miss = wanted - f
            if np.all(np.abs(miss * rpc.pixel_scale) < MAX_MISS):
                ground: Floats = x * rpc.ground_scale + rpc.ground_offset
                return ground
            J = (dm @ rpc.numerators.T - f[:, None] * (dm @ rpc.denominators.T)) / q[:, None]  # [N, 3, 2]
            (a, b), (c, d) = J[:, 0].T, J[:, 1].T  # rows: d/dL, d/dP
            det = a * d - b * c
            x[:, 0] += (d * miss[:, 0] - c * miss[:, 1]) / det
            x[:, 1] += (a * miss[:, 1] - b * miss[:, 0]) / det
    raise InputError("an RPC cannot be inverted over the image and the altitudes: give altitudes within its range")


def _monomials(x: Floats) -> tuple[Floats, Floats]:
    """Return m [N, 20] at normalised points [N, 3], and its derivatives [N, 3, 20]."""
    powers = x[:, None, :] ** np.arange(4)[:, None]  # [N, 4, 3]
    factors = [powers[:, _POWERS[:, k], k] for k in range(3)]
    derivatives = [_POWERS[:, k] * powers[:, np.maximum(_POWERS[:, k] - 1, 0), k] for k in range(3)]
    m = factors[0] * factors[1] * factors[2]
    by = [derivatives[k] * factors[k - 1] * factors[k - 2] for k in range(3)]
    return m, np.stack(by, axis=1)


def read_rpc(path: str | Path) -> RPC:
    """Return the RPC of an image: from its GeoTIFF metadata, or from a text that is given or lies beside it.

    Parameters
    ----------
    path : str or Path
        A ``.TXT`` or ``.RPB``, or an image, beside which ``NAME_RPC.TXT`` or ``NAME.RPB`` is looked for first.

    Raises
    ------
    InputError
        There is none, or it lacks a number; or it is in a GeoTIFF and rasterio is not installed.
    """
    path = Path(path)
    if path.suffix.lower() in (".txt", ".rpb"):
        return parse_rpc(_read_text(path), path)
    for end in ("_RPC.TXT", "_rpc.txt", ".RPB", ".rpb"):
        beside = path.with_name(path.stem + end)
        if beside.exists():
            return parse_rpc(_read_text(beside), beside)
    if path.suffix.lower() not in RASTERS:
        raise InputError(f"{path}: no RPC; put {path.stem}_RPC.TXT beside it")
    with open_raster(path) as file:
        tags = file.tags(ns="RPC")
    if not tags:
        raise InputError(f"{path}: its metadata have no RPC; put {path.stem}_RPC.TXT beside it")
    return _make_rpc({name: _floats(str(text)) for name, text in tags.items()}, path)


@contextmanager
def open_raster(path: Path) -> Iterator[Any]:
    """Open an image by rasterio.

    Raises
    ------
    InputError
        It is damaged or in an unknown format, or rasterio is not installed.
    """
    rasterio = import_rasterio(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # its RPC is its place
            with rasterio.open(path) as file:
                yield file
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{path}: cannot be read, {one_line(str(error))}; export it again") from error


def import_rasterio(path: Path) -> Any:
    """Return rasterio, which few need.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        import rasterio
    except ImportError as error:
        raise InputError(
            f"{path}: GeoTIFF and 16 bits need rasterio: pip install 'minisplat-ref[satellite]', or use texts,"
            " PNGs of 8 bits and .npy"
        ) from error
    return rasterio


def parse_rpc(text: str, path: Path) -> RPC:
    """Return the RPC of a text in the style of _RPC.TXT (``LINE_OFF: 1``, one coefficient a line) or of .RPB.

    Raises
    ------
    InputError
        A number is missing.
    """
    fields: dict[str, list[float]] = {}
    if "=" in text:  # .RPB: name = value; or name = (values);
        for name, value in re.findall(r"(\w+)\s*=\s*(\([^)]*\)|[^;\n]*)", text):
            if name in _RPB_NAMES:
                fields[_RPB_NAMES[name]] = _floats(value)
    else:
        for name, _, number, value in re.findall(r"(?m)^\s*([A-Z_]+?)(_(\d+))?\s*:\s*(\S+)", text):
            fields.setdefault(name, []).extend(_floats(value))
            if number and int(number) != len(fields[name]):
                raise InputError(f"{path}: {name}_{number} is out of order; take the file as it was delivered")
    return _make_rpc(fields, path)


def _make_rpc(fields: dict[str, list[float]], path: Path) -> RPC:
    def take(*names: str, count: int = 1) -> Floats:
        for name in names:
            if len(fields.get(name, ())) != count or not np.all(np.isfinite(fields[name])):
                raise InputError(f"{path}: an RPC needs {count} finite value(s) of {name}; take another file")
        return np.array([fields[name] for name in names])

    found = RPC(
        take("LONG_OFF", "LAT_OFF", "HEIGHT_OFF")[:, 0],
        take("LONG_SCALE", "LAT_SCALE", "HEIGHT_SCALE")[:, 0],
        take("SAMP_OFF", "LINE_OFF")[:, 0],
        take("SAMP_SCALE", "LINE_SCALE")[:, 0],
        take("SAMP_NUM_COEFF", "LINE_NUM_COEFF", count=20),
        take("SAMP_DEN_COEFF", "LINE_DEN_COEFF", count=20),
    )
    if not (np.all(found.ground_scale != 0) and np.all(found.pixel_scale != 0)):
        raise InputError(f"{path}: a scale of the RPC is 0; take another file")
    return found


def _floats(text: str) -> list[float]:
    return [float(found) for found in re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", text)]


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read, {error.strerror}") from error


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
