"""What ``simplify`` shows: its table, the curve as a figure, and ``report.html``."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator

from minisplat_ref.reports.commands import command
from minisplat_ref.reports.images import Image8
from minisplat_ref.reports.page import cards, code, curves, grid, page, panel, paragraph, section, slider, table
from minisplat_ref.reports.palette import BLUE, EDGE_COLOR, RED, TITLE_COLOR
from minisplat_ref.reports.plots import PLOT_STYLE, to_svg
from minisplat_ref.runs.rate_distortion import N_SIZES, SIZES_PER_HALVING

TABLE_HEADING = ["Gaussians", "PLY bytes", "PSNR (dB)", "drop (dB)", "std. error", ""]
N_BELOW = 3  # sizes below the chosen one on the enlarged axes
ZOOM_MIN = 0.1  # dB that the enlarged axis of drops shows at least

CURVE_TEXT = """\
Of each size the most important Gaussians were kept, by their blend weights in the training views, and fine-tuned alike.
The held-out training views took part in neither. Bars are one standard error of the paired differences between these
views, so what makes one view harder than another is not in them."""
REFERENCE_TEXT = """\
Fine-tuning alone changes a run: it may continue to learn, and it forgets what is peculiar to the held-out views, which
it was trained on until now. The drop is therefore measured against all Gaussians, fine-tuned in the same way."""
KNEE_TEXT = """\
The knee is where the PSNR over the logarithm of the count lies highest above the straight line between the ends of the
measured sizes. It moves with these ends, so it decides only where no target was given."""
TEST_TEXT = """\
Nothing was decided on these views. The new model was ranked and fine-tuned by all training views. Fine-tuning alone
changes the run; what is due to fewer Gaussians is the drop from all of them, fine-tuned alike. Below 0 it is a gain."""


class Shown(NamedTuple):
    """A test view of the report."""

    name: str
    truth: Image8
    before: Image8
    after: Image8


def table_rows(result: dict[str, Any]) -> list[list[str]]:
    """Return a row for each size, the largest first."""
    rows = []
    for point in (result["all"], *reversed(result["curve"])):
        n = point["n_gaussians"]
        marks = ["all"] * (point is result["all"])
        marks += ["chosen"] * (point is not result["all"] and n == result["chosen"]["n_gaussians"])
        marks += ["knee"] * (n == result["knee"]["n_gaussians"])
        error = "" if point is result["all"] else f"{point['standard_error']:.3f}"
        drop = "" if point is result["all"] else f"{point['drop']:.3f}"
        rows.append([f"{n:,}", f"{point['n_bytes']:,}", f"{point['psnr']:.2f}", drop, error, ", ".join(marks)])
    return rows


def describe_outcome(result: dict[str, Any]) -> str:
    """Return what became of the test views, in one line."""
    counts = f"{result['all']['n_gaussians']:,} -> {result['chosen']['n_gaussians']:,} Gaussians"
    test = result["test"]
    if test is None:
        return f"{counts}; no test views to measure"
    n = len(test["views"])
    return (
        f"test PSNR {test['psnr_before']:.2f} -> {test['psnr_after']:.2f} dB (mean of {n} view{'s'[: n > 1]}), {counts}"
        f"; against all, fine-tuned alike, a drop of {_with_error(test)} dB"
    )


def _with_error(drop: dict[str, Any]) -> str:
    error = drop["standard_error"]
    return f"{drop['drop']:.3f}" if error is None else f"{drop['drop']:.3f} ± {error:.3f}"


def draw(result: dict[str, Any]) -> Figure:
    """Draw PSNR and drop against the number of Gaussians, with what was chosen and the knee."""
    return _figure(result, _draw_psnr, _draw_drop)


def _figure(result: dict[str, Any], *draws: Callable[[Axes, dict[str, Any]], None]) -> Figure:
    """Draw plots beside each other."""
    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=(5.2 * len(draws), 3.9), layout="constrained")
        for axes, draw_on in zip(figure.subplots(1, len(draws), squeeze=False)[0], draws, strict=True):
            draw_on(axes, result)
    return figure


def _draw_psnr(axes: Axes, result: dict[str, Any]) -> None:
    points = [*result["curve"], result["all"]]
    counts, psnrs = ([point[name] for point in points] for name in ("n_gaussians", "psnr"))
    errors = [point["standard_error"] for point in points]
    axes.errorbar(counts, psnrs, yerr=errors, color=BLUE, marker="o", ms=4, capsize=3, label="fine-tuned")
    axes.axhline(result["all"]["psnr"], color=EDGE_COLOR, linestyle="--", linewidth=1, label="all Gaussians")
    _mark(axes, result, "psnr")
    _finish(axes, result, "PSNR of held-out training views (dB)", 1)
    axes.legend(frameon=False, fontsize=9, loc="lower right")


def _draw_drop(axes: Axes, result: dict[str, Any]) -> None:
    points, chosen, limit = result["curve"], result["chosen"], result["max_drop"]
    counts, drops, errors = ([p[name] for p in points] for name in ("n_gaussians", "drop", "standard_error"))
    axes.errorbar(counts, drops, yerr=errors, color=BLUE, marker="o", ms=4, capsize=3)
    axes.axhline(0, color=EDGE_COLOR, linestyle="--", linewidth=1)
    if limit is not None:
        axes.axhline(limit, color=RED, linewidth=1, label=f"at most {limit:g} dB")
        axes.legend(frameon=False, fontsize=9, loc="upper right")
    _mark(axes, result, "drop")
    _finish(axes, result, "drop with its standard error (dB), enlarged", SIZES_PER_HALVING)
    worst = chosen["drop"] + chosen["standard_error"]
    top = 3 * max(worst, limit or 0.0, ZOOM_MIN)
    lowest = min(0.0, *(drop - error for drop, error in zip(drops, errors, strict=True)))
    axes.set_ylim(max(lowest, -top) - 0.08 * top, top)
    first = max(sum(n <= chosen["n_gaussians"] for n in counts) - N_BELOW - 1, 0)
    axes.set_xlim(left=counts[first] / 1.15)


def _mark(axes: Axes, result: dict[str, Any], name: str) -> None:
    """Ring the chosen size, and let the knee be a dotted line."""
    chosen, bend = result["chosen"], result["knee"]
    axes.axvline(bend["n_gaussians"], color=EDGE_COLOR, linestyle=":", linewidth=1.3, label="knee")
    axes.plot(
        chosen["n_gaussians"],
        chosen[name],
        marker="o",
        ms=11,
        mfc="none",
        mec=RED,
        mew=1.8,
        linestyle="none",
        label=f"chosen: {chosen['n_gaussians']:,}",
    )


def _finish(axes: Axes, result: dict[str, Any], title: str, ticks_per_halving: int) -> None:
    counts = [point["n_gaussians"] for point in (*result["curve"], result["all"])]
    axes.set_xscale("log")
    ticks = result["all"]["n_gaussians"] * 2.0 ** -(np.arange(N_SIZES + 1) / ticks_per_halving)
    axes.set_xticks(ticks, [f"{tick:,.0f}" for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(min(counts) / 1.15, max(counts) * 1.15)
    axes.set_title(title, fontsize=11, loc="left", color=TITLE_COLOR)
    axes.set_xlabel("Gaussians")


def report_html(folder: Path, result: dict[str, Any], shown: Sequence[Shown]) -> str:
    """Return the page as text of one self-contained HTML file; ``folder`` is where the new model will lie."""
    chosen, test = result["chosen"], result["test"]
    n, n_all, n_held = chosen["n_gaussians"], result["all"]["n_gaussians"], len(result["held_out"])
    introduction = (
        f"{result['scene']}: {n:,} of {n_all:,} Gaussians, chosen by {result['target']} on {n_held} of"
        f" {result['train_views']} training views."
    )
    figures = [
        (f"{n:,}", f"Gaussians, from {n_all:,}"),
        (f"{chosen['n_bytes'] / 1e6:.2f} MB", f"PLY, from {result['all']['n_bytes'] / 1e6:.2f} MB"),
        (f"{_with_error(chosen)} dB", f"drop and standard error, {n_held} held-out training views"),
        (f"{result['knee']['n_gaussians']:,}", "Gaussians at the knee"),
    ]
    if test is not None:
        figures.append((f"{test['psnr_after']:.2f} dB", f"test PSNR, from {test['psnr_before']:.2f} dB"))
    svgs = [to_svg(_figure(result, draw_on)) for draw_on in (_draw_psnr, _draw_drop)]
    sections = [
        cards(figures),
        section("How small it may be", paragraph(CURVE_TEXT), curves(svgs, 2)),
        section("The decision", paragraph(_decision(result)), table(table_rows(result), TABLE_HEADING)),
        paragraph(f"{REFERENCE_TEXT} Before it, the run has {result['run_psnr']:.2f} dB on them."),
        paragraph(KNEE_TEXT),
    ]
    if test is not None:
        about = paragraph(f"{describe_outcome(result)}. {TEST_TEXT}")
        sections.append(section("Test views", about, grid(list(map(_panel, shown)))))
    walk = command("render", folder, "--cameras", "orbit")
    pack = command("convert", folder, folder.parent / f"{folder.name}.spz")
    sections.append(section("What to do with it", code(f"{walk}\n{pack}")))
    return page(f"{result['scene']}, simplified", introduction, sections)


def _panel(view: Shown) -> str:
    return panel(view.name, [slider(view.truth, {"after": view.after, "before": view.before})], n_columns=1)


def _decision(result: dict[str, Any]) -> str:
    """Say what the rule was and what it led to."""
    chosen = result["chosen"]
    found = f"{chosen['n_gaussians']:,} Gaussians lose {_with_error(chosen)} dB"
    if result["max_drop"] is not None:
        limit = f"{result['max_drop']:g} dB"
        return f"The smallest size was taken whose drop plus one standard error is at most {limit}: {found}."
    if result["budget"] is None and result["max_bytes"] is None:
        return f"No target was given, so the knee was taken: {found}."
    if result["is_all_that_matter"]:
        return f"{result['target']} allows more than all Gaussians that matter to any training view: {found}."
    return f"As many were kept as {result['target']} allows: {found}."
