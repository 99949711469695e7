"""Claims of StopThePop (arXiv 2402.00525) and Optimal Projection (arXiv 2402.00752): order and footprints."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, Argument, argument, declare, number, seed
from data_tools.claims.kit.figures import subplots, table_of
from minisplat_ref.constants import EXACT_ORDER, GSPLAT_MAIN, LIST_ORDER, SH_C0, Conventions
from minisplat_ref.interface.palette import BLUE, GREEN, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.orders import blending_order
from minisplat_ref.mechanisms.tangent.planes import hit, project
from minisplat_ref.mechanisms.tangent.rays import (
    METHODS,
    color_changes,
    count_misordered,
    ewa_hits,
    orbit_camera,
    tangent_hits,
    yaw_camera,
)
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import activate
from minisplat_ref.types import Camera, Floats, Gaussians, Primitives

BARE = GSPLAT_MAIN._replace(eps2d=0.0)
ANGLES = (0.0, 15.0, 30.0, 45.0, 55.0)  # degrees off the optical axis
BUFFERS = {"list by distance": LIST_ORDER, "buffer of 4": 4, "buffer of 8": 8, "buffer of 16": 16, "exact": EXACT_ORDER}
ORBIT, ORBIT_STEPS = 2.0, 40  # degrees to either side, and steps
ORBITS = {"orbit": 1, "orbit_in_tenths": 10}
CENTER = np.array([0.0, 0.0, 4.0])  # of the random Gaussians
CHUNK = 64  # pixels at a time
COLORS = (GREY, OCHRE, GREEN, BLUE, RED)


def cloud(n: int, rng: np.random.Generator) -> tuple[Primitives, Floats]:
    """Return n overlapping anisotropic Gaussians around (0, 0, 4), 0.03 to 0.6 large, and their colours [n, 3]."""
    means = rng.normal(size=(n, 3)) * [1.2, 0.8, 0.8] + CENTER
    scales = np.exp(rng.uniform(np.log(0.03), np.log(0.6), (n, 3)))
    return Primitives(means, rng.normal(size=(n, 4)), scales, rng.uniform(0.2, 0.95, n)), rng.uniform(size=(n, 3))


def wide_camera(fov: float = 100.0, width: int = 64, height: int = 64) -> Camera:
    """Return a camera at the origin that looks along z, ``fov`` degrees wide."""
    focal = width / 2 / np.tan(np.radians(fov / 2))
    return Camera(np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height)


def rays_ahead(n: int, half_angle: float) -> Floats:
    """Return n x n rays [n * n, 3] that fill a square of ``half_angle`` degrees around z."""
    slopes = np.linspace(-1, 1, n) * np.tan(np.radians(half_angle))
    x, y = np.meshgrid(slopes, slopes)
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


# --- the rotation ---


def rotation(n: int, n_steps: int, seed: int, conventions: Conventions = GSPLAT_MAIN) -> dict[str, dict[str, Any]]:
    """Return the changes of colours per step by method, in a yaw of +-20 degrees and in an orbit of +-2.

    In the yaw rays stay fixed, and the worst counts. In the orbit, around the middle of the Gaussians, they turn with
    the camera; Gaussians pass each other, so that every order changes. The worst ray and the mean over the rays are
    returned: where the order of two whole Gaussians changes at once, the mean jumps, even if steps are ten times
    shorter; where pixels change one after the other, it does not.
    """
    primitives, colors = cloud(n, np.random.default_rng(seed))
    camera, rays, many_rays = wide_camera(), rays_ahead(8, 18.0), rays_ahead(16, 18.0)
    yaws = [yaw_camera(camera, yaw) for yaw in np.radians(np.linspace(-20, 20, n_steps + 1))]
    found: dict[str, dict[str, Any]] = {}
    for method in kit.with_progress(METHODS, "methods"):
        turned = color_changes(method, primitives, colors, yaws, [rays] * len(yaws), conventions)
        found[method] = {"yaw": turned.largest.tolist()}
        for name, k in ORBITS.items():
            angles = np.radians(np.linspace(-ORBIT, ORBIT, k * ORBIT_STEPS + 1))
            path = [orbit_camera(camera, angle, CENTER) for angle in angles]
            carried = [many_rays @ seen_by.cam_from_world_R for seen_by in path]
            moved = color_changes(method, primitives, colors, path, carried, conventions)
            found[method] |= {
                f"{name}_worst": float(moved.largest.max()),
                f"{name}_mean": float(moved.mean.max()),
                f"{name}_flicker": moved.flicker,
            }
    return found


def run_rotation(args: argparse.Namespace) -> kit.Report:
    """Rotate and move a camera."""
    found = rotation(args.gaussians, args.steps, args.seed)
    keys = [f"{name}_{what}" for what in ("worst", "mean", "flicker") for name in ORBITS]
    rows = [[method, f"{max(v['yaw']):.1e}", *(f"{v[key]:.1e}" for key in keys)] for method, v in found.items()]
    heads = ["worst ray, yaw", "worst ray, orbit", "in tenths", "mean of rays", "in tenths", "flicker", "in tenths"]
    text = (
        f"Largest change of rays' colours in a step: of a yaw of {40 / args.steps:g} degrees, of an orbit of"
        f" {2 * ORBIT / ORBIT_STEPS:g}, and of a tenth of that\n\n"
    )
    result = {**kit.settings_of(args, "gaussians", "seed"), "ways": found}
    return kit.Report(result, draw_rotation(found), text + markdown_table(["method", *heads], rows))


def draw_rotation(found: dict[str, dict[str, Any]]) -> Figure:
    """Draw the largest change in each step of the yaw."""
    figure, axes = subplots((8, 4.2))
    for (method, values), color in zip(found.items(), COLORS, strict=True):
        steps = np.maximum(values["yaw"], 1e-17)
        axes.semilogy(np.linspace(-20, 20, len(steps)), steps, color=color, lw=1.2, label=method)
    axes.set(title="Largest colour change of a fixed ray per step", xlabel="yaw (degrees)", ylim=(1e-17, 1))
    axes.legend()
    return figure


# --- the projection ---


def peak_responses(primitives: Primitives, rays: Floats) -> Floats:
    """Return the peaks ``exp(-min_t |x - t d|^2_C / 2)`` [N, P] on rays from the origin, without any projection."""
    precisions = np.linalg.inv(covariances(primitives.quats, primitives.scales))
    a = np.einsum("pi,nij,pj->np", rays, precisions, rays)
    b = np.einsum("pi,nij,nj->np", rays, precisions, primitives.means)
    c = np.einsum("ni,nij,nj->n", primitives.means, precisions, primitives.means)
    peaks: Floats = np.exp(-(c[:, None] - b * b / a) / 2)
    return peaks


def projection_errors(n: int, seed: int) -> dict[str, list[float]]:
    """Return the errors ``sum |G - peak| / sum peak`` over rays at each angle of ``ANGLES``, as means of n Gaussians.

    The same Gaussians and rays are rotated away from the axis together, so the truth stays.
    """
    rng, rays = np.random.default_rng(seed), rays_ahead(41, 25.0)
    scales = np.exp(rng.uniform(np.log(0.02), np.log(0.15), (n, 3)))
    ahead = Primitives(np.tile([0.0, 0.0, 1.0], (n, 1)), rng.normal(size=(n, 4)), scales, np.ones(n))
    truth = peak_responses(ahead, rays)
    camera = wide_camera(170.0, 2000, 2000)
    found: dict[str, list[float]] = {"EWA": [], "tangent planes": []}
    for angle in kit.with_progress(ANGLES, "angles"):
        seen = yaw_camera(camera, np.radians(angle))  # so that what lay ahead is off the axis
        in_camera = rays @ seen.cam_from_world_R.T
        is_ahead = in_camera[:, 2] > 0.05
        for name, hits in (("EWA", ewa_hits), ("tangent planes", tangent_hits)):
            drawn = hits(ahead, seen, in_camera[is_ahead], BARE)
            expected = truth[drawn.ids][:, is_ahead]
            errors = np.abs(drawn.hit.unclamped - expected).sum(axis=1) / expected.sum(axis=1)
            found[name].append(float(errors.mean()))
    return found


def run_projection(args: argparse.Namespace) -> kit.Report:
    """Measure footprints against the peak along the ray."""
    found = projection_errors(args.gaussians, args.seed)
    by_angle = {
        name: {f"{angle:g} degrees": error for angle, error in zip(ANGLES, errors, strict=True)}
        for name, errors in found.items()
    }
    text = "Error of a footprint against the peak along each ray, sum |G - peak| / sum peak\n\n"
    result = {**kit.settings_of(args, "gaussians", "seed"), "angles": ANGLES, "errors": found}
    return kit.Report(result, draw_projection(found), text + table_of("projection", by_angle, ".3f"))


def draw_projection(found: dict[str, list[float]]) -> Figure:
    """Draw the errors against the angle."""
    figure, axes = subplots((6, 4))
    for (name, errors), color in zip(found.items(), (COLORS[0], COLORS[4]), strict=True):
        axes.plot(ANGLES, errors, "o-", color=color, label=name)
    axes.set(title="Error of the footprint, relative", xlabel="degrees off the axis", ylim=(0, None))
    axes.legend()
    return figure


# --- the order ---


def orders(primitives: Primitives, colors: Floats, camera: Camera, centers: Floats) -> list[dict[str, Any]]:
    """Return the pairs of hits out of order and the errors of colours by order, at image positions ``centers`` [P, 2].

    The first row has the order of 3DGS, by camera z, with the same footprints.
    """
    footprints = project(primitives, camera, GSPLAT_MAIN)
    ways = {"list by z": (LIST_ORDER, footprints.depths)}
    ways |= {name: (buffer_size, footprints.distances) for name, buffer_size in BUFFERS.items()}
    pairs, wrong = dict.fromkeys(ways, 0), dict.fromkeys(ways, 0)
    images: dict[str, list[Floats]] = {name: [] for name in ways}
    ids = np.flatnonzero(footprints.radii[:, 0] > 0)
    for first in kit.with_progress(range(0, len(centers), CHUNK), "pixels"):
        found = hit(footprints, ids, centers[first : first + CHUNK])
        alphas = np.minimum(GSPLAT_MAIN.alpha_max, found.unclamped)
        alphas = np.where(alphas >= GSPLAT_MAIN.alpha_min, alphas, 0)
        rows = np.flatnonzero(alphas.any(axis=1))
        for name, (buffer_size, keys) in ways.items():
            listed = rows[np.argsort(keys[ids[rows]], kind="stable")]
            order = blending_order(alphas[listed] > 0, found.depths[listed], buffer_size)
            a, depths = (np.take_along_axis(array[listed], order, axis=0) for array in (alphas, found.depths))
            T = np.cumprod(np.concatenate([np.ones((1, a.shape[1])), 1 - a]), axis=0)
            images[name].append(np.einsum("gp,gpd->pd", a * T[:-1], colors[ids[listed]][order]))
            n_pairs, n_wrong = count_misordered(a > 0, depths)
            pairs[name], wrong[name] = pairs[name] + n_pairs, wrong[name] + n_wrong
    exact = np.concatenate(images["exact"])
    result = []
    for name, parts in images.items():
        errors = np.abs(np.concatenate(parts) - exact)
        largest, mean = float(errors.max()), float(errors.mean())
        share = wrong[name] / max(pairs[name], 1)
        result.append({"order": name, "misordered": share, "largest_error": largest, "mean_error": mean})
    return result


def run_order(args: argparse.Namespace) -> kit.Report:
    """Count pairs of hits out of order.

    Raises
    ------
    InputError
        The PLY or the cameras beside it cannot be used.
    """
    if args.ply is None:
        primitives, colors = cloud(args.gaussians, np.random.default_rng(args.seed))
        camera, source = wide_camera(70.0), f"{args.gaussians} random Gaussians"
    else:
        gaussians, camera = kit.read_run(args.ply)
        wide = Gaussians._make(field.astype(np.float64) for field in gaussians)
        primitives, colors = activate(wide), np.maximum(0.5 + SH_C0 * wide.sh_dc, 0)
        source = f"{len(colors):,} Gaussians of {args.ply}"
    rows = orders(primitives, colors, camera, grid_centers(camera, args.every))
    table = [
        [row["order"], f"{100 * row['misordered']:.2f}", f"{row['mean_error']:.1e}", f"{row['largest_error']:.1e}"]
        for row in rows
    ]
    text = f"{source}: pairs of hits of a pixel out of order, and colours against the exact order\n\n"
    text += markdown_table(["order", "pairs (%)", "mean error", "largest error"], table)
    return kit.Report({"source": source, "orders": rows}, draw_orders(rows), text)


def draw_orders(rows: list[dict[str, Any]]) -> Figure:
    """Draw the fraction of misordered pairs, and the resulting error of colours."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    names = [row["order"] for row in rows]
    for axes, key, title in zip(
        figure.subplots(1, 2),
        ("misordered", "mean_error"),
        ("Pairs of hits out of order (%)", "Mean error of a colour (% of white)"),
        strict=True,
    ):
        axes.barh(names, [100 * row[key] for row in rows], color=COLORS[3])
        axes.invert_yaxis()
        axes.set_title(title)
    return figure


def grid_centers(camera: Camera, step: int) -> Floats:
    """Return the centres [P, 2] of every ``step``-th pixel along both axes."""
    x, y = np.meshgrid(np.arange(0, camera.width, step) + 0.5, np.arange(0, camera.height, step) + 0.5)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def _cloud(n: int) -> tuple[Argument, ...]:
    return (OUT, number("--gaussians", n, "number of Gaussians"), seed("of the Gaussians"))


CLAIMS = (
    declare(
        "rotation",
        "colours of fixed rays while the camera turns and moves",
        run_rotation,
        *(*_cloud(100), number("--steps", 80, "steps of the yaw")),
    ),
    declare("projection", "footprints against the peak along rays, off the axis", run_projection, *_cloud(20)),
    declare(
        "order",
        "hits out of order in a list and in buffers",
        run_order,
        *_cloud(300),
        argument("--ply", type=Path, metavar="FILE", help="use the PLY of a run, seen by its first test camera"),
        number("--every", 4, "N-th pixels along both axes"),
    ),
)
