"""Polygon soups: the polygons of a model as a file that mesh tools edit, and the model carried along by the edit.

The file is a PLY in float64. Polygon m has the vertices ``m n`` to ``m n + n - 1`` and is one face of n corners, with
the opacity and the colour of degree 0 of its Gaussian. Gaussians that are too faint to have a polygon are not in it
(:func:`~minisplat_ref.mechanisms.meshes.fans.opacity_radii`), nor are those of no finite size.

After an edit, face m lists the vertices that are the corners of polygon m, in the order in which they were written.
Edited polygons are fitted (:func:`~minisplat_ref.mechanisms.meshes.fans.fit_flat_gaussians`): means, quaternions
and scales. The thickness keeps its ratio to the smaller of the two scales, so that the plane stays the plane. Higher
harmonics are rotated by the rotation that is nearest to the map of the plane. Opacities, and with them the radii,
stay. A polygon has two sides that look the same: a mirrored one counts as turned over, and colours are never mirrored.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.io.ply import COLORS, MEANS, check_finite
from minisplat_ref.io.ply_faces import read_faces
from minisplat_ref.io.ply_file import read_vertices, write_vertices
from minisplat_ref.mechanisms.editing.deformation import polar_rotations, quaternions
from minisplat_ref.mechanisms.editing.sh_rotation import rotate_sh
from minisplat_ref.mechanisms.meshes.fans import (
    fit_flat_gaussians,
    fit_spans,
    flatten,
    min_widths,
    opacity_radii,
    plane_axes,
    rims,
)
from minisplat_ref.types import Floats, Gaussians, Ints

WIDTH_MIN = 1e-9  # of a polygon, across over along: a vertex in float64 has not many more digits than that
SIDES_MAX = 255  # that a face of a PLY can have here


class Soup(NamedTuple):
    """The polygons of a model."""

    rows: Ints
    """[M] of the population."""
    radii: Floats
    """[M] in standard deviations, above 0."""
    corners: Floats
    """[M, n, 3] world frame."""


def make_soup(gaussians: Gaussians, n_sides: int) -> Soup:
    """Return the polygons of a model, of those Gaussians that have one."""
    flat = flatten(gaussians.means, gaussians.quats, gaussians.log_scales)
    radii = opacity_radii(gaussians.opacity_logits)
    has_size = np.isfinite(flat.scales).all(axis=1) & (flat.scales > 0).all(axis=1)
    rows = np.flatnonzero((radii > 0) & has_size)
    return Soup(rows, radii[rows], rims(flat.means[rows], flat.spans[rows], radii[rows], n_sides))


def save_soup(path: str | Path, gaussians: Gaussians, n_sides: int) -> Soup:
    """Write the polygons of a model, complete or not at all, and return them.

    Raises
    ------
    InputError
        Polygons have 3 to 255 sides, and the model has to have one.
    """
    if not 3 <= n_sides <= SIDES_MAX:
        raise InputError(f"a polygon has 3 to {SIDES_MAX} sides, not {n_sides}")
    soup = make_soup(gaussians, n_sides)
    if len(soup.rows) == 0:
        raise InputError(f"none of the {len(gaussians.means):,} Gaussians is opaque enough to have a polygon")
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits[soup.rows].astype(np.float64)))
    shades = np.column_stack([0.5 + SH_C0 * gaussians.sh_dc[soup.rows].astype(np.float64), opacities])
    levels = np.repeat(np.rint(255 * np.clip(shades, 0, 1)).astype(np.uint8), n_sides, axis=0)  # [M n, 4]
    columns: dict[str, NDArray] = dict(zip(MEANS, soup.corners.reshape(-1, 3).T, strict=True))
    columns |= zip((*COLORS, "alpha"), levels.T, strict=True)
    write_vertices(path, columns, np.arange(len(levels)).reshape(-1, n_sides))
    return soup


def load_corners(path: str | Path, n_polygons: int) -> NDArray:
    """Read the corners of edited polygons.

    Parameters
    ----------
    path : str or Path
        A PLY.
    n_polygons : int
        How many there must be.

    Returns
    -------
    ndarray of shape (M, n, 3)
        In the scalar type of the file, float32 or float64.

    Raises
    ------
    InputError
        The file cannot be read, has no faces, another number of polygons or vertices, a polygon of fewer than three
        corners, of another number than the first, or of a vertex that does not exist.
    """
    columns, faces = read_vertices(path), read_faces(path)
    if not faces or any(name not in columns for name in MEANS):
        raise InputError(f"{path}: not a polygon soup, it has no faces; make one with: polygons export MODEL")
    sizes = np.array([len(face) for face in faces])
    if sizes.min() < 3:
        raise InputError(
            f"{path}: polygon {np.argmin(sizes)} has {sizes.min()} corners, not 3 or more; export it again"
        )
    n = int(sizes[0])
    if (sizes != n).any():
        other = int(np.argmax(sizes != n))
        raise InputError(
            f"{path}: polygon {other} has {sizes[other]} corners, and polygon 0 has {n}: move vertices only, and export"
            " without cutting faces"
        )
    n_vertices = len(columns[MEANS[0]])
    if len(faces) != n_polygons or n_vertices != n * n_polygons:
        raise InputError(
            f"{path}: {len(faces)} polygons of {n} corners and {n_vertices} vertices, but the model has {n_polygons}"
            f" polygons, which are {n * n_polygons} vertices: move vertices only, and export without merging them"
        )
    corners = np.stack(faces)
    if corners.min() < 0 or corners.max() >= n_vertices:
        bad = int(np.argmax(((corners < 0) | (corners >= n_vertices)).any(axis=1)))
        raise InputError(f"{path}: polygon {bad} has a corner beyond the {n_vertices} vertices; export it again")
    check_finite(path, {name: columns[name] for name in MEANS})
    dtype = np.result_type(np.float32, *(columns[name].dtype for name in MEANS))
    vertices = np.stack([columns[name].astype(dtype) for name in MEANS], axis=1)
    edited: NDArray = vertices[corners]
    return edited


def carry_gaussians(gaussians: Gaussians, soup: Soup, corners: Floats, source: str | Path) -> tuple[Gaussians, int]:
    """Return the Gaussians after an edit of their polygons, and the number of changed ones.

    Parameters
    ----------
    gaussians : Gaussians
        Before.
    soup : Soup
        Their polygons before.
    corners : ndarray of shape (M, n, 3)
        After, world frame.
    source : str or Path
        What a message begins with.

    Returns
    -------
    gaussians : Gaussians
        In the dtype that they had. Rows whose corners did not move, as far as the dtype of ``corners`` tells, keep
        their bytes.
    n_edited : int
        Rows that changed.

    Raises
    ------
    InputError
        A polygon is degenerate: its corners coincide, or lie on one line.
    """
    moved = np.flatnonzero((corners != soup.corners.astype(corners.dtype)).any(axis=(1, 2)))
    if len(moved) == 0:
        return gaussians, 0
    rows, radii, after = soup.rows[moved], soup.radii[moved], corners[moved].astype(np.float64)
    widths = min_widths(after)
    is_degenerate = widths <= WIDTH_MIN
    if is_degenerate.any():
        raise InputError(
            f"{source}: polygon {moved[np.argmax(is_degenerate)]} has no area ({is_degenerate.sum()} have none): its"
            " corners coincide or lie on one line; give it a width"
        )
    columns = plane_axes(gaussians.log_scales[rows])
    before, now = (
        flatten(gaussians.means[rows], gaussians.quats[rows], gaussians.log_scales[rows]),
        fit_flat_gaussians(after, radii),
    )
    R = np.empty((len(rows), 3, 3))
    np.put_along_axis(R, columns[:, None, :], now.axes, axis=2)
    shrinkage = np.log(now.scales.min(axis=1) / before.scales.min(axis=1))
    thin = np.take_along_axis(gaussians.log_scales[rows], columns[:, 2:], axis=1)[:, 0] + shrinkage
    log_scales = np.empty((len(rows), 3))
    np.put_along_axis(log_scales, columns, np.column_stack([np.log(now.scales), thin]), axis=1)
    Q = polar_rotations(_plane_maps(before.axes, before.scales, fit_spans(after, radii)[1]))
    fields = {
        "means": now.means,
        "quats": quaternions(R),
        "log_scales": log_scales,
        "sh_rest": rotate_sh(gaussians.sh_rest[rows], Q, np.arange(len(rows))),
    }
    result = {}
    for name, values in fields.items():
        field = getattr(gaussians, name).copy()
        field[rows] = values
        result[name] = field
    return gaussians._replace(**result), len(rows)


def _plane_maps(axes: Floats, scales: Floats, spans: Floats) -> Floats:
    """Return the maps [M, 3, 3] that take spans ``s_k e_k`` to spans [M, 3, 2], and the normal to their normal."""
    normals = np.cross(spans[:, :, 0], spans[:, :, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    targets = np.concatenate([spans / scales[:, None, :], normals[:, :, None]], axis=2)
    maps: Floats = targets @ np.swapaxes(axes, 1, 2)
    return maps
