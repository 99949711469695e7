"""From ``package.module:function``, as it is typed, to the function."""

import importlib
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import did_you_mean

N_SHOWN = 8  # names that a message proposes


def load_function(text: str) -> tuple[Callable[..., Any], Callable[..., Any] | None]:
    """Import a function, and its gradient ``function_vjp`` if the module has one.

    Parameters
    ----------
    text : str
        ``package.module:function``; the module is looked for in the current folder, too.

    Raises
    ------
    InputError
        If the module cannot be imported, or has no such function.
    """
    module_name, _, name = text.partition(":")
    if not module_name or not name.isidentifier():
        raise InputError(f"{text!r} is no function: write package.module:function")
    module = _import_module(module_name)
    function = getattr(module, name, None)
    if function is None:
        own = _own_functions(module)
        there = f"there are {', '.join(own[:N_SHOWN])}" if own else "it has no function"
        raise InputError(f"module {module_name} has no {name!r}{did_you_mean(name, own) or f': {there}'}")
    if not callable(function):
        raise InputError(f"{text} is {type(function).__name__}, not a function")
    return function, getattr(module, f"{name}_vjp", None)


def functions_of_module(name: str) -> list[str]:
    """Return the names of the functions that a module has itself; none where there is no such module."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        is_there = all(part.isidentifier() for part in name.split(".")) and find_spec(name) is not None
    except (ImportError, ValueError):
        return []
    return _own_functions(_import_module(name))[:N_SHOWN] if is_there else []


def _own_functions(module: ModuleType) -> list[str]:
    return [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]


def _import_module(name: str) -> ModuleType:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise InputError(f"module {name} needs {error.name}, which is not installed") from error
        meant = did_you_mean(error.name, [path.stem for path in Path.cwd().glob("*.py")])
        way_out = meant or ": start in its folder, or install it"
        raise InputError(f"module {error.name} is not found{way_out}") from error
    except Exception as error:  # in the user's code, whatever it is
        raise InputError(f"importing {name} raised {type(error).__name__}: {error}") from error
