"""Rational polynomial cameras (RPC00B): their files, where they see a point, and which point a pixel sees.

Longitude, latitude and height, each minus an offset and over a scale, are L, P, H. Line and sample of the image are
ratios of cubics of them::

    line = (a . m(P, L, H)) / (b . m(P, L, H)) LINE_SCALE + LINE_OFF,   sample likewise by c and d

m has 20 monomials, so a camera has 80 coefficients. They are in a GeoTIFF's metadata, in a text ``_RPC.TXT`` or in an
``.RPB`` of the same numbers. Pixel (0, 0) of an RPC is the centre of the first pixel; here its centre is at 0.5.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite.rasters import RASTERS, open_raster
from minisplat_ref.types import Floats

# Powers of (L, P, H) of the 20 monomials, in the order of RPC00B.
_POWERS = np.array(
    [
        [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [2, 0, 0], [0, 2, 0], [0, 0, 2],
        [1, 1, 1], [3, 0, 0], [1, 2, 0], [1, 0, 2], [2, 1, 0], [0, 3, 0], [0, 1, 2], [2, 0, 1], [0, 2, 1], [0, 0, 3],
    ]
)  # fmt: skip
N_NEWTON = 20  # steps at most; four are usual
MAX_MISS = 1e-6  # pixels by which a localisation may miss

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
