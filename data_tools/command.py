"""What the data tools have in common on the command line: bad input is one line and exit code 2."""

import argparse
import sys
from collections.abc import Callable, Sequence

from minisplat_ref.errors import InputError


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
