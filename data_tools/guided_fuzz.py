"""``python -m data_tools.guided_fuzz READER``: damaged files, chosen by what they reach in the readers' code.

:mod:`data_tools.fuzz` damages files at random, and can do so again by number. Here atheris (libFuzzer) makes the same
choices, and keeps those that reach code which none before has reached. It ends at the first finding, with the choices
in a file ``crash-...``, which the same command reads again: ``python -m data_tools.guided_fuzz READER crash-...``.
"""

import os
import sys
from pathlib import Path
from tempfile import mkdtemp

from minisplat_ref.interface.arguments import HelpFormatter, Parser, integer

INSTRUMENTED = ["minisplat_ref.io"]  # where files are read; compiled kernels are not Python when they run


def main() -> None:
    """Fuzz what the command line says; the exit code is libFuzzer's: 0 when time is over, another after a finding."""
    parser = Parser(
        prog="python -m data_tools.guided_fuzz",
        description="Have a reader read damaged files, chosen by the code that they reach.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("reader", metavar="READER", help="as for data_tools.fuzz")
    parser.add_argument(
        "crash", nargs="?", type=Path, metavar="FILE", help="choices of an earlier finding, to see again"
    )
    parser.add_argument("--seconds", type=integer(1), default=60, metavar="N", help="how long (default 60)")
    parser.add_argument("--seed", type=integer(1), default=1, metavar="S", help="of libFuzzer (default 1)")
    args = parser.parse_args()
    try:
        import atheris
    except ImportError:
        parser.error("atheris is missing: pip install 'minisplat_ref[fuzzing]'")
    with atheris.instrument_imports(include=INSTRUMENTED):
        from data_tools.fuzz.judging import judge
        from data_tools.fuzz.readers import READERS, mutant
    if args.reader not in READERS:
        parser.error(f"reader {args.reader!r} does not exist: choose from {', '.join(READERS)}")
    reader, folder = READERS[args.reader], Path(mkdtemp())
    reader.write(folder)
    reader.read(folder, mutant(reader, folder, lambda n: 0).path)  # undamaged: must pass; loads what it needs

    def one_file(data: bytes) -> None:
        provider = atheris.FuzzedDataProvider(data)
        damaged = mutant(reader, folder, lambda n: provider.ConsumeIntInRange(0, n - 1))
        verdict = judge(reader, folder, damaged)
        if verdict.finding:
            raise AssertionError(f"{damaged.path.name}: {verdict.finding}")

    options = [f"-max_total_time={args.seconds}", f"-seed={args.seed}", "-rss_limit_mb=0"]
    crash = [] if args.crash is None else [os.fspath(args.crash)]
    atheris.Setup([sys.argv[0], *options, *crash], one_file)
    atheris.Fuzz()  # ends the process


if __name__ == "__main__":
    main()
