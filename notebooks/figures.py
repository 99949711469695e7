"""What the notebooks share: one palette, one figure style, panels for images and ellipses, the source of a function.

Importing this module sets the style. It is no part of the package: notebooks find it because Jupyter runs them in
their own folder.
"""

import ast
import inspect
import io
import textwrap
from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from IPython import get_ipython
from IPython.display import display
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator

from minisplat_ref.types import Projection

RED, BLUE, YELLOW, GREEN, PLUM, GREY = "#d2493f", "#35608c", "#e0a526", "#3f8f6b", "#7a2848", "#8a8580"

plt.rcParams.update(
    {
        "figure.dpi": 90,  # with widths of at most 11 inches: no picture is wider than a page of a code host
        "figure.facecolor": "white",  # also where a reader's theme is dark
        "figure.constrained_layout.use": True,
        "font.size": 9.5,
        "axes.titlesize": 9.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "image.interpolation": "nearest",  # a pixel is shown as a pixel
    }
)


def png(figure: Figure) -> bytes:
    """Return a figure as PNG, as large as it says. Cropped to its content, its size would depend on the text in it."""
    figure.draw_without_rendering()  # ticks and layout depend on each other: it takes two passes
    file = io.BytesIO()
    figure.savefig(file, dpi=figure.dpi)
    return file.getvalue()


if (_shell := get_ipython()) is not None:
    _shell.run_line_magic("matplotlib", "inline")
    _shell.display_formatter.formatters["image/png"].for_type(Figure, png)


def show_code(function: Callable) -> None:
    """Print the source of a function without its docstring."""
    source = textwrap.dedent(inspect.getsource(function))
    lines, body = source.splitlines(), ast.parse(source).body[0].body  # type: ignore[attr-defined]
    has_docstring = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
    print(*lines[: body[0].lineno - 1], *lines[body[has_docstring].lineno - 1 :], sep="\n")


def show(axes: Axes, image: np.ndarray, title: str = "", **style: Any) -> AxesImage:
    """Show an image [H, W, 3], clipped to 0 .. 1, or a map [H, W], without ticks."""
    shown = axes.imshow(np.clip(image, 0, 1) if image.dtype.kind == "f" and image.ndim == 3 else image, **style)
    axes.set(title=title, xticks=[], yticks=[])
    axes.spines[:].set(visible=True, linewidth=0.5, color=GREY)  # a white image on a white page needs an edge
    return shown


def show_pixels(axes: Axes, image: np.ndarray, title: str = "", **style: Any) -> AxesImage:
    """Show an image or a map in pixel coordinates, the top-left corner at (0, 0)."""
    height, width = image.shape[:2]
    shown = show(axes, image, title, extent=(0, width, height, 0), **style)
    axes.set(xlabel="x [px]", ylabel="y [px]")
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    return shown


def show_error(axes: Axes, image: np.ndarray, truth: np.ndarray, title: str = "error", vmax: float = 0.3) -> AxesImage:
    """Show the mean absolute difference of two images over their channels."""
    return show(axes, np.abs(image - truth).mean(axis=2), title, cmap="magma", vmin=0, vmax=vmax)


def with_sliders(draw: Callable[..., Figure], **ranges: tuple[float, float, float]) -> None:
    """Show a figure, and below it a slider for each of its parameters, which draws it again in its place.

    What is shown first is an ordinary picture, which stays where nothing runs. Sliders need ipywidgets, of the extra
    ``notebooks``.

    Parameters
    ----------
    draw : callable
        Makes the figure from the parameters, by name.
    **ranges
        For each parameter its first value, the least and the most.
    """

    def drawn(**values: float) -> Figure:
        figure = draw(**values)
        plt.close(figure)  # which would show it a second time
        return figure

    shown = display(drawn(**{name: first for name, (first, _, _) in ranges.items()}), display_id=True)
    try:
        import ipywidgets
    except ImportError:
        return
    sliders = {
        name: ipywidgets.FloatSlider(
            value=first, min=least, max=most, step=(most - least) / 40, description=name, continuous_update=False
        )
        for name, (first, least, most) in ranges.items()
    }

    def redraw(_: Any) -> None:
        shown.update(drawn(**{name: slider.value for name, slider in sliders.items()}))

    for slider in sliders.values():
        slider.observe(redraw, names="value")
    display(ipywidgets.VBox(list(sliders.values())))


def covariances2d(projection: Projection) -> np.ndarray:
    """Return the 2D covariances [N, 2, 2], px^2, of projected Gaussians; those that are culled have none: zeros."""
    covariances = np.zeros((len(projection.conics), 2, 2))
    is_drawn = projection.radii[:, 0] > 0
    covariances[is_drawn] = np.linalg.inv(projection.conics[is_drawn][:, [0, 1, 1, 2]].reshape(-1, 2, 2).astype(float))
    return covariances


def ellipse_axes(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviations [N, 2] along the axes of ellipses and the angle [N] of the first, degrees."""
    variances, directions = np.linalg.eigh(np.reshape(covariances, (-1, 2, 2)))
    return np.sqrt(np.maximum(variances, 0)), np.degrees(np.arctan2(directions[:, 1, 0], directions[:, 0, 0]))


def draw_ellipses(axes: Axes, means: np.ndarray, covariances: np.ndarray, n_sigmas: float = 1.0, **style: Any) -> None:
    """Draw the contours of one 2D Gaussian, mean [2] and covariance [2, 2], or of several, [N, 2] and [N, 2, 2]."""
    for mean, sigmas, angle in zip(np.reshape(means, (-1, 2)), *ellipse_axes(covariances), strict=True):
        axes.add_patch(Ellipse(mean, *(2 * n_sigmas * sigmas), angle=angle, **({"fill": False} | style)))
        style.pop("label", None)  # one entry in the legend
