"""The look of a report: one HTML file with pictures, curves and tables, and nothing that it loads from elsewhere.

Pictures are PNG in base64, curves are inline SVG (:mod:`minisplat_ref.experiments.plots`), the style sheet is in the
page.
"""

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape

from PIL import Image

from minisplat_ref.experiments.pictures import Picture

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
.panel { padding: 16px; margin: 12px 0; overflow-x: auto }
.row { display: grid; grid-template-columns: repeat(var(--columns, 3), minmax(0, 1fr)); gap: 12px }
figure { margin: 0 }
figure img { display: block; width: 100%; border-radius: 4px }
figcaption { color: #6a7580; font-size: 13.5px; padding: 6px 0 2px }
.pixels img { image-rendering: pixelated }
.label { font-size: 14px; color: #4a5560; margin: 0 0 8px }
svg { display: block; width: 100%; height: auto }
table { border-collapse: collapse; width: 100%; font-size: 15px }
td, th { padding: 6px 8px; border-bottom: 1px solid #eef1f4; vertical-align: top; text-align: left }
th { font-weight: 600 }
tr:last-child td { border-bottom: 0 }
td:first-child { color: #6a7580; width: 30% }
td { font-variant-numeric: tabular-nums }
pre { background: #eef2f6; border-radius: 8px; padding: 12px 14px; margin: 6px 0 16px; overflow-x: auto }
pre, code { font-size: 14px }
code, pre { font-family: ui-monospace, "DejaVu Sans Mono", monospace }
@media (max-width: 700px) { .row { grid-template-columns: 1fr } }
"""


def page(title: str, introduction: str, parts: Iterable[str]) -> str:
    """Return a self-contained HTML file.

    Parameters
    ----------
    title : str
        Heading, and name of the browser's tab.
    introduction : str
        One or two sentences under it.
    parts : iterable of str
        HTML: what the functions below return.
    """
    newline = "\n"  # an expression in an f-string holds no backslash before Python 3.12
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<h1>{escape(title)}</h1>
<p>{escape(introduction)}</p>
{newline.join(parts)}
</main>
</body>
</html>
"""


def section(heading: str, *parts: str) -> str:
    """Return parts of a page under a heading."""
    return "\n".join([f"<h2>{escape(heading)}</h2>", *parts])


def paragraph(text: str) -> str:
    """Return sentences."""
    return f"<p>{escape(text)}</p>"


def code(text: str) -> str:
    """Return lines to be copied."""
    return f"<pre>{escape(text)}</pre>"


def cards(figures: Iterable[tuple[str, str]]) -> str:
    """Return key figures, each a value with its unit and what it is."""
    boxes = (
        f'<div class="card"><b>{escape(value)}</b><span>{escape(meaning)}</span></div>' for value, meaning in figures
    )
    return f'<div class="cards">{"".join(boxes)}</div>'


def table(rows: Iterable[Sequence[str]], heading: Sequence[str] = ()) -> str:
    """Return a panel with a table whose first column names the rows."""
    head = f"<tr>{_cells('th', heading)}</tr>" if heading else ""
    body = "".join(f"<tr>{_cells('td', row)}</tr>" for row in rows)
    return f'<div class="panel"><table>{head}{body}</table></div>'


def _cells(tag: str, row: Sequence[str]) -> str:
    return "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in row)


def panel(label: str, figures: Sequence[str], n_columns: int = 3) -> str:
    """Return figures side by side under a label."""
    return (
        f'<div class="panel"><div class="label">{escape(label)}</div>'
        f'<div class="row" style="--columns: {n_columns}">{"".join(figures)}</div></div>'
    )


def curves(svgs: Sequence[str], n_columns: int = 3) -> str:
    """Return curves side by side, in as many rows as it takes."""
    return f'<div class="panel row" style="--columns: {min(n_columns, len(svgs))}">{"".join(svgs)}</div>'


def captioned(picture: Picture, caption: str) -> str:
    """Return a picture with a caption."""
    png = io.BytesIO()
    Image.fromarray(picture).save(png, format="PNG")
    content = base64.b64encode(png.getvalue()).decode("ascii")
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{content}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
