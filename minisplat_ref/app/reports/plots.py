"""Curves in one style, by matplotlib, as inline SVG for a page and as PNG files."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.interface.palette import EDGE_COLOR, GRID_COLOR, PAGE_NAMES, PNG_DPI, TICK_COLOR, TITLE_COLOR
from minisplat_ref.io.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLOT_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text: smaller, and in the page's own font
    "svg.hashsalt": "minisplat-ref",  # the same run gives the same bytes
    "font.family": "sans-serif",
    "font.size": 11,
    "text.color": TITLE_COLOR,
    "axes.edgecolor": EDGE_COLOR,
    "axes.labelcolor": TITLE_COLOR,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID_COLOR,
    "xtick.color": TICK_COLOR,
    "ytick.color": TICK_COLOR,
}


def can_plot() -> bool:
    """Return whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


@contextmanager
def plot(title: str, x_label: str, size: tuple[float, float] = (4.4, 3.0)) -> "Iterator[tuple[Figure, Axes]]":
    """Return a new figure and its axes.

    Parameters
    ----------
    title : str
        What the y axis shows, with its unit; written above it.
    x_label : str
    size : pair of float
        Width and height, inches.
    """
    from matplotlib import rc_context  # not at the top: a training, whose report may lack curves, does not need it
    from matplotlib.figure import Figure

    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots()
        axes.set_title(title, fontsize=11, loc="left", color=TITLE_COLOR)
        axes.set_xlabel(x_label)
        axes.margins(x=0.01)
        yield figure, axes


def to_svg(figure: "Figure") -> str:
    """Return the figure as an element of a page, in the page's colours, named after the titles of its axes."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with rc_context(PLOT_STYLE):
        figure.savefig(buffer, format="svg", transparent=True, metadata=no_metadata)
    text = buffer.getvalue()
    svg = re.sub(
        r'<g id="[^"]*">', "<g>", text[text.index("<svg") :]
    )  # the same in every figure, and nothing needs them
    for color, name in PAGE_NAMES.items():
        svg = svg.replace(color, f"var(--{name})")
    titles = ", ".join(axes.get_title(loc="left") for axes in figure.axes)
    return svg.replace("<svg", f'<svg role="img" aria-label="{escape(titles)}"', 1)


def save_png(figure: "Figure", path: Path) -> None:
    """Write the figure on white."""
    from matplotlib import rc_context

    with rc_context(PLOT_STYLE), replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=PNG_DPI, facecolor="white")
