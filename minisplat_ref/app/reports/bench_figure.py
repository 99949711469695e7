"""The Pareto figure: time of forward and backward against error, both on logarithmic axes."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.app.reports.page import grid, panel, paragraph, section
from minisplat_ref.app.reports.plots import PLOT_STYLE, save_png, to_svg
from minisplat_ref.interface.palette import EDGE_COLOR, GRID_COLOR, SERIES
from minisplat_ref.oracle.cases import Case

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TIME = "least both ms"
PANELS = (
    ("image max, no flips", "image max", "largest error of the image"),
    ("gradient, no flips", "gradient", "error of the gradient, relative L2, worst parameter"),
)
FRONT_TEXT = """\
Down is faster, left is more exact. A mark is the error without the pixels at which rounding decides a hit, a faint line
leads to the error with them; at the left edge the error is 0. Nothing lies below and left of the dotted line."""
EXACT = 1e-16  # position of an error of 0 on a logarithmic axis
SHAPES = {"-exp": "^", "-cut": "s", "-sigma": "s", "textbook": "D"}
HOLLOW = "^s"  # variants: they crowd around the default
Style = dict[str, Any]


def pareto_figure(cases: Sequence[Case]) -> "Figure":
    """Plot every workload as a row: error of the image on the left, of the gradient on the right.

    A marker is the error without the pixels at thresholds; a faint line leads from it to the error with them. An error
    of 0 is at the left edge. Failed contenders have no time and are left out. The step line is the Pareto front:
    nothing is below and left of it.

    Parameters
    ----------
    cases : sequence of Case
        From ``benchmark``, of any number of workloads.
    """
    from matplotlib.figure import Figure

    timed = _time_cases(cases)
    workloads = _workloads(timed) or ["nothing was timed"]
    styles = _styles(timed)
    figure = Figure(figsize=(12, 0.8 + 4.4 * len(workloads)), layout="constrained")
    rows = figure.subplots(len(workloads), len(PANELS), squeeze=False, sharex="col")
    for row, workload in zip(rows, workloads, strict=True):
        for axes, kind in zip(row, PANELS, strict=True):
            _draw_panel(axes, timed, workload, kind, styles)
    if timed:
        figure.legend(*_legend(styles), loc="outside right upper", frameon=False, fontsize=9)
    return figure


def pareto_section(cases: Sequence[Case]) -> str:
    """Return the same as the part of a page: a figure for each workload and error."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    timed, panels = _time_cases(cases), []
    styles = _styles(timed)
    for workload in _workloads(timed):
        for kind in PANELS:
            with rc_context(PLOT_STYLE):
                figure = Figure(figsize=(5.6, 5.2), layout="constrained")
                _draw_panel(figure.subplots(), timed, workload, kind, styles)
                figure.legend(*_legend(styles), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
                panels.append(panel(f"{workload}: {kind[2]}", [to_svg(figure)], n_columns=1))
    return section("Time against error", paragraph(FRONT_TEXT), grid(panels))


def save_figure(cases: Sequence[Case], path: str | Path) -> None:
    """Write the figure as a PNG.

    Raises
    ------
    InputError
        If the folder does not exist.
    """
    save_png(pareto_figure(cases), Path(path))


def _time_cases(cases: Sequence[Case]) -> list[Case]:
    return [case for case in cases if case.passed and case.figures.get(TIME)]


def _workloads(cases: Sequence[Case]) -> list[str]:
    return list(dict.fromkeys(map(_workload, cases)))


def _styles(cases: Sequence[Case]) -> dict[str, Style]:
    return {name: _style(i, name) for i, name in enumerate(dict.fromkeys(map(_contender, cases)))}


def _draw_panel(
    axes: "Axes", cases: Sequence[Case], workload: str, kind: tuple[str, str, str], styles: dict[str, Style]
) -> None:
    quiet, full, label = kind
    _draw(axes, [case for case in cases if _workload(case) == workload], quiet, full, styles)
    axes.set(xscale="log", yscale="log", xlabel=label, ylabel="forward + backward, least time (ms)")
    axes.set_title(workload, loc="left", fontsize=10)
    axes.grid(color=GRID_COLOR)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _draw(axes: "Axes", cases: Sequence[Case], quiet: str, full: str, styles: dict[str, Style]) -> None:
    points = [(max(float(c.figures[quiet] or 0), EXACT), float(c.figures[TIME] or 0)) for c in cases]
    for case, (error, time) in zip(cases, points, strict=True):
        style = styles[_contender(case)]
        axes.plot([error, max(error, float(case.figures[full] or 0))], [time, time], color=style["color"], alpha=0.35)
        axes.plot([error], [time], **style)
    front = [p for p in sorted(points) if not any(q[0] <= p[0] and q[1] < p[1] for q in points)]
    if front:
        axes.step(*zip(*front, strict=True), where="post", color=EDGE_COLOR, linewidth=0.8, linestyle=":", zorder=0)


def _legend(styles: dict[str, Style]) -> tuple[list, list[str]]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], **style) for style in styles.values()], list(styles)


def _style(i: int, name: str) -> Style:
    shape = next((shape for part, shape in SHAPES.items() if part in name), "o")
    color = SERIES[i % len(SERIES)]
    filling = {"markerfacecolor": "none", "zorder": 4} if shape in HOLLOW else {"markerfacecolor": color, "zorder": 3}
    return {"color": color, "marker": shape, "linestyle": "none", "markersize": 8, **filling}


def _workload(case: Case) -> str:
    return case.name.split("/", 1)[0]


def _contender(case: Case) -> str:
    return case.name.split("/", 1)[1]
