"""The studies of this extension: how exact edits are, and whether a sheet falls as physics says.

Both write ``result.json`` and ``figure.png`` to a new folder and print Markdown tables.
"""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PNG_DPI = 150


def add_affine_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out`` and ``--seeds``."""
    _add_out(parser)
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of seeds, from 0 on (default 3)")


def run_affine(args: argparse.Namespace) -> None:
    """Compare edits with the affine maps themselves, and a rolled sheet with the cylinder.

    Raises
    ------
    InputError
        ``--seeds`` is below 1, or the output folder cannot be used.
    """
    import numpy as np
    from tqdm import tqdm

    from minisplat_ref.extensions.proxies import edit_claims

    if args.seeds < 1:
        raise InputError(f"--seeds is {args.seeds}: give at least 1")
    with making_folder(args.out) as folder:
        edits = {}
        for name in tqdm(edit_claims.MAPS, desc="edits", leave=False, disable=None):
            rows = [edit_claims.edit_errors(name, seed) for seed in range(args.seeds)]
            is_seen = rows[0].picture is not None
            worst = {field: max(getattr(row, field) for row in rows) for field in rows[0]._fields[:3]}
            edits[name] = {**worst, "picture": max(row.picture or 0.0 for row in rows) if is_seen else None}
        cells = tqdm(edit_claims.CELLS, desc="bending", leave=False, disable=None)
        bend = edit_claims.bend_errors(edit_claims.flat_gaussians(np.random.default_rng(0)), cells)
        _write(folder, {"seeds": args.seeds, "edits": edits, "bend": bend}, edit_claims.draw(bend, seed=0))
    print("largest error of an affine edit, in float64\n")
    table = [[name, *("-" if e is None else f"{e:.1e}" for e in errors.values())] for name, errors in edits.items()]
    print(markdown_table(["map", "centre", "covariance", "colour", "picture"], table))
    print("\nlargest error of a sheet that a mesh shears and rolls onto a cylinder\n")
    columns = (bend["cells"], bend["centre"], *bend["covariance"].values())
    heading = ["cells a side", "centre", *(f"covariance, {name}" for name in bend["covariance"])]
    print(markdown_table(heading, [[str(n), *(f"{e:.1e}" for e in row)] for n, *row in zip(*columns, strict=True)]))


def add_sheet_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out`` and ``--seed``."""
    _add_out(parser)
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the carpet's Gaussians (default 0)")


def run_sheet(args: argparse.Namespace) -> None:
    """Let sheets fall, hang and swing.

    Raises
    ------
    InputError
        The output folder cannot be used.
    """
    from tqdm import tqdm

    from minisplat_ref.extensions.proxies import sheet_claims

    with making_folder(args.out) as folder:
        result = sheet_claims.measure(args.seed, lambda jobs: tqdm(jobs, desc="sheets", leave=False, disable=None))
        _write(folder, {"seed": args.seed, **result}, sheet_claims.draw(result, args.seed))
    fall = result["free_fall"]
    print(
        f"free fall for 1 s in {fall['steps']} steps, over {fall['distance']:.1f} units: centres off by"
        f" {fall['centre']:.1e}, covariances by {fall['covariance']:.1e} of the largest\n"
    )
    print("a hanging sheet: largest distance from the catenary over the sheet's length\n")
    print(_table("stretch under its own weight", " cells", result["hanging"]))
    print("\na swinging sheet: largest change of the total energy over the kinetic and dissipated energy\n")
    print(_table("step over the longest stable one", "", result["energy"]))


def _table(corner: str, unit: str, rows: dict[str, dict[str, float]]) -> str:
    heading = [f"{column}{unit}" for column in next(iter(rows.values()))]
    return markdown_table(
        [corner, *heading], [[name, *(f"{e:.1e}" for e in row.values())] for name, row in rows.items()]
    )


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="new folder for result.json and figure.png"
    )


def _write(folder: Path, result: dict[str, Any], figure: "Figure") -> None:
    (folder / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    figure.savefig(folder / "figure.png", dpi=PNG_DPI, facecolor="white")


STUDIES = (
    Study("affine", "edits against affine maps, and a rolled sheet", add_affine_arguments, run_affine),
    Study("sheet", "shape and energy of a sheet that falls, hangs and swings", add_sheet_arguments, run_sheet),
)
"""The studies ``proxies/affine`` and ``proxies/sheet``."""
