"""``bench``: time and error of each backend and precision, measured in one run."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.app.cli.oracle import add_json_argument
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import Commands, HelpFormatter, integer, list_of, name

if TYPE_CHECKING:
    from minisplat_ref.oracle.cases import Report

DEFAULT_WORKLOADS = ("synth", "synth5k")
DATA_WORKLOADS = ("garden", "garden20k")
JSON, TABLE, FIGURE, PAGE = "bench.json", "bench.md", "bench.png", "report.html"

DESCRIPTION = """\
Time every backend and precision on fixed workloads, and measure its error
against the float64 reference in the same run. What exceeds its bound of error
has failed and gets no time.

Errors are given with and without the pixels at which a hit is at a
threshold (alpha 1/255, the stop, depths); correct renderers differ there, and
"flips" counts where. Ratios of times mean something inside one run only.
"""
EPILOG = """\
examples:
  minisplat-ref bench --out bench
  minisplat-ref bench --workloads synth5k --backends cpu-f32,textbook-f32
  minisplat-ref bench --scene photos/fox --against opensplat=build/opensplat
  minisplat-ref bench --extension analytic
  minisplat-ref bench --recipes surfels,lens --iterations 10

Exit codes: 0 all within their bounds, 1 something failed, 2 bad input."""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "bench",
        help="measure speed against error",
        usage="minisplat-ref bench [-h] [options]",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "--workloads",
        type=list_of(name),
        metavar="A,B",
        help="synth, synth5k, garden, garden20k (default: those that there are data for)",
    )
    parser.add_argument("--data", type=Path, metavar="FILE", help="test_garden.npz of gsplat's repository, for garden")
    parser.add_argument(
        "--backends", type=list_of(name), metavar="A,B", help="contenders, like cpu-f32,textbook-f32 (default all)"
    )
    parser.add_argument(
        "--repeats", type=integer(1), default=10, metavar="N", help="timings of each contender (default 10)"
    )
    parser.add_argument(
        "--against",
        type=list_of(name),
        default=(),
        metavar="A,B",
        help="gsplat-torch, opensplat=PROGRAM: time them, too",
    )
    others = parser.add_mutually_exclusive_group()
    others.add_argument("--stages", action="store_true", help="instead: the time of a training iteration by stages")
    others.add_argument("--networks", action="store_true", help="instead: small networks, kernels beside NumPy")
    others.add_argument(
        "--extension", metavar="NAME", help="instead: an extension's renderer on both backends, beside 3DGS's"
    )
    others.add_argument(
        "--recipes",
        type=list_of(name),
        metavar="A,B",
        help="instead: processor time of a training iteration of recipes, beside 3dgs-accel",
    )
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="SCENE",
        help="photographs for --stages, --recipes (default a made room) and opensplat",
    )
    parser.add_argument(
        "--downscale", type=integer(1), default=1, metavar="D", help="make them D times smaller (default 1)"
    )
    parser.add_argument("--iterations", type=integer(1), default=100, metavar="N", help="of the scene (default 100)")
    add_output_arguments(parser)
    parser.set_defaults(run=run)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out DIR`` or ``--json FILE``."""
    outputs = parser.add_mutually_exclusive_group()
    outputs.add_argument("--out", type=Path, metavar="DIR", help=f"write {PAGE}, {JSON}, {TABLE} and {FIGURE}")
    add_json_argument(outputs)


def run(args: argparse.Namespace) -> int:
    """Measure, print the table, write the requested files."""
    return publish(_measure(args), args)


def publish(report: "Report", args: argparse.Namespace) -> int:
    """Print tables and verdict, write the requested files; return 1 where a case failed, else 0."""
    from minisplat_ref.oracle.cases import save_json, verdict

    print(f"{report.title}\n\n{_tables(report)}\n\n{verdict([report])}")
    if args.json is not None:
        save_json(report, args.json)
    if args.out is not None:
        _save_folder(report, args.out)
    return 1 if report.n_failed else 0


def _measure(args: argparse.Namespace) -> "Report":
    if args.stages:
        return _profile(args)
    if args.networks:
        return _networks(args)
    if args.extension is not None:
        return _extension(args)
    if args.recipes:
        return _recipes(args)
    return _benchmark(args)


