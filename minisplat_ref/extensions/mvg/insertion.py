"""From the depth maps of views to the points at which Gaussians are inserted.

Each map is smoothed along its photograph. A pixel stays if enough other views agree on its depth; the mean of all that
agree is its depth from then on. A smoothed histogram of all these depths separates near, middle and far. Pixels of the
near and of the far level are taken on a grid whose stride is the level's, each with the normal of its smoothed map and
with the radius ``r = D / f * stride``, which is the spacing of the grid on the surface. A point within the radius of an
older one is left out, so surfaces that several views show are covered once.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.mechanisms.depth_maps.bilateral import BilateralWidths, joint_bilateral_depth
from minisplat_ref.mechanisms.depth_maps.normals import central_normals
from minisplat_ref.mechanisms.depth_maps.reprojection import DepthView, Tolerances, agree, nearest_views, unproject
from minisplat_ref.strategy.ops import take
from minisplat_ref.types import Bools, Floats, Ints

N_BINS = 512
BANDWIDTH = 0.9  # Silverman's factor
HALF = 0.5  # of the peak: denser depths are the middle
NEAR, MIDDLE, FAR = 0, 1, 2
WIDTHS = BilateralWidths(radius=2, spatial=1.0, color=0.1)


class Density(NamedTuple):
    """The distribution of depths."""

    depths: Floats
    """[B] middles of the bins, world units."""
    values: Floats
    """[B] per world unit; their integral is 1."""


def depth_density(depths: Floats) -> Density:
    """Return the kernel density of depths, by convolution in the Fourier domain.

    With the histogram h, and the Gaussian kernel whose width is Silverman's::

        p = irfft(rfft(h) exp(-(2 pi f sigma)^2 / 2)),   sigma = 0.9 min(std, IQR / 1.34) P^(-1/5)

    Parameters
    ----------
    depths : ndarray of shape (P,)
        World units, not all equal.
    """
    low, high = float(depths.min()), float(depths.max())
    quartiles = np.quantile(depths, [0.25, 0.75])
    spread = min(float(depths.std()), float(quartiles[1] - quartiles[0]) / 1.34) or float(depths.std())
    sigma = BANDWIDTH * spread * len(depths) ** -0.2
    margin = 4 * sigma  # so that what wraps around is zero
    h, edges = np.histogram(depths, N_BINS, (low - margin, high + margin))
    width = edges[1] - edges[0]
    frequencies = np.fft.rfftfreq(N_BINS, width)  # per world unit
    smooth = np.fft.irfft(np.fft.rfft(h) * np.exp(-0.5 * (2 * np.pi * frequencies * sigma) ** 2), N_BINS)
    return Density((edges[:-1] + edges[1:]) / 2, np.maximum(smooth, 0) / (len(depths) * width))


def depth_cuts(depths: Floats) -> tuple[float, float]:
    """Return the depths between near and middle, and between middle and far.

    The middle is the interval around the highest peak of the density in which it is above half of it. The quantiles at
    which depths are cut adapt to the scene in this way: a wall behind an object has a narrow peak, and all of the
    object is near.

    Parameters
    ----------
    depths : ndarray of shape (P,)
        World units, at least one.
    """
    if np.ptp(depths) == 0:
        return float(depths[0]), float(depths[0])
    density = depth_density(depths)
    peak = int(np.argmax(density.values))
    is_low = density.values < HALF * density.values[peak]
    before, after = np.flatnonzero(is_low[:peak]), np.flatnonzero(is_low[peak:])
    first = before[-1] if len(before) else 0
    last = peak + after[0] if len(after) else N_BINS - 1
    return float(density.depths[first]), float(density.depths[last])


def assign_levels(depths: Floats, cuts: tuple[float, float]) -> Ints:
    """Return 0, 1 or 2 for each depth: near, middle, far."""
    near, far = cuts
    return np.where(depths < near, NEAR, np.where(depths > far, FAR, MIDDLE))


def choose_grid_pixels(shape: tuple[int, int], stride: int, corner: tuple[int, int]) -> Bools:
    """Return which pixels [H, W] are those of every ``stride``-th row and column, from a corner on; none for 0."""
    chosen = np.zeros(shape, bool)
    if stride:
        chosen[corner[0] % stride :: stride, corner[1] % stride :: stride] = True
    return chosen


class Photographed(NamedTuple):
    """A depth map and its photograph."""

    seen: DepthView
    image: Floats
    """[H, W, 3] RGB in [0, 1]."""


class Rules(NamedTuple):
    """The choice of pixels that become points."""

    tolerances: Tolerances
    n_sources: int
    """Views that vote on a pixel: the nearest. Without a test, 0."""
    strides: tuple[int, int, int]
    """Pixels between two points, by level: near, middle, far; 0 for no points."""


class Insertions(NamedTuple):
    """Points of surfaces, and the appearance of Gaussians there."""

    points: Floats
    """[M, 3] world frame."""
    normals: Floats
    """[M, 3] unit vectors, world frame, towards the camera."""
    radii: Floats
    """[M] world units."""
    colors: Floats
    """[M, 3] RGB in [0, 1]."""
    levels: Ints
    """[M] near, middle, far."""
    views: Ints
    """[M] the view of the pixel."""
    pixels: Ints
    """[M] the pixel, counted row by row."""


def smooth_map(view: Photographed) -> Photographed:
    """Return a view whose depths are smoothed along its photograph."""
    smooth = joint_bilateral_depth(view.seen.depth, view.image, WIDTHS)
    return view._replace(seen=view.seen._replace(depth=smooth))


def agreed_depths(views: Sequence[Photographed], rules: Rules) -> list[Floats]:
    """Return for each view the depths [H, W] on which enough others agree, 0 elsewhere; all of them without a test."""
    maps = [view.seen for view in views]
    if rules.n_sources == 0:
        return [view.depth for view in maps]
    sources = nearest_views([view.camera for view in maps], rules.n_sources)
    return [
        agree(view, [maps[k] for k in near], rules.tolerances).depth for view, near in zip(maps, sources, strict=True)
    ]


def propose(views: Sequence[Photographed], rules: Rules, rng: np.random.Generator) -> Insertions:
    """Return the points that the depth maps of views propose, those of the first view first.

    Parameters
    ----------
    views : sequence of Photographed
        Their depths as they shall be tested; :func:`smooth_map` first.
    rules : Rules
    rng : Generator
        Of the places where each view's grids begin.
    """
    fused = agreed_depths(views, rules)
    known = np.concatenate([depth[depth > 0] for depth in fused])
    cuts = depth_cuts(known) if len(known) else (0.0, 0.0)
    parts = [
        _propose_in_view(
            view._replace(seen=view.seen._replace(depth=depth)), view.seen.depth, cuts, rules.strides, i, rng
        )
        for i, (view, depth) in enumerate(zip(views, fused, strict=True))
    ]
    joined: list[Any] = [np.concatenate(fields) for fields in zip(*parts, strict=True)]
    return Insertions(*joined)


def _propose_in_view(
    view: Photographed,
    smooth: Floats,
    cuts: tuple[float, float],
    strides: tuple[int, int, int],
    index: int,
    rng: np.random.Generator,
) -> Insertions:
    """Return the points of one view, whose depths are those agreed upon; normals are of the depths before that."""
    depth, camera = view.seen.depth, view.seen.camera
    levels = assign_levels(depth, cuts)
    normals = central_normals(smooth.astype(np.float64), camera)
    is_chosen = np.zeros(depth.shape, bool)
    for level, stride in enumerate(strides):
        corner = rng.integers(0, max(stride, 1), 2)
        is_chosen |= (levels == level) & choose_grid_pixels(depth.shape, stride, (int(corner[0]), int(corner[1])))
    is_chosen &= (depth > 0) & _is_inner(smooth) & (np.abs(normals).sum(axis=2) > 0)
    pixels = np.flatnonzero(is_chosen)
    spacing = np.take(strides, levels[is_chosen]) / np.sqrt(camera.fx * camera.fy)
    return Insertions(
        unproject(view.seen)[is_chosen],
        normals[is_chosen] @ camera.cam_from_world_R,
        depth[is_chosen] * spacing,
        view.image[is_chosen],
        levels[is_chosen],
        np.full(len(pixels), index),
        pixels,
    )


def _is_inner(depth: Floats) -> Bools:
    """Return which pixels have four neighbours with a depth."""
    has = depth > 0
    inner = np.zeros_like(has)
    inner[1:-1, 1:-1] = has[2:, 1:-1] & has[:-2, 1:-1] & has[1:-1, 2:] & has[1:-1, :-2]
    return inner


def drop_covered(found: Insertions, older: Floats) -> Insertions:
    """Return the insertions that are further than their radius from older points [N, 3] and from those before them."""
    is_kept = np.ones(len(found.points), bool)
    if len(older):
        is_kept = cKDTree(older).query(found.points)[0] > found.radii
    rows = np.flatnonzero(is_kept)
    tree = cKDTree(found.points[rows])
    near = tree.query_ball_point(found.points[rows], found.radii[rows])
    stays = np.zeros(len(rows), bool)
    for i, others in enumerate(near):
        stays[i] = not any(stays[j] for j in others if j < i)
    return take(found, rows[stays])
