"""The output of ``simplify``: its table, the curve as a figure, and ``report.html``."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator

from minisplat_ref.app.reports.commands import command
from minisplat_ref.app.reports.images import Image8
from minisplat_ref.app.reports.page import cards, code, curves, grid, page, panel, paragraph, section, slider, table
from minisplat_ref.app.reports.plots import PLOT_STYLE, to_svg
from minisplat_ref.interface.palette import BLUE, EDGE_COLOR, RED, TITLE_COLOR

TABLE_HEADING = ["Gaussians", "PLY bytes", "PSNR (dB)", "SSIM", "drop (dB)", "std. error", ""]
N_TICKS = 8  # sizes along an axis whose numbers do not cover each other
MARGIN = 1.05  # of the axis of sizes, a factor

CURVE_TEXT = """\
Each size was reached by {how}, and was fine-tuned. Every training
view was held out once: it measured a copy that was fine-tuned without it. Bars are one standard error of the paired
differences between these views, so what makes one view harder than another is not in them."""
MERGED = "merging near neighbours, those of small blend weight first"
RANKED = "keeping the Gaussians of the largest blend weight"
REFERENCE_TEXT = """\
Fine-tuning alone changes a copy: it may continue to learn, and it forgets what is peculiar to the held-out views, which
the run was trained on. The drop is therefore measured against all Gaussians, fine-tuned in the same way. Neither
forgets everything, and more Gaussians know more, so the drop is rather too large than too small."""
TEST_TEXT = """\
Nothing was decided on these views, and neither model was trained on them. The new one was fine-tuned by all training
views. Below 0 the drop is a gain."""


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
        marks += ["chosen"] * (n == result["chosen"]["n_gaussians"])
        drop, error = ("", "") if point is result["all"] else (f"{point[k]:.3f}" for k in ("drop", "standard_error"))
        psnr, ssim = f"{point['psnr']:.2f}", f"{point['ssim']:.4f}"
        rows.append([f"{n:,}", f"{point['n_bytes']:,}", psnr, ssim, drop, error, ", ".join(marks)])
    return rows


def describe_decision(result: dict[str, Any]) -> str:
    """Return the chosen size and its loss, or that the run is as small as it gets, in one line."""
    chosen, n_views = result["chosen"], len(result["views"])
    held_out = f"on {n_views} training views, each held out in turn"
    if not result["is_unchanged"]:
        ssim = result["all"]["ssim"] - chosen["ssim"]
        lost = f"lose {_format_drop(chosen)} dB of PSNR and {ssim:.4f} of SSIM"
        return f"{chosen['n_gaussians']:,} of {result['all']['n_gaussians']:,} Gaussians {lost} {held_out}"
    if result["max_drop"] is None:
        return f"already as small: {result['target']} allows all {chosen['n_gaussians']:,} Gaussians of the run"
    if not result["curve"]:
        return "already as small as it gets: it has no number of Gaussians below this to choose from"
    nearest = min(result["curve"], key=lambda point: point["drop"] + point["standard_error"])
    return (
        f"already as small as it gets: {nearest['n_gaussians']:,} instead of {chosen['n_gaussians']:,} Gaussians lose"
        f" {_format_drop(nearest)} dB {held_out}; the two together are more than {result['max_drop']:g} dB"
    )


def describe_outcome(result: dict[str, Any]) -> str:
    """Return the change of the test views, in one line."""
    counts = f"{result['all']['n_gaussians']:,} -> {result['chosen']['n_gaussians']:,} Gaussians"
    if result["is_unchanged"]:
        counts = f"{result['chosen']['n_gaussians']:,} Gaussians"
    test = result["test"]
    if test is None:
        return f"{counts}; no test views to measure"
    views = f"mean of {len(test['views'])} view{'s'[: len(test['views']) > 1]}"
    if result["is_unchanged"]:
        return f"test PSNR {test['psnr_after']:.2f} dB, as before ({views}), {counts}"
    return (
        f"test PSNR {test['psnr_before']:.2f} -> {test['psnr_after']:.2f} dB ({views}), a drop of"
        f" {_format_drop(test)} dB, {counts}"
    )


def _format_drop(drop: dict[str, Any]) -> str:
    error = drop["standard_error"]
    return f"{drop['drop']:.3f}" if error is None else f"{drop['drop']:.3f} ± {error:.3f}"


def plot(result: dict[str, Any]) -> Figure:
    """Plot PSNR and drop against the number of Gaussians, with the chosen size."""
    return _figure(result, _plot_psnr, _plot_drop)


def _figure(result: dict[str, Any], *plots: Callable[[Axes, dict[str, Any]], None]) -> Figure:
    """Plot side by side."""
    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=(5.2 * len(plots), 3.9), layout="constrained")
        for axes, plot_on in zip(figure.subplots(1, len(plots), squeeze=False)[0], plots, strict=True):
            plot_on(axes, result)
    return figure


def _plot_psnr(axes: Axes, result: dict[str, Any]) -> None:
    points = [*result["curve"], result["all"]]
    counts, psnrs = ([point[name] for point in points] for name in ("n_gaussians", "psnr"))
    axes.plot(counts, psnrs, color=BLUE, marker="o", ms=4, label="fine-tuned")
    axes.axhline(result["all"]["psnr"], color=EDGE_COLOR, linestyle="--", linewidth=1, label="all Gaussians")
    _mark(axes, result, "psnr")
    _finish(axes, result, "PSNR of held-out training views (dB)")
    axes.legend(frameon=False, fontsize=9, loc="lower right")


def _plot_drop(axes: Axes, result: dict[str, Any]) -> None:
    points, limit = [*result["curve"], result["all"]], result["max_drop"]
    counts, drops, errors = ([p[name] for p in points] for name in ("n_gaussians", "drop", "standard_error"))
    axes.errorbar(counts, drops, yerr=errors, color=BLUE, marker="o", ms=4, capsize=3)
    axes.axhline(0, color=EDGE_COLOR, linestyle="--", linewidth=1)
    if limit is not None:
        axes.axhline(limit, color=RED, linewidth=1, label=f"at most {limit:g} dB")
        axes.legend(frameon=False, fontsize=9, loc="upper right")
    _mark(axes, result, "drop")
    _finish(axes, result, "drop with its standard error (dB)")


def _mark(axes: Axes, result: dict[str, Any], name: str) -> None:
    """Ring the chosen size."""
    chosen = result["chosen"]
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


def _finish(axes: Axes, result: dict[str, Any], title: str) -> None:
    counts = [point["n_gaussians"] for point in (*result["curve"], result["all"])]
    axes.set_xscale("log")
    ticks: list[int] = []
    for count in reversed(counts):
        if not ticks or ticks[-1] / count >= (counts[-1] / counts[0]) ** (1 / N_TICKS):
            ticks.append(count)
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(min(counts) / MARGIN, max(counts) * MARGIN)
    axes.set_title(title, fontsize=11, loc="left", color=TITLE_COLOR)
    axes.set_xlabel("Gaussians")


def report_html(folder: Path, result: dict[str, Any], shown: Sequence[Shown]) -> str:
    """Return the page as text of one self-contained HTML file; ``folder`` is where the new model will lie."""
    chosen, test = result["chosen"], result["test"]
    n, n_all, n_views = chosen["n_gaussians"], result["all"]["n_gaussians"], len(result["views"])
    introduction = (
        f"{result['scene']}: {n:,} of {n_all:,} Gaussians, chosen by {result['target']}, measured on {n_views} training"
        " views, each held out in turn."
    )
    figures = [
        (f"{n:,}", f"Gaussians, from {n_all:,}"),
        (f"{chosen['n_bytes'] / 1e6:.2f} MB", f"PLY, from {result['all']['n_bytes'] / 1e6:.2f} MB"),
    ]
    if not result["is_unchanged"]:
        figures.append((f"{_format_drop(chosen)} dB", f"drop and standard error, {n_views} held-out training views"))
    if test is not None:
        figures.append((f"{test['psnr_after']:.2f} dB", f"test PSNR, from {test['psnr_before']:.2f} dB"))
    svgs = [to_svg(_figure(result, plot_on)) for plot_on in (_plot_psnr, _plot_drop)]
    sections = [
        cards(figures),
        section(
            "How small it may be",
            paragraph(CURVE_TEXT.format(how=MERGED if result["is_merged"] else RANKED)),
            curves(svgs, 2),
        ),
        section("The decision", paragraph(_decision(result)), table(table_rows(result), TABLE_HEADING)),
        paragraph(f"{REFERENCE_TEXT} Before it, the run has {result['run_psnr']:.2f} dB on them."),
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
    """Describe the rule and its result."""
    found = describe_decision(result)
    if result["max_drop"] is not None:
        limit = f"{result['max_drop']:g} dB"
        rule = f"The rule takes the smallest size whose drop plus one standard error is at most {limit}"
    elif result["is_all_that_matter"]:
        rule = f"{result['target']} allows more than all Gaussians that matter to any training view"
    else:
        rule = f"As many were kept as {result['target']} allows"
    return f"{rule}. The outcome: {found}."
