"""A study: a claim about a method, which a command measures and puts in a table and a figure.

Studies of 3DGS and Mini-Splatting are in :mod:`minisplat_ref.studies`; an extension brings its own.
``minisplat-ref study NAME`` runs either. :func:`declare` makes a study of the arguments that this module names and of a
function that is imported when it runs, because its module loads Numba and matplotlib, which the help must not.
:mod:`minisplat_ref.studies.kit` has what such functions are made of.
"""

import argparse
import textwrap
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.arguments import SYNTHETIC_SCENES, integer, list_of, name

Argument = Callable[[argparse._ActionsContainer], Any]  # adds itself to a parser
RESULT, FIGURE = "result.json", "figure.png"  # files that a study writes


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
    is_resumed: bool = False
    """Whether it continues in its folder, by :func:`.records.resume`; then its jobs can be carried out by workers."""


def declare(title: str, summary: str, function: str, *arguments: Argument, description: str | None = None) -> Study:
    """Return a study whose work is a function of a module that is imported when it runs.

    Parameters
    ----------
    title, summary : str
        See :class:`Study`.
    function : str
        ``package.module.function``. It gets the arguments and returns the :class:`~minisplat_ref.studies.kit.Report`
        that is written to ``--out`` and printed; without ``--out`` it returns only the text that is printed.
    *arguments
        Those of this module, or of :func:`argument`.
    description : str, optional
        Precedes the help in place of the summary.
    """

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        parser.description = textwrap.fill(description or summary, 80)
        for add in arguments:
            add(parser)

    def run(args: argparse.Namespace) -> None:
        from minisplat_ref.studies.kit import carry_out

        module, _, measure = function.rpartition(".")
        carry_out(getattr(import_module(module), measure), args, is_resumed=is_resumed)

    is_resumed = RESUMED_OUT in arguments
    return Study(title, summary, add_arguments, run, is_resumed)


def argument(*names: str, **settings: Any) -> Argument:
    """Return the argument that ``parser.add_argument`` adds."""
    return lambda parser: parser.add_argument(*names, **settings)


def one_of(*arguments: Argument) -> Argument:
    """Return arguments of which at most one may be given."""

    def add(parser: argparse._ActionsContainer) -> None:
        group = parser.add_mutually_exclusive_group()
        for each in arguments:
            each(group)

    return add


def number(option: str, default: int, meaning: str, minimum: int = 1, metavar: str = "N") -> Argument:
    """Return an option that is a whole number of at least ``minimum``."""
    return argument(
        option, type=integer(minimum), default=default, metavar=metavar, help=f"{meaning} (default {default})"
    )


def scene(default: str | None = None) -> Argument:
    """Return the scene: a folder, or a synthetic one by its name."""
    meaning = f"folder of a scene, or a synthetic one: {', '.join(SYNTHETIC_SCENES)}"
    if default is None:
        return argument("scene", metavar="SCENE", help=meaning)
    return argument("scene", nargs="?", default=default, metavar="SCENE", help=f"{meaning} (default {default})")


def synthetic_scene() -> Argument:
    """Return the name of a synthetic scene."""
    return argument("scene", metavar="SCENE", help=f"a synthetic scene: {', '.join(SYNTHETIC_SCENES)}")


def downscale(default: int = 1) -> Argument:
    """Return ``--downscale`` of a folder's photographs."""
    return number("--downscale", default, "make photographs D times smaller", metavar="D")


def iterations(default: int, meaning: str = "per training", minimum: int = 1) -> Argument:
    """Return ``--iterations``."""
    return number("--iterations", default, meaning, minimum)


def recipe(default: str, meaning: str = "of the trainings") -> Argument:
    """Return ``--recipe``."""
    return argument(
        "--recipe", type=name, default=default, metavar="R", help=f"{meaning}, as in train --recipe (default {default})"
    )


def seeds(n: int) -> Argument:
    """Return ``--seeds N``, those from 0 on."""
    return number("--seeds", n, "number of seeds, from 0 on")


def seed(meaning: str) -> Argument:
    """Return ``--seed`` of one training or one random scene."""
    return number("--seed", 0, meaning, minimum=0, metavar="S")


def fine_tune(default: int) -> Argument:
    """Return ``--fine-tune``, iterations."""
    return number("--fine-tune", default, "iterations of fine-tuning", metavar="M")


def trainings(iterations_: int, recipe_: str) -> tuple[Argument, ...]:
    """Return the arguments of a scene that is trained once per seed, unless its Gaussians are given."""
    return (SCENE, OUT, downscale(), recipe(recipe_), iterations(iterations_), PLY, seeds(3))


SCENE = scene()
OUT = argument("--out", type=Path, required=True, metavar="DIR", help=f"new folder for {RESULT} and {FIGURE}")
RESUMED_OUT = argument(
    "--out", type=Path, required=True, metavar="DIR", help=f"folder for {RESULT} and {FIGURE}, or one to continue"
)
PLY = argument("--ply", type=Path, metavar="FILE", help="take these Gaussians instead of training")
SEEDS = argument(
    "--seeds", type=list_of(integer(0)), default=(0, 1, 2), metavar="S,T", help="of the trainings (default 0,1,2)"
)
CONTINUES = "The same command with the same folder continues where it was interrupted."
