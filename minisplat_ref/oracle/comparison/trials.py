"""Planted faults rendered as a renderer was: the same scene, the same arrays, and how far the two are apart.

A renderer that differs is explained by a fault if the reference with this fault gives the renderer's arrays: those that
are wrong as they are wrong, and those that are right, right. Values that rounding decides are left out.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from minisplat_ref.oracle.faults import Fault
from minisplat_ref.oracle.golden.format import SPECS, Arrays, Golden
from minisplat_ref.oracle.golden.running import PROJECTION, grid_of, projection_of, reference_bins, run_stages
from minisplat_ref.oracle.tangent import on_tangent, turning
from minisplat_ref.types import Bools, Floats, Projection

NOT_OF_FAULTS = ("loss", "statistics", "surface", "adam")  # stages that no fault changes
OF_ROTATION = ("v_R_projection", "v_R_colors", "v_R")
OF_VIEW = ("v_viewmat",)
BY_ROW = ("means2d", "depths", "conics", "opacities2d", "colors")  # compared where both show the Gaussian
BOUNDS = ("radii", "gaussian_ids")
FAR = 10.0  # allowed errors, from which on a value is not explained
FEW = 0.05  # of the wrong values, that may stay unexplained
EXACT = 0.1  # of the error, that may
SPOILED = 0.01  # of the values of a right array, that a fault may spoil


class Evidence(NamedTuple):
    """What a renderer gave for a scene."""

    given: Arrays
    truth: Golden
    may_flip: Mapping[str, Bools]
    """Of arrays, the places along their first axes that rounding decides."""
    dtype: str | None
    """Of the computation; None: that of each array."""
    is_fed: bool
    """Whether every stage got the truth's input."""


def comparable(name: str, given: Floats, truth: Golden) -> tuple[Floats, Floats]:
    """Return an array and the truth's; of gradients of a view, their part on the tangent of SE(3)."""
    expected, camera = truth.arrays[name], truth.camera
    if name in OF_ROTATION:
        return turning(given, camera.cam_from_world_R), turning(expected, camera.cam_from_world_R)
    if name in OF_VIEW:
        view = np.column_stack([camera.cam_from_world_R, camera.cam_from_world_t])
        return on_tangent(given, view), on_tangent(expected, view)
    return given, expected


def shown_rows(given: Arrays, truth: Golden) -> Bools:
    """Return the Gaussians [N] that the truth shows and, if it gives radii, the renderer does."""
    rows: Bools = truth.arrays["radii"][:, 0] > 0
    if "radii" in given:
        rows = rows & (given["radii"].reshape(len(rows), -1)[:, 0] > 0)
    return rows


class Trace(NamedTuple):
    """An array of the renderer, of which the values that count are kept."""

    name: str
    is_wrong: bool
    given: Floats
    expected: Floats
    keep: Bools
    """Which values of the whole array these are."""
    unit: float
    """The allowed error."""

    def of(self, arrays: Arrays, truth: Golden) -> Floats:
        """Return the same values of other arrays."""
        array = comparable(self.name, arrays.get(self.name, truth.arrays[self.name]), truth)[0]
        if array.shape != self.keep.shape:  # lists of another length
            return np.full_like(self.given, np.inf)
        return np.asarray(array, np.float64)[self.keep]


def traces_of(evidence: Evidence, wrong: frozenset[str], *, is_forward: bool) -> list[Trace]:
    """Return the arrays by which faults are told: images, or gradients where all images are right."""
    roles = ("output",) if is_forward else ("gradient",)
    skipped = (*NOT_OF_FAULTS, *(("view",) if evidence.is_fed else ()))  # a whole view shows no stage by itself
    traces = []
    for name, array in evidence.given.items():
        spec = SPECS[name]
        if spec.role not in roles or spec.stage in skipped or name in ("boxes", "tile_offsets", "median_depth"):
            continue
        if (name in BOUNDS and name not in wrong) or array.shape[1:] != evidence.truth.arrays[name].shape[1:]:
            continue  # bounds that differ without an effect
        a, b = comparable(name, array, evidence.truth)
        if a.shape != b.shape:
            continue
        keep = np.ones(b.shape, bool)
        if name in BY_ROW:
            rows = shown_rows(evidence.given, evidence.truth)
            keep &= rows.reshape(rows.shape + (1,) * (b.ndim - 1))
        if name in evidence.may_flip:
            aside = evidence.may_flip[name]
            keep &= ~aside.reshape(aside.shape + (1,) * (b.ndim - aside.ndim))
        given, expected = np.asarray(a, np.float64)[keep], np.asarray(b, np.float64)[keep]
        scale = float(np.max(np.abs(expected), initial=0)) or 1.0
        unit = 0.5 if name in BOUNDS else spec.tolerance.of(evidence.dtype or str(array.dtype)) * scale
        traces.append(Trace(name, name in wrong, given, expected, keep, unit or 1e-12))
    return traces


