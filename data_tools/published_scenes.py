"""Our figures beside those that others have published for the same scene, a row at a time.

``python -m data_tools.published_scenes ROW --data DIR --out RUN`` trains as the row says, measures, and prints the row
with the published figure, its source, and the machine; without ROW it lists the rows. ``--part 10`` trains for a tenth
of the iterations, with the schedule compressed accordingly, ``--seed 1`` with another seed, and ``--set NAME=VALUE``
with another setting of the recipe. DIR is what ``minisplat-ref data SET`` fetches. A run in RUN that has ended is not
trained again, and one that was stopped continues. ``docs/measured/published.md`` has what was found.

Published figures differ in more than the method, so each row says under which rules it was measured. On Lego, the
images are composited onto white, there are no points, and random ones in a cube are the start
(:mod:`minisplat_ref.io.transforms`); PSNR is the mean over images.
"""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from data_tools.few_images import FIRST, PAPERS, THREE, FewImages, FewPhotographs, thin_out
from minisplat_ref.app.cli import main as minisplat_ref
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.run_folder import CONFIG, METRICS, is_finished
from minisplat_ref.app.runs.settings import load
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import integer
from minisplat_ref.interface.reporting import describe_machine, markdown_table

WHITE = ("--background", "255,255,255")


class Row(NamedTuple):
    """A published figure, and the training that is compared with it."""

    data_set: str
    """Of ``minisplat-ref data``."""
    options: tuple[str, ...]
    """Of ``minisplat-ref train``."""
    published: float | None
    """PSNR, dB; None where nobody has published one."""
    source: str
    few: FewImages | FewPhotographs | None = None
    """All images by default."""


RERUN = "blender.html of nerfbaselines/nerfbaselines.github.io at e1c9749"
FULL = f"Kerbl et al. 2023, arXiv 2308.04079, table of the synthetic scenes; 35.70 and SSIM 0.982 in {RERUN}"
FLAT = (
    "issue 158 of hbb1/2d-gaussian-splatting, by its author: with regularisers; without them 35.14, and 35.10 in the"
    " paper, arXiv 2403.17888, table 7. The commands there do not ask for white"
)
CHAIN = f"Kheradmand et al. 2024, arXiv 2404.09591, with at most 325,000 (configs/lego.json); 35.75 in {RERUN}"
FILTERED = f"Mip-Splatting in {RERUN}, SSIM 0.982"
EIGHT = "issue 40 of Fictionarry/DNGaussian, by a user of the released code of 3DGS, with 10,000 points"
NERF = (
    "not of splatting, but of NeRF: Mildenhall et al. 2020, arXiv 2003.08934, as quoted in jaxnerf/README.md of"
    " google-research/google-research at 22575c7, where JaxNeRF has 24.83"
)
LENGTHS = {
    "3dgs": 30_000,
    "3dgs-accel": 30_000,
    "mini-splatting": 30_000,
    "mini-splatting-d": 30_000,
    "mini-splatting2": 18_000,
    "mini-splatting2-d": 18_000,
    "surfels": 30_000,
    "antialiasing": 30_000,
    "mcmc": 30_000,
    "analytic": 30_000,
    "vdgs": 30_000,
    "rays": 30_000,
    "polygons": 30_000,
}
"""Iterations of the released trainers; ``adaptive`` decides itself."""
CURVE = ("--eval-every", "7000")  # at 7,000 the released trainer of 3DGS measures, too
FIGURES = {
    "3dgs": (35.78, FULL),
    "3dgs-accel": (35.78, FULL),
    "surfels": (34.38, FLAT),
    "antialiasing": (35.45, FILTERED),
    "mcmc": (36.01, CHAIN),
}
"""Published PSNR, dB, and its source, by recipe."""
QUARTER = ("3dgs-accel", "antialiasing", "analytic", "rays", "polygons")
"""Recipes that are trained at 200 x 200, too: an iteration of ``rays`` takes seconds at 800 x 800."""
MORE = {"mcmc": ("--budget", "325000")}
"""Options by recipe."""


def _rows() -> dict[str, Row]:
    rows = {}
    for recipe, length in (*LENGTHS.items(), ("adaptive", None)):
        published, source = FIGURES.get(recipe, (None, ""))
        options = ["--recipe", recipe, *MORE.get(recipe, ()), *WHITE]
        options += [] if length is None else ["--iterations", str(length), "--profile", "INRIA", *CURVE]
        rows[f"lego-{recipe}"] = Row("lego", tuple(options), published, source)
        if recipe in QUARTER:
            rows[f"lego-quarter-{recipe}"] = Row("lego", (*options, "--downscale", "4"), None, "")
    for recipe, length in (("3dgs", 6000), ("3dgs-accel", 6000), ("mini-splatting2", 6000), ("adaptive", None)):
        options = ["--recipe", recipe, "--downscale", "2", *WHITE]
        options += [] if length is None else ["--iterations", str(length)]
        rows[f"lego-8-{recipe}"] = Row("lego", tuple(options), None, "", PAPERS)
        if recipe.startswith("3dgs"):
            rows[f"lego-first-8-{recipe}"] = Row("lego", tuple(options), 22.48, EIGHT, FIRST)
    for recipe in ("3dgs-accel", "mini-splatting2", "adaptive"):
        options = ["--recipe", recipe]
        options += ["--iterations", str(LENGTHS[recipe])] if recipe in LENGTHS else []
        rows[f"fern-{recipe}"] = Row("fern", tuple(options), 25.17, NERF)
    for recipe in ("3dgs-accel", "mini-splatting2", "adaptive"):
        few = ["--recipe", recipe, "--downscale", "2", "--test-every", "2"]
        few += ["--iterations", "6000"] if recipe != "adaptive" else []
        rows[f"fern-3-{recipe}"] = Row("fern", tuple(few), None, "", THREE)
    return rows


