"""The difference of two arrays, apart from values that rounding decides, and the effect of other bounds on the image.

Boxes and tile lists differ between renderers for good reasons; only a difference of the image counts. So the reference
renders the truth's footprints once more, within the other renderer's bounds or in its order.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.oracle.golden.format import Arrays, Golden
from minisplat_ref.oracle.golden.running import grid_of, projection_of, reference_bins
from minisplat_ref.oracle.thresholds import thresholds
from minisplat_ref.oracle.tolerances import COMPARE_FLOAT64
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Bools, Floats, Ints, Projection, TileBins


class Difference(NamedTuple):
    """Difference of an array from the truth."""

    max_error: float
    """Largest |given - expected|; infinite where one of them is not finite."""
    rms_error: float
    """Root mean square of given - expected."""
    scale: float
    """Largest |expected|, or 1 where all is zero."""
    tolerance: float
    """Allowed error relative to the scale."""
    n_over: int
    """Number of values that are off by more."""
    n: int
    """Number of values that were compared."""
    n_flips: int = 0
    """Number of values that were set aside as flips, being off by more."""

    @property
    def relative(self) -> float:
        """Return the largest error relative to the scale."""
        return self.max_error / self.scale

    @property
    def excess(self) -> float:
        """Return the largest error in units of the allowed one; above 1 the array diverges."""
        return self.relative / self.tolerance if self.tolerance else np.inf * (self.max_error > 0)


def difference(given: Floats, expected: Floats, tolerance: float, may_flip: Bools | None = None) -> Difference:
    """Compare two arrays of one shape, value by value.

    Parameters
    ----------
    given, expected : ndarray
        The other renderer's and the truth's.
    tolerance : float
        Allowed error relative to the largest expected value.
    may_flip : ndarray of bool, optional
        Places, along the first axes, that rounding decides. They are neither averaged nor failed, but counted where
        they are off.

    Returns
    -------
    Difference
        Zeros for empty arrays.
    """
    given, expected = np.asarray(given, np.float64), np.asarray(expected, np.float64)
    is_compared = np.ones(expected.shape, bool)
    if may_flip is not None:
        is_compared &= ~may_flip.reshape(may_flip.shape + (1,) * (expected.ndim - may_flip.ndim))
    with np.errstate(invalid="ignore"):
        errors = np.abs(given - expected)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    scale = float(np.max(np.abs(expected), initial=0)) or 1.0
    is_over = errors > tolerance * scale
    compared = errors[is_compared]
    if compared.size == 0:
        return Difference(0.0, 0.0, scale, tolerance, 0, 0, int(is_over.sum()))
    return Difference(
        max_error=float(compared.max()),
        rms_error=float(np.sqrt(np.mean(compared**2))),
        scale=scale,
        tolerance=tolerance,
        n_over=int((is_over & is_compared).sum()),
        n=int(is_compared.sum()),
        n_flips=int((is_over & ~is_compared).sum()),
    )


FOOTPRINT = ("means2d", "depths", "conics", "opacities2d")


class Bounds(NamedTuple):
    """The effect of a difference in bounds or lists."""

    n_different: int  # rows, or tiles
    n: int
    changes_image: bool
    note: str


def compare_bounds(given: Arrays, truth: Golden) -> Bounds | None:
    """Judge radii and boxes, whichever were given; None where neither was.

    A Gaussian that the truth culls is rendered with the other renderer's footprint, if that was given.
    """
    if "radii" not in given and "boxes" not in given:
        return None
    expected, n = truth.arrays, len(truth.arrays["means"])
    bounds = {key: given[key] for key in ("radii", "boxes") if key in given}
    if "radii" in bounds:  # a single radius is that of a square
        bounds["radii"] = np.broadcast_to(bounds["radii"].reshape(n, -1), (n, 2))
    is_different = np.logical_or.reduce([(array != expected[key]).any(axis=1) for key, array in bounds.items()])
    if not is_different.any():
        return Bounds(0, n, False, "")

    projection = projection_of(expected)
    is_shown = expected["radii"][:, 0] > 0
    if "radii" in bounds:
        shows = bounds["radii"][:, 0] > 0
    else:
        shows = np.min(bounds["boxes"][:, 2:] - bounds["boxes"][:, :2], axis=1) > 0
    is_extra = shows & ~is_shown
    if is_extra.any() and all(key in given for key in FOOTPRINT):
        rows = {key: _merge_rows(is_extra, given[key], expected[key]) for key in FOOTPRINT}
        projection = projection_of(expected | rows)
    boxes = bounds["boxes"] if "boxes" in bounds else _make_boxes(projection, bounds["radii"], truth)
    projection = projection._replace(boxes=np.where(shows[:, None], boxes, 0).astype(np.int32))
    bins = REFERENCE.bin_gaussians(projection, grid_of(expected, (16, 16)), truth.conventions)
    changes = _changes_image(projection, bins, truth)
    parts = [
        _count(int((is_shown & ~shows).sum()), "culled that the reference shows"),
        _count(int(is_extra.sum()), "shown that the reference culls"),
        _count(int((is_different & shows & is_shown).sum()), "bounded differently"),
    ]
    return Bounds(int(is_different.sum()), n, changes, ", ".join(part for part in parts if part))


def compare_lists(given: Arrays, truth: Golden) -> Bounds | None:
    """Judge tile lists; None where none were given.

    They are compared with those that the reference makes for tiles of the same size: as sets, then in their order.
    """
    if "gaussian_ids" not in given or "tile_offsets" not in given:
        return None
    size = given.get("tile_size", truth.arrays["tile_size"])
    tile_size = (int(size[0]), int(size[1]))
    grid, expected = grid_of(truth.arrays, tile_size), reference_bins(truth.arrays, truth.conventions, tile_size)
    ids, offsets = given["gaussian_ids"].astype(np.int64), given["tile_offsets"].astype(np.int64)
    n_tiles, n = grid.n_tiles_x * grid.n_tiles_y, len(truth.arrays["means"])
    is_list = offsets.shape == (n_tiles + 1,) and offsets[0] == 0 and offsets[-1] == len(ids)
    if not (is_list and (np.diff(offsets) >= 0).all() and (ids >= 0).all() and (ids < n).all()):
        return Bounds(n_tiles, n_tiles, True, f"no lists of rows below {n} for {n_tiles} tiles")

    n_fewer = n_more = n_sets = n_orders = 0
    for tile in range(n_tiles):
        ours = expected.gaussian_ids[expected.tile_offsets[tile] : expected.tile_offsets[tile + 1]]
        theirs = ids[offsets[tile] : offsets[tile + 1]]
        n_fewer += len(np.setdiff1d(ours, theirs))
        n_more += len(theirs) - len(np.intersect1d(ours, theirs))
        n_sets += set(ours) != set(theirs) or len(set(theirs)) != len(theirs)
        n_orders += not np.array_equal(ours[np.isin(ours, theirs)], theirs[np.isin(theirs, ours)])
    if n_sets + n_orders == 0:
        return Bounds(0, n_tiles, False, "")
    bins = TileBins(ids.astype(np.int32), offsets, expected.slots, expected.gaussian_offsets, grid)
    parts = [
        _count(n_fewer, "pairs fewer"),
        _count(n_more, "pairs more"),
        _count(n_orders, "tiles in another order"),
    ]
    changes = _changes_image(projection_of(truth.arrays), bins, truth)
    return Bounds(max(n_sets, n_orders), n_tiles, changes, ", ".join(part for part in parts if part))


def _changes_image(projection: Projection, bins: TileBins, truth: Golden) -> bool:
    """Return whether these boxes and lists change the reference's image."""
    arrays = truth.arrays
    output = REFERENCE.composite(projection, arrays["colors"], arrays["background"], bins, truth.conventions)
    may_flip = thresholds(projection, bins, truth.conventions).jumps
    pairs = ((output.image, arrays["image"]), (output.alpha, arrays["alpha"]))
    return any(difference(a, b, COMPARE_FLOAT64, may_flip).n_over for a, b in pairs)


def _make_boxes(projection: Projection, radii: Ints, truth: Golden) -> Ints:
    """Return boxes of half-sides ``radii`` around the means, clipped to the image."""
    size = truth.arrays["image_size"]
    low = np.clip(np.floor(projection.means2d - radii), 0, size)
    high = np.clip(np.ceil(projection.means2d + radii), 0, size)
    return np.hstack([low, high]).astype(np.int32)


def _merge_rows(rows: Bools, given: Floats, expected: Floats) -> Floats:
    """Return the given values in these rows and the expected ones in all others."""
    merged = expected.copy()
    merged[rows] = given[rows]
    return merged


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n else ""
