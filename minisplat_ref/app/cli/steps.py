"""Commands that consist of other commands: each is printed, so that it can be given alone, and run."""

from pathlib import Path


def do(*words: str | Path) -> int:
    """Print a command, run it and return its exit code."""
    from minisplat_ref.app.cli import build_parser
    from minisplat_ref.app.reports.commands import command

    print(f"$ {command(*words)}", flush=True)
    args = build_parser().parse_args([str(word) for word in words])
    return args.run(args)
