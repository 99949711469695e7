"""``python -m data_tools.hints`` judges what ``oracle compare`` says of planted faults, at other sizes and scenes.

How often the fault that was planted is the first that a report names, and how often it is among the three; for a
renderer that gives every stage, a function with a meta, one without, and images alone. Errors of other people's source
are judged by tests/oracle/test_oracle_foreign.py.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.interface.arguments import HelpFormatter, Parser, integer
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.oracle.comparison.hints import INTERMEDIATE, Hint
from minisplat_ref.oracle.comparison.staged import compare_scene, hints_of
from minisplat_ref.oracle.comparison.trials import run_fault
from minisplat_ref.oracle.faults import FAULTS, Fault
from minisplat_ref.oracle.golden.format import SPECS, Arrays, Golden
from minisplat_ref.oracle.golden.scenes import RECIPES, inputs, truth
from minisplat_ref.oracle.renderer import ComparedRenderer

SCENES = ("antialiased", "off-centre", "sh3", "planes")
OF_FUNCTION = ("image", "alpha", "feature_image", "accumulated_depth", "view", "view_alpha")
OF_IMAGE = ("image", "alpha")
GRADIENTS = ("v_means", "v_quats", "v_scales", "v_opacities", "v_sh_dc", "v_sh_rest", "v_background", "v_features")
BETWEEN = 0.85  # of the way from nothing to a usual size


class Way(NamedTuple):
    """A way of calling a renderer."""

    is_fed: bool
    gives: Callable[[str], bool]
    """Whether it has an array of this name."""


def _is_of_function(array: str) -> bool:
    spec = SPECS[array]
    is_gradient = array in GRADIENTS or (spec.stage == "view" and spec.role == "gradient")
    return array in OF_FUNCTION or is_gradient


WAYS = {
    "every stage": Way(True, lambda array: SPECS[array].role in ("output", "gradient")),
    "a function with a meta": Way(False, lambda array: _is_of_function(array) or array in INTERMEDIATE),
    "a function without a meta": Way(False, _is_of_function),
    "its image alone": Way(False, lambda array: array in OF_IMAGE),
}


def scenes_of(seed: int, way: Way, names: Sequence[str] = SCENES) -> list[Golden]:
    """Return golden scenes drawn with another seed; 0 is that of the golden vectors."""
    zeros = () if way.is_fed else ("v_depths",)
    recipes = [recipe for recipe in RECIPES if recipe.name in names]
    return [truth(inputs(recipe, seed), seed=seed, zeros=zeros) for recipe in recipes]


def size_of(fault: Fault) -> float:
    """Return a size that is not tried: between nothing and the first; a jump has only those that are."""
    return fault.sizes[0] if fault.null is None else fault.null + BETWEEN * (fault.sizes[0] - fault.null)


def faulty(fault: Fault, size: float, way: Way) -> ComparedRenderer:
    """Return a renderer with a fault of a size, which gives what is given in this way."""

    def arrays(scene: Golden) -> Arrays:
        found = run_fault(fault, size, scene, is_fed=way.is_fed)
        return {name: array for name, array in found.items() if name in scene.arrays and way.gives(name)}

    return ComparedRenderer(fault.what, "float64", way.is_fed, arrays)


def hints_for(renderer: ComparedRenderer, scenes: Sequence[Golden]) -> list[Hint]:
    """Return what a report would say of a renderer."""
    return hints_of([row for scene in scenes for row in compare_scene(renderer, scene)])[0]


def is_named(hint: Hint, fault: Fault, size: float) -> bool:
    """Return whether a hint is of this fault, its size, and perhaps more than one place."""
    return hint.what == fault.words(size) and fault.where in hint.places


def judge(name: str, seed: int, faults: Sequence[Fault]) -> list[str]:
    """Return a row: how often the true fault is named first, and among the three, of those that are seen."""
    way, ranks, unseen = WAYS[name], [], 0
    scenes = scenes_of(seed, way)
    for fault in with_progress(faults, name, "faults"):
        size = size_of(fault)
        hints = hints_for(faulty(fault, size, way), scenes)
        if not hints:
            unseen += 1
            continue
        ranks.append(next((k for k, hint in enumerate(hints) if is_named(hint, fault, size)), len(hints) + 1))
        if ranks[-1]:
            words = "; ".join(hint.words for hint in hints)
            print(f"{name}: {fault.words(size)}, {fault.where}: {words}", file=sys.stderr)
    n = max(len(ranks), 1)
    n_first, n_three = int(np.sum(np.equal(ranks, 0))), int(np.sum(np.less(ranks, 3)))
    return [name, *(f"{k} of {len(ranks)} ({k / n:.0%})" for k in (n_first, n_three)), str(unseen)]


def main() -> None:
    """Judge the hints."""
    parser = Parser(
        prog="python -m data_tools.hints",
        description="Judge the planted faults that reports of oracle compare name.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--seed", type=int, default=2, metavar="S", help="of the scenes to judge on (default 2)")
    parser.add_argument(
        "--ways", nargs="+", choices=tuple(WAYS), default=tuple(WAYS), metavar="WAY", help="(default all)"
    )
    parser.add_argument(
        "--every", type=integer(1), default=1, metavar="N", help="judge every Nth planted fault (default 1: all)"
    )
    args: argparse.Namespace = parser.parse_args()
    faults = FAULTS[:: args.every]
    rows = [judge(name, args.seed, faults) for name in args.ways]
    heading = ["given", "true one first", "among the three", "not seen or not named"]
    print(f"{len(faults)} of {len(FAULTS)} faults, scenes of seed {args.seed}, other sizes; {describe_machine()}\n")
    print(markdown_table(heading, rows))


if __name__ == "__main__":
    main()
