"""Claims ``mixed/shapes`` and ``mixed/letter`` (arXiv 2507.11321) ask what lines and triangles are worth in an image.

Few primitives of one kind are trained on images of 48 x 48 pixels, from random places; their number stays.

``shapes``: how many ellipses match one line, and one triangle with a soft rim, at 30 dB? Those images are what one
primitive of another kind draws. Of a round Gaussian an ellipse is enough, and vertices are of no use.

``letter``: images that no kind draws by itself: the silhouettes of a letter A, of straight strokes, and of a ring.
"""

import argparse
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import beside_images
from data_tools.claims.kit.tables import first, spread, table
from data_tools.claims.mixed import fit
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.types import Floats

ENOUGH = 30.0  # dB
COLORS = {1: GREY, 2: BLUE, 3: RED}
NUMBERS: dict[str, dict[int, tuple[int, ...]]] = {
    "shapes": {1: (1, 2, 3, 4, 6, 8, 12), 2: (1, 2), 3: (1, 2)},
    "letter": {1: (3, 5, 9, 14), 2: (2, 4, 8, 12), 3: (2, 4, 7, 11)},
}
SHOWN = {"shapes": {1: 3, 2: 1, 3: 1}, "letter": {1: 5, 2: 4, 3: 4}}  # about as many floats of each kind


def run(name: str, args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    rows, images = outcomes(name, args.iterations, args.seeds)
    needed = [min_number(rows, *pair) for pair in dict.fromkeys((row["image"], row["kind"]) for row in rows)]
    result = {**kit.settings_of(args, "iterations", "seeds"), "rows": rows, "needed": needed}
    keys = {"image": "image", "kind": "kind", "number": "number", "n_floats": "floats"}
    text = table(rows, keys, (("PSNR", spread("psnr", 1)), ("best", first(lambda row: max(row["psnr"]), ".1f"))))
    heading = ["image", "kind", f"for {ENOUGH:.0f} dB at best", "floats"]
    text += "\n\n" + markdown_table(heading, [[str(value) for value in row.values()] for row in needed])
    return kit.Report(result, draw(rows, images), text)


run_shapes, run_letter = partial(run, "shapes"), partial(run, "letter")


def outcomes(name: str, iterations: int, n_seeds: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return a row for each image, kind and number, and for each image the target and some of the best fits."""
    shapes = {"line": fit.one_line, "triangle": fit.one_triangle, "round": fit.one_blob}
    draws = shapes if name == "shapes" else {"letter": fit.letter_a, "ring": fit.ring}
    targets = {subject: draw().astype(np.float64) for subject, draw in draws.items()}
    jobs = [(subject, m, n) for subject in targets for m, numbers in NUMBERS[name].items() for n in numbers]
    rows: list[dict[str, Any]] = []
    images: dict[str, list[tuple[str, Floats]]] = {key: [("target", target)] for key, target in targets.items()}
    for subject, m, n in kit.with_progress(jobs, "trainings"):
        fits = [
            fit.render_primitives(
                fit.fit_primitives(targets[subject], n, n_vertices=m, iterations=iterations, seed=seed)
            )
            for seed in range(n_seeds)
        ]
        psnr = [kit.psnr_of(image, targets[subject]) for image in fits]
        if n == SHOWN[name][m]:
            best = int(np.argmax(psnr))
            name_of_kind = fit.NAMES[m].removesuffix("s") if n == 1 else fit.NAMES[m]
            images[subject].append((f"{n} {name_of_kind}, {psnr[best]:.1f} dB", fits[best]))
        row = {"image": subject, "kind": fit.NAMES[m], "n_vertices": m, "number": n}
        rows.append({**row, "n_floats": n * fit.N_FLOATS[m], "psnr": psnr})
    return rows, images


def min_number(rows: list[dict[str, Any]], subject: str, kind: str) -> dict[str, Any]:
    """Return how many of a kind the best training needed to reach ``ENOUGH``."""
    of_kind = [row for row in rows if (row["image"], row["kind"]) == (subject, kind)]
    enough = [row for row in of_kind if max(row["psnr"]) >= ENOUGH]
    number, n_floats = (enough[0]["number"], enough[0]["n_floats"]) if enough else (f"> {of_kind[-1]['number']}", "")
    return {"image": subject, "kind": kind, "number": number, "n_floats": n_floats}


def draw(rows: list[dict[str, Any]], images: dict[str, Any]) -> Figure:
    """Draw the best PSNR over the number of floats, and images."""
    columns = 2 + len(next(iter(images.values())))
    figure = Figure(figsize=(2.4 * columns, 2.7 * len(images)), layout="constrained")
    for subject, axes in beside_images(figure, images).items():
        for m, color in COLORS.items():
            of_kind = [row for row in rows if (row["image"], row["n_vertices"]) == (subject, m)]
            floats, best = [row["n_floats"] for row in of_kind], [max(row["psnr"]) for row in of_kind]
            axes.plot(floats, best, "o-", ms=4, color=color, label=of_kind[0]["kind"])
            axes.plot(floats, [np.mean(row["psnr"]) for row in of_kind], ":", color=color, lw=1)
        axes.axhline(ENOUGH, color="black", lw=0.6)
        axes.set(title=subject, xlabel="floats", ylabel="PSNR (dB), best and mean")
        axes.legend()
    return figure
