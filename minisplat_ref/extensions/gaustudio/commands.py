"""The commands ``gaustudio modules``, which lists the alternatives of each stage, and ``masks``, which writes skies.

The list is data: the functions that ``train --set STAGE=MODULE`` takes. Masks of the sky become files, for inspection
and correction.
"""

import argparse
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.gaustudio.alternatives import by_color
from minisplat_ref.extensions.gaustudio.model import RECIPE
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import load_scene, write_image
from minisplat_ref.io.atomic import making_folder
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
MODULES_EPILOG = """\
examples:
  minisplat-ref train SCENE --recipe gaustudio --set background=sky_map
  minisplat-ref train SCENE --recipe gaustudio --set representation=surfels
  minisplat-ref mesh RUN --out mesh.ply --depth expected"""
MASKS_EPILOG = """\
example:
  minisplat-ref gaustudio masks SCENE --out masks
  minisplat-ref train SCENE --recipe gaustudio \\
    --set sky_mask=from_files --set mask_folder=masks"""


def add_parser(commands: Any) -> None:
    """Add both commands."""
    modules = commands.add_parser(
        "modules",
        help="list the stages, and what each can be exchanged for",
        description="List the stages of the recipe gaustudio and the modules of each.\n* marks the one it has.",
        epilog=MODULES_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    modules.set_defaults(run=run_modules)
    masks = commands.add_parser(
        "masks",
        help="write what sky_mask=by_color takes for sky, to be mended by hand",
        epilog=MASKS_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    masks.add_argument("scene", metavar="SCENE", help="folder of a scene")
    masks.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for NAME.png, white is sky")
    masks.set_defaults(run=run_masks)


# --- modules ---


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


def run_modules(args: argparse.Namespace) -> int:
    """Print the list."""
    print("\n".join(to_lines()))
    return 0


# --- masks ---


def run_masks(args: argparse.Namespace) -> int:
    """Write a mask for each photograph, and report its fraction of sky."""
    scene = load_scene(args.scene, test_every=0)
    shares = []
    with making_folder(args.out) as folder:
        for view in with_progress(scene.train_views, "looking for skies", "photographs"):
            is_sky = by_color(view.load(), "")
            file = folder / f"{view.name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_image(file, is_sky)
            shares.append(np.mean(is_sky))
    n_with = sum(share > 0 for share in shares)
    print(
        f"{len(shares)} masks in {args.out}: {n_with} show a sky, {np.mean(shares):.0%} of all pixels; look at them and"
        " mend what is wrong"
    )
    return 0
