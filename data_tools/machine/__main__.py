"""``python -m data_tools.machine large|memory|conversions|slopes|start|roofline``: measure and report."""

import argparse
import sys
from pathlib import Path

from data_tools.machine.conversions import SUFFIXES, N
from minisplat_ref.app.cli.bench import add_output_arguments, progress, publish
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import HelpFormatter, Parser, integer, list_of, name
from minisplat_ref.oracle.cases import Report


def measure_large(args: argparse.Namespace) -> Report:
    """Train on more photographs than fit into memory."""
    from data_tools.machine.large_scene import LARGEST, large_case

    progress("large: reads thousands of photographs, which takes a quarter of an hour")
    return Report("Photographs beyond memory", (large_case(LARGEST),), {})


def measure_memory(args: argparse.Namespace) -> Report:
    """Measure the peak memory of two trainings."""
    from data_tools.machine.large_scene import MODERATE, large_case
    from data_tools.machine.peak_memory import memory_case

    progress("memory: a few iterations in separate processes")
    return Report("Peak memory of training", (memory_case(), large_case(MODERATE)), {})


def measure_conversions(args: argparse.Namespace) -> Report:
    """Measure the peak memory and the time of ``convert``, format by format."""
    from data_tools.machine.conversions import conversion_cases

    progress(f"conversions: {args.gaussians:,} Gaussians to {', '.join(args.formats)}")
    cases = []
    for case in conversion_cases(args.gaussians, args.formats):
        cases.append(case)
        progress(f"conversions: {case.name} {case.figures} {case.note}")
    return Report(f"Conversion of {args.gaussians:,} Gaussians of degree 3", tuple(cases), {})


def measure_slopes(args: argparse.Namespace) -> Report:
    """Time views from few Gaussians to many."""
    from data_tools.machine.slopes import slope_cases

    cases = slope_cases(args.repeats, progress)
    return Report("What time grows with: forward and backward, float32", tuple(cases), {"repeats": args.repeats})


def measure_start(args: argparse.Namespace) -> Report:
    """Time the first iteration of ``train``."""
    from data_tools.machine.start_time import start_cases

    progress("start: train with no compiled kernels, then with them")
    return Report("From the start of train to the end of its first iteration", tuple(start_cases()), {})


def measure_roofline(args: argparse.Namespace) -> Report:
    """Compare kernels with the limits of the machine."""
    from data_tools.machine.contests import time_contests
    from data_tools.machine.limits import adams, stages
    from data_tools.machine.roofline import blending
    from data_tools.machine.threads import thread_cases, threads
    from minisplat_ref.bench.workloads import get_workload

    workloads = [get_workload(workload, args.data) for workload in args.workloads]  # before anything takes its time
    progress("a training iteration on one thread and on all, alternating")
    cases = thread_cases(args.scene, args.downscale, args.iterations)
    progress("blending against straight-line loops, Adam against a copy, other stages by themselves, all alternating")
    contests = [contest for made in workloads for contest in (blending(made), *threads(made))]
    cases += time_contests([*contests, *adams(), *stages()], args.repeats)
    return Report("How far the kernels are from the limits", tuple(cases), {})


MEASUREMENTS = {
    "large": (measure_large, "2,000 photographs of 12 megapixels within 8 GB"),
    "memory": (measure_memory, "peak of training in 1920 x 1080 and 12 megapixels"),
    "conversions": (measure_conversions, "memory and time of convert, 5 million Gaussians"),
    "slopes": (measure_slopes, "time against hits, 12,500 to 200,000 Gaussians"),
    "start": (measure_start, "seconds to the first iteration, cold and warm"),
    "roofline": (measure_roofline, "kernels and threads against what the processor can give"),
}


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all measurements."""
    parser = Parser(
        prog="python -m data_tools.machine",
        description="Measure this machine with the package.",
        formatter_class=HelpFormatter,
    )
    commands = parser.add_subparsers(dest="measurement", metavar="COMMAND", required=True)
    own = {
        title: commands.add_parser(title, help=text, description=text, formatter_class=HelpFormatter)
        for title, (_, text) in MEASUREMENTS.items()
    }
    for measurement in own.values():
        add_output_arguments(measurement)
    for title in ("slopes", "roofline"):
        own[title].add_argument(
            "--repeats", type=integer(1), default=10, metavar="N", help="timings of each, in each round (default 10)"
        )
    add = own["conversions"].add_argument
    add("--gaussians", type=integer(1), default=N, metavar="N", help=f"how many (default {N:,})")
    add("--formats", type=list_of(name), default=SUFFIXES, metavar="A,B", help="suffixes (default all)")
    add = own["roofline"].add_argument
    add("--scene", type=Path, metavar="SCENE", help="photographs to train on (default a made room)")
    add("--downscale", type=integer(1), default=1, metavar="D", help="make them D times smaller (default 1)")
    add("--iterations", type=integer(1), default=100, metavar="N", help="of each training (default 100)")
    add("--workloads", type=list_of(name), default=("synth",), metavar="A,B", help="as for bench (default synth)")
    add("--data", type=Path, metavar="FILE", help="test_garden.npz of gsplat's repository, for garden")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run one measurement; return 0, 1 where a case failed, or 2 for bad input."""
    args = build_parser().parse_args(argv)
    measure, _ = MEASUREMENTS[args.measurement]
    try:
        return publish(measure(args), args)
    except InputError as error:
        print(f"data_tools.machine: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
