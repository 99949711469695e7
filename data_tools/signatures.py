"""``python -m data_tools.signatures`` measures what each planted fault looks like; ``--judge``, how well they are told.

The table is measured on the golden scenes, at one size of each fault. It is judged on other random scenes and other
sizes: how often the true fault is the first, and how often among the three, that a report names. Three ways of calling
are judged, each with what it has: every stage with the truth's input, a function with a meta, and one without.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.interface.arguments import HelpFormatter, Parser
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.io.atomic import replacing
from minisplat_ref.oracle.comparison.signatures import (
    FILE,
    INTERMEDIATE,
    N_LIKELIEST,
    Signature,
    Table,
    likeliest,
    rows_of,
    signature,
)
from minisplat_ref.oracle.comparison.staged import compare_scene, marks_by_scene
from minisplat_ref.oracle.faults import FAULTS, Fault
from minisplat_ref.oracle.golden.format import SPECS, Arrays, Golden
from minisplat_ref.oracle.golden.running import run_stages
from minisplat_ref.oracle.golden.scenes import RECIPES, inputs, truth
from minisplat_ref.oracle.renderer import ComparedRenderer

LEFT_OUT = ("loss", "statistics", "surface", "adam")  # stages that no fault changes
OF_FUNCTION = ("image", "alpha", "feature_image", "accumulated_depth", "view", "view_alpha")
BETWEEN = 0.85  # of the way from the table's size of a fault to one of its others
META = (*INTERMEDIATE, "gaussian_ids", "tile_offsets", "tile_size")


def _all(array: str) -> bool:
    return True


def _of_function(array: str) -> bool:
    """Return whether a function of NumPy without a meta gives an array."""
    spec = SPECS[array]
    of_gradients = ("v_means", "v_quats", "v_scales", "v_opacities", "v_sh_dc", "v_sh_rest", "v_background")
    is_gradient = array in of_gradients or spec.stage == "view" or array in ("v_features", "v_feature_background")
    return array in OF_FUNCTION or (spec.role == "gradient" and is_gradient)


def _with_meta(array: str) -> bool:
    return _of_function(array) or array in META


class Way(NamedTuple):
    """A way of calling a renderer."""

    is_fed: bool
    gives: Callable[[str], bool]
    """Whether it has an array of this name."""


WAYS = {
    "every stage": Way(True, _all),
    "a function with a meta": Way(False, _with_meta),
    "a function without a meta": Way(False, _of_function),
    "its image alone": Way(False, lambda array: array in ("image", "alpha")),
}


def scenes_of(seed: int, way: Way) -> dict[str, Golden]:
    """Return the golden scenes drawn with another seed; 0 is that of the golden vectors."""
    zeros = () if way.is_fed else ("v_depths",)
    return {r.name: truth(inputs(r, seed), seed=seed, zeros=zeros) for r in RECIPES}


def faulty(fault: Fault, size: float, way: Way, dtype: str = "float64") -> ComparedRenderer:
    """Return a renderer with a fault of a size, that gives what is given in this way."""
    backend = fault.plant(size)

    def arrays(scene: Golden) -> Arrays:
        with np.errstate(all="ignore"):
            fed = scene.arrays if way.is_fed else None
            found = run_stages(backend, scene, dtype, fed=fed, without=LEFT_OUT)
        return {name: array for name, array in found.items() if way.gives(name)}

    return ComparedRenderer(fault.what, dtype, way.is_fed, arrays)


def signature_of(renderer: ComparedRenderer, scenes: Iterable[Golden]) -> Signature:
    """Return the signature of a renderer over scenes."""
    return signature(marks_by_scene(row for scene in scenes for row in compare_scene(renderer, scene)))


def measure() -> dict[str, object]:
    """Return the content of the table: each fault at its size, on the golden scenes."""
    content: dict[str, object] = {"scenes": [recipe.name for recipe in RECIPES]}
    for mode, way in (("fed", Way(True, _all)), ("unfed", Way(False, _all))):
        scenes = scenes_of(0, way)
        found = {
            (fault.what, fault.where): signature_of(faulty(fault, fault.size, way), scenes.values())
            for fault in with_progress(FAULTS, mode, "faults")
        }
        content[mode] = rows_of(Table(tuple(scenes), found))
    return content


def sizes_of(fault: Fault) -> list[float]:
    """Return the sizes on which the table is judged: neither its own, nor those with which weights were chosen."""
    return [fault.size + BETWEEN * (other - fault.size) for other in fault.others] or [fault.size]


def judge(seed: int, dtype: str, names: Sequence[str]) -> list[list[str]]:
    """Return a row for each way: how often the true fault is the first, and among the three, of those that are seen."""
    rows = []
    for name in names:
        way = WAYS[name]
        scenes, ranks, unseen, missed = scenes_of(seed, way), [], 0, []
        trials = [(fault, size) for fault in FAULTS for size in sizes_of(fault)]
        for fault, size in with_progress(trials, name, "trials"):
            found = signature_of(faulty(fault, size, way, dtype), scenes.values())
            ranked = [one.what for one in likeliest(found, list(scenes), is_fed=way.is_fed, n=len(FAULTS))]
            if not ranked:
                unseen += 1
                continue
            ranks.append(ranked.index(fault.what))
            if ranks[-1] >= N_LIKELIEST:
                missed.append(f"{fault.what} ({size:g}): place {ranks[-1] + 1}, after {', '.join(ranked[:3])}")
        n, n_first, n_three = len(ranks), sum(r == 0 for r in ranks), sum(r < N_LIKELIEST for r in ranks)
        shares = [f"{k} of {n} ({k / n:.0%})" for k in (n_first, n_three)]
        rows.append([name, dtype, *shares, str(unseen)])
        for line in missed:
            print(f"{name}: {line}", file=sys.stderr)
    return rows


def main() -> None:
    """Write the table, or judge it."""
    parser = Parser(
        prog="python -m data_tools.signatures",
        description="Measure the signatures of planted faults, which reports of oracle compare name.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--judge", action="store_true", help="judge the stored table on other scenes and sizes")
    parser.add_argument("--seed", type=int, default=2, metavar="S", help="of the scenes to judge on (default 2)")
    parser.add_argument("--dtype", nargs="+", choices=("float64", "float32"), default=("float64", "float32"))
    parser.add_argument(
        "--ways", nargs="+", choices=tuple(WAYS), default=tuple(WAYS), metavar="WAY", help="(default all)"
    )
    args: argparse.Namespace = parser.parse_args()
    if args.judge:
        rows = [row for dtype in args.dtype for row in judge(args.seed, dtype, args.ways)]
        heading = ["given", "computed in", "true one first", "among the three", "no array wrong"]
        print(f"scenes of seed {args.seed}, other sizes; {describe_machine()}\n\n{markdown_table(heading, rows)}")
        return
    with replacing(FILE) as temporary:
        temporary.write_text(json.dumps(measure(), separators=(",", ":")) + "\n", encoding="utf-8")
    print(f"wrote {FILE}: {len(FAULTS)} faults, {FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
