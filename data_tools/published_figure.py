"""The curves of published scenes: PSNR and the number of Gaussians over the iterations of a few runs.

``python -m data_tools.published_figure RUN [RUN ...] --published DB`` draws ``docs/figures/published.png`` from what
the runs have logged; nothing is measured here. A line is the PSNR of the training views, the mean over a hundred
iterations or more; a dot is that of all test views.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.reports.plots import PLOT_STYLE
from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import GREY, PNG_DPI, SERIES, TITLE_COLOR
from minisplat_ref.io.atomic import replacing
from minisplat_ref.types import Floats, Ints

FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "published.png"
WINDOW = 100  # iterations that a point of a line is the mean of, at least
POINTS_MAX = 150  # of a line


class Course(NamedTuple):
    """What a run has logged, over its iterations."""

    name: str
    steps: Ints
    """[P] last iterations of the windows."""
    psnr: Floats
    """[P] mean PSNR of the training views in each window, dB."""
    n_gaussians: Floats
    """[P] mean number of Gaussians."""
    test_steps: Ints
    """[Q] iterations after which the test views were measured."""
    test_psnr: Floats
    """[Q] dB."""


def read_course(folder: Path) -> Course:
    """Read what a run has logged.

    Raises
    ------
    InputError
        It has logged less than a window.
    """
    records = read_log(folder / run_folder.LOG)
    if not records or records[-1]["step"] < WINDOW:
        raise InputError(f"{folder} has logged fewer than {WINDOW} iterations: give the --out folder of a training")
    steps, psnr, n_gaussians = (
        np.array([record[key] for record in records]) for key in ("step", "psnr", "n_gaussians")
    )
    width = max(WINDOW, -(-int(steps[-1]) // POINTS_MAX))
    windows = (steps - 1) // width
    numbers = np.unique(windows)
    means = [[float(np.mean(x[windows == k])) for k in numbers] for x in (psnr, n_gaussians)]
    ends = np.minimum((numbers + 1) * width, steps[-1])
    measured = read_log(folder / run_folder.CURVE)
    tests = (np.array([record[key] for record in measured]) for key in ("step", "psnr"))
    return Course(folder.name, ends, *(np.array(mean) for mean in means), *tests)


def draw(courses: Sequence[Course], published: float | None, out: Path) -> None:
    """Write the figure as a PNG.

    Parameters
    ----------
    courses : sequence of Course
    published : float, optional
        PSNR that others have published, dB: a line across.
    out : Path
    """
    from matplotlib import rc_context  # not at the top: reading logs does not need it
    from matplotlib.figure import Figure

    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=(10, 4), layout="constrained", facecolor="white")
        left, right = figure.subplots(1, 2)
        for course, color in zip(courses, SERIES, strict=False):
            left.plot(course.steps, course.psnr, color=color, linewidth=1, label=course.name)
            left.plot(course.test_steps, course.test_psnr, "o", color=color)
            right.plot(course.steps, course.n_gaussians, color=color)
        if published is not None:
            left.axhline(published, color=GREY, linestyle="--", linewidth=1, label=f"3DGS, published: {published:g} dB")
        for axes, title in ((left, "PSNR (dB): lines training views, dots test views"), (right, "Gaussians")):
            axes.set_title(title, fontsize=11, loc="left", color=TITLE_COLOR)
            axes.set_xlabel("iterations")
        right.set_yscale("log")
        left.legend(loc="lower right")
        with replacing(out) as path:
            figure.savefig(path, dpi=PNG_DPI, format="png")


def main(arguments: list[str] | None = None) -> int:
    """Draw the curves of runs."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.published_figure", description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="--out folder of a training")
    parser.add_argument("--published", type=float, metavar="DB", help="PSNR that others have published")
    parser.add_argument("--out", type=Path, default=FIGURE, metavar="PNG", help="file to write")
    args = parser.parse_args(arguments)
    if len(args.runs) > len(SERIES):
        parser.error(f"{len(args.runs)} runs are more than the {len(SERIES)} colours: leave some out")
    try:
        draw([read_course(folder) for folder in args.runs], args.published, args.out)
    except InputError as error:
        print(f"published_figure: error: {error}", file=sys.stderr)
        return 2
    print(f"{args.out}: {args.out.stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