ROWS = _rows()


def shortened(options: Sequence[str], part: int) -> list[str]:
    """Return the options for 1 / ``part`` of the iterations, measured as often."""
    return [
        str(max(1, int(word) // part)) if before in ("--iterations", "--eval-every") else word
        for before, word in zip(("", *options), options, strict=False)
    ]


class Variant(NamedTuple):
    """How a training differs from that of its row."""

    part: int = 1
    """1 / ``part`` of the iterations."""
    seed: int = 0
    settings: tuple[str, ...] = ()
    """Of the recipe, NAME=VALUE."""

    def options(self, row: Row) -> list[str]:
        """Return the options of ``minisplat-ref train``."""
        changed = [word for setting in self.settings for word in ("--set", setting)]
        return [*shortened(row.options, self.part), "--seed", str(self.seed), *changed]

    def name(self, row: str) -> str:
        """Return the name of the row with the seed, unless it is 0, and the settings."""
        return ", ".join([row, *([f"seed {self.seed}"] if self.seed else []), *self.settings])

    def published(self, row: Row) -> float | None:
        """Return what is published for the same iterations and settings; it holds for every seed."""
        return None if self.settings or shortened(row.options, self.part) != list(row.options) else row.published


def measure(name: str, data: Path, out: Path, variant: Variant) -> list[str]:
    """Train a row to its end, unless that has been done, and return its cells.

    Raises
    ------
    InputError
        ``out`` has a training of something else, or the training fails, for a reason that has been printed.
    """
    row = ROWS[name]
    scene = data if row.few is None else out.parent / row.few.folder
    options = variant.options(row)
    command: list[str] | None = ["train", str(scene), *options, "--out", str(out)]
    if (out / CONFIG).exists():
        settings = load(out)
        _refuse_another(out, settings, scene, options)
        command = None if is_finished(out, settings.iterations) else ["train", "--resume", str(out)]
    if command is not None:
        if row.few is not None:
            thin_out(data, row.few, scene)
        if minisplat_ref(command):
            raise InputError(f"{name}: the training has failed")
    metrics = json.loads((out / METRICS).read_text(encoding="utf-8"))
    return cells(variant.name(name), metrics, variant.published(row))


def _refuse_another(out: Path, settings: Settings, scene: Path, options: Sequence[str]) -> None:
    """Raise InputError if the run in ``out`` has another scene, recipe, seed, settings or number of iterations."""
    given = dict(pairwise(options))
    changed = [after for before, after in pairwise(options) if before == "--set"]
    wanted = {
        "scene": (settings.scene, str(scene.resolve())),
        "downscale": (settings.downscale, int(given.get("--downscale", 1))),
        "recipe": (settings.recipe, given["--recipe"]),
        "seed": (settings.seed, int(given["--seed"])),
        "iterations": (settings.iterations, int(given.get("--iterations", settings.iterations))),
        "settings": (_words(f"{name}={value}" for name, value in settings.set.items()), _words(changed)),
    }
    for name, (found, value) in wanted.items():
        if found != value:
            raise InputError(f"{out} was trained with {name} {found}, not {value}: give another --out")


def _words(settings: Iterable[str]) -> str:
    return ", ".join(sorted(settings)) or "of the recipe alone"


def cells(name: str, metrics: dict[str, float], reference: float | None) -> list[str]:
    """Return the cells of a row, by the metrics of its run and the figure published for its length, if there is one."""
    psnr = metrics["psnr"]
    published = "-" if reference is None else f"{reference:.2f}"
    difference = "-" if reference is None else f"{psnr - reference:+.2f}"
    seconds = f"{metrics['train_cpu_seconds']:,.0f}"
    n_gaussians, iterations = f"{metrics['n_gaussians']:,}", f"{metrics['iterations']:,}"
    return [name, iterations, published, f"{psnr:.2f}", difference, f"{metrics['ssim']:.4f}", n_gaussians, seconds]


HEADING = ["row", "iterations", "published (dB)", "ours (dB)", "difference", "SSIM", "Gaussians", "processor seconds"]


def main(arguments: list[str] | None = None) -> int:
    """Measure a row, or list all."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.published_scenes", description=__doc__.split("\n")[0])
    parser.add_argument("row", nargs="?", choices=list(ROWS), metavar="ROW", help="what to measure (default: list)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="what `minisplat-ref data SET --out DIR` has fetched")
    parser.add_argument("--out", type=Path, metavar="RUN", help="folder of the run, new or with a run that has ended")
    parser.add_argument("--part", type=integer(1), default=1, metavar="N", help="1 / N of the iterations (default all)")
    parser.add_argument("--seed", type=integer(0), default=0, metavar="N", help="of the training (default 0)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="another setting of the recipe, as in `train`; nothing published is beside it",
    )
    args = parser.parse_args(arguments)
    if args.row is None:
        for name, row in ROWS.items():
            print(f"{name:<24}data {row.data_set}, train {' '.join(row.options)}")
        return 0
    if args.data is None or args.out is None:
        parser.error(f"{args.row} needs --data DIR and --out RUN")
    try:
        found = measure(args.row, args.data, args.out, Variant(args.part, args.seed, tuple(args.set)))
    except InputError as error:
        print(f"published_scenes: error: {error}", file=sys.stderr)
        return 2
    print(f"{describe_machine()}\n\n{markdown_table(HEADING, [found])}")
    row = ROWS[args.row]
    if row.published is not None:
        print(f"\npublished, for all iterations: {row.published:.2f} dB, {row.source}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
