"""The studies of this extension: where a difference of Gaussians helps, and what it does not do in compositing.

Both write ``result.json`` and ``figure.png`` to a new folder and print a Markdown table.
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
from minisplat_ref.studies.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PNG_DPI = 150


def add_ring_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--seeds`` and ``--starts``."""
    _add_out(parser)
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of seeds, from 0 on (default 3)")
    parser.add_argument("--starts", type=int, default=16, metavar="N", help="per fit; the best counts (default 16)")


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
    print("PSNR (dB) of the best fit: mean over the seeds ± half their range\n")
    print(markdown_table(["thickness / outer radius", *rings.MODELS], rows))
    print()
    for pair, others in result["crossings"].items():
        places = [f"{name} at {', '.join(f'{x:.2f}' for x in xs) or 'no thickness'}" for name, xs in others.items()]
        print(f"{pair}: crosses {'; '.join(places)}")


def add_backdrop_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--seed`` and ``--starts``."""
    _add_out(parser)
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the starts (default 0)")
    parser.add_argument("--starts", type=int, default=4, metavar="N", help="per fit; the best counts (default 4)")


def run_backdrop(args: argparse.Namespace) -> None:
    """Fit a ring in front of a black wall and of a dotted one.

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
    heading = ["wall", "Gaussians of the ring", "PSNR (dB)", "in the hole", "transmittance of the hole"]
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
    Study("rings", "one Gaussian minus another against 2 to 4 positive ones", add_ring_arguments, run_rings),
    Study("backdrop", "the hole of a ring: negative colours do not open it", add_backdrop_arguments, run_backdrop),
)
"""The studies ``negative/rings`` and ``negative/backdrop``."""
