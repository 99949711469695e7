"""Notebooks with their outputs: run them and store what they show, or run them afresh and compare.

A notebook is a pair: NAME.py is its text, which is edited, and NAME.ipynb the same with outputs, which is made here.
What is stored depends on the text alone, as far as that is possible: no execution counts, times, paths or warnings. A
cell whose output depends on more says so by a tag:

``rounding``
    Another processor rounds differently, and hundreds of training steps make that visible. Numbers are left out of
    the comparison, and images have more room.
``clock``
    Its output is a time, or depends on what is installed. It runs, and what it shows is stored, but only the kinds of
    its outputs are compared.

Solutions of exercises are blocks of Python in markdown. They are run too, after the last cell, and an error in one is
an error of the notebook.
"""

import asyncio
import base64
import difflib
import hashlib
import io
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import numpy as np
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError
from numpy.typing import NDArray
from PIL import Image

from minisplat_ref.errors import InputError, one_line
from minisplat_ref.interface.arguments import HelpFormatter, Parser
from minisplat_ref.io.atomic import replacing

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "notebooks"
SECONDS_MAX = 900  # of a cell: a training of one minute took more than five on a slow machine that did other work
PNG_MAX = 100_000  # bytes of an image
AT_ONCE = min(os.cpu_count() or 1, 4)  # notebooks: each takes one core, and up to a gigabyte

# Mean absolute difference of two images' values, 0 to 255: room for another version's fonts.
IMAGE_EXACT = 1.0
# The same for an image after a training, averaged over squares, so that lines may move a little, and as a part of its
# difference from a white page. With kernels compiled for another processor (NUMBA_CPU_NAME=haswell on a Zen 5) the
# images of notebooks 06 to 11 differ by up to 0.42: the points that notebook 08 draws at random.
IMAGE_ROUNDED = 0.6
SQUARE = 8  # pixels

WIDGET = "application/vnd.jupyter.widget-view+json"  # sliders, which nobody can move in a stored notebook
Cell = Any  # nbformat's nodes are dictionaries whose keys are attributes, too
Notebook = Any

_NUMBER = re.compile(r"[-+]?\d[\d,]*(\.\d+)?(e[-+]?\d+)?")
_ROUNDING_ERROR = re.compile(r"[-+]?\d(\.\d+)?e-(0[6-9]|[1-9]\d)|\b0(\.0+)?e\+00")
_SOLUTION = re.compile(r"<details>.*?```python\n(.*?)```.*?</details>", re.DOTALL)


