"""The study ``cuts/card`` measures what cuts gain where a picture has a sharp edge.

There are two pictures of 48 x 48 pixels: a Gaussian with a part cut away, which one Gaussian with a cut can reproduce,
and a card of one brightness with a curved edge, which none can. Few Gaussians are trained on each from random
positions, with and without cuts; their number stays. The error of the best seed is given near the edge, within 1.5
pixels, and elsewhere.
"""

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np

from minisplat_ref.extensions import shared_studies
from minisplat_ref.extensions import shared_trainings as shared
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.studies.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NUMBERS = {"plain": (1, 3, 6, 12), "cut": (1, 3, 6)}
COLORS = {"plain": shared.GREY, "cut": shared.RED}
N_FLOATS = {"plain": 14, "cut": 22}  # per Gaussian without view-dependent colour


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--iterations`` and ``--seeds``."""
    shared_studies.add_out(parser)
    parser.add_argument("--iterations", type=int, default=300, metavar="N", help="per training (default 300)")
    parser.add_argument("--seeds", type=int, default=4, metavar="N", help="number of seeds, from 0 on (default 4)")


def run(args: argparse.Namespace) -> None:
    """Train, measure, write the results, and print the table.

    Raises
    ------
    InputError
        A number is out of range, or the output folder cannot be used.
    """
    from minisplat_ref.reporting import markdown_table

    shared_studies.check_at_least(1, iterations=args.iterations, seeds=args.seeds)
    with making_folder(args.out) as folder:
        rows, pictures = outcomes(args.iterations, args.seeds)
        result = {"iterations": args.iterations, "seeds": args.seeds, "rows": rows}
        shared_studies.write(folder, result, draw(rows, pictures))
    heading = ["picture", "Gaussians", "number", "floats", "PSNR", "best", "at the edge", "elsewhere", "10-90 % (px)"]
    print(markdown_table(heading, [to_line(row) for row in rows]))


def outcomes(iterations: int, n_seeds: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return a row per picture, kind and number, and the targets with pictures of the first seed."""
    from tqdm import tqdm

    from minisplat_ref.extensions.cuts import card

    targets = {"cut Gaussian": card.cut_gaussian(), "card": card.card()}
    jobs = [(name, kind, n) for name in targets for kind, numbers in NUMBERS.items() for n in numbers]
    rows, pictures = [], {name: [("target", target.image)] for name, target in targets.items()}
    for name, kind, n in tqdm(jobs, desc="trainings", leave=False, disable=None):
        found = [card.fitted(targets[name], n, kind == "cut", iterations, seed) for seed in range(n_seeds)]
        measures = [card.measured(targets[name], population) for population in found]
        pictures[name].append((f"{n} {kind}", card.drawn(found[0])))
        row = {"picture": name, "kind": kind, "n_gaussians": n, "n_floats": n * N_FLOATS[kind]}
        rows.append({**row, **{key: [measure[key] for measure in measures] for key in measures[0]}})
    return rows, pictures


def to_line(row: dict[str, Any]) -> list[str]:
    """Return a line of the table."""
    best = int(np.argmax(row["psnr"]))
    measures = [f"{row[key][best]:.1f}" for key in ("psnr", "band", "elsewhere", "edge_width")]
    numbers = [str(row["n_gaussians"]), str(row["n_floats"])]
    return [row["picture"], row["kind"], *numbers, shared.with_deviation(row["psnr"], 1), *measures]


def draw(rows: list[dict[str, Any]], pictures: dict[str, Any]) -> "Figure":
    """Draw PSNR against the number of floats, and the pictures."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.0, 5.0), layout="constrained")
    columns = 2 + len(next(iter(pictures.values())))
    for i, (name, shown) in enumerate(pictures.items()):
        axes = figure.add_subplot(len(pictures), columns, (i * columns + 1, i * columns + 2))
        for kind, color in COLORS.items():
            of_kind = [row for row in rows if (row["picture"], row["kind"]) == (name, kind)]
            pairs = [shared.mean_and_deviation(row["psnr"]) for row in of_kind]
            means, deviations = np.transpose(pairs)
            numbers = [row["n_floats"] for row in of_kind]
            axes.errorbar(numbers, means, yerr=deviations, fmt="o-", ms=4, capsize=3, color=color, label=kind)
        axes.set(title=name, xlabel="floats", ylabel="PSNR (dB)")
        axes.legend(frameon=False, fontsize=8)
        shared_studies.tidy(axes)
        for k, (title, image) in enumerate(shown):
            axes = figure.add_subplot(len(pictures), columns, i * columns + 3 + k)
            axes.imshow(np.clip(image, 0, 1))
            axes.set_title(title, fontsize=8)
            axes.set_axis_off()
    return figure


CARD = Study("card", "pictures with a sharp edge, by few Gaussians with and without cuts", add_arguments, run)
"""The study ``cuts/card``."""
