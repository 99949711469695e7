"""The decisions of a training, for a page: a paragraph, figures with the evidence, and a table.

Most are those of ``adaptive`` (:mod:`minisplat_ref.training.pace`); each has its iteration and its reason.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from minisplat_ref.app.reports.page import curves, paragraph, section, table
from minisplat_ref.app.reports.plots import can_plot, plot, to_svg
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.training.pace import COOLED, FINER, Decision, Measurement, Pace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DONE = {
    COOLED: "the learning rates began to fall",
    "exposures": "each photograph got its own exposure",
    FINER: "views of twice the width and height were shown",
    "sky": "a sky took the place of the largest Gaussians",
    "poses": "the poses of the cameras were trained, too",
    "anti-aliasing": "opacities were compensated for anti-aliasing",
    "prune": "Gaussians were removed",
    "prune ended": "the removal ended",
    "bands": "colours that hardly depend on the direction were made simpler",
}
HEADING = ("decision", "iteration", "why", "gain (dB)", "std. error")
PSNR = "PSNR of the measured training views (dB)"
FIGURES_TEXT = """\
Thin lines are the measured training views, the thick one is their mean, broken lines are decisions. The work is the
number of pairs of a tile and a Gaussian, of all iterations so far."""
SIZES_TEXT = "Views of another size have their own line: larger ones show more that can be wrong."
SLOPE_TEXT = "A red line has the slope by which it was decided that little was left to gain."


def decisions_section(pace: Pace, n_iterations: int, *, has_schedule: bool = False, holds_out: bool = True) -> str:
    """Return the part of a page about the decisions.

    Parameters
    ----------
    pace : Pace
        Of the end of the run.
    n_iterations : int
        That the run has done.
    has_schedule : bool
        Whether the recipe's length and rates are fixed.
    holds_out : bool
        Whether the views that were measured were held back.
    """
    text = story(pace, n_iterations, has_schedule=has_schedule, holds_out=holds_out)
    parts = [paragraph(text)] if text else []
    if pace.measurements and can_plot():
        parts += [curves([to_svg(figure) for figure in (over_iterations(pace), over_work(pace))], 2)]
        is_by_slope = any(_is_of_slope(decision) for decision in pace.decisions)
        is_of_sizes = any(decision.what == FINER for decision in pace.decisions)
        parts += [paragraph(" ".join([FIGURES_TEXT, *[SIZES_TEXT] * is_of_sizes, *[SLOPE_TEXT] * is_by_slope]))]
    if pace.decisions:
        parts.append(table(map(_row, pace.decisions), HEADING))
    return section("What was decided, and why", *parts)


def story(pace: Pace, n_iterations: int, *, has_schedule: bool = False, holds_out: bool = True) -> str:
    """Return in sentences what the decisions rest on, and how the training ended."""
    n = len(pace.measurements)
    sentences = []
    if n:
        rises = [
            f"from {part[0].psnr:.2f} dB after {part[0].step:,} iterations to {part[-1].psnr:.2f} dB after"
            f" {part[-1].step:,}"
            for part in _group_by_size(pace)
        ]
        which = "views were held back and" if holds_out else "views, trained on like all others, were"
        sentences.append(
            f"{len(pace.measurements[0].psnrs)} training {which} measured {n} time{'s'[: n > 1]}:"
            f" {', at twice the size '.join(rises)}."
        )
    if has_schedule:
        return " ".join(sentences)
    if pace.cooling_from is None:
        sentences.append(f"It was stopped at iteration {n_iterations:,}, before the learning rates fell.")
    elif pace.last_step == n_iterations:
        sentences.append(
            f"With all training views and falling learning rates it continued to iteration {n_iterations:,}, its end."
        )
    else:
        sentences.append(f"It was stopped at iteration {n_iterations:,} of the {pace.last_step:,} that it had planned.")
    return " ".join(sentences)


def _group_by_size(pace: Pace) -> list[tuple[Measurement, ...]]:
    """Return the measurements of views of each size; those of one size cannot be compared with those of another."""
    steps = [decision.step for decision in pace.decisions if decision.what == FINER]
    parts = (
        tuple(m for m in pace.measurements if start < m.step <= end)
        for start, end in zip([0, *steps], [*steps, math.inf], strict=True)
    )
    return [part for part in parts if part]


def _row(decision: Decision) -> list[str]:
    effect = f": {DONE[decision.what]}" if decision.what in DONE else ""
    numbers = ["" if n is None else f"{n:.3f}" for n in (decision.gain, decision.standard_error)]
    return [f"{decision.what}{effect}", f"{decision.step:,}", decision.why, *numbers]


def over_iterations(pace: Pace) -> "Figure":
    """Plot the PSNR of the held-out views over the iterations, with the decisions."""
    with plot(PSNR, "iterations", (5.6, 3.6)) as (figure, axes):
        for part in _group_by_size(pace):
            _draw(axes, part, [float(m.step) for m in part])
        for decision in pace.decisions:
            axes.axvline(decision.step, color=GREY, linestyle="--", linewidth=1)
        _name_decisions(axes, pace.decisions)
        axes.set_xlim(left=0)
    return figure


def _name_decisions(axes: "Axes", decisions: tuple[Decision, ...]) -> None:
    """Write each decision at the foot of its line; decisions of nearly the same iteration share one label."""
    labels: dict[int, list[str]] = {}
    for decision in decisions:
        near = next((step for step in labels if decision.step - step <= 1), decision.step)
        names = labels.setdefault(near, [])
        names += [decision.what] * (decision.what not in names)
    for step, names in labels.items():
        axes.annotate(
            ", ".join(names),
            (step, 0.02),
            (-3, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            rotation=90,
            ha="right",
            va="bottom",
            fontsize=9,
        )


def over_work(pace: Pace) -> "Figure":
    """Plot the same over the work; the gain is counted for each doubling of it."""
    with plot(PSNR, "work (pairs of tile and Gaussian)", (5.6, 3.6)) as (figure, axes):
        for part in _group_by_size(pace):
            _draw(axes, part, [float(m.n_pairs) for m in part])
        axes.set_xscale("log", base=2)
        for decision in pace.decisions:
            if decision.gain is not None and _is_of_slope(decision):
                _draw_slope(axes, pace.before(decision).recent(), decision.gain)
    return figure


def _is_of_slope(decision: Decision) -> bool:
    """Return whether the gain is one for each doubling of the work; None where a limit ended the growth."""
    return decision.what in (COOLED, FINER) and decision.gain is not None


def _draw(axes: "Axes", measurements: tuple[Measurement, ...], xs: list[float]) -> None:
    axes.plot(xs, np.array([m.psnrs for m in measurements]), color=BLUE, linewidth=0.6, alpha=0.45)
    axes.plot(xs, [m.psnr for m in measurements], color=BLUE, linewidth=2.2, marker="o", markersize=3)


def _draw_slope(axes: "Axes", recent: list[Measurement], gain: float) -> None:
    """Plot the line through measurements whose slope is ``gain`` dB for each doubling of the work."""
    doublings = np.log2([m.n_pairs for m in recent])
    middle = np.mean([m.psnr for m in recent])
    axes.plot(2**doublings, middle + gain * (doublings - doublings.mean()), color=RED, linewidth=2, zorder=3)