def execute(text: Path) -> Notebook:
    """Run a notebook and its solutions.

    Parameters
    ----------
    text : Path
        The notebook as text, NAME.py.

    Returns
    -------
    notebook
        With outputs, stripped of what a second run would change.

    Raises
    ------
    InputError
        If a cell or a solution fails or takes longer than :data:`SECONDS_MAX`, or an image is larger than
        :data:`PNG_MAX`.
    """
    notebook = jupytext.read(text)
    cells = list(notebook.cells)
    blocks = [block for cell in cells if cell.cell_type == "markdown" for block in _SOLUTION.findall(cell.source)]
    notebook.cells += [nbformat.v4.new_code_cell(block) for block in blocks]  # type: ignore[no-untyped-call]
    client = NotebookClient(
        notebook,
        timeout=SECONDS_MAX,
        kernel_name="python3",
        resources={"metadata": {"path": str(text.parent)}},
        coalesce_streams=True,
        extra_arguments=["--log-level=ERROR"],  # it warns that others could listen
    )
    # The matrices and images are small: threads that wait for each other cost more than they help.
    threads = {"OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    try:
        asyncio.run(client.async_execute(env={**os.environ, **threads, "PYTHONPATH": str(ROOT)}))  # in any thread
    except CellExecutionError as error:
        is_failed = [any(out.output_type == "error" for out in cell.get("outputs", [])) for cell in notebook.cells]
        number = is_failed.index(True)
        where = f"cell {number}" if number < len(cells) else f"solution {number - len(cells) + 1}"
        line = next((line[5:].strip() for line in _plain(error.traceback).splitlines() if line.startswith("---->")), "")
        raise InputError(f"{text.name}, {where}: {error.ename} {error.evalue} at: {line}") from None
    except (CellTimeoutError, DeadKernelError) as error:
        raise InputError(f"{text.name}: a cell takes more than {SECONDS_MAX} s, or Python died: {error}") from None
    notebook.cells = cells
    return strip_notebook(notebook, text.stem)


def strip_notebook(notebook: Notebook, name: str) -> Notebook:
    """Return the notebook without what a second run would change; raises as :func:`execute` does."""
    notebook.metadata.pop("language_info", None)
    notebook.metadata.pop("widgets", None)  # where ipywidgets is installed
    seen: dict[str, int] = {}
    for number, cell in enumerate(notebook.cells):
        seen[cell.source] = seen.get(cell.source, 0) + 1
        cell.id = hashlib.sha256(f"{cell.source}{seen[cell.source]}".encode()).hexdigest()[:8]
        if cell.cell_type != "code":
            continue
        cell.execution_count = None
        cell.metadata.pop("execution", None)
        shown = [out for out in cell.outputs if out.get("name") != "stderr" and WIDGET not in out.get("data", {})]
        cell.outputs = [_strip_output(out) for out in shown]
        for out in cell.outputs:
            size = len(_png(out))
            if size > PNG_MAX:
                raise InputError(
                    f"{name}, cell {number}: its image has {size:,} bytes, more than {PNG_MAX:,}; make it smaller"
                )
    return notebook


def _strip_output(out: Cell) -> Cell:
    if out.output_type == "stream":
        out.text = _without_paths(out.text)
        return out
    out.metadata = {}
    if "execution_count" in out:
        out.execution_count = None
    if _png(out):
        out.data = {"image/png": base64.b64encode(_compact(_png(out))).decode()}
    else:
        out.data = {kind: _without_paths(content) for kind, content in out.data.items() if kind != "text/html"}
        if "text/markdown" in out.data:
            out.data.pop("text/plain", None)
    return out


def _compact(png: bytes) -> bytes:
    """Return an image in fewer bytes: the same, or with 256 colours if it would be larger than allowed."""
    with Image.open(io.BytesIO(png)) as image:
        whole = image.convert("RGB")
    for candidate in (whole, whole.quantize(256, dither=Image.Dither.NONE)):
        file = io.BytesIO()
        candidate.save(file, "PNG", optimize=True)
        if file.tell() <= PNG_MAX:
            break
    return file.getvalue()


def _plain(text: str) -> str:
    return re.sub(r"\x1b\[[0-9;]*m", "", text)


def _without_paths(text: str) -> str:
    return text.replace(str(ROOT), ".").replace(tempfile.gettempdir(), "TMP")


def _png(out: Cell) -> bytes:
    return base64.b64decode(out.get("data", {}).get("image/png", ""))


def differences(stored: Notebook, fresh: Notebook) -> Iterator[str]:
    """Yield in a few words each cell that shows something else than what is stored."""
    if [cell.source for cell in stored.cells] != [cell.source for cell in fresh.cells]:
        yield "the stored notebook has another text"
        return
    for number, (old, new) in enumerate(zip(stored.cells, fresh.cells, strict=True)):
        if old.cell_type != "code":
            continue
        tags = old.metadata.get("tags", [])
        if [_kind(out) for out in old.outputs] != [_kind(out) for out in new.outputs]:
            yield f"cell {number}: shows {_list_outputs(new.outputs)}, stored is {_list_outputs(old.outputs)}"
        elif "clock" not in tags:
            for a, b in zip(old.outputs, new.outputs, strict=True):
                if what := _difference(a, b, "rounding" in tags):
                    yield f"cell {number}: {what}"


def _kind(out: Cell) -> str:
    return "an image" if _png(out) else "text"


def _list_outputs(outputs: Sequence[Cell]) -> str:
    return ", ".join(map(_kind, outputs)) or "nothing"


def _difference(old: Cell, new: Cell, is_rounded: bool) -> str:
    if not _png(old):
        before, after = (comparable(_text(out), is_rounded) for out in (old, new))
        gone_and_come = [line for line in difflib.ndiff(before, after) if line[0] in "-+"]
        return f"text differs: {' '.join(gone_and_come)[:200]}" if gone_and_come else ""
    images = []
    for out in (old, new):
        with Image.open(io.BytesIO(_png(out))) as image:
            images.append(np.asarray(image.convert("RGB"), dtype=float))
    a, b = images
    if a.shape != b.shape:
        return f"image of {b.shape[1]} x {b.shape[0]} pixels, stored are {a.shape[1]} x {a.shape[0]}"
    allowed = IMAGE_EXACT
    if is_rounded:
        a, b = _coarse(a), _coarse(b)
        allowed = max(allowed, IMAGE_ROUNDED * np.abs(255 - a).mean())
    difference = np.abs(a - b).mean()
    return f"image differs by {difference:.2f} of 255, more than {allowed:.2f}" if difference > allowed else ""


def _coarse(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Average an image [H, W, 3] over squares; what is left over at the right and at the bottom does not count."""
    height, width = image.shape[0] // SQUARE, image.shape[1] // SQUARE
    squares = image[: height * SQUARE, : width * SQUARE].reshape(height, SQUARE, width, SQUARE, 3)
    return np.asarray(squares.mean(axis=(1, 3)))


def _text(out: Cell) -> str:
    return out.text if out.output_type == "stream" else "\n".join(str(out.data[kind]) for kind in sorted(out.data))


def comparable(text: str, is_rounded: bool) -> list[str]:
    """Return the lines of an output without the numbers that another machine may change.

    Parameters
    ----------
    text : str
        What a cell printed.
    is_rounded : bool
        Leave out all numbers, the width of columns, and how often a line comes; otherwise only errors below 1e-5,
        which are those of rounding.
    """
    if not is_rounded:
        return _ROUNDING_ERROR.sub("#", text).splitlines()
    return sorted(set(re.sub(r"[ \t]+", " ", _NUMBER.sub("#", text)).splitlines()))


def _paths(names: Sequence[str]) -> list[Path]:
    """Texts of the notebooks whose names begin with one of these."""
    every = sorted(FOLDER.glob("[0-9]*.py"))
    for name in names:
        if not any(path.stem.startswith(name) for path in every):
            raise InputError(f"no notebook's name begins with {name!r}: there are {every[0].stem} to {every[-1].stem}")
    return [path for path in every if not names or path.stem.startswith(tuple(names))]


def store(text: Path) -> str:
    """Run a notebook, write it beside its text, and return what there is to say."""
    notebook = execute(text)
    with replacing(text.with_suffix(".ipynb")) as part:
        part.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")  # type: ignore[no-untyped-call]
    sizes = [len(_png(out)) for cell in notebook.cells for out in cell.get("outputs", []) if _png(out)]
    return f"{len(sizes)} images, the largest {max(sizes, default=0) / 1000:.0f} kB"


def check(text: Path) -> str:
    """Run a notebook afresh; return how it differs from what is stored, or nothing."""
    if not text.with_suffix(".ipynb").exists():
        return "nothing is stored"
    return "; ".join(differences(nbformat.read(text.with_suffix(".ipynb"), as_version=4), execute(text)))  # type: ignore[no-untyped-call]


def _treat(path: Path, is_checked: bool) -> tuple[str, bool]:
    """Store or check a notebook; return the line about it, and whether all is well."""
    start = time.perf_counter()
    try:
        what = check(path) if is_checked else store(path)
        is_good = not (is_checked and what)
    except InputError as error:
        what, is_good = str(error), False
    seconds = time.perf_counter() - start
    return one_line(f"{path.stem}: {what or 'as stored'} ({seconds:.0f} s)"), is_good


def main(arguments: Sequence[str] | None = None) -> int:
    """Store or check notebooks, with one line for each; return the exit code."""
    parser = Parser(
        prog="python -m data_tools.notebooks",
        description="Run notebooks and store what they show, or compare it with what is stored.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="beginnings of names, like 03 (default: all)")
    parser.add_argument("--check", action="store_true", help="run afresh and compare; nothing is written")
    args = parser.parse_args(arguments)
    different = []
    try:
        paths = _paths(args.names)
    except InputError as error:
        parser.error(str(error))
    with ThreadPoolExecutor(AT_ONCE) as pool:  # each waits for a kernel, which is a process
        for path, (line, is_good) in zip(paths, pool.map(partial(_treat, is_checked=args.check), paths), strict=True):
            print(line, flush=True)
            if not is_good:
                different.append(path.stem[:2])
    if different and args.check:
        print(f"what is meant to be different is stored by: python -m data_tools.notebooks {' '.join(different)}")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