def run_fault(fault: Fault, size: float, truth: Golden, *, is_fed: bool) -> Arrays:
    """Return the arrays of the reference with a fault: images for an error of these, all for one of gradients."""
    with np.errstate(all="ignore"):
        if not fault.is_forward:
            fed = truth.arrays if is_fed else None
            without = (*NOT_OF_FAULTS, *(("view",) if is_fed else ()))
            return run_stages(fault.plant(size), truth, "float64", fed=fed, without=without)
        arrays = _forward(fault, size, truth, is_fed)
        return arrays if fault.after is None else fault.after(arrays, size)


def _forward(fault: Fault, size: float, truth: Golden, is_fed: bool) -> Arrays:
    """Run projection, colours and one blending of all channels.

    Where the rules cut nothing off, footprints are bounded by alpha alone: a fault must not be hidden by right boxes.
    """
    backend, a, c, camera = fault.plant(size), truth.arrays, truth.conventions, truth.camera
    projection = backend.project(a["means"], a["quats"], a["scales"], a["opacities"], camera, c)
    out: Arrays = dict(zip(PROJECTION, projection, strict=True))
    shown = projection_of(a) if is_fed else projection
    tile_size = backend.tile_width, backend.tile_height
    bins = backend.bin_gaussians(shown, grid_of(a, tile_size), c)
    out |= {"tile_size": np.array(tile_size), "gaussian_ids": bins.gaussian_ids, "tile_offsets": bins.tile_offsets}
    out["colors"] = backend.sh_colors(
        a["means"], a["sh_dc"], a["sh_rest"], camera, truth.sh_degree, a["radii"] if is_fed else projection.radii
    )
    if is_fed and fault.where in ("projection", "colours"):
        return out
    if c.has_full_support and not fault.has_own_bounds:
        shown = _unbounded(shown, truth)
        bins = backend.bin_gaussians(shown, grid_of(a, tile_size), c)
    if is_fed:
        bins = reference_bins(a, c, tile_size)
    channels = np.column_stack([a["colors"] if is_fed else out["colors"], a["features"], shown.depths])
    background = np.concatenate([a["background"], a["feature_background"], [0.0]])
    output = backend.composite(shown, channels, background, bins, c)
    image, features, depth = np.split(output.image, [3, channels.shape[1] - 1], axis=2)
    alpha, depth = output.alpha, depth[..., 0]
    expected = np.where(alpha > 0, depth / np.where(alpha > 0, alpha, 1), 0)
    out |= {"image": image, "alpha": alpha, "feature_image": features, "accumulated_depth": depth}
    return out | {"view": np.dstack([image, expected]), "view_alpha": alpha}


def _unbounded(projection: Projection, truth: Golden) -> Projection:
    """Return footprints that may touch every pixel."""
    width, height = map(int, truth.arrays["image_size"])
    is_shown = projection.radii[:, :1] > 0
    return projection._replace(boxes=np.where(is_shown, [0, 0, width, height], 0).astype(np.int32))


class Fit(NamedTuple):
    """How well arrays explain those of a renderer."""

    misfit: float
    """Part of the error that is left, plus the part of right arrays that they spoil; 0 if they are the same."""
    is_exact: bool
    """Whether they are the same as far as allowed errors tell."""


def fit_of(traces: list[Trace], arrays: Arrays, truth: Golden) -> Fit:
    """Compare a fault's arrays with a renderer's."""
    left, spoiled, is_exact = [], [0.0], True
    for trace in traces:
        errors = np.abs(trace.given - trace.of(arrays, truth))
        limit = 1e6 * trace.unit
        errors = np.where(np.isfinite(errors), np.minimum(errors, limit), limit)
        if trace.is_wrong:
            whole = np.abs(trace.given - trace.expected)
            whole = np.where(np.isfinite(whole), np.minimum(whole, limit), limit)
            part = float(errors.sum() / max(whole.sum(), trace.unit))
            left.append(min(part, 2.0))
            n_left, n_wrong = int((errors > FAR * trace.unit).sum()), int((whole > trace.unit).sum())
            if trace.name not in BOUNDS:
                is_exact &= part <= EXACT and n_left <= FEW * n_wrong
        elif errors.size:
            share = float((errors > 2 * trace.unit).mean())
            spoiled.append(min(1.0, 5 * share))
            is_exact &= share <= SPOILED
    return Fit(float(np.mean(left)) if left else 0.0, is_exact)._replace(
        misfit=(float(np.mean(left)) if left else 0.0) + float(np.mean(spoiled))
    )
