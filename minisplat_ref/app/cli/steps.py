"""Commands that consist of other commands: each is printed, so that it can be given alone, and run."""

from pathlib import Path

VIEWS, MESH = "views", "mesh.ply"


def do(*words: str | Path) -> int:
    """Print a command, run it and return its exit code."""
    from minisplat_ref.app.cli import build_parser
    from minisplat_ref.app.reports.commands import command

    print(f"$ {command(*words)}", flush=True)
    args = build_parser().parse_args([str(word) for word in words])
    return args.run(args)


def make_page_and_film(run: Path, folder: Path, *up: str) -> bool:
    """Write the page and the film of a run into a folder; return whether one was written.

    Parameters
    ----------
    run : Path
        Folder of the run.
    folder : Path
        Where they are. What is there stays, unless ``up`` is given.
    *up : str
        ``--up`` and what is up, where it is not what the run has recorded.
    """
    from minisplat_ref.app.runs.next_steps import FILM, FILM_OPTIONS, PAGE

    page, film = folder / PAGE, folder / FILM
    is_whole = page.exists() and film.exists() and not up
    if up or not page.exists():
        do("convert", run, page, *up)
    if up or not film.exists():
        do("render", run, *FILM_OPTIONS, "--film", film, "--out", run / VIEWS, *up)
    return not is_whole


def show_made(run: Path, report: Path, folder: Path) -> str:
    """Return the part of a run's report that shows what :func:`make_page_and_film` has written; "" if nothing is left.

    Parameters
    ----------
    run : Path
        Folder of the run.
    report : Path
        File of the report.
    folder : Path
        Of the page.
    """
    from minisplat_ref.app.runs.next_steps import FILM_FPS, PAGE
    from minisplat_ref.app.runs.report_parts import showcase

    frames = sorted((run / VIEWS).glob("orbit_*.png"))
    return showcase(report, folder / PAGE, frames, FILM_FPS) if frames else ""


def print_results(run: Path, report: Path, folder: Path) -> None:
    """Print what there is to look at, the page first, and what can be done next."""
    from minisplat_ref.app.reports.commands import command
    from minisplat_ref.app.runs.next_steps import FILM, PAGE, live_view, surface

    print(f"\nto look at, in any browser: open {(folder / PAGE).resolve()}")
    print(f"a film: open {(folder / FILM).resolve()}")
    print(f"how good it is, and what to try next: open {report.resolve()}")
    for step in (live_view(run), surface(run, folder / MESH)):
        print(f"{step.purpose[0].lower()}{step.purpose[1:]}: {step.line}")
    print(f"make it smaller: {command('simplify', run, '--out', folder / 'small')}")
