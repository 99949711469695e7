"""What the demo's ``report.html`` holds, top to bottom."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.experiments.page import captioned, cards, page, panel, table
from minisplat_ref.experiments.pictures import Picture, colored, depth_picture, depth_range
from minisplat_ref.experiments.plots import plot, to_svg
from minisplat_ref.types import Floats

DEPTH_ERROR_RANGE = 0.1  # of the true depth: larger differences are all shown as the brightest colour


class ViewPictures(NamedTuple):
    """One held-out view of the report."""

    name: str
    """Name of the view."""
    caption: str
    """What was measured on it."""
    truth: Picture
    """[H, W, 3] photograph, sRGB."""
    render: Picture
    """[H, W, 3] render, sRGB."""
    error: Picture
    """[H, W, 3] picture of the difference."""
    true_depth: Floats
    """[H, W] exact camera z, world units; 0 where the view sees nothing."""
    depth: Floats
    """[H, W] rendered camera z, world units; 0 where nothing was hit."""


class Report(NamedTuple):
    """What the page shows, top to bottom."""

    title: str
    """Heading."""
    introduction: str
    """One or two sentences under it."""
    figures: Sequence[tuple[str, str]]
    """Key figures: (value with its unit, what it is)."""
    views: Sequence[ViewPictures]
    """Held-out views."""
    log: Sequence[Mapping[str, Any]]
    """Records of log.jsonl: step, loss, psnr, n_gaussians."""
    settings: Sequence[tuple[str, str]]
    """Rows of the table of what was run."""
    next_steps: Sequence[tuple[str, str]]
    """(sentence, command) of what to try next."""


def report_html(report: Report) -> str:
    """Return the page as text of one self-contained HTML file."""
    steps = "".join(f"<p>{escape(text)}</p><pre>{escape(command)}</pre>" for text, command in report.next_steps)
    body = f"""{cards(report.figures)}
<h2>Held-out views</h2>
<p>The training never saw these views. Error is the mean absolute difference of the three channels:
dark is none, bright is a quarter of the range or more.</p>
{"".join(map(_color_panel, report.views))}
<h2>Depth</h2>
<p>Nothing taught the Gaussians depth. Here is the distance that they came to, next to the exact one
of the ray tracer. Near is bright; the third picture is the difference relative to the true depth.</p>
{"".join(map(_depth_panel, report.views))}
<h2>How the training went</h2>
<p>Where the number of Gaussians jumps, those with a large gradient were cloned or split: the loss
jumps with it, and recovers.</p>
<div class="panel row">{"".join(_curves(report.log))}</div>
<h2>What was run</h2>
{table(report.settings)}
<h2>What to try next</h2>
{steps}"""
    return page(report.title, report.introduction, body)


def _color_panel(view: ViewPictures) -> str:
    pictures = [
        captioned(view.truth, "truth"),
        captioned(view.render, "render"),
        captioned(view.error, "error"),
    ]
    return panel(f"{view.name}: {view.caption}", pictures)


def _depth_panel(view: ViewPictures) -> str:
    near, far = depth_range(view.true_depth)
    is_seen = view.true_depth > 0  # [H, W]
    relative = np.abs(view.depth - view.true_depth) / np.where(is_seen, view.true_depth, 1.0) * is_seen  # [H, W]
    median = float(np.median(relative[is_seen])) if is_seen.any() else 0.0
    pictures = [
        captioned(depth_picture(view.true_depth, near, far), f"true depth, {near:.2f} to {far:.2f} units"),
        captioned(depth_picture(view.depth, near, far), "rendered depth, same colours"),
        captioned(colored(relative, 0.0, DEPTH_ERROR_RANGE, "magma"), "relative difference, 0 to 10 % or more"),
    ]
    return panel(f"{view.name}: median difference {100 * median:.1f} %", pictures)


def _curves(log: Sequence[Mapping[str, Any]]) -> list[str]:
    """SVG of loss, PSNR and number of Gaussians over the steps."""
    steps = [record["step"] for record in log]
    plots = (
        ("loss", "loss", "#b4553d"),
        ("psnr", "PSNR of training views (dB)", "#2d6a8e"),
        ("n_gaussians", "Gaussians", "#4b7f52"),
    )
    return [_curve(steps, [record[key] for record in log], title, color) for key, title, color in plots]


def _curve(steps: Sequence[int], values: Sequence[float], title: str, color: str) -> str:
    with plot(title, "step") as (figure, axes):
        axes.plot(steps, values, color=color, linewidth=1.8)
    return to_svg(figure)
