"""The definition of an extension, and loaders of extensions and of recipes by name."""

import sys
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions import folders, module_of
from minisplat_ref.interface.arguments import suggest
from minisplat_ref.io.formats import UNBUNDLED, Format
from minisplat_ref.io.formats.catalogue import FORMATS
from minisplat_ref.io.formats.sog import SOG
from minisplat_ref.io.label import NO_LABEL, Label
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.methods import RECIPES
from minisplat_ref.rendering import SPLATTING
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.representation import GAUSSIANS, Representation
from minisplat_ref.training.schedule import Recipe, scale_recipe
from minisplat_ref.types import Gaussians


class Extension(NamedTuple):
    """A relative of 3DGS, as a value."""

    name: str
    """The name of its folder, with hyphens for underscores."""
    recipes: tuple[Recipe, ...] = ()
    """Methods that train it; they get ``representation`` and ``losses`` from here."""
    representation: Representation = GAUSSIANS
    """The population that is trained, and its renderer."""
    losses: tuple[LossTerm, ...] = ()
    """Terms that join those of any recipe that is trained with the extension; ``--set NAME=WEIGHT`` weighs them."""
    save: Callable[[str | Path, Any, Label], None] = save_ply
    """``save(path, population, label)``: a PLY with the comments of a label (:mod:`minisplat_ref.io.label`) in its
    header; by default further fields become columns that other readers skip."""
    load: Callable[[str | Path, Any], Any] = load_ply
    """``load(path, type)`` of the population's type."""
    commands: tuple[ModuleType, ...] = ()
    """Modules with ``add_parser(commands)`` and ``run(args)``: ``minisplat-ref NAME COMMAND``."""
    saves_plain: bool = False
    """Whether ``save`` writes Gaussians of 3DGS, and ``load`` reads the six fields: then its files have no label."""
    stages: Callable[..., Any] | None = None
    """``stages(backend, setting, rng)``: further stages that ``oracle gradients --extension NAME`` checks."""
    sample: Callable[[Gaussians, np.random.Generator], Any] | None = None
    """Makes of any Gaussians a population that exercises the renderer, for ``bench --extension NAME``; by default the
    representation's ``extend``, which may leave them as they are."""
    formats: tuple[Format, ...] = ()
    """File formats of the six fields of 3DGS, which ``convert`` writes, and every command reads that reads a PLY."""

    @property
    def label(self) -> Label:
        """The label of its files: none where 3DGS renders them."""
        is_plain = (self.representation.population, self.representation.renderer) == (Gaussians, SPLATTING)
        return NO_LABEL if is_plain or self.saves_plain else Label(self.name)


CORE = Extension("core", formats=FORMATS)
"""The program without any extension."""


def load_extension(name: str) -> Extension:
    """Return an extension.

    Raises
    ------
    InputError
        There is none of that name, it cannot be imported, or its ``EXTENSION`` is missing or not as it should be.
    """
    found = folders()
    if name not in found:
        raise InputError(f"extension {name!r} does not exist{suggest(name, found)}")
    return _load(name, found[name])


def _load(name: str, folder: Path) -> Extension:
    """Return the extension in a folder of those that :func:`folders` lists; raise as :func:`load_extension` does."""
    try:
        module = import_module(module_of(name))
    except (Exception, SystemExit) as error:  # whatever the user's file does
        reason = " ".join(str(error).split())
        raise InputError(
            f"extension {name} in {folder} cannot be loaded, {type(error).__name__}: {reason}; mend or remove it"
        ) from error
    extension = getattr(module, "EXTENSION", None)
    if not isinstance(extension, Extension):
        raise InputError(
            f"extension {name} in {folder} has no EXTENSION that is an Extension: let its __init__.py say"
            f' EXTENSION = Extension("{name}", ...)'
        )
    _check_parts(extension, name, folder)
    return extension


_PARTS: dict[str, type] = {
    "recipes": Recipe,
    "losses": LossTerm,
    "commands": ModuleType,
    "formats": Format,
}


