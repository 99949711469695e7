"""Measurements of the claims ``vr/foveation``, ``vr/queues`` and ``vr/yaw`` (VRSplat, arXiv 2505.10144)."""

import argparse
import statistics
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import subplots
from data_tools.claims.vr import queues
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.extensions.vr.foveation import Gaze, Zone, eccentricities, render_foveated, resolved_angles
from minisplat_ref.extensions.vr.model import BUFFER
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io import load_ply
from minisplat_ref.mechanisms.tangent.rays import color_changes, ewa_hits, tangent_hits, yaw_camera
from minisplat_ref.mechanisms.tangent.renderer import prepare
from minisplat_ref.rendering import Request, activate
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Camera, Floats, Gaussians, Ints, Model, Primitives, View

EVERYWHERE = 180.0  # degrees: every pixel is drawn
METHODS = ("3DGS: EWA, by z", "tangent planes, buffer of 16", "tangent planes, exact order")
COLORS = (GREY, BLUE, RED)
FULLS = (2.0, 4.0, 8.0, 12.0)  # degrees
COUNTS = ("n_tiles", "n_samples", "n_pairs")
HALF_ANGLE = 10.0  # of the yaw, degrees


def weighted_psnr(image: Floats, target: Floats, angles: Floats) -> float:
    """Return the PSNR, dB, with pixels weighted by the resolution of the eye, ``1 / MAR(e)^2``.

    Parameters
    ----------
    image, target : ndarray of shape (H, W, 3)
        In [0, 1].
    angles : ndarray of shape (H, W)
        Eccentricities, degrees.
    """
    weights = 1 / resolved_angles(angles) ** 2
    squared = np.mean((np.clip(image, 0, 1).astype(np.float64) - target) ** 2, axis=2)
    return float(-10 * np.log10(np.average(squared, weights=weights)))


def measure_foveation(
    model: Model, views: Sequence[View], background: Floats, fulls: Sequence[float], repeats: int
) -> list[dict[str, Any]]:
    """Return work and errors for each angle of ``fulls``, after those of images that are drawn in full everywhere.

    The eye looks at the middle of each view. Counts are totals over the views.
    """
    request, rows = Request(background, backend=CPU), []
    whole: list[Floats] = []
    for full in kit.with_progress((EVERYWHERE, *fulls), "angles"):
        psnrs, against_whole, plain, times = [], [], [], []
        zones: list[list[Zone]] = []
        for v, view in enumerate(views):
            camera = view.camera
            gaze = Gaze(camera.width / 2, camera.height / 2, full)
            seconds = []
            for _ in range(repeats):
                start = time.perf_counter()
                image, found = render_foveated(model, camera, request, gaze, BUFFER)
                seconds.append(time.perf_counter() - start)
            if full == EVERYWHERE:
                whole.append(image)
            zones.append(found)
            times.append(min(seconds))
            angles, truth = eccentricities(camera, gaze.x, gaze.y), view.load().image / 255
            psnrs.append(weighted_psnr(image, truth, angles))
            plain.append(weighted_psnr(image, truth, np.zeros_like(angles)))
            if full != EVERYWHERE:
                against_whole.append(weighted_psnr(image, np.clip(whole[v], 0, 1), angles))
        by_zone = [
            {"block": z[0].block, "begins": z[0].begins, **{n: sum(getattr(one, n) for one in z) for n in COUNTS}}
            for z in zip(*zones, strict=True)
        ]
        rows.append(
            {
                "full": full,
                "zones": by_zone,
                **{name: sum(zone[name] for zone in by_zone) for name in COUNTS},
                "seconds": sum(times),
                "weighted_psnr": statistics.mean(psnrs),
                "psnr": statistics.mean(plain),
                "weighted_psnr_of_whole": statistics.mean(against_whole) if against_whole else None,
            }
        )
    return rows


