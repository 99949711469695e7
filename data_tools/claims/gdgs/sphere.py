"""Claim ``gdgs/sphere``: what each part of GDGS does to noisy points of a sphere, without any photograph.

The paper is GDGS, arXiv 2507.00363. Points of a unit sphere with noise along all axes become Gaussians: where they are,
where the predictor puts them, and after steps of gradient descent on the attraction, on it with contraction, and on it
with dispersion.
"""

import argparse
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from data_tools.claims import kit
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.extensions.gdgs.model import Weights, attract, contract, densest, disperse, regions_of
from minisplat_ref.extensions.gdgs.recipe import N_CELLS, N_TOP, on_planes, spacing_of
from minisplat_ref.mechanisms.oriented.planes import fit_planes
from minisplat_ref.mechanisms.oriented.thin_axis import angles_between, normals_of
from minisplat_ref.types import Floats, Gaussians

N_POINTS, NOISE = 2000, 0.05  # of a unit sphere
ONLY_POSITIONS = Weights(1.0, 0.0, 0.0)
RATE = 0.2  # of the distance to the plane, for each step
CROWDING_RATE = 0.01  # of the region's side: the longest step by the terms on crowds
ARMS = ("points", "predictor and planes", "attraction", "attraction and contraction", "attraction and dispersion")
COLUMNS = (
    ("distance to the sphere (RMS)", spread("distance", 4)),
    ("angle of normals (degrees)", spread("angle", 1)),
    ("spacing (variation)", spread("spacing", 3)),
)


def run(args: argparse.Namespace) -> str:
    """Return the table."""
    found = [measure(args.steps, seed) for seed in kit.with_progress(range(args.seeds), "seeds")]
    records = [{"arm": arm, **measured} for of_seed in found for arm, measured in of_seed.items()]
    text = f"{N_POINTS:,} points of a unit sphere with noise {NOISE:g}; {args.steps} steps; {args.seeds} seeds"
    return f"{text}\n\n{table(records, {'arm': 'Gaussians'}, COLUMNS)}"


def measure(steps: int, seed: int) -> dict[str, dict[str, float]]:
    """Return what each arm ends with."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(N_POINTS, 3))
    points = points / np.linalg.norm(points, axis=1, keepdims=True) + NOISE * rng.normal(size=points.shape)
    start = _gaussians(points)
    planes = on_planes(start, rng)
    ends = {"points": start, "predictor and planes": planes}
    for arm in ARMS[2:]:
        ends[arm] = planes._replace(means=_descend(planes, points, arm.rpartition(" ")[2], steps))
    return {arm: _measures(end) for arm, end in ends.items()}


def _gaussians(points: Floats) -> Gaussians:
    n = len(points)
    quats = np.tile((1.0, 0, 0, 0), (n, 1))
    return Gaussians(points, quats, np.full((n, 3), -3.0), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 0, 3)))


def _descend(gaussians: Any, points: Floats, crowd: str, steps: int) -> Floats:
    """Return the means after steps down the gradient of the attraction, and of a term on the densest regions."""
    planes, regions = fit_planes(points), regions_of(points, N_CELLS)
    for _ in range(steps):
        pull = attract(gaussians, planes, ONLY_POSITIONS, 0.0, 1.0).means * len(points) / 2
        means = gaussians.means - RATE * pull
        if crowd != "attraction":
            members = densest(means, regions, N_TOP)
            _, crowding = (
                contract(means, members, regions.side)
                if crowd == "contraction"
                else disperse(means, members, spacing_of(regions))
            )
            means = means - CROWDING_RATE * regions.side * crowding / max(
                float(np.linalg.norm(crowding, axis=1).max()), 1e-12
            )
        gaussians = gaussians._replace(means=means)
    ends: Floats = gaussians.means
    return ends


def _measures(gaussians: Any) -> dict[str, float]:
    """Return distance, angle and the coefficient of variation of nearest neighbours' distances in crowded regions."""
    means = gaussians.means
    radii = np.linalg.norm(means, axis=1)
    members = densest(means, regions_of(means, N_CELLS), N_TOP)
    gaps = cKDTree(means).query(means, 2)[0][:, 1]
    crowded = gaps[np.concatenate(members)]
    return {
        "distance": float(np.sqrt(np.mean((radii - 1) ** 2))),
        "angle": float(np.median(angles_between(normals_of(gaussians), means / radii[:, None]))),
        "spacing": float(crowded.std() / crowded.mean()),
    }
