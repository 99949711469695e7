"""``python -m data_tools.conformance [NAME ...] --out DIR`` runs renderers on the probes and writes table and page."""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
from PIL import Image

from data_tools.conformance import judging
from data_tools.conformance.judging import Verdict, judge, nearest_habits
from data_tools.conformance.pages import browsing, picture, serving
from data_tools.conformance.probes import PROBES, write
from data_tools.conformance.renderers import Renderer, install
from data_tools.conformance.report import NAMES, Result, page, table
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import HelpFormatter, Parser
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.types import Floats

BY_NAME = {probe.name: probe for probe in PROBES}


def main() -> None:
    """Run what is asked for, from where an earlier run ended."""
    parser = Parser(
        prog="python -m data_tools.conformance",
        description="Compare public renderers with the reference, probe by probe.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"renderers (default all): {', '.join(NAMES)}")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="pictures, CONFORMANCE.md and page.html")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="of packages that are fetched (default OUT/cache)")
    args: argparse.Namespace = parser.parse_args()
    strange = [name for name in args.names if name not in NAMES]
    if strange:
        parser.error(f"renderer {strange[0]!r} is unknown; choose some of {', '.join(NAMES)}")
    wanted = [renderer for name, renderer in NAMES.items() if name in args.names or not args.names]
    cache = args.cache or args.out / "cache"
    results: list[Result] = []
    pictures: dict[str, dict[str, Floats]] = {}
    for renderer in wanted:
        if renderer.reason:
            results.append(Result(renderer, None, {}, renderer.reason))
            continue
        try:
            pictures[renderer.name] = take_pictures(renderer, args.out / renderer.name, cache)
        except InputError as error:
            results.append(Result(renderer, None, {}, str(error)))
            continue
        results.append(judged(renderer, pictures[renderer.name], args.out / renderer.name))
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "CONFORMANCE.md").write_text(table(results), encoding="utf-8")
    (args.out / "page.html").write_text(page(results, pictures), encoding="utf-8")
    print(f"wrote {args.out / 'CONFORMANCE.md'} and {args.out / 'page.html'}")


def take_pictures(renderer: Renderer, folder: Path, cache: Path) -> dict[str, Floats]:
    """Return the pictures of all probes that a renderer shows; those of an earlier run of this version are read.

    Raises
    ------
    InputError
        The renderer cannot be had, or shows nothing at all.
    """
    folder = folder / renderer.version
    folder.mkdir(parents=True, exist_ok=True)
    missing = [probe for probe in PROBES if not (folder / f"{probe.name}.png").is_file()]
    problems = []
    if renderer.render is not None:
        for probe in missing:
            save(renderer.render(probe), folder / f"{probe.name}.png")
    elif missing:
        install(renderer, cache)
        with serving(folder, cache) as address, browsing(folder / "profile") as browser:
            for probe in with_progress(missing, renderer.name, "probes"):
                try:
                    request = write(probe, folder, renderer.n_more)
                    shown = picture(browser, address, folder, renderer.driver, dict(renderer.imports), request)
                    save(shown, folder / f"{probe.name}.png")
                except InputError as error:
                    problems.append(str(error))
    found = {name: folder / f"{name}.png" for name in BY_NAME}
    pictures: dict[str, Floats] = {
        name: np.asarray(Image.open(file)) / 255.0 for name, file in found.items() if file.is_file()
    }
    if not pictures:
        raise InputError(problems[0] if problems else f"{renderer.name} shows nothing")
    return pictures


def save(image: Floats, path: Path) -> None:
    """Write a picture as PNG, which keeps its bytes."""
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(path)


def judged(renderer: Renderer, pictures: dict[str, Floats], folder: Path) -> Result:
    """Judge all pictures by the habits that are nearest to them, and write the figures; those of the same are read."""
    file = folder / f"{renderer.version}.json"
    source = (Path(judging.__file__).read_bytes(), *(pictures[name].tobytes() for name in sorted(pictures)))
    digest = hashlib.sha256(b"".join(source)).hexdigest()
    known = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if known.get("of") == digest:
        habits = next(habits for habits in judging.HABITS if habits.name == known["habits"])
        return Result(renderer, habits, {name: Verdict(**verdict) for name, verdict in known["verdicts"].items()})
    habits = nearest_habits(pictures, BY_NAME)
    verdicts = {}
    for name in with_progress(BY_NAME, f"{renderer.name} by {habits.name}", "probes"):
        if name in pictures:
            verdicts[name] = judge(BY_NAME[name], pictures[name], habits)
        else:
            verdicts[name] = Verdict(name, "no picture", "", *(float("nan"),) * 4)
    figures = {"of": digest, "habits": habits.name, "verdicts": {n: v._asdict() for n, v in verdicts.items()}}
    file.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return Result(renderer, habits, verdicts)


if __name__ == "__main__":
    main()