def _benchmark(args: argparse.Namespace) -> "Report":
    from minisplat_ref.bench.benchmark import benchmark
    from minisplat_ref.bench.contenders import choose
    from minisplat_ref.bench.peers import make_peers
    from minisplat_ref.bench.training_time import compare_opensplat
    from minisplat_ref.bench.workloads import get_workload
    from minisplat_ref.oracle.cases import Report

    peers, opensplat = make_peers(args.against)
    if opensplat is not None and args.scene is None:
        raise InputError("opensplat trains on photographs: give a scene with --scene")
    contenders = [*choose(args.backends), *peers]
    names = args.workloads or (*DEFAULT_WORKLOADS, *(DATA_WORKLOADS if args.data else ()))
    workloads = [get_workload(workload, args.data) for workload in names]  # before the first one takes its time
    cases = [case for workload in workloads for case in benchmark(workload, contenders, args.repeats, progress)]
    if opensplat is not None:
        cases += compare_opensplat(opensplat, args.scene, args.downscale, args.iterations)
    if args.data is None and args.workloads is None:
        progress("garden, garden20k: skipped; minisplat-ref data garden fetches their points, for --data data/garden")
    title = "Speed against error: every time beside its error against the float64 reference"
    return Report(title, tuple(cases), {"workloads": list(names), "repeats": args.repeats})


def _extension(args: argparse.Namespace) -> "Report":
    from minisplat_ref.bench.extension_times import extension_cases
    from minisplat_ref.bench.workloads import get_workload
    from minisplat_ref.extensions.extension import load_extension
    from minisplat_ref.oracle.cases import Report

    extension = load_extension(args.extension)
    names = args.workloads or ("synth5k",)
    workloads = [get_workload(workload, args.data) for workload in names]
    cases = [case for workload in workloads for case in extension_cases(extension, workload, args.repeats, progress)]
    title = f"Renderer of {extension.name} beside that of 3DGS, each against its own float64 reference"
    return Report(title, tuple(cases), {"workloads": list(names), "repeats": args.repeats})


def _networks(args: argparse.Namespace) -> "Report":
    from minisplat_ref.bench.network_times import N_ROWS, network_cases
    from minisplat_ref.jit.compile import n_threads
    from minisplat_ref.oracle.cases import Report

    title = f"Networks and encodings of {N_ROWS:,} rows, {n_threads()} threads: kernels beside NumPy"
    return Report(title, tuple(network_cases(args.repeats)), {"rows": N_ROWS, "repeats": args.repeats})


def _profile(args: argparse.Namespace) -> "Report":
    from minisplat_ref.bench.training_time import profile
    from minisplat_ref.oracle.cases import Report

    cases = profile(args.scene, args.downscale, args.iterations)
    return Report("A training iteration by stages", tuple(cases), {"iterations": args.iterations})


def _recipes(args: argparse.Namespace) -> "Report":
    from minisplat_ref.bench.training_time import compare_recipes
    from minisplat_ref.jit.compile import n_threads
    from minisplat_ref.oracle.cases import Report

    cases = compare_recipes(args.recipes, args.scene, args.downscale, args.iterations)
    settings = {"iterations": args.iterations, "threads": n_threads()}
    return Report("Processor time of a training iteration, on the same points", tuple(cases), settings)


def _tables(report: "Report") -> str:
    """Return a table for each kind of case."""
    from minisplat_ref.oracle.cases import as_markdown, by_kind

    return "\n\n".join(as_markdown(report._replace(cases=tuple(cases))) for cases in by_kind(report.cases))


def _save_folder(report: "Report", folder: Path) -> None:
    """Write JSON, tables, figure and page into a folder, which is made."""
    from minisplat_ref.app.reports.bench_figure import pareto_section, save_figure
    from minisplat_ref.app.reports.check_report import write_page
    from minisplat_ref.io.atomic import replacing
    from minisplat_ref.oracle.cases import save_json

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made: {error.strerror}") from error
    with replacing(folder / TABLE) as temporary:
        temporary.write_text(f"{report.title}\n\n{_tables(report)}\n", encoding="utf-8")
    figures = []
    if any("both ms" in case.figures for case in report.cases):
        save_figure(report.cases, folder / FIGURE)
        figures.append(pareto_section(report.cases))
    save_json(report, folder / JSON)
    write_page(report, folder / PAGE, figures, is_by_kind=True)
    print(f"\nopen {(folder / PAGE).resolve()}")


def progress(line: str) -> None:
    """Report the current step on stderr."""
    print(f"minisplat-ref: {line}", file=sys.stderr, flush=True)
