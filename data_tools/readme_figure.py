"""The README's figure: a photograph beside its render, and speed beside error.

Nothing is measured here. The images are of one test view of a run; the times and errors are those of the table in
``docs/measured/speed.md``, which ``minisplat-ref bench`` has printed::

    minisplat-ref train BANANA --out runs/banana
    python -m data_tools.readme_figure runs/banana --view DSC_0423

BANANA is a data set of Piero Toffanin; its licence, MIT, lies beside the figure. Photographs under other licences stay
out of the repository.
"""

import argparse
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from minisplat_ref.app.reports.images import GAP
from minisplat_ref.app.reports.plots import PLOT_STYLE
from minisplat_ref.app.runs import run_folder
from minisplat_ref.errors import InputError
from minisplat_ref.io import read_image
from minisplat_ref.io.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DOCS = Path(__file__).parents[1] / "docs"
CONTENDERS = {  # backend of the table: what the figure calls it, its colour, where the text stands, points
    "reference float64": ("the reference: NumPy, float64", "#3d4650", (13, 0)),
    "cpu float64": ("kernels, float64", "#35608c", (13, 0)),
    "cpu float32": ("kernels, float32: the default", "#b8392f", (-13, -2)),
    "textbook float32": ("a textbook loop, compiled, float32", "#8a5a14", (-13, 2)),
}
TEXT = "#22272c"
ERROR_MIN = 1e-16  # where the reference stands, which has none
SIZE, DPI = (11.6, 4.8), 100  # inches; pixels per inch
N_COLORS = 256  # of the PNG, to keep it small


def main() -> None:
    """Write the figure."""
    parser = argparse.ArgumentParser(description="Draw the README's figure.")
    parser.add_argument("run", type=Path, metavar="RUN", help="the --out folder of a training")
    parser.add_argument("--view", metavar="NAME", required=True, help="test view to show")
    parser.add_argument(
        "--out", type=Path, default=DOCS / "figures" / "readme.png", metavar="PNG", help="file to write"
    )
    args = parser.parse_args()
    draw(args.run, args.view, args.out)
    print(f"{args.out}: {args.out.stat().st_size:,} bytes")


def draw(run: Path, name: str, out: Path) -> None:
    """Write the figure as a PNG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    metrics = run_folder.read_json_object(run / run_folder.METRICS)
    psnrs = {view["name"]: view["psnr"] for view in metrics["per_view"]}
    if name not in psnrs:
        raise InputError(f"{run} has no test view {name!r}: give --view one of {', '.join(psnrs)}")
    truth, render = _truth_and_render(run / run_folder.RENDERS / f"{name}.png")
    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained", facecolor="white")
        grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.75])
        for row, (image, title) in enumerate(
            (
                (truth, "a photograph, held out"),
                (render, f"its render: {psnrs[name]:.1f} dB, {metrics['n_gaussians']:,} Gaussians"),
            )
        ):
            axes = figure.add_subplot(grid[row, 0])
            axes.imshow(image, interpolation="lanczos")
            axes.set_title(title, fontsize=11, color=TEXT)
            axes.set_axis_off()
        times = times_and_errors((DOCS / "measured" / "speed.md").read_text(encoding="utf-8"))
        _draw_times(figure.add_subplot(grid[:, 1]), times)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    small = Image.open(buffer).convert("RGB").quantize(N_COLORS, dither=Image.Dither.NONE)
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as temporary:
        small.save(temporary, format="PNG", optimize=True)


def times_and_errors(text: str) -> dict[str, tuple[float, float]]:
    """Return milliseconds of both passes, and the gradient's error, of each backend on ``synth``.

    Parameters
    ----------
    text : str
        With the table of ``docs/measured/speed.md``.

    Raises
    ------
    InputError
        A backend is not in the table.
    """
    found: dict[str, tuple[float, float]] = {}
    for line in text.splitlines():
        cells = [cell.strip(" *") for cell in line.strip("|").split("|")]
        if len(cells) == 8 and cells[1] in CONTENDERS:
            found.setdefault(cells[1], (_number(cells[3]), _number(cells[6])))  # synth comes before garden
    for name in CONTENDERS:
        if name not in found:
            raise InputError(f"docs/measured/speed.md has no row of {name!r}: give it the table of minisplat-ref bench")
    return found


def _number(cell: str) -> float:
    """Return the number of a cell that stands before any brackets."""
    return float(re.sub(r"\(.*\)|,", "", cell))


def _truth_and_render(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the first two of the three images side by side in ``renders/``."""
    image = read_image(path)  # [H, 3 W + 2 GAP, 3]
    width = (image.shape[1] - 2 * GAP) // 3
    return image[:, :width], image[:, width + GAP : 2 * width + GAP]


def _draw_times(axes: "Axes", found: dict[str, tuple[float, float]]) -> None:
    for name, (label, color, offset) in CONTENDERS.items():
        milliseconds, error = found[name]
        place = (max(error, ERROR_MIN), milliseconds)
        axes.plot(*place, "o", color=color, markersize=12)
        axes.annotate(
            f"{label}\n{milliseconds:,.0f} ms",
            place,
            xytext=offset,
            textcoords="offset points",
            color=color,
            ha="left" if offset[0] > 0 else "right",
            va="center",
        )
    axes.set(xscale="log", yscale="log", xlim=(ERROR_MIN / 3, 1e-4), ylim=(5, 30_000))
    axes.set_xlabel("error of the gradient against the reference (relative L2, worst parameter)")
    axes.set_title("50,000 Gaussians, forward and backward, two cores (ms)", fontsize=11, color=TEXT)
    axes.set_axisbelow(True)


if __name__ == "__main__":
    main()
