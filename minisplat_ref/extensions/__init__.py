"""Relatives of 3DGS: one folder each, found by its folder and loaded when it is used.

An extension is a package in this folder, or in one that the environment variable ``MINISPLAT_EXTENSIONS`` names
(several between path separators), whose ``EXTENSION`` is an
:class:`~minisplat_ref.extensions.extension.Extension`. Nothing registers it, and nothing in the core refers to it:
``docs/EXTENDING.md`` walks through one.

This module lists the folders without loading any of them; :mod:`minisplat_ref.extensions.extension` loads them.
"""

import ast
import os
from pathlib import Path
from pkgutil import iter_modules

from minisplat_ref.errors import InputError

VARIABLE = "MINISPLAT_EXTENSIONS"

# Packages of other folders are found as if they were here, so that ``minisplat_ref.extensions.NAME`` is their name in
# every process, wherever they lie.
__path__ += [os.path.abspath(folder) for folder in os.environ.get(VARIABLE, "").split(os.pathsep) if folder]


def folders() -> dict[str, Path]:
    """Return the folder of each extension by its name, in the order of the names; ``a_b`` is the folder of ``a-b``.

    Raises
    ------
    InputError
        Two extensions have one name, or the variable names something that is not a folder.
    """
    found: dict[str, Path] = {}
    for place in __path__:
        if not os.path.isdir(place):
            raise InputError(f"{VARIABLE} names {place}, which is no folder: correct or unset it")
        for module in iter_modules([place]):
            if not module.ispkg:
                continue
            name, folder = module.name.replace("_", "-"), Path(place, module.name)
            if name in found:
                raise InputError(f"extension {name} is in {found[name]} and in {folder}: rename one")
            found[name] = folder
    return dict(sorted(found.items()))


def module_of(name: str) -> str:
    """Return the name of the package of an extension."""
    return f"{__name__}.{name.replace('-', '_')}"


def summaries() -> dict[str, str]:
    """Return the first line of each extension's docstring by its name; nothing is imported."""
    return {name: _first_line(folder / "__init__.py") for name, folder in folders().items()}


def _first_line(file: Path) -> str:
    try:
        docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))
    except (OSError, SyntaxError, ValueError) as error:
        return f"cannot be read: {error}"
    return (docstring or "").partition("\n")[0]
