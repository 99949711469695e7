"""Flat Gaussians before they are traced, as polygons, beside the gradient.

Both backends use these: they are of the size of the population, and no loop over intersections.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.mechanisms.meshes.fans import N_SIDES, flatten, opacity_radii, plane_axes
from minisplat_ref.reference.covariance import rotation_matrices_vjp
from minisplat_ref.types import Floats


class Polygons(NamedTuple):
    """Flat Gaussians, each in its polygon; float64."""

    means: Floats
    """[N, 3] world frame."""
    spans: Floats
    """[N, 3, 2] ``S = [s_a e_a, s_b e_b]``, perpendicular."""
    radii: Floats
    """[N] r in standard deviations; 0 of an empty polygon."""
    opacities: Floats
    """[N] in [0, 1]."""
    n_sides: int = N_SIDES
    """Of every polygon."""


def polygons_of(population: Any, opacities: Floats, n_sides: int = N_SIDES) -> Polygons:
    """Return the polygons of Gaussians, each flattened into the plane of its two larger axes.

    Parameters
    ----------
    population : Gaussians, or a NamedTuple with its fields
        N rows; the least scale of each does not matter.
    opacities : ndarray of shape (N,)
        Activated, and 0 where a Gaussian is not rendered.
    n_sides : int
        3 or more.
    """
    flat = flatten(population.means, population.quats, population.log_scales)
    return Polygons(flat.means, flat.spans, opacity_radii(population.opacity_logits), opacities, n_sides)


def spans_vjp(population: Any, polygons: Polygons, v_spans: Floats) -> tuple[Floats, Floats]:
    """Gradient of the spans ``S_k = s_k e_k``: ``v_e_k = s_k v_S_k``, ``v_log_s_k = S_k . v_S_k``.

    Parameters
    ----------
    population : Gaussians, or a NamedTuple with its fields
        N rows.
    polygons : Polygons
        Made of it.
    v_spans : ndarray of shape (N, 3, 2)
        Derivative with respect to the spans.

    Returns
    -------
    v_quats : ndarray of shape (N, 4)
    v_log_scales : ndarray of shape (N, 3)
        0 along the normal.
    """
    is_met = np.any(v_spans, axis=(1, 2))  # the others may have no finite spans
    spans = np.where(is_met[:, None, None], polygons.spans, 0.0)
    columns = plane_axes(population.log_scales)[:, :2]  # [N, 2]
    v_log_scales, v_R = np.zeros((len(spans), 3)), np.zeros((len(spans), 3, 3))
    np.put_along_axis(v_log_scales, columns, np.sum(spans * v_spans, axis=1), axis=1)
    scales = np.linalg.norm(spans, axis=1)  # [N, 2]
    np.put_along_axis(v_R, columns[:, None, :], scales[:, None, :] * v_spans, axis=2)
    return rotation_matrices_vjp(population.quats.astype(np.float64), v_R), v_log_scales
