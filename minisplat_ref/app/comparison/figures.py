"""The figures of a comparison: PSNR over time, iterations and number of Gaussians, the surface, and the gallery."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from minisplat_ref.app.comparison.crops import Crop
from minisplat_ref.app.comparison.metrics import best_record
from minisplat_ref.app.reports.plots import PLOT_STYLE, plot
from minisplat_ref.interface.palette import SERIES, TITLE_COLOR

SIZE = (5.6, 4.0)  # inches, of a plot
CROP_WIDTH = 2.2  # inches, in the gallery
BEST_MARK: dict[str, Any] = {
    "marker": "*",
    "markersize": 13,
    "markeredgecolor": "white",
    "linestyle": "none",
    "zorder": 5,  # over the lines of all recipes
}

Curves = Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]
"""For every recipe the records of ``curve.jsonl`` of each seed."""


def color(index: int) -> str:
    """Return the colour of a recipe."""
    return SERIES[index % len(SERIES)]


def psnr_over_time(curves: Curves) -> Figure:
    """Plot the PSNR of the test views over the training time: a line per run, a colour per recipe, a star its best."""
    return _over(curves, "seconds", "psnr", "PSNR of the test views (dB)", "training time (s)")


def psnr_over_iterations(curves: Curves) -> Figure:
    """Plot the PSNR of the test views over the iterations."""
    return _over(curves, "step", "psnr", "PSNR of the test views (dB)", "iterations")


def chamfer_over_iterations(curves: Curves) -> Figure:
    """Plot the distance to the true surface over the iterations, where it is known."""
    return _over(curves, "step", "chamfer", "Chamfer distance to the true surface (extents)", "iterations")


def is_chamfer_known(curves: Curves) -> bool:
    """Return whether some record has a distance to a true surface."""
    return any(record.get("chamfer") is not None for runs in curves.values() for records in runs for record in records)


def _over(curves: Curves, x: str, y: str, title: str, x_label: str) -> Figure:
    with plot(title, x_label, SIZE) as (figure, axes):
        for index, (recipe, runs) in enumerate(curves.items()):
            for number, records in enumerate(runs):
                axes.plot(
                    [record[x] for record in records],
                    [math.nan if record[y] is None else record[y] for record in records],  # a gap
                    color=color(index),
                    linewidth=1.6,
                    marker="o",
                    markersize=2.5,
                    label=recipe if number == 0 else None,
                )
                if y == "psnr":
                    best = best_record(records)
                    axes.plot(best[x], best[y], **BEST_MARK, color=color(index))
        if y == "psnr":
            axes.plot([], [], **BEST_MARK, color=TITLE_COLOR, label="best of a run")
        axes.margins(x=0.03)  # room for a star at the end
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axes.legend(loc="best", frameon=False)
    return figure


def psnr_over_count(curves: Curves) -> Figure:
    """Plot the PSNR of the test views over the number of Gaussians: the way there thin, the end as a disc."""
    with plot("PSNR of the test views (dB)", "Gaussians", SIZE) as (figure, axes):
        for index, (recipe, runs) in enumerate(curves.items()):
            for number, records in enumerate(runs):
                counts = [record["n_gaussians"] for record in records]
                psnrs = [record["psnr"] for record in records]
                axes.plot(counts, psnrs, color=color(index), linewidth=0.8, alpha=0.6)
                axes.plot(
                    counts[-1:],
                    psnrs[-1:],
                    color=color(index),
                    marker="o",
                    markersize=8,
                    linestyle="none",
                    label=recipe if number == 0 else None,
                )
        axes.set_xscale("log")
        axes.margins(x=0.05)  # room for the discs
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.legend(loc="best", frameon=False)
    return figure


def gallery(crops: Sequence[Crop], recipes: Sequence[str]) -> Figure:
    """Show the crops: a row each, the truth on the left, then a column per recipe."""
    n_columns = 1 + len(recipes)
    height, width = crops[0].truth.shape[:2]
    row_height = CROP_WIDTH * height / width + 0.3  # with its title
    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=(CROP_WIDTH * n_columns, row_height * len(crops)), layout="constrained")
        rows = figure.subplots(len(crops), n_columns, squeeze=False)
        for row, crop in zip(rows, crops, strict=True):
            titles = (f"{crop.view}, truth", *recipes)
            for axes, image, title in zip(row, (crop.truth, *crop.renders), titles, strict=True):
                axes.imshow(image, interpolation="nearest")
                axes.set_title(title, fontsize=9, loc="left", color=TITLE_COLOR)
                axes.set_axis_off()
    return figure
