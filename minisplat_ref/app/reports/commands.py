"""Command lines that a report suggests: they can be copied into a terminal in any folder."""

import importlib.metadata
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path


def program() -> str:
    """Return the words that call the program from anywhere: its name, or the interpreter that runs it now."""
    if shutil.which("minisplat-ref") is not None:
        return "minisplat-ref"
    call = f"{_quote(sys.executable)} -m minisplat_ref"
    if _is_installed():
        return call
    root = Path(__file__).resolve().parents[3]  # a clone, which Python finds from its own folder only
    return f"cd {_quote(str(root))} && {call}"


def command(*words: str | Path) -> str:
    """Return a line that runs the program; paths are made absolute, and quoted where a shell needs it.

    Parameters
    ----------
    *words : str or Path
        Arguments in their order; a str stays as it is.
    """
    arguments = [_quote(str(word.resolve())) if isinstance(word, Path) else word for word in words]
    return " ".join([program(), *arguments])


def _is_installed() -> bool:
    try:
        importlib.metadata.distribution("minisplat_ref")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _quote(word: str) -> str:
    return subprocess.list2cmdline([word]) if os.name == "nt" else shlex.quote(word)
