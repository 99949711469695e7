"""Claim ``cuts/edge``: a real edge, in a window of a photograph, by few Gaussians with no, one and two curves each.

The paper is DisC-GS, arXiv 2405.15196. The window of 48 x 48 pixels is the one whose gradients agree best on a
direction: the difference of the eigenvalues of their structure tensor is the largest. So it has a strong edge, and
little besides; how sharp it is, is up to the lens. The band around it is what is within 1.5 pixels of a gradient of at
least half the largest. The Gaussians' number stays, and their colours do not depend on the view; numbers of Gaussians
are chosen so that those of floats are alike.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import ndimage

from data_tools.claims import kit
from data_tools.claims.cuts import card
from data_tools.claims.kit.figures import plot_curves, show
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.types import Bools, Floats

COLORS = {"no curve": GREY, "1 curve": RED, "2 curves": BLUE}
NAMES = tuple(COLORS)  # by the number of curves
NUMBERS = ((6, 12, 24, 48), (6, 12, 15, 30), (6, 11, 22))  # Gaussians: 14, 22 and 30 floats each
N_FLOATS = (14, 22, 30)
COLUMNS = (("PSNR (dB)", spread("psnr", 1)), ("at the edge", spread("band", 1)), ("elsewhere", spread("elsewhere", 1)))
EDGE_SHARE = 0.5  # of the largest gradient


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        The scene cannot be used, or its first photograph is smaller than the window.
    """
    view = kit.read_scene(args.scene, args.downscale, is_tested=False).train_views[0]
    target, corner = find_edge(view.load().image / 255)
    rows, images = [], []
    jobs = [(n_curves, n) for n_curves, numbers in enumerate(NUMBERS) for n in numbers]
    for n_curves, n in kit.with_progress(jobs, "trainings"):
        found = [card.fit_card(target, n, n_curves, args.iterations, seed) for seed in range(args.seeds)]
        measures = [card.measure_parts(target, population) for population in found]
        if n == NUMBERS[n_curves][-1]:
            images.append((f"{n}, {NAMES[n_curves]}", card.render_card(found[0])))
        row = {"kind": NAMES[n_curves], "n_gaussians": n, "n_floats": n * N_FLOATS[n_curves]}
        rows.append({**row, **{key: [measure[key] for measure in measures] for key in measures[0]}})
    place = {"photograph": view.name, "x": corner[0], "y": corner[1]}
    result = {**kit.settings_of(args, "scene", "downscale", "iterations", "seeds"), **place, "rows": rows}
    text = f"{view.name}, {card.SIZE} x {card.SIZE} pixels from {corner[0]}, {corner[1]}\n\n"
    text += table(rows, {"kind": "Gaussians", "n_gaussians": "number", "n_floats": "floats"}, COLUMNS)
    arms = kit.arms_of([row for row in rows if row["n_gaussians"] == NUMBERS[0][0]], "kind", ("psnr",))
    return kit.Report(result, draw(rows, [("photograph", target.image), *images]), text, arms)


def find_edge(photograph: Floats) -> tuple[card.Target, tuple[int, int]]:
    """Return the window of a photograph [H, W, 3] with the strongest single edge, and x and y of its first pixel.

    Raises
    ------
    InputError
        The photograph is smaller than the window.
    """
    if min(photograph.shape[:2]) < card.SIZE:
        raise InputError(
            f"the photograph has {photograph.shape[1]} x {photograph.shape[0]} pixels, and an edge takes a window of"
            f" {card.SIZE} x {card.SIZE}: lower --downscale"
        )
    x, y = (ndimage.sobel(photograph.mean(axis=2), axis=axis) for axis in (1, 0))
    xx, xy, yy = (ndimage.uniform_filter(product, card.SIZE) for product in (x * x, x * y, y * y))
    half = card.SIZE // 2  # a window is around the pixel that follows its middle
    inside = np.s_[half : photograph.shape[0] - half + 1, half : photograph.shape[1] - half + 1]
    gaps = np.hypot(xx - yy, 2 * xy)[inside]  # of the eigenvalues
    top, left = (int(i) for i in np.unravel_index(np.argmax(gaps), gaps.shape))
    window = np.s_[top : top + card.SIZE, left : left + card.SIZE]
    return card.Target(photograph[window], near_strong(np.hypot(x, y)[window])), (left, top)


def near_strong(gradients: Floats) -> Bools:
    """Return which pixels [H, W] are within ``BAND`` pixels of a strong gradient."""
    is_strong = gradients >= EDGE_SHARE * gradients.max()
    near: Bools = ndimage.distance_transform_edt(~is_strong) < card.BAND
    return near


def draw(rows: list[dict[str, Any]], images: list[tuple[str, Floats]]) -> Figure:
    """Draw PSNR, whole and at the edge, against the number of floats, and the images."""
    figure = Figure(figsize=(14.0, 6.5), layout="constrained")
    places = figure.add_gridspec(2, 2 * len(images))
    for column, (key, title) in enumerate((("psnr", "whole window"), ("band", "at the edge"))):
        axes = figure.add_subplot(places[0, column * len(images) : (column + 1) * len(images)])
        plot_curves(axes, rows, "n_floats", key, COLORS, key="kind")
        axes.set(title=title, xlabel="floats", ylabel="PSNR (dB)")
        axes.legend()
    for k, (heading, image) in enumerate(images):
        show(figure.add_subplot(places[1, 2 * k : 2 * k + 2]), np.clip(image, 0, 1), heading)
    return figure
