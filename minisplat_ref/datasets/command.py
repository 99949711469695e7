"""What the data tools have in common: bad input is one line and exit code 2, and pycolmap is quiet."""

import argparse
import sys
from collections.abc import Callable, Sequence
from types import ModuleType

from minisplat_ref.errors import InputError
from minisplat_ref.io.lens import import_pycolmap


def run_command(
    parser: argparse.ArgumentParser, action: Callable[[argparse.Namespace], None], argv: Sequence[str] | None
) -> int:
    """Parse the arguments and act.

    Parameters
    ----------
    parser : ArgumentParser
        The program's options.
    action : callable
        Takes the parsed options; raises InputError for bad input.
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.

    Returns
    -------
    int
        Exit code: 0 done, 2 bad input, 130 interrupted.
    """
    options = parser.parse_args(argv)
    try:
        action(options)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted, nothing was written", file=sys.stderr)
        return 130
    return 0


def import_quiet_pycolmap() -> ModuleType:
    """Import pycolmap without its log on stderr: what goes wrong comes as an exception or an empty result."""
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    return pycolmap