def run_foveation(args: argparse.Namespace) -> kit.Report:
    """Render the test views at rates by eccentricity."""
    scene, model = kit.read_scene(args.scene, args.downscale), Model(load_ply(args.ply))
    rows = measure_foveation(model, scene.test_views, scene.background, FULLS, args.repeats)
    first, *others = rows
    names = ["everywhere", *(f"{row['full']:g} degrees" for row in others)]
    table = [
        [
            name,
            *(f"{100 * row[key] / first[key]:.0f}" for key in ("n_samples", "n_pairs", "seconds")),
            *(f"{row[key]:.2f}" for key in ("weighted_psnr", "psnr")),
            "" if row is first else f"{row['weighted_psnr_of_whole']:.1f}",
        ]
        for name, row in zip(names, rows, strict=True)
    ]
    quality = ("weighted PSNR (dB)", "PSNR (dB)", "of the whole image (dB)")
    zones = [
        [f"{row['full']:g}", f"{zone['begins']:.1f}", str(zone["block"] ** 2), *(f"{zone[n]:,}" for n in COUNTS[:2])]
        for row in others
        for zone in row["zones"]
    ]
    n = len(model.gaussians.means)
    text = f"{scene.name}, {len(scene.test_views)} test views, {n:,} Gaussians, gaze in the middle\n\n"
    text += markdown_table(["in full", "rays (%)", "pairs (%)", "time (%)", *quality], table) + "\n\n"
    text += markdown_table(["in full (degrees)", "zone begins at", "pixels a ray", "tiles", "rays"], zones)
    return kit.Report({"scene": scene.name, "gaussians": n, "rows": rows}, draw_foveated(rows), text)


def draw_foveated(rows: list[dict[str, Any]]) -> Figure:
    """Draw the weighted PSNR against the number of rays."""
    figure, axes = subplots((6.5, 4))
    work = [100 * row["n_samples"] / rows[0]["n_samples"] for row in rows]
    axes.plot(work, [row["weighted_psnr"] for row in rows], "o", color=COLORS[2], label="weighted by acuity")
    axes.plot(work, [row["psnr"] for row in rows], "o", color=COLORS[0], label="unweighted")
    for x, row in zip(work, rows, strict=True):
        label = "everywhere" if row["full"] == EVERYWHERE else f"{row['full']:g} degrees"
        axes.annotate(label, (x, row["weighted_psnr"]), fontsize=8, xytext=(4, 4), textcoords="offset points")
    axes.set(title="Test views: PSNR (dB)", xlabel="rays drawn (% of the pixels)")
    axes.legend()
    return figure


