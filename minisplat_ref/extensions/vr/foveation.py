"""Foveated rendering: fewer rays the further they are from the gaze.

The minimum angle of resolution of the eye grows about linearly with the eccentricity e, the angle to the gaze (Guenter
et al. 2012)::

    MAR(e) = w + m e,   w = 1/48 degree, m = 0.0275

The pixel of the display is taken as the resolution of the eye at the eccentricity ``full``; up to there every pixel is
rendered. Where MAR has doubled, one ray for each block of 2 x 2 pixels is enough, and where it has doubled again, one
for 4 x 4. These coarse images are rendered through the centres of the blocks with the same footprints, low-pass
included, and only in the tiles that need them. They are interpolated between the centres, and blended with the finer
image in a ring where a zone begins.

A footprint on its tangent plane does not depend on the pixels, so each Gaussian is projected and shaded once for all
zones, and one sort of the keys (zone, tile, distance) makes their lists. A tile has as many rays in every zone, so one
of blocks of 4 x 4 pixels covers 16 times the area.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.tangent.planes import TangentFootprints
from minisplat_ref.mechanisms.tangent.renderer import Prepared, prepare
from minisplat_ref.reference.pinhole import pinhole_rays, with_principal_point
from minisplat_ref.rendering import Request
from minisplat_ref.types import Bools, Camera, Floats, Ints, Model, TileBins, TileGrid

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
    """Eccentricity up to which every pixel is rendered, degrees."""


class Sampling(NamedTuple):
    """The rays of a zone."""

    block: int
    """Pixels per side of the block of one ray."""
    camera: Camera
    """Its pixels are the blocks; those at the edges may extend beyond the image."""
    grid: TileGrid
    """The tiles of its image."""
    is_needed: Bools
    """[n_tiles] which of them hold a ray that is needed."""


class Zone(NamedTuple):
    """The work of rendering at one rate."""

    block: int
    """Pixels per side of the block of one ray."""
    begins: float
    """Eccentricity at which the zone begins, degrees."""
    n_tiles: int
    """Number of tiles that were rendered."""
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

    A ring lies in the coarser zone, so that no pixel is rendered more coarsely than its eccentricity allows.
    """
    weights, rest = [], np.ones_like(eccentricities)
    for begins in zone_begins(full)[1:]:
        t = np.clip((eccentricities - begins) / max(RING * begins, 1e-9), 0, 1)
        share = t * t * (3 - 2 * t)  # of coarser pixels
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
        Of colours only.
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
    conventions = request.conventions._replace(uses_principal_point=True)
    camera = with_principal_point(camera, request.conventions)
    weights, begins = zone_weights(eccentricities(camera, gaze.x, gaze.y), gaze.full), zone_begins(gaze.full)
    tile = request.backend.tile_width, request.backend.tile_height
    samplings = [_sample(camera, weight > 0, 2**k, tile) for k, weight in enumerate(weights)]
    # The coarsest blocks may extend beyond the image, and so may the projected footprints.
    coarsest = samplings[-1]
    width, height = coarsest.block * coarsest.camera.width, coarsest.block * coarsest.camera.height
    all_blocks = camera._replace(width=width, height=height)
    prepared = prepare(model, all_blocks, request._replace(conventions=conventions), buffer_size)
    lists = bin_zones(prepared.footprints, samplings)

    image, zones = np.zeros((camera.height, camera.width, 3), model.gaussians.means.dtype), []
    for sampling, bins, weight, begin in zip(samplings, lists, weights, begins, strict=True):
        if sampling.is_needed.any():
            coarse = _render_zone(prepared, sampling, bins)
            image += weight[:, :, None] * _interpolate(coarse, sampling.block, weight.shape)
        n_tiles, n_rays = int(sampling.is_needed.sum()), _n_pixels(sampling.is_needed, sampling.grid)
        zones.append(Zone(sampling.block, begin, n_tiles, n_rays, len(bins.gaussian_ids)))
    return image, zones


def bin_zones(footprints: TangentFootprints, samplings: Sequence[Sampling]) -> list[TileBins]:
    """List the Gaussians of every tile that is needed, of all zones with one sort; the other tiles' lists are empty.

    The lists suffice for rendering, not for differentiating.
    """
    offsets = np.cumsum([0, *(len(sampling.is_needed) for sampling in samplings)])  # of a zone's tiles among all
    pairs = [_list_pairs(footprints.boxes, sampling) for sampling in samplings]
    ids = np.concatenate([of_zone[0] for of_zone in pairs])
    tiles = np.concatenate([of_zone[1] + offset for of_zone, offset in zip(pairs, offsets, strict=False)])
    order = np.lexsort((ids, footprints.distances[ids], tiles))
    ids, starts = ids[order].astype(np.int32), np.searchsorted(tiles[order], np.arange(offsets[-1] + 1))
    lists = []
    for k, sampling in enumerate(samplings):
        of_tiles = starts[offsets[k] : offsets[k + 1] + 1]
        own = ids[of_tiles[0] : of_tiles[-1]]
        n_of_each = np.append(0, np.cumsum(np.bincount(own, minlength=len(footprints.radii))))
        lists.append(
            TileBins(own, of_tiles - of_tiles[0], np.arange(len(own), dtype=np.int32), n_of_each, sampling.grid)
        )
    return lists


