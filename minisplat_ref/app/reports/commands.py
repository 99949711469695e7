"""Command lines that a report suggests: they can be copied into a terminal in any folder."""

import importlib.metadata
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

NAME = "minisplat-ref"


def program() -> str:
    """Return the words that call the program: its name, or what calls it from anywhere where the name cannot."""
    if shutil.which(NAME) is not None or _activate() is not None:
        return NAME
    call = f"{_quote(sys.executable)} -m minisplat_ref"
    if _is_installed():
        return call
    root = Path(__file__).resolve().parents[3]  # a clone, which Python finds from its own folder only
    return f"cd {_quote(str(root))} && {call}"


def how_to_call() -> list[str]:
    """Return the line that has to be given before commands are found by their name; none where they are."""
    activate = _activate()
    if shutil.which(NAME) is not None or activate is None:
        return []
    call = _quote(str(activate)) if os.name == "nt" else f". {_quote(str(activate))}"
    return [f"in a new terminal, give first: {call}"]


def command(*words: str | Path) -> str:
    """Return a line that runs the program; paths are made absolute, and quoted where a shell needs it.

    Parameters
    ----------
    *words : str or Path
        Arguments in their order; a str stays as it is.
    """
    arguments = [_quote(str(word.resolve())) if isinstance(word, Path) else word for word in words]
    return " ".join([program(), *arguments])


def _activate() -> Path | None:
    """Return the script that puts the program on the shell's path; None where it is not in an environment."""
    folder = Path(sys.executable).parent
    script, activate = folder / NAME, folder / "activate"
    if os.name == "nt":
        script, activate = script.with_suffix(".exe"), activate.with_suffix(".bat")
    return activate if script.is_file() and activate.is_file() else None


def _is_installed() -> bool:
    try:
        importlib.metadata.distribution("minisplat_ref")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _quote(word: str) -> str:
    return subprocess.list2cmdline([word]) if os.name == "nt" else shlex.quote(word)
