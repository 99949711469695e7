"""The studies ``polygons/edits`` and ``polygons/cost``."""

import argparse
from typing import Any

from minisplat_ref.extensions.shared_studies import add_out, check_at_least, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study


def add_edits_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out`` and ``--seeds``."""
    add_out(parser)
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="from 0 on, of the clouds (default 3)")


def run_edits(args: argparse.Namespace) -> None:
    """Take polygons to Gaussians and back, edit them, bend a sheet of them.

    Raises
    ------
    InputError
        There are no seeds, or the output folder cannot be used.
    """
    from tqdm import tqdm

    from minisplat_ref.extensions.polygons import claims

    check_at_least(1, seeds=args.seeds)
    with making_folder(args.out) as folder:
        result = claims.measure(args.seeds, lambda jobs: tqdm(jobs, desc="edits", leave=False, disable=None))
        write(folder, {"seeds": args.seeds, **result}, claims.draw(result))
    print("largest distance of a corner from itself, after the way to a Gaussian and back\n")
    print(markdown_table(["sides", "distance"], [[str(n), f"{e:.1e}"] for n, e in result["round trip"].items()]))
    print("\nlargest error of an affine edit of the corners, against the Gaussians under the same map\n")
    print(_table("map", result["affine"]))
    print(f"\na sheet of {claims.USUAL_PER_SIDE**2} splats that is bent\n")
    print(_table("degrees", result["angle"]))
    print(f"\na sheet that is bent by {claims.USUAL_ANGLE} degrees\n")
    print(_table("splats", result["splats"]))


def add_cost_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--gaussians`` and ``--repeats``."""
    parser.add_argument("--gaussians", type=int, default=10_000, metavar="N", help="default 10000")
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="the least time counts (default 5)")


def run_cost(args: argparse.Namespace) -> None:
    """Count and time what a pixel of polygons costs, beside ellipsoids on rays and splats.

    Raises
    ------
    InputError
        There is nothing to time.
    """
    from minisplat_ref.extensions.polygons import cost

    check_at_least(1, gaussians=args.gaussians, repeats=args.repeats)
    rows = cost.measure(args.gaussians, args.repeats)
    heading = list(next(iter(rows.values())))
    print(
        markdown_table(["", *heading], [[name, *(_figure(row[key]) for key in heading)] for name, row in rows.items()])
    )


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _table(corner: str, rows: dict[Any, dict[str, float]]) -> str:
    heading = list(next(iter(rows.values())))
    return markdown_table(
        [corner, *heading], [[str(key), *(f"{e:.1e}" for e in row.values())] for key, row in rows.items()]
    )


STUDIES = (
    Study("edits", "polygons to Gaussians and back, affine edits, a bent sheet", add_edits_arguments, run_edits),
    Study("cost", "a pixel of polygons beside one of ellipsoids on rays and of splats", add_cost_arguments, run_cost),
)
"""``polygons/edits`` and ``polygons/cost``."""
