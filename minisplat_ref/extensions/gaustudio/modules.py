"""The command ``minisplat-ref gaustudio modules``: every stage, and the modules that it can be exchanged for.

The list is data: the functions that ``train --set STAGE=MODULE`` takes, which are those in the file of the stage.
"""

import argparse
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

from minisplat_ref.extensions.gaustudio.method import RECIPE
from minisplat_ref.training.recipe_settings import find_alternatives, settings_of

STAGES = {
    "initialiser": "the Gaussians with which a training begins",
    "representation": "what the primitives are",
    "background": "what lies behind the scene",
    "photo_loss": "how an image is compared with its photograph",
    "sky_mask": "which pixels show the sky, where sky_opacity keeps the scene empty",
    "density": "what becomes of Gaussians whose images move",
}
DEPTHS = {
    "median": "of the hit at which half of the light is left.",
    "expected": "the mean of all hits.",
    "midpoint": "of the dominant Gaussian; surfels have none.",
}
"""The values of ``mesh --depth``, the default first."""
EPILOG = """\
examples:
  minisplat-ref train SCENE --recipe gaustudio --set background=sky_map
  minisplat-ref train SCENE --recipe gaustudio --set representation=surfels
  minisplat-ref mesh RUN --out mesh.ply --depth expected"""


class Stage(NamedTuple):
    """A stage of the recipe, and its alternatives."""

    name: str
    """In ``--set NAME=MODULE``."""
    summary: str
    present: str
    modules: dict[str, Callable[..., Any]]
    """By name."""


def all_stages() -> tuple[Stage, ...]:
    """Return the stages of a training."""
    present = settings_of(RECIPE)
    return tuple(
        Stage(name, summary, present[name].__name__, find_alternatives(present[name]))
        for name, summary in STAGES.items()
    )


def to_lines() -> list[str]:
    """Return the list as text; a star is before the module that the recipe has."""
    lines = []
    for stage in all_stages():
        lines += [f"--set {stage.name}=...  {stage.summary}"]
        first_lines = {name: inspect.getdoc(module) or "" for name, module in stage.modules.items()}
        lines += [*_rows({name: text.partition("\n")[0] for name, text in first_lines.items()}, stage.present), ""]
    return [*lines, "mesh RUN --depth ...  which depth of a pixel is fused", *_rows(DEPTHS, next(iter(DEPTHS)))]


def _rows(summaries: dict[str, str], present: str) -> list[str]:
    return [f"  {'*' if name == present else ' '} {name:<12}  {text}" for name, text in summaries.items()]


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "modules",
        help="list the stages, and what each can be exchanged for",
        description="List the stages of the recipe gaustudio and the modules of each.\n* marks the one it has.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the list."""
    print("\n".join(to_lines()))
    return 0
