"""Claim ``lens/footprints`` (arXiv 2412.12507): footprints of three kinds against the peak along the ray, off the axis.

Random Gaussians at distance 1 are turned away from the axis of a pinhole and of an equidistant fisheye. The truth in a
pixel is the maximum of the Gaussian along its ray. EWA is the conic of the first-order expansion of the lens at the
mean, UT that of the moments of seven sigma points, both without a low-pass; exact is the renderer's response, cut at
the bounds that the unscented transform gives it, so that its error is what these bounds leave out. They
may leave out alphas below ``alpha_min``, which are no hits; ``bounds`` is the part of this error in pixels above it,
where the bounds are wrong.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import table_of
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.interface.palette import BLUE, GREEN, GREY, RED
from minisplat_ref.mechanisms.cameras.models import model_of, ray_table
from minisplat_ref.mechanisms.cameras.ray_footprints import hit, project
from minisplat_ref.mechanisms.cameras.unscented import unscented
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Camera, Floats, Optics, Primitives

ANGLES = {"pinhole": (0.0, 15.0, 30.0, 45.0, 55.0), "fisheye": (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)}
COLORS = {"EWA": GREY, "UT": BLUE, "exact": RED, "bounds": GREEN}
SIZE = 400  # pixels of the image's sides
HALF_ANGLES = {"pinhole": 70.0, "fisheye": 100.0}  # degrees from the axis to the image's edge


def camera_of(kind: str) -> Camera:
    """Return the camera at the origin, which looks along z."""
    edge = np.radians(HALF_ANGLES[kind])
    focal = SIZE / 2 / (np.tan(edge) if kind == "pinhole" else edge)
    optics = None if kind == "pinhole" else Optics("fisheye", (0.0, 0.0, 0.0, 0.0))
    return Camera(np.eye(3), np.zeros(3), focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE, optics)


def turn(angle: float) -> Floats:
    """Return the rotation [3, 3] from the z axis towards x by an angle, degrees."""
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def errors_at(ahead: Primitives, angle: float, kind: str) -> dict[str, float]:
    """Return the errors ``sum |G - peak| / sum peak`` of the kinds of footprints, as means of the Gaussians."""
    camera, R = camera_of(kind), turn(angle)
    model = model_of(camera)
    axes = R @ rotation_matrices(ahead.quats) * ahead.scales[:, None, :]  # [N, 3, 3] in the camera's frame
    x = ahead.means @ R.T
    grid = np.arange(SIZE) + 0.5
    pixels = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    rays = np.moveaxis(ray_table(camera).reshape(SIZE, 3, -1)[:, :, :SIZE], 1, 2).reshape(-1, 3)
    P = np.linalg.inv(axes @ np.swapaxes(axes, 1, 2))
    J = model.jacobians(x, camera)
    conics = {
        "EWA": (model.project(x, camera), J @ axes @ np.swapaxes(J @ axes, 1, 2)),
        "UT": unscented(x, axes, model, camera)[:2],
    }
    # The camera turns instead of the Gaussians, so that quaternions stay.
    seen = project(ahead, camera._replace(cam_from_world_R=R), GSPLAT_MAIN)
    sums: dict[str, list[float]] = {name: [] for name in COLORS}
    for n in range(len(x)):
        peaks = _peaks(x[n], P[n], rays)
        total = peaks.sum()
        for name, (means2d, C) in conics.items():
            offsets = pixels - means2d[n]
            flat = np.exp(-np.einsum("pi,ij,pj->p", offsets, np.linalg.inv(C[n]), offsets) / 2)
            sums[name].append(float(np.abs(flat - peaks).sum() / total))
        x0, y0, x1, y1 = seen.boxes[n]
        is_inside = (pixels > (x0, y0)).all(axis=1) & (pixels < (x1, y1)).all(axis=1)
        drawn = np.where(is_inside, hit(seen, np.array([n]), pixels).unclamped[0], 0)
        errors = np.abs(drawn - peaks)
        sums["exact"].append(float(errors.sum() / total))
        sums["bounds"].append(float(errors[peaks >= GSPLAT_MAIN.alpha_min].sum() / total))
    return {name: float(np.mean(values)) for name, values in sums.items()}


def _peaks(x: Floats, P: Floats, rays: Floats) -> Floats:
    """Return the maximum of one Gaussian along each of P rays from the origin; 0 behind it."""
    a, b = np.einsum("pi,ij,pj->p", rays, P, rays), rays @ P @ x
    return np.where(b > 0, np.exp(-(x @ P @ x - b * b / a) / 2), 0)


def measure(n: int, seed: int) -> dict[str, dict[str, list[float]]]:
    """Return the errors over ``ANGLES``, by camera and kind of footprint."""
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.uniform(np.log(0.02), np.log(0.15), (n, 3)))
    ahead = Primitives(np.tile([0.0, 0.0, 1.0], (n, 1)), rng.normal(size=(n, 4)), scales, np.ones(n))
    found: dict[str, dict[str, list[float]]] = {}
    for kind, angles in ANGLES.items():
        rows = [errors_at(ahead, angle, kind) for angle in kit.with_progress(angles, kind)]
        found[kind] = {name: [row[name] for row in rows] for name in COLORS}
    return found


def run(args: argparse.Namespace) -> kit.Report:
    """Measure footprints against the peak along the ray."""
    found = measure(args.gaussians, args.seed)
    parts = ["Error of a footprint against the peak along each ray, sum |G - peak| / sum peak"]
    for kind, errors in found.items():
        by_angle = {
            name: {f"{angle:g} degrees": value for angle, value in zip(ANGLES[kind], values, strict=True)}
            for name, values in errors.items()
        }
        parts.append(table_of(kind, by_angle, ".4f"))
    result: dict[str, Any] = {**kit.settings_of(args, "gaussians", "seed"), "angles": ANGLES, "errors": found}
    return kit.Report(result, draw(found), "\n\n".join(parts))


def draw(found: dict[str, dict[str, list[float]]]) -> Figure:
    """Draw the errors against the angle to the axis, for each camera."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    for axes, (kind, errors) in zip(figure.subplots(1, 2, sharey=True), found.items(), strict=True):
        for name, values in errors.items():
            axes.plot(ANGLES[kind], values, "o-", color=COLORS[name], label=name)
        axes.set(title=f"Error of the footprint, {kind}", xlabel="degrees off the axis")
    axes.set_ylim(bottom=0)  # last, as it ends the scaling of both panels
    axes.legend()
    return figure
