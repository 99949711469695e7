"""Figures of claims, in both senses: means and deviations over seeds, as text, as tables and as curves."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from minisplat_ref.interface.palette import BLUE, GREY, GRID_COLOR
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.types import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "grid.color": GRID_COLOR,
    "legend.fontsize": 8,
    "legend.frameon": False,
}


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and sample standard deviation; the latter is 0 for one value."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def standard_error(values: Sequence[float]) -> float | None:
    """Return the standard error of the mean; None for one value."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def group(records: Iterable[Mapping[str, Any]], *keys: str) -> dict[Any, list[Any]]:
    """Return the records by the value of an entry, or by the values of several, in the order in which these come."""
    groups: dict[Any, list[Any]] = {}
    for record in records:
        values = tuple(record[key] for key in keys)
        groups.setdefault(values if len(keys) > 1 else values[0], []).append(record)
    return groups


def summarise(
    records: Sequence[Mapping[str, Any]], key: str, measures: Iterable[str]
) -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and deviation of every measure over the records that share the entry ``key``, by that entry.

    A measure that is None in some records is that of the others, and is left out if it is None in all.
    """
    measures, summary = list(measures), {}
    for name, own in group(records, key).items():
        values = {measure: [record[measure] for record in own if record[measure] is not None] for measure in measures}
        summary[name] = {measure: mean_and_deviation(found) for measure, found in values.items() if found}
    return summary


def plus_minus(mean_and_deviation: Sequence[float], digits: int) -> str:
    """Return mean and deviation as text for a table."""
    return " ± ".join(f"{value:,.{digits}f}" for value in mean_and_deviation)


def with_deviation(values: Sequence[float], digits: int) -> str:
    """Return mean and deviation as text for a table; of a single value, the value alone."""
    return plus_minus(mean_and_deviation(values)[: min(len(values), 2)], digits)


def table_of(corner: str, rows: Mapping[Any, Mapping[Any, float | None]], form: str = ".1e", unit: str = "") -> str:
    """Return a table in Markdown of numbers by row and column; what is None has no meaning."""
    heading = [f"{column}{unit}" for column in next(iter(rows.values()))]
    lines = [
        [str(name), *("-" if value is None else format(value, form) for value in row.values())]
        for name, row in rows.items()
    ]
    return markdown_table([corner, *heading], lines)


def show(axes: "Axes", image: Any, heading: str = "", **settings: Any) -> None:
    """Show an image [H, W, 3] in [0, 1], or as ``imshow`` has it, with a heading and without ticks."""
    axes.imshow(image if settings else np.clip(image, 0, 1), **settings)
    axes.set_title(heading, fontsize=8)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(True)


def beside_images(figure: "Figure", images: Mapping[str, Sequence[tuple[str, Any]]]) -> dict[str, "Axes"]:
    """Show each row of images, with their headings, and return the axes on the left of each row, by its name."""
    columns = 2 + max(map(len, images.values()))
    places = figure.add_gridspec(len(images), columns)
    for i, row in enumerate(images.values()):
        for k, (heading, image) in enumerate(row):
            show(figure.add_subplot(places[i, 2 + k]), image, heading)
    return {name: figure.add_subplot(places[i, :2]) for i, name in enumerate(images)}


def subplots(size: tuple[float, float], rows: int = 1, columns: int = 1, **settings: Any) -> "tuple[Figure, Any]":
    """Return a figure of that size in inches, and its axes, as ``Figure.subplots`` returns them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, **settings)


def bars(
    records: Iterable[Mapping[str, Any]],
    titles: Mapping[str, str],
    size: tuple[float, float],
    colors: Sequence[str] | None = None,
    key: str = "arm",
) -> "Figure":
    """Draw bars of means with deviations, a panel for each measure, by its title, and a bar for each arm.

    By default the first arm is grey and the others are blue. A PSNR does not begin at zero.
    """
    arms = group(records, key)
    figure, panels = subplots(size, 1, len(titles), sharey=True)
    for axes, (measure, title) in zip(panels, titles.items(), strict=True):
        values = [mean_and_deviation([record[measure] or 0.0 for record in own]) for own in arms.values()]
        means, deviations = np.transpose(values)
        axes.barh(list(arms), means, xerr=deviations, color=colors or [GREY, *[BLUE] * (len(arms) - 1)])
        axes.set_title(title, fontsize=9)
        if measure == "psnr":
            axes.set_xlim(min(means - deviations) - 0.5, None)
    panels[0].invert_yaxis()
    return figure


def plot_deviations(axes: "Axes", x: Any, by_seed: Iterable[Sequence[float]], **style: Any) -> None:
    """Plot mean and deviation of the values over the seeds at each x."""
    means, deviations = np.transpose([mean_and_deviation(values) for values in by_seed])
    axes.errorbar(x, means, yerr=deviations, **{"fmt": "-o", "ms": 4, "capsize": 3, **style})


def plot_curves(
    axes: "Axes", records: Iterable[Mapping[str, Any]], x: str, y: str, colors: Mapping[str, str], key: str = "arm"
) -> None:
    """Plot mean and deviation of ``y`` over ``x``, a line for each arm that has a colour.

    Entries ``x`` differ from point to point and are the same for all seeds of one.
    """
    arms = group(records, key)
    for name, color in colors.items():
        points = group(arms.get(name, ()), x)
        by_seed = [np.ravel([record[y] for record in own]).tolist() for own in points.values()]
        plot_deviations(axes, list(points), by_seed, color=color, label=name)


def plot_band(axes: "Axes", x: Sequence[float], values: Floats, color: str, label: str) -> None:
    """Plot the mean of values [seeds, X] over x as a line, and a deviation to either side as a band."""
    means, deviations = np.transpose([mean_and_deviation(of_seeds) for of_seeds in values.T])
    axes.fill_between(x, means - deviations, means + deviations, color=color, alpha=0.25, lw=0)
    axes.plot(x, means, "o-", ms=4, color=color, label=label)


def set_ticks(axes: "Axes", ticks: Sequence[float], labels: Sequence[str]) -> None:
    """Label these values of x alone."""
    axes.set_xticks(ticks, labels)
    axes.minorticks_off()
