"""Claim ``compression/rate-distortion``: what bytes cost in quality, and what a fixed step costs in a small scene.

The claim is ours. The Gaussians come from a training or from a PLY. They are written at every level of every format of
this extension, read again and measured on the test views; so is the PLY itself and, if ``--splat-transform`` names that
program of PlayCanvas, its SOG. Sizes are those of whole files.

SPZ has a fixed step of 2^-12 world units for centres and a fixed range for scales; the step of ``.msz`` follows the
small Gaussians. So this also makes the scene smaller and smaller, with Gaussians, cameras and near plane together:
every image stays the same, and so should the loss of a file.

SPZ's harmonics have 4 and 5 bits. What they cost is the difference from a file that keeps them as they were.
"""

import argparse
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import argument, declare, trainings
from data_tools.claims.kit.figures import plot_deviations, set_ticks, subplots, with_deviation
from data_tools.claims.kit.tables import mean, spread, table
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.compression.msz import MSZ
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io.formats import Format
from minisplat_ref.io.formats.spz import SPZ
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.types import Floats, Gaussians, View

SHRUNK = (1.0, 1 / 8, 1 / 64, 1 / 512)  # sizes of the scene, relative to the original
SHRUNK_LEVEL = 5  # of .msz
COLORS = {"ply": GREY, "msz": BLUE, "spz": RED, "sog": OCHRE}
COLUMNS = (
    ("bytes", mean("n_bytes")),
    ("bytes per Gaussian", mean("bytes_per_gaussian", 1)),
    ("dB lost", spread("drop", 3)),
)


