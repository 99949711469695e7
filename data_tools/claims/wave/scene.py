"""Claim ``wave/scene`` (Gaussian Wave Splatting, arXiv 2505.06582): holograms of a trained scene against its rendering.

*In one plane.* A box thinner than a wavelength has everything in focus. What differs from the rendering by the run's
own renderer is what flattening, the Jacobian and the windows cost.

*In depth.* The pixels of the rendering are divided into thirds by depth. The hologram is focused on many depths, and
the PSNR of each third is measured against the rendering: it should be best where the third is.
"""

import argparse
import time
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import show, subplots, table_of
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.extensions.wave.focus import Hologram, reconstruct
from minisplat_ref.extensions.wave.hologram import BLENDING, PITCH, THICKNESS, WAVELENGTHS, place, steepest_slope
from minisplat_ref.extensions.wave.model import Grid
from minisplat_ref.interface.palette import BLUE, GREEN, RED
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.io.ply import read_label
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.types import Camera, Floats, Gaussians, Model, view_from

THIN = 1e-7  # metres
N_FOCI = 15
THIRDS = {"near": BLUE, "middle": GREEN, "far": RED}
EDGE = 8  # pixels along the sides, where the display ends, that do not count


def hologram_of(gaussians: Gaussians, camera: Camera, thickness: float, blending: str = "exact") -> Hologram:
    """Return the hologram of what a camera sees, of a pixel for each of its own, in a box of a thickness in metres."""
    pitch, wavelengths = PITCH * 1e-6, np.array(WAVELENGTHS) * 1e-9
    steepest = steepest_slope(float(wavelengths.max()), pitch)
    placed = place(gaussians, camera, camera.width * pitch, thickness, steepest, GSPLAT_MAIN)
    grid = Grid(camera.width, camera.height, pitch)
    blend = BLENDING[blending]
    fields = np.stack([blend(placed.scene, grid, float(w), channel) for channel, w in enumerate(wavelengths)])
    return Hologram(fields, wavelengths, pitch, np.array([placed.box.nearest, placed.box.farthest]), thickness)


def run(args: argparse.Namespace) -> kit.Report:
    """Render, make holograms, focus them."""
    gaussians, camera = kit.read_run(args.ply)
    image, depth = _render(gaussians, camera, read_label(args.ply).extension)
    thirds = _thirds(depth)
    thin = reconstruct(hologram_of(gaussians, camera, THIN), 0.0)
    start = time.process_time()
    hologram = hologram_of(gaussians, camera, THICKNESS * 1e-3)
    seconds = time.process_time() - start
    inverse = np.linspace(1 / hologram.depths[0], 1 / hologram.depths[1], N_FOCI)
    foci = 1 / inverse
    stack = [reconstruct(hologram, hologram.z_of(focus)) for focus in foci]
    curves = {name: [kit.psnr_of(seen[is_in], image[is_in]) for seen in stack] for name, is_in in thirds.items()}
    table = {
        name: {
            "depth": float(np.median(depth[is_in])),
            "best focus": float(foci[int(np.argmax(curves[name]))]),
            "PSNR there": max(curves[name]),
            "focused nearest": curves[name][0],
            "focused farthest": curves[name][-1],
        }
        for name, is_in in thirds.items()
    }
    middle = hologram.z_of(table["middle"]["depth"])
    phases = reconstruct(hologram, middle, is_phase_only=True)
    counted = np.any(list(thirds.values()), axis=0)
    plain = {
        "in one plane": kit.psnr_of(thin[counted], image[counted]),
        "phases alone against the field": kit.psnr_of(
            phases[counted], np.clip(reconstruct(hologram, middle), 0, 1)[counted]
        ),
    }
    result = {
        "machine": describe_machine(),
        "size": [camera.width, camera.height],
        "gaussians": len(gaussians.means),
        "seconds": seconds,
        "psnr": plain,
        "thirds": table,
        "foci": foci.tolist(),
        "curves": curves,
    }
    text = (
        f"{camera.width} x {camera.height} pixels of {PITCH:g} um, {len(gaussians.means):,} Gaussians;"
        f" {result['machine']}; {seconds:.0f} s\n\nPSNR, dB: {', '.join(f'{k} {v:.1f}' for k, v in plain.items())}\n\n"
        f"PSNR of thirds of the pixels by depth\n\n{table_of('third', table, '.3g')}"
    )
    best = [stack[int(np.argmax(curves[name]))] for name in ("near", "far")]
    return kit.Report(result, draw(result, [image, *best, phases]), text)


def _render(gaussians: Gaussians, camera: Camera, extension: str | None) -> tuple[Floats, Floats]:
    """Return image [H, W, 3] and depth [H, W] by the renderer that the file is made for."""
    renderer = SPLATTING if extension is None else load_extension(extension).representation.renderer
    wants = frozenset({"depth"})
    output, _ = renderer.render(Model(gaussians), view_from(camera), Request(wants=wants))
    sums = output.image[..., renderer.channels(wants)["depth"]][..., 0]
    return np.clip(output.image[..., :3], 0, 1).astype(np.float64), expected_depth(sums, output.alpha)


def _thirds(depth: Floats) -> dict[str, Any]:
    """Return which pixels [H, W] are in each third by depth; those along the sides are in none."""
    is_inside = np.zeros(depth.shape, bool)
    is_inside[EDGE:-EDGE, EDGE:-EDGE] = True
    is_inside &= depth > 0
    bounds = np.quantile(depth[is_inside], [0, 1 / 3, 2 / 3, 1])
    which = np.clip(np.searchsorted(bounds, depth, side="right") - 1, 0, 2)
    return {name: is_inside & (which == i) for i, name in enumerate(THIRDS)}


def draw(result: dict[str, Any], images: list[Floats]) -> Figure:
    """Draw the PSNR of each third over the focus, the rendering, and the hologram focused near and far."""
    figure, panels = subplots((11, 3.6), 1, 5, gridspec_kw={"width_ratios": [1.6, 1, 1, 1, 1]})
    for name, color in THIRDS.items():
        panels[0].plot(result["foci"], result["curves"][name], color=color, label=name)
        panels[0].axvline(result["thirds"][name]["depth"], color=color, lw=0.8, ls=":")
    panels[0].set_xlabel("focused on the depth")
    panels[0].set_ylabel("PSNR of the third, dB")
    panels[0].legend(loc="lower center")
    titles = ("rendering", "focused near", "focused far", "phases alone, middle")
    for axes, title, image in zip(panels[1:], titles, images, strict=True):
        show(axes, image, title)
    return figure
