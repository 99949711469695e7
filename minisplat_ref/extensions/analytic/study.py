"""The study ``analytic/footprint`` measures how far each method is from the integral over a pixel."""

import argparse

from minisplat_ref.extensions.shared_studies import add_out, check_at_least, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--places`` and ``--seed``."""
    add_out(parser)
    parser.add_argument("--places", type=int, default=64, metavar="N", help="positions within a pixel (default 64)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of positions and angles (default 0)")


def run(args: argparse.Namespace) -> None:
    """Measure the errors, write the results, and print a table.

    Raises
    ------
    InputError
        There is nothing to measure, or the output folder cannot be used.
    """
    from minisplat_ref.extensions.analytic import footprint

    check_at_least(1, places=args.places)
    with making_folder(args.out) as folder:
        found = footprint.measure(args.places, args.seed)
        result = footprint.summarise(found)
        write(folder, {"places": args.places, "seed": args.seed, **result}, footprint.draw(found))
    print("RMS error of alpha, relative to the RMS of its exact mean over the pixel\n")
    rows = [
        [shape, f"{sigma:g}", *(f"{methods[name][s]:.2g}" for name in footprint.METHODS)]
        for shape, methods in found.items()
        for s, sigma in enumerate(footprint.SIGMAS)
    ]
    print(markdown_table(["shape", "sigma (px)", *footprint.METHODS], rows))
    print(f"\nThe distribution functions differ by {result['largest_difference_of_distributions']:.1e} at most.")


FOOTPRINT = Study("footprint", "alpha of one Gaussian against its integral over pixels", add_arguments, run)