class Point(NamedTuple):
    """The size of a file and the quality of what it holds."""

    name: str
    """Format and level."""
    n_bytes: int
    bytes_per_gaussian: float
    drop: float
    """Loss of PSNR on the test views, dB."""


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        The program cannot be used.
    """
    scene = kit.read_scene(args.scene, args.downscale)
    runs, shrunk, psnrs, counts, kept = [], [], [], [], []
    for gaussians in kit.populations(args, scene):
        psnrs.append(mean_psnr(gaussians, scene.test_views, scene.background))
        counts.append(len(gaussians.means))
        files = rate_points(gaussians, scene.test_views, scene.background, psnrs[-1], args.splat_transform)
        runs.append([point._asdict() for point in kit.with_progress(files, "files")])
        kept.append(drop_apart_from_harmonics(gaussians, scene.test_views, scene.background, psnrs[-1]))
        shrunk.append(drops_when_shrunk(gaussians, scene.test_views, scene.background))
    drops = {name: [of_seed[name] for of_seed in shrunk] for name in shrunk[0]}
    result = {**kit.describe_trainings(args, scene), "psnr": psnrs, "gaussians": counts, "runs": runs, "shrunk": drops}
    result |= {"spz_apart_from_harmonics": kept}
    text = f"{scene.name}: {with_deviation(psnrs, 2)} dB, {np.mean(counts):,.0f} Gaussians\n\n"
    text += table([point for run in runs for point in run], {"name": "file"}, COLUMNS)
    text += f"\n\n.spz with the harmonics kept as they are loses {with_deviation(kept, 3)} dB"
    text += "\n\ndB lost by size of the scene\n\n"
    rows = [[name, *(with_deviation(d, 3) for d in zip(*of_seeds, strict=True))] for name, of_seeds in drops.items()]
    text += markdown_table(["file", *(f"1/{1 / factor:.0f}" for factor in SHRUNK)], rows)
    return kit.Report(result, draw(result), text)


def mean_psnr(
    gaussians: Gaussians, views: tuple[View, ...], background: Floats, conventions: Conventions = GSPLAT_MAIN
) -> float:
    """Return the mean PSNR over views, dB."""
    psnr = evaluate(gaussians, views, RenderSettings(background, conventions=conventions)).psnr
    assert psnr is not None
    return psnr


def rate_points(
    gaussians: Gaussians, views: tuple[View, ...], background: Floats, psnr: float, program: str | None
) -> Iterator[Point]:
    """Yield the size and the loss of each file of the Gaussians, whose own PSNR is given."""
    n = max(1, len(gaussians.means))
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder, "a.ply")
        save_ply(ply, gaussians)
        size = ply.stat().st_size
        yield Point("ply", size, size / n, psnr - mean_psnr(load_ply(ply), views, background))
        if program is not None:
            size, back = sog_round_trip(program, ply)
            yield Point("sog", size, size / n, psnr - mean_psnr(back, views, background))
    for format_ in (SPZ, MSZ):
        for level, name in enumerate(format_.levels):
            content, back = round_trip(gaussians, format_, level)
            label = f"{format_.suffix[1:]} {name if format_ is SPZ else level}"
            yield Point(label, len(content), len(content) / n, psnr - mean_psnr(back, views, background))


def round_trip(gaussians: Gaussians, format_: Format, level: int) -> tuple[bytes, Gaussians]:
    """Return the content of a file, and the Gaussians that are read from it."""
    content = format_.encode(gaussians, level)
    return content, format_.decode(content, format_.suffix)


def drop_apart_from_harmonics(gaussians: Gaussians, views: tuple[View, ...], background: Floats, psnr: float) -> float:
    """Return the loss of an ``.spz``, dB, if the harmonics of degree 1 and above were kept as they are."""
    back = round_trip(gaussians, SPZ, 0)[1]
    return psnr - mean_psnr(back._replace(sh_rest=gaussians.sh_rest), views, background)


def sog_round_trip(program: str, ply: Path) -> tuple[int, Gaussians]:
    """Return the size of the SOG that the program makes from a PLY, and the Gaussians that it reads from it.

    Raises
    ------
    InputError
        The program cannot be started, or fails.
    """
    sog, back = ply.with_name("a.sog"), ply.with_name("back.ply")
    for given, made in ((ply, sog), (sog, back)):
        try:
            subprocess.run([program, "-g", "cpu", given, made], check=True, capture_output=True, timeout=600)
        except (OSError, subprocess.SubprocessError) as error:
            raise InputError(f"--splat-transform {program} does not work: {error}") from error
    return sog.stat().st_size, load_ply(back)


def drops_when_shrunk(gaussians: Gaussians, views: tuple[View, ...], background: Floats) -> dict[str, list[float]]:
    """Return the loss of each format, dB, at each size of the scene in ``SHRUNK``."""
    drops: dict[str, list[float]] = {"msz 5": [], "spz version 3": []}
    for factor in kit.with_progress(SHRUNK, "sizes"):
        small = shrink(gaussians, factor)
        near = tuple(view.load()._replace(camera=shrink_camera(view, factor)) for view in views)
        conventions = GSPLAT_MAIN._replace(near_plane=factor * GSPLAT_MAIN.near_plane)
        before = mean_psnr(small, near, background, conventions)
        for name, (format_, level) in zip(drops, ((MSZ, SHRUNK_LEVEL), (SPZ, 0)), strict=True):
            back = round_trip(small, format_, level)[1]
            drops[name].append(before - mean_psnr(back, near, background, conventions))
    return drops


def shrink(gaussians: Gaussians, factor: float) -> Gaussians:
    """Return the Gaussians of a scene that is ``factor`` times as large."""
    return gaussians._replace(
        means=gaussians.means * np.float32(factor), log_scales=gaussians.log_scales + np.float32(np.log(factor))
    )


def shrink_camera(view: View, factor: float) -> Any:
    """Return the camera of a view in a scene that is ``factor`` times as large."""
    return view.camera._replace(cam_from_world_t=view.camera.cam_from_world_t * factor)


def draw(result: dict[str, Any]) -> Figure:
    """Draw loss against bytes, and loss against the size of the scene."""
    figure, (rate, small) = subplots((9.6, 3.6), 1, 2, width_ratios=(3, 2))
    for kind in COLORS:
        _draw_kind(rate, kind, result["runs"])
    rate.axhline(0, color=GREY, linewidth=0.8)
    rate.set(
        xscale="log", xlabel="bytes per Gaussian", ylabel="PSNR lost (dB)", title=f"{result['scene']}: bytes and loss"
    )
    ticks = (8, 16, 32, 64, 128, 256)
    set_ticks(rate, ticks, [str(tick) for tick in ticks])
    for name, drops in result["shrunk"].items():
        color = COLORS[name.split()[0]]
        plot_deviations(small, SHRUNK, zip(*drops, strict=True), color=color, label=f".{name}")
    small.set(xscale="log", xlabel="size of the scene", ylabel="PSNR lost (dB)", title="the same scene made smaller")
    set_ticks(small, SHRUNK, ["1", *(f"1/{1 / factor:.0f}" for factor in SHRUNK[1:])])
    small.invert_xaxis()
    for axes in (rate, small):
        axes.legend()
    return figure


def _draw_kind(axes: Axes, kind: str, runs: list[list[dict[str, Any]]]) -> None:
    """Draw the files of one format as a line through its levels."""
    of_levels = [of_seeds for of_seeds in zip(*runs, strict=True) if of_seeds[0]["name"].split()[0] == kind]
    if not of_levels:
        return
    sizes = [np.mean([point["bytes_per_gaussian"] for point in of_seeds]) for of_seeds in of_levels]
    losses = [[point["drop"] for point in of_seeds] for of_seeds in of_levels]
    plot_deviations(axes, sizes, losses, fmt="-o" if kind == "msz" else "s", color=COLORS[kind], label=f".{kind}")


CLAIMS = (
    declare(
        "rate-distortion",
        "bytes against quality: .msz beside PLY, SPZ and SOG",
        run,
        *trainings(1000, "mini-splatting2"),
        argument("--splat-transform", metavar="CMD", help="measure SOG, too, written by this program"),
    ),
)