def yaw_steps(
    gaussians: Gaussians, camera: Camera, n_rays: int, half_angle: float, n_steps: int
) -> dict[str, list[float]]:
    """Return the largest change of any ray's colour in each step of a yaw of +-``half_angle`` degrees, by method.

    There are n_rays x n_rays rays within 6 degrees of the camera's axis. Gaussians have their colours of degree 0;
    those that no ray hits at any of five of the cameras are left out.
    """
    wide = Gaussians._make(field.astype(np.float64) for field in gaussians)
    primitives, colors = activate(wide), np.maximum(0.5 + SH_C0 * wide.sh_dc, 0)
    slopes = np.linspace(-1, 1, n_rays) * np.tan(np.radians(6.0))
    x, y = np.meshgrid(slopes, slopes)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ camera.cam_from_world_R
    path = [yaw_camera(camera, yaw) for yaw in np.radians(np.linspace(-half_angle, half_angle, n_steps + 1))]
    rows = _hit_rows(primitives, path[:: max(n_steps // 4, 1)], rays)
    seen = Primitives._make(field[rows] for field in primitives)
    seen_by = (seen, colors[rows], path, [rays] * len(path), GSPLAT_MAIN)
    return {
        method: color_changes(method, *seen_by).largest.tolist() for method in kit.with_progress(METHODS, "methods")
    }


def _hit_rows(primitives: Primitives, cameras: Sequence[Camera], rays: Floats) -> Ints:
    is_hit = np.zeros(len(primitives.means), bool)
    for camera in cameras:
        for hits in (ewa_hits, tangent_hits):
            found = hits(primitives, camera, rays @ camera.cam_from_world_R.T, GSPLAT_MAIN)
            is_hit[found.ids] |= (found.hit.unclamped >= GSPLAT_MAIN.alpha_min).any(axis=1)
    return np.flatnonzero(is_hit)


def run_yaw(args: argparse.Namespace) -> kit.Report:
    """Yaw the first test camera of a run."""
    gaussians, camera = kit.read_run(args.ply)
    found = yaw_steps(gaussians, camera, 6, HALF_ANGLE, args.steps)
    step, n = 2 * HALF_ANGLE / args.steps, len(gaussians.means)
    rows = [[method, f"{max(steps):.1e}", f"{sorted(steps)[len(steps) // 2]:.1e}"] for method, steps in found.items()]
    text = f"Largest change of a fixed ray's colour in a step of {step:g} degrees, {n:,} Gaussians\n\n"
    text += markdown_table(["method", "largest", "median of the steps"], rows)
    return kit.Report({"gaussians": n, "steps": args.steps, "ways": found}, draw_yaw(found, HALF_ANGLE), text)


def draw_yaw(found: dict[str, list[float]], half_angle: float) -> Figure:
    """Draw the largest change in each step."""
    figure, axes = subplots((8, 4))
    for (method, steps), color in zip(found.items(), COLORS, strict=True):
        axes.semilogy(
            np.linspace(-half_angle, half_angle, len(steps)), np.maximum(steps, 1e-17), color=color, label=method
        )
    axes.set(title="Largest colour change of a fixed ray per step", xlabel="yaw (degrees)", ylim=(1e-17, 1))
    axes.legend()
    return figure


def run_queues(args: argparse.Namespace) -> kit.Report:
    """Order the hits of the first test view of a run in several ways."""
    gaussians, camera = kit.read_run(args.ply)
    wide = Gaussians._make(field.astype(np.float64) for field in gaussians)
    prepared = prepare(Model(wide), camera, Request(backend=REFERENCE), None)
    images, works = queues.draw(prepared, queues.ORDERS)
    exact, rows = images[-1], []
    for stages, image, work in zip(queues.ORDERS, images, works, strict=True):
        largest = float(np.abs(image - exact).max())
        psnr = None if stages is queues.EXACT else kit.psnr_of(image, exact)
        rows.append({"order": stages.name, **work._asdict(), "psnr": psnr, "largest": largest})
    table = [
        [
            row["order"],
            *(f"{row[key] / row['n_hits']:.2f}" for key in ("n_depths", "n_steps")),
            f"{100 * row['n_wrong'] / max(row['n_pairs'], 1):.3f}",
            "" if row["psnr"] is None else f"{row['psnr']:.1f}",
            f"{255 * row['largest']:.1f}",
        ]
        for row in rows
    ]
    heading = ["order", "depths per hit", "steps per hit", "wrong pairs (%)", "PSNR (dB)", "largest error (levels)"]
    n, n_hits = len(wide.means), rows[0]["n_hits"]
    text = f"{n:,} Gaussians, {camera.width} x {camera.height} pixels, {n_hits / exact[..., 0].size:.1f} hits per pixel"
    text += ", against exact order\n\n" + markdown_table(heading, table)
    return kit.Report({"gaussians": n, "rows": rows}, draw_orders(rows), text)


def draw_orders(rows: list[dict[str, Any]]) -> Figure:
    """Draw the pairs in the wrong order against the work."""
    figure, axes = subplots((8, 4))
    for i, row in enumerate(rows):
        x, y = (row["n_depths"] + row["n_steps"]) / row["n_hits"], row["n_wrong"] / max(row["n_pairs"], 1)
        axes.plot(x, y, "o", color=RED if row["order"] == queues.HIERARCHY.name else BLUE)
        axes.annotate(row["order"], (x, y), fontsize=8, xytext=(6, 8 - 8 * (i % 3)), textcoords="offset points")
    axes.set_yscale("symlog", linthresh=1e-5)
    axes.set(title="Pairs of hits in the wrong order", xlabel="depths and steps of insertion, per hit", ylabel="share")
    return figure
