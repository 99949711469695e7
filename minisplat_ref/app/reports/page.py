"""The common layout of all reports: a self-contained HTML file with images, curves and tables.

Images are in the page in base64, curves are inline SVG (:mod:`minisplat_ref.app.reports.plots`), and so are the style
sheet and the few lines of script (:mod:`minisplat_ref.app.reports.page_style`), which are optional: without them a
slider is two images side by side. The page tells the browser to load nothing else.
"""

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from PIL import Image

from minisplat_ref.app.reports.images import Image8
from minisplat_ref.app.reports.page_style import SCRIPT, STYLE

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
BAD = {"FAILED", "DIVERGES FIRST", "diverges"}  # cells that stand out
GOOD = {"passed", "agrees"}
LONG = 44  # characters of a cell that may break into lines
N_COLUMNS = 4  # of a table that fits on a phone; in one with more, or with a long cell, cells are below each other
TALL = 60  # rows of a table that scrolls in the page instead of making it long
PNG_PIXELS = 1 << 17  # of larger images a PNG would make the page heavy
JPEG_QUALITY = 92
FILM_QUALITY = 75  # of WebP


def page(title: str, introduction: str, parts: Iterable[str]) -> str:
    """Return a self-contained HTML file.

    Parameters
    ----------
    title : str
        Heading, and name of the browser's tab.
    introduction : str
        One or two sentences under it.
    parts : iterable of str
        HTML, from the functions below.
    """
    # Names of files that are not text in the file system's encoding cannot be written; they are shown with escapes.
    parts = [part.encode("utf-8", "backslashreplace").decode() for part in parts]
    title, introduction = (text.encode("utf-8", "backslashreplace").decode() for text in (title, introduction))
    newline = "\n"  # an expression in an f-string holds no backslash before Python 3.12
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<h1>{escape(title)}</h1>
<p>{escape(introduction)}</p>
{newline.join(parts)}
</main>
<script>{SCRIPT}</script>
</body>
</html>
"""


def section(heading: str, *parts: str) -> str:
    """Return parts of a page under a heading."""
    return "\n".join([f"<h2>{escape(heading)}</h2>", *parts])


def folded(heading: str, *parts: str) -> str:
    """Return parts of a page under a heading that has to be opened."""
    newline = "\n"
    return f"<details><summary><h2>{escape(heading)}</h2></summary>\n{newline.join(parts)}\n</details>"


def paragraph(text: str) -> str:
    """Return sentences."""
    return f"<p>{escape(text)}</p>"


def link(text: str, target: str) -> str:
    """Return a line with a link to a file beside the page."""
    return f'<p><a href="{escape(target)}">{escape(text)}</a></p>'


def make_list(texts: Iterable[str]) -> str:
    """Return sentences as a list."""
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>"


def code(text: str) -> str:
    """Return lines to be copied."""
    return f'<pre tabindex="0">{escape(text)}</pre>'


def cards(figures: Iterable[tuple[str, str]]) -> str:
    """Return key figures, each a value with its unit and its meaning."""
    boxes = (
        f'<div class="card"><b>{escape(value)}</b><span>{escape(meaning)}</span></div>' for value, meaning in figures
    )
    return f'<div class="cards">{"".join(boxes)}</div>'


def table(rows: Iterable[Sequence[str]], heading: Sequence[str] = ()) -> str:
    """Return a panel with a table whose first column names the rows; a wide one scrolls under that column.

    On a phone the cells of a wide row are below each other, each behind its heading.
    """
    rows = [tuple(row) for row in rows]
    head = f"<thead><tr>{''.join(map(_heading_cell, heading))}</tr></thead>" if heading else ""
    is_wide = len(heading) > N_COLUMNS or (bool(heading) and any(len(cell) > LONG for row in rows for cell in row))
    labels = heading[1:] if is_wide else [""] * max((len(row) for row in rows), default=0)
    lines = [f"<tr>{_name_cell(name)}{''.join(map(_cell, cells, labels))}</tr>" for name, *cells in rows]
    kind, tall = "data wide" if is_wide else "data" if heading else "facts", " tall" * (len(lines) > TALL)
    content = f'<table class="{kind}">{head}<tbody>{"".join(lines)}</tbody></table>'
    return f'<div class="panel scroll{tall}" tabindex="0">{content}</div>'


def _heading_cell(text: str) -> str:
    return f'<th scope="col">{escape(text)}</th>'


def _name_cell(text: str) -> str:
    return f'<th scope="row">{escape(text).replace("_", "_<wbr>")}</th>'


def _cell(text: str, label: str) -> str:
    kind = "bad" if text in BAD else "good" if text in GOOD else "long" if len(text) > LONG else ""
    marks = [*([f'class="{kind}"'] if kind else []), *([f'data-label="{escape(label)}"'] if label else [])]
    return f"<td{''.join(f' {mark}' for mark in marks)}>{escape(text)}</td>"


def panel(label: str, figures: Sequence[str], n_columns: int = 3) -> str:
    """Return figures side by side under a label."""
    return (
        f'<div class="panel"><div class="label">{escape(label)}</div>'
        f'<div class="row" style="--columns: {n_columns}">{"".join(figures)}</div></div>'
    )


def grid(panels: Sequence[str], *, is_smooth: bool = True) -> str:
    """Return panels in pairs side by side; images that are not smoothed show their pixels."""
    kind = "row" if is_smooth else "row pixels"
    return f'<div class="{kind}" style="--columns: 2">{"".join(panels)}</div>'


def curves(svgs: Sequence[str], n_columns: int = 3) -> str:
    """Return curves side by side, in as many rows as it takes."""
    return f'<div class="panel row" style="--columns: {min(n_columns, len(svgs))}">{"".join(svgs)}</div>'


def slider(truth: Image8, renders: Mapping[str, Image8]) -> str:
    """Return an image of which the left part is the truth and the right part a render, with a line that moves.

    Parameters
    ----------
    truth : ndarray of shape (H, W, 3)
        sRGB.
    renders : mapping
        Images of the same size by their captions; of several, the reader chooses one.
    """
    figures = [add_caption(truth, "truth"), *(add_caption(image, caption) for caption, image in renders.items())]
    return f'<div class="slider">{"".join(figures)}</div>'


def add_caption(image: Image8, caption: str) -> str:
    """Return an image with a caption."""
    height, width = image.shape[:2]
    return _figure(*_encode(image), width, height, caption)


def film(frames: Sequence[Image8], fps: float, caption: str) -> str:
    """Return a panel with a film of images of one size, which repeats without end."""
    first, *others = map(Image.fromarray, frames)
    file = io.BytesIO()
    first.save(
        file,
        format="webp",
        save_all=True,
        append_images=others,
        duration=round(1000 / fps),
        loop=0,
        quality=FILM_QUALITY,
        method=4,
    )
    return f'<div class="panel">{_figure("webp", file.getvalue(), first.width, first.height, caption)}</div>'


def _figure(kind: str, content: bytes, width: int, height: int, caption: str) -> str:
    url = f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"
    return (
        f'<figure><img alt="{escape(caption)}" width="{width}" height="{height}" src="{url}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _encode(image: Image8) -> tuple[str, bytes]:
    """Return the kind and the content of an image file, for a large image a JPEG with colours at full resolution."""
    is_large = image.shape[0] * image.shape[1] > PNG_PIXELS
    kind = "jpeg" if is_large else "png"
    options = {"quality": JPEG_QUALITY, "subsampling": 0} if is_large else {}
    file = io.BytesIO()
    Image.fromarray(image).save(file, format=kind, **options)
    return kind, file.getvalue()
