"""The README's figure: a photograph beside its render, and speed beside error.

Nothing is measured here; two folders are read, with BACKENDS reference-f64,cpu-f64,cpu-f32,textbook-f32::

    minisplat-ref train FOX --out runs/fox
    NUMBA_NUM_THREADS=1 minisplat-ref bench --workloads synth --repeats 3 --backends BACKENDS --out bench
    python -m data_tools.readme_figure runs/fox bench

The photograph is the test view of median PSNR. Times are the least of the turns that each contender had.
"""

import argparse
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from minisplat_ref.experiments import run_folder
from minisplat_ref.experiments.pictures import GAP
from minisplat_ref.experiments.plots import PLOT_STYLE
from minisplat_ref.io import read_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OUT = Path(__file__).parents[1] / "docs" / "figures" / "readme.png"
CONTENDERS = {  # name in bench.json: what the figure calls it, its colour, where the text stands
    "reference-f64": ("the reference: NumPy, float64", "#3d4650", (12, -4)),
    "cpu-f64": ("kernels, float64", "#35608c", (12, -4)),
    "cpu-f32": ("kernels, float32 (default)", "#d2493f", (-12, -18)),
    "textbook-f32": ("a textbook loop,\ncompiled, float32", "#b5651d", (-12, 10)),
}
LEAST_ERROR = 1e-16  # where the reference stands, which has none
SIZE, DPI = (11.6, 4.4), 100  # inches; pixels per inch
N_COLORS = 256  # of the PNG, to keep it small


def main() -> None:
    """Read the folders and write the figure."""
    parser = argparse.ArgumentParser(description="Draw the README's figure from a run and a benchmark.")
    parser.add_argument("run", type=Path, metavar="RUN", help="the --out folder of a training")
    parser.add_argument("bench", type=Path, metavar="BENCH", help="the --out folder of minisplat-ref bench")
    parser.add_argument("--out", type=Path, default=OUT, metavar="PNG", help="file to write")
    args = parser.parse_args()
    print(f"{args.out}: {draw(args.run, args.bench, args.out)} bytes")


def draw(run: Path, bench: Path, out: Path) -> int:
    """Write the figure and return its size in bytes."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    metrics = run_folder.read_json_object(run / run_folder.METRICS)
    view = sorted(metrics["per_view"], key=lambda view: view["psnr"])[len(metrics["per_view"]) // 2]
    truth, render = _truth_and_render(run / run_folder.RENDERS / f"{view['name']}.png")
    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained", facecolor="white")
        grid = figure.subplots(1, 3, width_ratios=[1, 1, 2.9])
        for axes, picture, title in (
            (grid[0], truth, "photograph, not trained on"),
            (grid[1], render, f"rendered: {view['psnr']:.1f} dB"),
        ):
            axes.imshow(picture, interpolation="lanczos")
            axes.set_title(title, fontsize=11)
            axes.set_axis_off()
        _draw_times(grid[2], json.loads((bench / "bench.json").read_text(encoding="utf-8"))["cases"])
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    picture = Image.open(buffer).convert("RGB").quantize(N_COLORS, dither=Image.Dither.NONE)
    out.parent.mkdir(parents=True, exist_ok=True)
    picture.save(out, optimize=True)
    return out.stat().st_size


def _truth_and_render(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the first two of the three pictures side by side in ``renders/``."""
    picture = read_image(path)  # [H, 3 W + 2 GAP, 3]
    width = (picture.shape[1] - 2 * GAP) // 3
    return picture[:, :width], picture[:, width + GAP : 2 * width + GAP]


def _draw_times(axes: "Axes", cases: list[dict[str, Any]]) -> None:
    by_name = {case["name"].split("/", 1)[1]: case["figures"] for case in cases}
    for name, (label, color, offset) in CONTENDERS.items():
        figures = by_name[name]
        error, milliseconds = max(float(figures["gradient, no flips"]), LEAST_ERROR), float(figures["least both ms"])
        axes.plot([error], [milliseconds], "o", color=color, markersize=11)
        axes.annotate(
            f"{label}\n{milliseconds:,.0f} ms",
            (error, milliseconds),
            xytext=offset,
            textcoords="offset points",
            color=color,
            ha="left" if offset[0] > 0 else "right",
            va="center" if offset[1] == -4 else "bottom" if offset[1] > 0 else "top",
        )
    axes.set(xscale="log", yscale="log", xlim=(LEAST_ERROR / 2, 1e-3), ylim=(10, 60_000))
    axes.set_xlabel("error of the gradient against the reference (relative, worst parameter)")
    axes.set_title("50,000 Gaussians, 480 x 270, forward and backward, one core (ms)", fontsize=11)
    axes.set_axisbelow(True)


if __name__ == "__main__":
    main()
