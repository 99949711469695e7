"""The guard around a command: errors and warnings in one line each, and the exit codes of errors."""

import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TextIO

from minisplat_ref.errors import InputError, InputWarning

EXTRAS = {"matplotlib": "photos"}
"""Packages for figures, by the extra that installs them."""


def run_guarded(work: Callable[[], int], program: str = "minisplat-ref") -> int:
    """Run a command, and return its exit code.

    Parameters
    ----------
    work : callable
        Returns the exit code.
    program : str
        Begins the line on stderr.

    Returns
    -------
    int
        That of ``work``, 2 for bad input, 130 when interrupted.
    """
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it tells of its caches of fonts
    with warnings.catch_warnings(), _printing_any_name():
        _print_warnings_in_one_line(program)
        try:
            code = work()
            sys.stdout.flush()
        except InputError as error:
            print(f"{program}: error: {' '.join(str(error).split())}", file=sys.stderr)
            return 2
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in EXTRAS:
                raise
            print(f"{program}: error: {_missing(package)}", file=sys.stderr)
            return 2
        except MemoryError:
            print(f"{program}: error: memory is full: close other programs, or give smaller input", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print(f"{program}: interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:  # the reader of the output has seen enough, like head
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else the interpreter fails at its end
            return 0
    return code


def check_packages(needed: Sequence[str]) -> None:
    """Refuse a command that would fail at its end for lack of a package."""
    for package in needed:
        if find_spec(package) is None:
            raise InputError(_missing(package))


def _missing(package: str) -> str:
    return f"this needs {package}, which is not installed: pip install 'minisplat_ref[{EXTRAS[package]}]'"


@contextmanager
def _printing_any_name() -> Iterator[None]:
    """Have characters that the terminal's code page lacks printed as escapes, instead of ending the command."""
    streams = [stream for stream in (sys.stdout, sys.stderr) if isinstance(stream, io.TextIOWrapper)]
    strict = [stream for stream in streams if stream.errors in ("strict", "surrogateescape")]
    before = [str(stream.errors) for stream in strict]
    for stream in strict:
        stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        for stream, errors in zip(strict, before, strict=True):
            if not stream.closed:
                stream.reconfigure(errors=errors)


def _print_warnings_in_one_line(program: str) -> None:
    """Have warnings about the input printed like errors, without the line of our source that gave them.

    What NumPy says of an overflow, and matplotlib of a letter that its font lacks, helps no user and is left out.
    """
    show = warnings.showwarning

    def show_input_warning(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, InputWarning):
            print(f"{program}: warning: {message}", file=sys.stderr)
        elif not (issubclass(category, RuntimeWarning) or str(message).startswith("Glyph ")):
            show(message, category, filename, lineno, file, line)

    warnings.simplefilter("always", InputWarning)
    warnings.showwarning = show_input_warning
