"""Pieces of a population: a few rows at a time, so that no array of all of them in float64 is needed.

A trained scene of five million Gaussians takes 1.2 GB in float32. An encoder that converts it as a whole holds copies
of several times that; in pieces, it holds the model, and the arrays of the file in the types of the file.
"""

from collections.abc import Iterator

import numpy as np

from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.types import Gaussians, Ints

ROWS = 1 << 18  # of a piece; files of fewer Gaussians are made as a whole


def pieces(n: int, description: str = "encoding") -> Iterator[slice]:
    """Yield slices that together are all rows from 0 to n, with a bar of progress.

    Parameters
    ----------
    n : int
    description : str
        Of the work on them.
    """
    with progress_bar(description, "Gaussians", n) as bar:
        for start in range(0, n, ROWS):
            part = slice(start, min(start + ROWS, n))
            yield part
            bar.update(part.stop - start)


def rows_of(gaussians: Gaussians, rows: slice | Ints) -> Gaussians:
    """Return some of the Gaussians, in float64."""
    return Gaussians(*(field[rows].astype(np.float64) for field in gaussians))
