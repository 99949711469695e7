"""Notebooks as pages of the site: their text, code and stored outputs as Markdown, and formulas as MathML.

nbconvert makes the Markdown and takes the images out; latex2mathml makes the formulas, which browsers render
themselves, so that a page loads nothing.
"""

import re
from pathlib import Path

FOLDER = "notebooks"
SOLUTION = re.compile(r"^<details>", re.MULTILINE)
IMAGE = re.compile(r"!\[[^\]]*\]\((output_\d+_\d+\.png)\)")
FORMULA = re.compile(r'<(span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</\1>', re.DOTALL)


def convert_notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a stored notebook as Markdown, and its images by their path beside the page.

    Parameters
    ----------
    path : Path
        A notebook with outputs; the images of ``notebooks/01_a.ipynb`` are in ``01_a_files/``.
    """
    import nbformat
    from nbconvert import MarkdownExporter

    notebook = nbformat.read(path, as_version=4)
    notebook.metadata["language_info"] = {"name": "python"}  # what is not stored, and colours the code
    text, resources = MarkdownExporter().from_notebook_node(notebook)
    folder = f"{path.stem}_files"
    text = SOLUTION.sub('<details markdown="1">', text)
    text = IMAGE.sub(rf"![Output of the cell above]({folder}/\1)", text)
    return text, {f"{folder}/{name}": data for name, data in resources["outputs"].items()}


def formulas_in_mathml(html: str) -> str:
    """Return a page whose formulas, as ``pymdownx.arithmatex`` marks them, are MathML."""
    from html import unescape

    from latex2mathml.converter import convert

    def to_mathml(match: re.Match[str]) -> str:
        is_block = match[3] is not None
        formula = convert(unescape(match[3] if is_block else match[2]), display="block" if is_block else "inline")
        return f'<div class="formula">{formula}</div>' if is_block else formula

    return FORMULA.sub(to_mathml, html)
