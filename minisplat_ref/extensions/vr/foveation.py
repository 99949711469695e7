"""Foveated rendering: fewer rays the further they are from the gaze.

The minimum angle of resolution of the eye grows about linearly with the eccentricity e, the angle to the gaze (Guenter
et al. 2012)::

    MAR(e) = w + m e,   w = 1/48 degree, m = 0.0275

The pixel of the display counts as what the eye resolves at the eccentricity ``full``; up to there every pixel is drawn.
Where MAR has doubled, one ray for each block of 2 x 2 pixels is enough, and where it has doubled again, one for 4 x 4.
These coarse images are drawn through the centres of the blocks with the same footprints, low-pass included, and only
in the tiles that need them. They are interpolated between the centres, and blended with the finer image in a ring
where a zone begins.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.tangent.renderer import prepare
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import Request
from minisplat_ref.types import Bools, Camera, Floats, Model, TileBins

ACUITY_OFFSET, ACUITY_SLOPE = 1 / 48, 0.0275  # degrees, and degrees per degree
N_ZONES = 3  # blocks of 1, 2 and 4 pixels per side
RING = 0.2  # width of a blended ring, relative to the eccentricity at which it begins


class Gaze(NamedTuple):
    """The point of the image at which the eye looks."""

    x: float
    """Pixels."""
    y: float
    """Pixels."""
    full: float
    """Eccentricity up to which every pixel is drawn, degrees."""


class Zone(NamedTuple):
    """The work of drawing at one rate."""

    block: int
    """Pixels per side of the block of one ray."""
    begins: float
    """Eccentricity at which the zone begins, degrees."""
    n_tiles: int
    """Number of tiles that were drawn."""
    n_samples: int
    """Number of their rays."""
    n_pairs: int
    """Number of their pairs (tile, Gaussian)."""


def resolved_angles(eccentricities: Floats) -> Floats:
    """Return the minimum angle of resolution MAR(e), degrees, at eccentricities in degrees."""
    return ACUITY_OFFSET + ACUITY_SLOPE * eccentricities


def zone_begins(full: float) -> list[float]:
    """Return the eccentricities [N_ZONES], degrees, at which each zone begins: where MAR has doubled once more."""
    return [0.0] + [
        (2.0**k * (ACUITY_OFFSET + ACUITY_SLOPE * full) - ACUITY_OFFSET) / ACUITY_SLOPE for k in range(N_ZONES - 1)
    ]


def eccentricities(camera: Camera, x: float, y: float) -> Floats:
    """Return the angles [H, W] between the rays of the pixels and that through (x, y), degrees."""
    ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
    rays, gaze = pinhole_rays(xs, ys, camera), pinhole_rays(x, y, camera)
    sines = np.linalg.norm(np.cross(rays, gaze), axis=-1)
    angles: Floats = np.degrees(np.arctan2(sines, rays @ gaze))
    return angles


def zone_weights(eccentricities: Floats, full: float) -> list[Floats]:
    """Return the weight [H, W] of each zone's image; the weights add up to one.

    A ring lies in the coarser zone, so that no pixel is drawn more coarsely than its eccentricity allows.
    """
    weights, rest = [], np.ones_like(eccentricities)
    for begins in zone_begins(full)[1:]:
        t = np.clip((eccentricities - begins) / max(RING * begins, 1e-9), 0, 1)
        share = t * t * (3 - 2 * t)  # of what is coarser
        weights.append(rest * (1 - share))
        rest = rest * share
    return [*weights, rest]


def check_gaze(gaze: Gaze, camera: Camera, name: str = "image") -> None:
    """Refuse a gaze outside an image, and an angle out of range.

    Raises
    ------
    InputError
        The gaze lies outside, or ``full`` is not from 0 to 180 degrees.
    """
    if not (0 <= gaze.x <= camera.width and 0 <= gaze.y <= camera.height):
        raise InputError(
            f"gaze {gaze.x:g},{gaze.y:g} lies outside {name}, which has {camera.width} x {camera.height} pixels:"
            f" give x from 0 to {camera.width} and y from 0 to {camera.height}"
        )
    if not 0 <= gaze.full <= 180:
        raise InputError(f"--full is {gaze.full:g} degrees: give 0 to 180")


def render_foveated(
    model: Model, camera: Camera, request: Request, gaze: Gaze, buffer_size: int | None
) -> tuple[Floats, list[Zone]]:
    """Render a view with rates by eccentricity.

    Parameters
    ----------
    model : Model
        The Gaussians.
    camera : Camera
        The camera of the whole image.
    request : Request
        It asks for colours only.
    gaze : Gaze
        Where the eye looks.
    buffer_size : int, optional
        Hits that a pixel sorts in its buffer; all by default.

    Returns
    -------
    image : ndarray of shape (H, W, 3)
    zones : list of Zone
        The work of each zone.

    Raises
    ------
    InputError
        The gaze lies outside the image.
    """
    check_gaze(gaze, camera)
    weights = zone_weights(eccentricities(camera, gaze.x, gaze.y), gaze.full)
    image, zones = np.zeros((camera.height, camera.width, 3), model.gaussians.means.dtype), []
    for k, (weight, begins) in enumerate(zip(weights, zone_begins(gaze.full), strict=True)):
        block = 2**k
        conventions = request.conventions._replace(eps2d=request.conventions.eps2d / block**2)
        coarse = _coarser(camera, block)
        is_needed = _find_needed_samples(weight > 0, block)
        if not is_needed.any():
            zones.append(Zone(block, begins, 0, 0, 0))
            continue
        prepared = prepare(model, coarse, request._replace(conventions=conventions), buffer_size)
        bins = prepared.listed()
        tiles = _find_needed_tiles(is_needed, bins)
        kept = _keep_tiles(bins, tiles)
        image += weight[:, :, None] * _interpolate(prepared.blended(kept).image, block, weight.shape)
        zones.append(Zone(block, begins, int(tiles.sum()), _n_pixels(tiles, bins), len(kept.gaussian_ids)))
    return image, zones


def _coarser(camera: Camera, block: int) -> Camera:
    """Return the camera whose pixels are blocks; those at the edges may extend beyond the image."""
    return camera._replace(
        fx=camera.fx / block,
        fy=camera.fy / block,
        cx=camera.cx / block,
        cy=camera.cy / block,
        width=-(-camera.width // block),
        height=-(-camera.height // block),
    )


def _find_needed_samples(is_needed: Bools, block: int) -> Bools:
    """Return which samples are needed: those of the blocks of needed pixels, and their neighbours for interpolation."""
    if block == 1:
        return is_needed
    height, width = (-(-n // block) for n in is_needed.shape)
    padded = np.zeros((height * block, width * block), bool)
    padded[: is_needed.shape[0], : is_needed.shape[1]] = is_needed
    own = np.pad(padded.reshape(height, block, width, block).any(axis=(1, 3)), 1)
    shifted = [own[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return np.logical_or.reduce(shifted)


def _find_needed_tiles(is_needed: Bools, bins: TileBins) -> Bools:
    """Return which tiles [n_tiles] hold a sample that is needed."""
    grid = bins.grid
    ys, xs = np.nonzero(is_needed)
    tiles = np.zeros(grid.n_tiles_x * grid.n_tiles_y, bool)
    tiles[ys // grid.tile_height * grid.n_tiles_x + xs // grid.tile_width] = True
    return tiles


def _keep_tiles(bins: TileBins, is_kept: Bools) -> TileBins:
    """Return the lists with those of other tiles empty; this suffices for drawing, not for differentiating."""
    counts = np.diff(bins.tile_offsets)
    offsets = np.concatenate([[0], np.cumsum(np.where(is_kept, counts, 0))])
    pairs = np.repeat(is_kept, counts)
    return bins._replace(gaussian_ids=bins.gaussian_ids[pairs], tile_offsets=offsets, slots=bins.slots[pairs])


def _n_pixels(tiles: Bools, bins: TileBins) -> int:
    """Return how many pixels of the image lie in tiles."""
    grid, total = bins.grid, 0
    for tile in np.flatnonzero(tiles):
        y, x = divmod(int(tile), grid.n_tiles_x)
        total += min(grid.tile_width, grid.width - x * grid.tile_width) * min(
            grid.tile_height, grid.height - y * grid.tile_height
        )
    return total


def _interpolate(coarse: Floats, block: int, shape: tuple[int, int]) -> Floats:
    """Return an image [H, W, 3] by bilinear interpolation between the centres of blocks, clamped at the edges."""
    if block == 1:
        return coarse
    for axis, size in enumerate(shape):
        at = np.clip((np.arange(size) + 0.5) / block - 0.5, 0, coarse.shape[axis] - 1)
        low = np.minimum(at.astype(int), max(coarse.shape[axis] - 2, 0))
        high = np.minimum(low + 1, coarse.shape[axis] - 1)
        t = (at - low).astype(coarse.dtype).reshape([-1 if a == axis else 1 for a in range(3)])
        coarse = (1 - t) * np.take(coarse, low, axis) + t * np.take(coarse, high, axis)
    return coarse
