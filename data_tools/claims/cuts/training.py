"""Claim ``cuts/card`` (DisC-GS, arXiv 2405.15196) measures what cuts gain where an image has a sharp edge.

There are two images of 48 x 48 pixels: a Gaussian with a part cut away, which one Gaussian with a cut can reproduce,
and a card of one brightness with a curved edge, which none can. Few Gaussians are trained on each from random
positions, with and without cuts; their number stays. The error of the best seed is given near the edge, within 1.5
pixels, and elsewhere.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.cuts import card
from data_tools.claims.kit.figures import beside_images, plot_curves
from data_tools.claims.kit.tables import Cell, first, spread, table
from minisplat_ref.interface.palette import GREY, RED

NUMBERS = {"plain": (1, 3, 6, 12), "cut": (1, 3, 6)}
COLORS = {"plain": GREY, "cut": RED}
N_FLOATS = {"plain": 14, "cut": 22}  # per Gaussian without view-dependent colour


def _of_best(measure: str) -> Cell:
    """Return a cell with a measure of the training that has the highest PSNR."""
    return first(lambda row: row[measure][int(np.argmax(row["psnr"]))], ".1f")


COLUMNS = (
    ("PSNR", spread("psnr", 1)),
    ("best", _of_best("psnr")),
    ("at the edge", _of_best("band")),
    ("elsewhere", _of_best("elsewhere")),
    ("10-90 % (px)", _of_best("edge_width")),
)


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    rows, images = outcomes(args.iterations, args.seeds)
    result = {**kit.settings_of(args, "iterations", "seeds"), "rows": rows}
    arms = kit.arms_of([row for row in rows if row["n_gaussians"] in NUMBERS["cut"]], "kind", ("psnr",))
    keys = {"image": "image", "kind": "Gaussians", "n_gaussians": "number", "n_floats": "floats"}
    return kit.Report(result, draw(rows, images), table(rows, keys, COLUMNS), arms)


def outcomes(iterations: int, n_seeds: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return a row per image, kind and number, and the targets with images of the first seed."""
    targets = {"cut Gaussian": card.cut_gaussian(), "card": card.card()}
    jobs = [(name, kind, n) for name in targets for kind, numbers in NUMBERS.items() for n in numbers]
    rows, images = [], {name: [("target", target.image)] for name, target in targets.items()}
    for name, kind, n in kit.with_progress(jobs, "trainings"):
        found = [card.fit_card(targets[name], n, int(kind == "cut"), iterations, seed) for seed in range(n_seeds)]
        measures = [card.measure_card(targets[name], population) for population in found]
        images[name].append((f"{n} {kind}", card.render_card(found[0])))
        row = {"image": name, "kind": kind, "n_gaussians": n, "n_floats": n * N_FLOATS[kind]}
        rows.append({**row, **{key: [measure[key] for measure in measures] for key in measures[0]}})
    return rows, images


def draw(rows: list[dict[str, Any]], images: dict[str, Any]) -> Figure:
    """Draw PSNR against the number of floats, and the images."""
    figure = Figure(figsize=(14.0, 5.0), layout="constrained")
    for name, axes in beside_images(figure, images).items():
        plot_curves(axes, [row for row in rows if row["image"] == name], "n_floats", "psnr", COLORS, key="kind")
        axes.set(title=name, xlabel="floats", ylabel="PSNR (dB)")
        axes.legend()
    return figure