def _list_pairs(boxes: Ints, sampling: Sampling) -> tuple[Ints, Ints]:
    """Return Gaussian and tile of each pair [M] of a zone, for the tiles that are needed."""
    grid, (x0, y0, x1, y1) = sampling.grid, _convert_boxes(boxes, sampling).astype(np.int64).T
    left, top = x0 // grid.tile_width, y0 // grid.tile_height
    right, bottom = -(-x1 // grid.tile_width), -(-y1 // grid.tile_height)
    needed = sampling.is_needed.reshape(grid.n_tiles_y, grid.n_tiles_x)
    before = np.pad(needed.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))  # needed tiles above and to the left
    n_needed = before[bottom, right] - before[top, right] - before[bottom, left] + before[top, left]
    rows = np.flatnonzero((x1 > x0) & (y1 > y0) & (n_needed > 0))
    n_x, n_pairs = (right - left)[rows], ((right - left) * (bottom - top))[rows]
    of_row = np.repeat(np.arange(len(rows)), n_pairs)
    k = np.arange(len(of_row)) - np.repeat(np.cumsum(n_pairs) - n_pairs, n_pairs)  # 0, 1, ... within a Gaussian
    down, along = np.divmod(k, n_x[of_row])
    tiles = (top[rows][of_row] + down) * grid.n_tiles_x + left[rows][of_row] + along
    is_kept = sampling.is_needed[tiles]
    return rows[of_row[is_kept]], tiles[is_kept]


def _convert_boxes(boxes: Ints, sampling: Sampling) -> Ints:
    """Return boxes of pixels as boxes [N, 4] of the blocks that they touch, in the zone's image."""
    block, size = sampling.block, np.array(2 * [sampling.grid.width, sampling.grid.height])
    touched = np.concatenate([boxes[:, :2] // block, -(-boxes[:, 2:] // block)], axis=1)
    return np.minimum(touched, size).astype(np.int32)


def _render_zone(prepared: Prepared, sampling: Sampling, bins: TileBins) -> Floats:
    """Return the image [H, W, 3] of a zone; Gaussians that are not listed there are not even read."""
    rows = np.unique(bins.gaussian_ids)
    fields = {name: field[rows] for name, field in prepared.footprints._asdict().items() if name != "camera"}
    fields["boxes"] = _convert_boxes(fields["boxes"], sampling)
    listed = prepared._replace(
        footprints=TangentFootprints(**fields, camera=sampling.camera), channels=prepared.channels[rows]
    )
    return listed.blended(bins._replace(gaussian_ids=np.searchsorted(rows, bins.gaussian_ids).astype(np.int32))).image


def _sample(camera: Camera, is_needed: Bools, block: int, tile: tuple[int, int]) -> Sampling:
    """Return the rays of a zone whose pixels [H, W] are ``is_needed``."""
    coarse = _coarser(camera, block)
    grid = TileGrid(coarse.width, coarse.height, *tile)
    return Sampling(block, coarse, grid, _find_needed_tiles(_find_needed_samples(is_needed, block), grid))


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
    if block == 1 or not is_needed.any():
        return is_needed[::block, ::block]
    height, width = (-(-n // block) for n in is_needed.shape)
    padded = np.zeros((height * block, width * block), bool)
    padded[: is_needed.shape[0], : is_needed.shape[1]] = is_needed
    own = np.pad(padded.reshape(height, block, width, block).any(axis=(1, 3)), 1)
    shifted = [own[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return np.logical_or.reduce(shifted)


def _find_needed_tiles(is_needed: Bools, grid: TileGrid) -> Bools:
    """Return which tiles [n_tiles] hold a sample that is needed."""
    ys, xs = np.nonzero(is_needed)
    tiles = np.zeros(grid.n_tiles_x * grid.n_tiles_y, bool)
    tiles[ys // grid.tile_height * grid.n_tiles_x + xs // grid.tile_width] = True
    return tiles


def _n_pixels(tiles: Bools, grid: TileGrid) -> int:
    """Return the number of the image's pixels that lie in tiles."""
    total = 0
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
