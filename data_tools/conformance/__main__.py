"""``python -m data_tools.conformance [NAME ...] --out DIR`` runs renderers on the probes and writes table and page."""

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from data_tools.conformance.fetching import clone, install
from data_tools.conformance.judging import Verdict, judge
from data_tools.conformance.pages import DRIVERS, browsing, picture, serving
from data_tools.conformance.probes import PROBES, Probe, with_unseen, write
from data_tools.conformance.renderers import Renderer
from data_tools.conformance.report import NAMES, Result, page, table
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import HelpFormatter, Parser
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.types import Floats

BY_NAME = {probe.name: probe for probe in PROBES}
HERE = Path(__file__).parent
JUDGED_BY = tuple(HERE / name for name in ("judging.py", "habits.py", "storing.py", "probes.py"))
DRAWN_BY = tuple(HERE / name for name in ("programs.py", "opensplat.cpp"))
DRAWN_IN_A_PAGE = (HERE / "pages.py", *(DRIVERS / name for name in ("camera.js", "three_camera.js")))


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
            results.append(Result(renderer, {}, renderer.reason))
            continue
        try:
            pictures[renderer.name] = take_pictures(renderer, args.out / renderer.name, cache)
        except InputError as error:
            results.append(Result(renderer, {}, str(error)))
            continue
        results.append(judged(renderer, pictures[renderer.name], args.out / renderer.name))
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "CONFORMANCE.md").write_text(table(results), encoding="utf-8")
    (args.out / "page.html").write_text(page(results, pictures), encoding="utf-8")
    print(f"wrote {args.out / 'CONFORMANCE.md'} and {args.out / 'page.html'}")


def take_pictures(renderer: Renderer, folder: Path, cache: Path) -> dict[str, Floats]:
    """Return the pictures of all probes that a renderer shows.

    Those of an earlier run are read, if this version was run by the same driver on the same probe.

    Raises
    ------
    InputError
        The renderer cannot be had, or shows nothing at all.
    """
    folder = folder / renderer.version
    folder.mkdir(parents=True, exist_ok=True)
    files = {probe.name: folder / f"{probe.name}.{digest_of(renderer, probe)}.png" for probe in PROBES}
    missing = [probe for probe in PROBES if not files[probe.name].is_file()]
    problems: list[str] = []
    if renderer.render is not None:
        for probe in with_progress(missing, renderer.name, "probes"):
            keep(problems, probe, files, lambda probe: renderer.render(probe, cache))  # type: ignore[misc]
    elif missing:
        install(renderer.packages, cache)
        if renderer.repository is not None:
            clone(*renderer.repository, cache)
        with serving(folder, cache) as address, browsing(folder / "profile") as browser:

            def shown(probe: Probe) -> Floats:
                request = write(probe, folder, renderer.n_more)
                return picture(browser, address, folder, renderer.driver, dict(renderer.imports), request)

            for probe in with_progress(missing, renderer.name, "probes"):
                keep(problems, probe, files, shown)
    pictures: dict[str, Floats] = {
        name: np.asarray(Image.open(file)) / 255.0 for name, file in files.items() if file.is_file()
    }
    if not pictures:
        raise InputError(problems[0] if problems else f"{renderer.name} shows nothing")
    for problem in problems:
        print(problem, file=sys.stderr)
    return pictures


def digest_of(renderer: Renderer, probe: Probe) -> str:
    """Return a digest of all that makes a picture: the probe, and the sources of the driver and of the page."""
    shown = with_unseen(probe, renderer.n_more)
    arrays = (*shown, *probe.camera, np.array([*probe.background, *probe.centre, renderer.n_more]))
    sources = DRAWN_BY if renderer.render is not None else (*DRAWN_IN_A_PAGE, DRIVERS / renderer.driver)
    parts = [np.ascontiguousarray(array).tobytes() for array in arrays] + [file.read_bytes() for file in sources]
    return hashlib.sha256(b"".join(parts)).hexdigest()[:12]


def keep(problems: list[str], probe: Probe, files: Mapping[str, Path], render: Callable[[Probe], Floats]) -> None:
    """Write the picture of a probe; a renderer that refuses it is noted."""
    try:
        save(render(probe), files[probe.name])
    except InputError as error:
        problems.append(str(error))


def save(image: Floats, path: Path) -> None:
    """Write a picture as PNG, which keeps its bytes."""
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(path)


def judged(renderer: Renderer, pictures: dict[str, Floats], folder: Path) -> Result:
    """Judge all pictures by the renderer's habits, and write the figures; those of the same are read."""
    file = folder / f"{renderer.version}.json"
    sources = [path.read_bytes() for path in JUDGED_BY] + [pictures[name].tobytes() for name in sorted(pictures)]
    habits = renderer.habits
    assert habits is not None
    digest = hashlib.sha256(b"".join([habits.name.encode(), *sources])).hexdigest()
    known = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if known.get("of") == digest:
        found = {name: Verdict(**verdict) for name, verdict in known["verdicts"].items()}
        return Result(renderer, {name: verdict._replace(seen=tuple(verdict.seen)) for name, verdict in found.items()})
    verdicts = {}
    for name in with_progress(BY_NAME, f"{renderer.name}, judged", "probes"):
        if name in pictures:
            verdicts[name] = judge(BY_NAME[name], pictures[name], habits)
        else:
            verdicts[name] = Verdict(name, "no picture", "", *(float("nan"),) * 4)
    figures = {"of": digest, "verdicts": {n: v._asdict() for n, v in verdicts.items()}}
    file.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return Result(renderer, verdicts)


if __name__ == "__main__":
    main()
