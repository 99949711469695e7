"""The claims as studies: where a difference of Gaussians helps, and what it does not do in compositing.

Both write ``result.json`` and ``figure.png`` into a new folder, and print a Markdown table.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PNG_DPI = 150


def add_ring_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--seeds`` and ``--starts``."""
    _add_out(parser)
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="from 0 on, for the starts (default 3)")
    parser.add_argument("--starts", type=int, default=16, metavar="N", help="of each fit; the best counts (default 16)")


def run_rings(args: argparse.Namespace) -> None:
    """Fit rings of several thicknesses with one pair and with 2 to 4 positive Gaussians.

    Raises
    ------
    InputError
        There is nothing to fit, or the output folder cannot be used.
    """
    from minisplat_ref.extensions.negative import rings

    _check_positive(seeds=args.seeds, starts=args.starts)
    with making_folder(args.out) as folder:
        fits = rings.measure(args.seeds, args.starts)
        result = rings.summarise(fits)
        _write(folder, {"seeds": args.seeds, "starts": args.starts, **result}, rings.draw(fits))
    rows = [
        [f"{thickness}", *(_mean_and_spread(result["psnr"][name][t]) for name in rings.MODELS)]
        for t, thickness in enumerate(rings.THICKNESSES)
    ]
    print("PSNR (dB) of the best fit: mean of the seeds, and half of their range\n")
    print(markdown_table(["thickness / outer radius", *rings.MODELS], rows))
    print()
    for pair, others in result["crossings"].items():
        places = [f"{name} at {', '.join(f'{x:.2f}' for x in xs) or 'no thickness'}" for name, xs in others.items()]
        print(f"{pair}: crosses {'; '.join(places)}")


def add_backdrop_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--seed`` and ``--starts``."""
    _add_out(parser)
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the starts (default 0)")
    parser.add_argument("--starts", type=int, default=4, metavar="N", help="of each fit; the best counts (default 4)")


def run_backdrop(args: argparse.Namespace) -> None:
    """Fit a ring before a black wall and before a dotted one.

    Raises
    ------
    InputError
        There is nothing to fit, or the output folder cannot be used.
    """
    from minisplat_ref.extensions.negative import backdrop

    _check_positive(starts=args.starts)
    with making_folder(args.out) as folder:
        fits = backdrop.measure(args.starts, args.seed)
        result = backdrop.summarise(fits)
        _write(folder, {"seed": args.seed, "starts": args.starts, "walls": result}, backdrop.draw(fits))
    rows = [
        [wall, case, f"{fit['psnr']:.2f}", f"{fit['hole_psnr']:.2f}", f"{fit['see_through']:.1%}"]
        for wall, cases in result.items()
        for case, fit in cases.items()
    ]
    heading = ["wall", "Gaussians of the ring", "PSNR (dB)", "in the hole", "what the hole lets through"]
    print(markdown_table(heading, rows))


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="new folder for result.json and figure.png"
    )


def _check_positive(**numbers: int) -> None:
    for name, number in numbers.items():
        if number < 1:
            raise InputError(f"--{name} is {number}: give at least 1")


def _mean_and_spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.1f} ± {np.ptp(values) / 2:.1f}"


def _write(folder: Path, result: dict[str, Any], figure: "Figure") -> None:
    (folder / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    figure.savefig(folder / "figure.png", dpi=PNG_DPI, facecolor="white")


STUDIES = (
    Study("rings", "one Gaussian less another against 2 to 4 positive ones", add_ring_arguments, run_rings),
    Study("backdrop", "a ring's hole: negative colours do not see through", add_backdrop_arguments, run_backdrop),
)
"""``negative/rings`` and ``negative/backdrop``."""
