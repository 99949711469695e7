"""A model's file: the extension that renders it, from its label, and the parts of its run that it lacks."""

import sys
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.extensions import VARIABLE, folders
from minisplat_ref.extensions.extension import CORE, Extension, find_format, load_extension
from minisplat_ref.io import formats
from minisplat_ref.io.formats import Format
from minisplat_ref.io.label import Label, warn_of_another
from minisplat_ref.io.other_places import find_model_file
from minisplat_ref.io.ply import further_properties, read_label
from minisplat_ref.training.compensation import COMPENSATION
from minisplat_ref.training.recipe_settings import configure_renderer, renderer_settings
from minisplat_ref.training.sky import SKY
from minisplat_ref.types import Gaussians

PARTS = {SKY: "the sky", COMPENSATION: "the compensation of opacities"}
"""Parts of a model that every view shows and no file of Gaussians holds, by the names of its shared parameters."""


class ModelFile(NamedTuple):
    """A file, read."""

    population: Any
    owner: Extension
    """The extension of the population and its renderer, with the file's settings."""
    label: Label
    """The label for another file of it."""


def missing_parts(shared: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the shared parameters of a model that its file lacks and every view shows."""
    return tuple(name for name in PARTS if name in shared)


def describe_parts(names: Iterable[str]) -> str:
    """Return parts of a model in a few words; parts that only another version has, by their names."""
    return " and ".join(PARTS.get(name, name) for name in names)


def make_label(owner: Extension, shared: Iterable[str], settings: Mapping[str, str]) -> Label:
    """Return the label for a file with the population of a run.

    Parameters
    ----------
    owner : Extension
        The owner of the population.
    shared : iterable of str
        Names of the shared parameters of the run, which the file does not hold.
    settings : mapping of str to str
        Of the run; those of the renderer count.
    """
    settings_of_renderer = renderer_settings(owner.representation.renderer, settings)
    return owner.label._replace(lacks=missing_parts(shared), set=settings_of_renderer)


def find_file(path: Path) -> Path:
    """Return the file that a path of another program means, and say so on stderr if it is not the path itself.

    Raises
    ------
    InputError
        It is of a program whose models are not read.
    """
    found = find_model_file(path)
    if found != path:
        print(f"minisplat-ref: {path}: reading {found.relative_to(path)}", file=sys.stderr)
    return found


def find_label(path: Path) -> Label:
    """Return the label of a PLY or a compact file.

    Raises
    ------
    InputError
        The file, or its label, cannot be read.
    """
    format_ = find_format(path)
    return read_label(path) if format_ is None else formats.label_of(path, format_, formats.read_content(path))


def recorded_owner(path: Path, label: Label) -> Extension:
    """Return the extension that is recorded in a file; ``CORE`` if there is none.

    Raises
    ------
    InputError
        It is not installed, or cannot be loaded.
    """
    if label.extension is None:
        return CORE
    if label.extension not in folders():
        raise InputError(
            f"{path} is drawn by extension {label.extension}, which is not installed: let {VARIABLE} name the folder"
            f" that it is in; render and convert take --extension {CORE.name} for what 3DGS knows of it"
        )
    owner = load_extension(label.extension)
    return _configured(path, owner, label) if label.set else owner


def _configured(path: Path, owner: Extension, label: Label) -> Extension:
    """Return an extension that renders with the settings of a label."""
    try:
        renderer = configure_renderer(owner.representation.renderer, label.set)
    except InputError as error:
        raise InputError(f"{path} was made for another version of extension {owner.name}: {error}") from None
    return owner._replace(representation=owner.representation._replace(renderer=renderer))


def choose_owner(path: Path, label: Label, given: Extension | None, why: str) -> Extension:
    """Return the extension that renders a file: the user's choice, else the one recorded in the file.

    The user's choice has priority, so that a model can be shown as another renderer, or another program, renders it. A
    file with another label is then read with a warning.

    Parameters
    ----------
    path : Path
    label : Label
        Of the file.
    given : Extension or None
        What the user names, with an option or by a run; None for nothing.
    why : str
        That, for the warning.

    Raises
    ------
    InputError
        As for :func:`recorded_owner`.
    """
    if given is None or given.name == label.extension:
        return recorded_owner(path, label)
    warn_of_another(path, label, given.name, why)
    return given


def format_with_axes(path: Path, axes: str | None) -> Format | None:
    """Return the format of a file, with the axes that the user names; None for a PLY.

    Raises
    ------
    InputError
        Axes are named for a format whose files all have the same, or there are no such axes.
    """
    format_ = find_format(path)
    if axes is None:
        return format_
    if format_ is None or format_.with_axes is None:
        raise InputError(f"{path}: --axes is for .spz, whose programs disagree about them: leave it out")
    return format_.with_axes(axes)


def read_population(path: Path, owner: Extension, format_: Format | None = None) -> Any:
    """Read the population of a PLY or of a compact file.

    Parameters
    ----------
    path : Path
        A file with an unknown suffix is read as a PLY.
    owner : Extension
        The owner of the population, for a PLY; ``CORE`` for the six fields.
    format_ : Format, optional
        That of the file, by default the one of its suffix; a line on stderr reports the axes that it chooses.

    Raises
    ------
    InputError
        The file is damaged or missing, or lacks an array that the extension needs.
    """
    format_ = format_ or find_format(path)
    if format_ is None:
        return owner.load(path, owner.representation.population)
    if owner.representation.population is not Gaussians and not owner.saves_plain:
        fields = ", ".join(set(owner.representation.population._fields) - set(Gaussians._fields))
        raise InputError(f"{path}: {format_.suffix} does not hold {fields} of extension {owner.name}: give a PLY")
    content = formats.read_content(path)
    population = format_.decode(content, path)
    if format_.describe_axes is not None:
        print(f"minisplat-ref: {path} is read with the axes {format_.describe_axes(content, path)}", file=sys.stderr)
    return population


def read_model(path: Path, extension: str | None = None, axes: str | None = None) -> ModelFile:
    """Read a PLY or a compact file on its own; warn about parts that it lacks, and about parts that are left out.

    Parameters
    ----------
    path : Path
    extension : str, optional
        The one that renders it, ``core`` for 3DGS; by default the one recorded in the file.
    axes : str, optional
        Those of an .spz, instead of those that it names.

    Raises
    ------
    InputError
        The file is damaged or missing, its extension is not installed, or an array is missing that the extension needs.
    """
    format_ = format_with_axes(path, axes)
    label = find_label(path)
    given = None
    if extension is not None:
        given = CORE if extension == CORE.name else load_extension(extension)
    owner = choose_owner(path, label, given, f"--extension {extension}")
    population = read_population(path, owner, format_)
    if owner is CORE and format_ is None and label.extension is not None and (further := further_properties(path)):
        _warn(f"{path} also has {', '.join(further)}, which are left out")
    if label.lacks:
        _warn(f"{path} does not hold {describe_parts(label.lacks)} of its run, which is drawn with it: give the run")
    is_as_recorded = owner.name == label.extension
    return ModelFile(
        population, owner, owner.label._replace(lacks=label.lacks, set=label.set if is_as_recorded else ())
    )


def _warn(message: str) -> None:
    warnings.warn(one_line(message), InputWarning, stacklevel=3)
