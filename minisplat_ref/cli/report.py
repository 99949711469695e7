"""The demo's ``report.html``: one file with pictures, curves and settings, and nothing that it loads from elsewhere.

Pictures are PNG in base64, curves are inline SVG, the style sheet is in the page.
"""

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from PIL import Image

from minisplat_ref.cli.pictures import Picture, colored, depth_picture, depth_range
from minisplat_ref.types import Floats

DEPTH_ERROR_RANGE = 0.1  # of the true depth: larger differences are all shown as the brightest colour

PLOT_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text: smaller, and in the page's own font
    "svg.hashsalt": "minisplat-ref",  # the same run gives the same bytes
    "font.family": "sans-serif",
    "font.size": 11,
    "axes.edgecolor": "#8a94a0",
    "axes.labelcolor": "#4a5560",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6eaee",
    "xtick.color": "#6a7580",
    "ytick.color": "#6a7580",
}

STYLE = """
:root { color-scheme: light }
body { margin: 0; background: #f6f7f9; color: #25303b; font: 16px/1.55 system-ui, "DejaVu Sans", sans-serif }
main { max-width: 1080px; margin: 0 auto; padding: 40px 24px 64px }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 8px; font-weight: 650 }
h2 { font-size: 20px; margin: 48px 0 4px; font-weight: 600 }
p { margin: 4px 0 16px; color: #4a5560; max-width: 74ch }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin: 24px 0 }
.card, .panel { background: #fff; border: 1px solid #e3e7eb; border-radius: 10px }
.card { padding: 14px 16px }
.card b { display: block; font-size: 24px; font-weight: 600; font-variant-numeric: tabular-nums }
.card span { color: #6a7580; font-size: 13.5px }
.panel { padding: 16px; margin: 12px 0 }
.row { display: grid; grid-template-columns: repeat(3, minmax(0, 1fr)); gap: 12px }
figure { margin: 0 }
figure img { display: block; width: 100%; border-radius: 4px }
figcaption { color: #6a7580; font-size: 13.5px; padding: 6px 0 2px }
.label { font-size: 14px; color: #4a5560; margin: 0 0 8px }
svg { display: block; width: 100%; height: auto }
table { border-collapse: collapse; width: 100%; font-size: 15px }
td { padding: 6px 8px; border-bottom: 1px solid #eef1f4; vertical-align: top }
tr:last-child td { border-bottom: 0 }
td:first-child { color: #6a7580; width: 30% }
pre { background: #eef2f6; border-radius: 8px; padding: 12px 14px; margin: 6px 0 16px; overflow-x: auto }
pre, code { font-size: 14px }
code, pre { font-family: ui-monospace, "DejaVu Sans Mono", monospace }
@media (max-width: 700px) { .row { grid-template-columns: 1fr } }
"""


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
    cards = "".join(
        f'<div class="card"><b>{escape(value)}</b><span>{escape(meaning)}</span></div>'
        for value, meaning in report.figures
    )
    settings = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in report.settings)
    steps = "".join(f"<p>{escape(text)}</p><pre>{escape(command)}</pre>" for text, command in report.next_steps)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(report.title)}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<h1>{escape(report.title)}</h1>
<p>{escape(report.introduction)}</p>
<div class="cards">{cards}</div>
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
<div class="panel"><table>{settings}</table></div>
<h2>What to try next</h2>
{steps}
</main>
</body>
</html>
"""


def _color_panel(view: ViewPictures) -> str:
    pictures = [
        _figure(view.truth, "truth"),
        _figure(view.render, "render"),
        _figure(view.error, "error"),
    ]
    return _panel(f"{view.name}: {view.caption}", pictures)


def _depth_panel(view: ViewPictures) -> str:
    near, far = depth_range(view.true_depth)
    is_seen = view.true_depth > 0  # [H, W]
    relative = np.abs(view.depth - view.true_depth) / np.where(is_seen, view.true_depth, 1.0) * is_seen  # [H, W]
    median = float(np.median(relative[is_seen])) if is_seen.any() else 0.0
    pictures = [
        _figure(depth_picture(view.true_depth, near, far), f"true depth, {near:.2f} to {far:.2f} units"),
        _figure(depth_picture(view.depth, near, far), "rendered depth, same colours"),
        _figure(colored(relative, 0.0, DEPTH_ERROR_RANGE, "magma"), "relative difference, 0 to 10 % or more"),
    ]
    return _panel(f"{view.name}: median difference {100 * median:.1f} %", pictures)


def _panel(label: str, figures: Iterable[str]) -> str:
    return f'<div class="panel"><div class="label">{escape(label)}</div><div class="row">{"".join(figures)}</div></div>'


def _figure(picture: Picture, caption: str) -> str:
    png = io.BytesIO()
    Image.fromarray(picture).save(png, format="PNG")
    content = base64.b64encode(png.getvalue()).decode("ascii")
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{content}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


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
    with rc_context(PLOT_STYLE):
        figure = Figure(figsize=(4.4, 3.0), layout="constrained")
        axes = figure.subplots()
        axes.plot(steps, values, color=color, linewidth=1.8)
        axes.set_title(title, fontsize=11, loc="left", color="#4a5560")
        axes.set_xlabel("step")
        axes.margins(x=0.01)
        buffer = io.StringIO()
        no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(buffer, format="svg", transparent=True, metadata=no_metadata)
    svg = buffer.getvalue()
    return svg[svg.index("<svg") :]
