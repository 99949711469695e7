"""The study ``micro/checker`` measures what trace penalty and detail gain at equal count."""

import argparse

import numpy as np

from minisplat_ref.extensions.shared_studies import add_out, check_at_least, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--iterations``, ``--seeds``, ``--beta`` and ``--trace``."""
    add_out(parser)
    parser.add_argument(
        "--iterations", type=int, default=1500, metavar="N", help="iterations per training (default 1500)"
    )
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of seeds, from 0 on (default 3)")
    parser.add_argument("--beta", type=float, default=1.0, metavar="B", help="weight of the detail (default 1)")
    parser.add_argument("--trace", type=float, default=0.001, metavar="L", help="weight of the penalty (default 0.001)")


def run(args: argparse.Namespace) -> None:
    """Train the chart with every variant and seed, write the results, and print a table.

    Raises
    ------
    InputError
        There is nothing to train, or the output folder cannot be used.
    """
    from minisplat_ref.extensions.micro import checker

    check_at_least(1, seeds=args.seeds)
    check_at_least(100, iterations=args.iterations)
    with making_folder(args.out) as folder:
        outcomes = checker.measure(args.iterations, args.seeds, args.beta, args.trace)
        result = checker.summarise(outcomes)
        settings = {key: getattr(args, key) for key in ("iterations", "seeds", "beta", "trace")}
        write(folder, {**settings, "variants": result}, checker.draw(outcomes, args.beta, args.trace))
    rows = [[name, *(_mean_and_spread(numbers[key]) for key in checker.NUMBERS)] for name, numbers in result.items()]
    heading = ["variant", "Gaussians", "PSNR at edges", "PSNR of the ramp", "PSNR", "largest / middle scale", "on ramp"]
    print("mean over the seeds ± half their range\n")
    print(markdown_table(heading, rows))


def _mean_and_spread(values: list[float]) -> str:
    return f"{np.mean(values):.2f} ± {np.ptp(values) / 2:.2f}"


CHECKER = Study("checker", "small Gaussians and detail at equal count, on edges and on a ramp", add_arguments, run)