def _check_parts(extension: Extension, name: str, folder: Path) -> None:
    """Refuse an extension whose fields have wrong types or values, before anything fails because of them.

    Raises
    ------
    InputError
        It has another name than its folder, a recipe with the name of one of the core, or a field of a wrong type.
    """
    if extension.name != name:
        raise InputError(f"extension {extension.name} lies in a folder called {folder}: rename one of them")
    for part, kind in _PARTS.items():
        values = getattr(extension, part)
        if type(values) is not tuple or not all(isinstance(value, kind) for value in values):
            raise InputError(
                f"extension {name} in {folder}: {part} is not a tuple of {kind.__name__}; write {part}=(...,)"
            )
    if not isinstance(extension.representation, Representation):
        raise InputError(f"extension {name} in {folder}: representation is not a Representation")
    population = extension.representation.population
    lacking = [field for field in Gaussians._fields if field not in getattr(population, "_fields", ())]
    if lacking and (extension.save is save_ply or extension.load is load_ply):
        raise InputError(
            f"extension {name} in {folder}: its population has no {', '.join(lacking)}, which a PLY of 3DGS has: give"
            " it a save and a load of its own"
        )
    if not _takes_three(extension.save):
        raise InputError(f"extension {name} in {folder}: save does not take a path, a population and a label")
    for recipe in extension.recipes:
        if recipe.name in RECIPES:
            raise InputError(
                f"extension {name} has a recipe {recipe.name}, and so has the core: rename the extension's"
            )


def _takes_three(function: Callable[..., Any]) -> bool:
    """Return whether a function can be called with three arguments, so that an error is found before a training."""
    try:
        signature(function).bind(None, None, None)
    except TypeError:
        return False
    except ValueError:  # its signature is unknown
        return True
    return True


def load_extensions() -> list[Extension]:
    """Return all extensions but those that cannot be loaded; stderr has one line about each of these, once."""
    extensions = []
    for name, folder in folders().items():
        try:
            extensions.append(_load(name, folder))
        except InputError as error:
            if name not in _REPORTED:
                print(f"minisplat-ref: warning: {' '.join(str(error).split())}", file=sys.stderr)
                _REPORTED.add(name)
    return extensions


_REPORTED: set[str] = set()  # names of extensions that could not be loaded, and were reported on stderr


def find_recipe(name: str, iterations: int | None = None, *, extension: str | None = None) -> Recipe:
    """Return the recipe of that name, of the core or of an extension, ready to train.

    Parameters
    ----------
    name : str
        Name of the recipe.
    iterations : int, optional
        Length to which it is scaled; the published one by default.
    extension : str, optional
        An extension to train a recipe of the core with. A recipe of an extension brings its own, and may be trained
        with another one that has nothing but loss terms.

    Raises
    ------
    InputError
        There is no such recipe or extension, two extensions have a recipe of that name, the recipe belongs to another
        extension, or ``iterations`` is below 1.
    """
    recipe, owner = (RECIPES[name], None) if name in RECIPES else _of_extensions(name)
    if extension is not None and (owner is None or owner.name != extension):
        other = load_extension(extension)
        if owner is not None and (other.representation != GAUSSIANS or not other.losses):
            raise InputError(f"recipe {name} belongs to extension {owner.name}: leave out --extension {extension}")
        recipe = recipe._replace(representation=other.representation, losses=(*recipe.losses, *other.losses))
    if owner is not None:
        recipe = recipe._replace(representation=owner.representation, losses=(*recipe.losses, *owner.losses))
    return recipe if iterations is None else scale_recipe(recipe, iterations)


def owner_of(recipe: str, extension: str | None = None) -> Extension | None:
    """Return the extension whose population a recipe trains, None for the core alone."""
    if recipe not in RECIPES:
        return _of_extensions(recipe)[1]
    return None if extension is None else load_extension(extension)


def _of_extensions(name: str) -> tuple[Recipe, Extension]:
    extensions = load_extensions()
    found = [(recipe, extension) for extension in extensions for recipe in extension.recipes if recipe.name == name]
    if not found:
        names = (*RECIPES, *(recipe.name for extension in extensions for recipe in extension.recipes))
        raise InputError(f"recipe {name!r} does not exist{suggest(name, names)}")
    if len(found) > 1:
        owners = " and ".join(extension.name for _, extension in found)
        raise InputError(f"recipe {name} is in the extensions {owners}: rename one")
    return found[0]


def find_format(path: str | Path) -> Format | None:
    """Return the format of a file by its suffix; None for a PLY, and where no extension knows the suffix.

    Raises
    ------
    InputError
        Two extensions have a format of that suffix.
    """
    if Path(path).name == UNBUNDLED:
        return SOG
    suffix = "".join(Path(path).suffixes[-2:]).lower()
    if suffix in ("", ".ply", ".csv"):  # which need no extension to be loaded
        return None
    found = [(format_, owner) for owner, format_ in all_formats() if suffix.endswith(format_.suffix)]
    if len(found) > 1:
        owners = " and ".join(owner for _, owner in found)
        raise InputError(f"{found[0][0].suffix} is a format of the extensions {owners}: rename one")
    return found[0][0] if found else None


def all_formats() -> list[tuple[str, Format]]:
    """Return every format behind the name of its extension, those of the core first."""
    return [(extension.name, format_) for extension in (CORE, *load_extensions()) for format_ in extension.formats]
