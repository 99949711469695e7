"""Parts that all reports share: a table in Markdown, and the machine on which the figures were measured."""

import platform
from collections.abc import Sequence
from pathlib import Path


def markdown_table(heading: Sequence[str], rows: Sequence[Sequence[str]], *, is_aligned: bool = True) -> str:
    """Return a table in Markdown.

    Parameters
    ----------
    heading : sequence of str
        One text per column.
    rows : sequence of sequences of str
        One text per column each.
    is_aligned : bool
        Pad the cells so that columns line up in a terminal; otherwise a long cell does not widen its column.
    """
    table = [heading, *rows]
    widths = [max(map(len, column)) if is_aligned else 0 for column in zip(*table, strict=True)]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in table]
    rule = "|" + "|".join("-" * (width + 2) if is_aligned else " --- " for width in widths) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def machine() -> dict[str, str | int]:
    """Return everything that timings depend on: processor, threads, and versions of the numerical packages."""
    import numba
    import numpy as np

    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text().splitlines() if cpu_info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "threads": numba.get_num_threads(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def describe_machine() -> str:
    """Return :func:`machine` in half a line."""
    return "{processor}, {threads} threads, Python {python}, Numba {numba}".format_map(machine())
