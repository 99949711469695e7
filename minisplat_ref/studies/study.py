"""A study: a claim about a method, which a command measures and puts in a table and a figure.

Studies of 3DGS and Mini-Splatting are in :mod:`minisplat_ref.studies`; an extension brings its own.
``minisplat-ref study NAME`` runs either.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple


class Study(NamedTuple):
    """What to measure, and how."""

    name: str
    """The NAME of ``minisplat-ref study NAME``; for a study of an extension the user types EXTENSION/NAME."""
    summary: str
    """What is measured; short enough to follow the name in a line of 80 columns."""
    add_arguments: Callable[[argparse.ArgumentParser], None]
    """Adds the arguments to the parser, and a description where the summary is not enough; loads nothing heavy."""
    run: Callable[[argparse.Namespace], int | None]
    """Measures, writes, prints; returns the exit code, None for 0. Raises InputError for bad input."""
