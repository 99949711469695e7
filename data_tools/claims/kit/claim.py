"""A claim about a method, which a command measures and puts in a table and a figure, and the arguments of commands.

:func:`declare` makes a claim of arguments that this module names and of a function that measures, which is made of what
:mod:`data_tools.claims.kit` has.
"""

import argparse
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.interface.arguments import SYNTHETIC_SCENES, add_number, integer, list_of, name

Argument = Callable[[argparse._ActionsContainer], Any]  # adds itself to a parser
NAMES = list_of(name)
"""The type of names between commas."""
RESULT, FIGURE = "result.json", "figure.png"  # files that a measurement writes


class Claim(NamedTuple):
    """What to measure, and how."""

    name: str
    """The NAME of ``python -m data_tools.claims FILE/NAME``, where a file has several."""
    summary: str
    """What is measured; short enough to follow the name in a line of 80 columns."""
    add_arguments: Callable[[argparse.ArgumentParser], None]
    """Adds the arguments to the parser, and a description where the summary is not enough."""
    run: Callable[[argparse.Namespace], int | None]
    """Measures, writes, prints; returns the exit code, None for 0. Raises InputError for bad input."""
    is_resumed: bool = False
    """Whether it continues in its folder, by :func:`.records.resume`; then its jobs can be carried out by workers."""


def declare(
    title: str,
    summary: str,
    measure: Callable[[argparse.Namespace], Any],
    *arguments: Argument,
    description: str | None = None,
) -> Claim:
    """Return a claim.

    Parameters
    ----------
    title, summary : str
        See :class:`Claim`.
    measure : callable
        Gets the arguments and returns the :class:`~data_tools.claims.kit.Report` that is written to ``--out`` and
        printed; without ``--out`` it returns only the text that is printed.
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
        from data_tools.claims.kit import carry_out

        carry_out(measure, args, is_resumed=is_resumed)

    is_resumed = RESUMED_OUT in arguments
    return Claim(title, summary, add_arguments, run, is_resumed)


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
    return lambda parser: add_number(parser, option, default, meaning, minimum, metavar)


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


def folds(default: int) -> Argument:
    """Return ``--folds``, of which each holds out every K-th photograph."""
    return number("--folds", default, "held out is every K-th photograph", minimum=2, metavar="K")


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
LONG_SIDE = number("--long-side", 480, "make photographs a whole number of times smaller, to this", 16, "PX")
CONTINUES = "The same command with the same folder continues where it was interrupted."

CONDITION_HELP = (
    "whole, few (every fifth photograph), gains (wrong exposures), few-gains (both), poses (wrong cameras),"
    " sizes (every second at half the size), sky (synthetic scenes, cut off)"
)
CONDITION = argument("--condition", type=name, default="whole", metavar="C", help=f"{CONDITION_HELP} (default whole)")
RESUMED_SCENE = (SCENE, RESUMED_OUT, downscale())
SYNTHETIC_SCENE = synthetic_scene()
CALIBRATION = (
    SYNTHETIC_SCENE,
    OUT,
    iterations(3000, "of each of three trainings"),
    number("--views", 24, "to train on", minimum=4, metavar="V"),
    number("--width", 160, "of 4:3 images", minimum=16, metavar="PX"),
    seed("of the disturbance and the trainings"),
)
