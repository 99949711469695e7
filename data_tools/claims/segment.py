"""Claim ``segment/masks``: labels of a trained scene from masks with errors, over the bias to the background.

The paper is FlashSplat, arXiv 2409.08270. Objects of the synthetic room are labelled from the exact masks of its
training views, and from masks of which some are shifted by a few pixels, show no object at all, as a tracker's do
that has lost it, or spill over the outlines of the objects. Labels are drawn at held-out views and compared with the
exact ids there, by intersection over union, the mean of the objects.
"""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import distance_transform_edt

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, iterations, seeds
from data_tools.claims.kit.figures import plot_curves, subplots
from data_tools.claims.kit.objects import OBJECTS, mean_iou, object_ids
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.segment.votes import assign_labels, count_votes, label_map
from minisplat_ref.interface.palette import MIDDLE_BLUE, SERIES
from minisplat_ref.rendering import SPLATTING
from minisplat_ref.types import Gaussians, Ints

BIASES = (-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6)
SHIFTS = (3, 5)  # pixels, the least and the most along each axis
CONDITIONS = {
    "clean": (0.0, 0.0),
    "30 % shifted": (0.3, 0.0),
    "all shifted": (1.0, 0.0),
    "10 % lost": (0.0, 0.1),
    "20 % lost": (0.0, 0.2),
    "30 % lost": (0.0, 0.3),
}
"""Shares of masks that are shifted and lost."""
SPILLS = {"all grown by 2": (1.0, 2), "all grown by 4": (1.0, 4), "half grown by 6": (0.5, 6)}
"""Shares of masks whose objects are grown, and by how many pixels."""


def run(args: argparse.Namespace) -> kit.Report:
    """Train with every seed, label from every kind of masks, and measure."""
    made = make_scene("room")
    records = []
    for seed in kit.with_progress(range(args.seeds), "seeds"):
        state = kit.train_with_progress(made.scene, find_recipe("3dgs-accel", args.iterations), seed)
        records += [{"seed": seed, **record} for record in measure(made, state.gaussians, seed)]
    description = {**kit.describe_scene(made.scene), **kit.settings_of(args, "iterations", "seeds")}
    text = f"{kit.title(description)}; mean IoU of {len(OBJECTS)} objects at held-out views\n\n"
    text += table(records, {"masks": "masks"}, [(f"gamma {bias:g}", spread(_at(bias), 3)) for bias in BIASES])
    return kit.Report({**description, "biases": BIASES, "records": records}, draw(records), text)


def measure(made: SyntheticScene, gaussians: Gaussians, seed: int) -> list[dict[str, Any]]:
    """Return the mean IoU for every kind of masks and bias."""
    records = []
    exact, truth = ([object_ids(ids) for ids in views] for views in (made.train_ids, made.test_ids))
    kinds = {name: spoil(exact, *shares, np.random.default_rng(seed)) for name, shares in CONDITIONS.items()}
    kinds |= {name: spill(exact, *spilt, np.random.default_rng(seed)) for name, spilt in SPILLS.items()}
    for name, masks in kinds.items():
        cameras = (view.camera for view in made.scene.train_views)
        every = range(1 + len(OBJECTS))
        votes = count_votes(gaussians, SPLATTING, zip(cameras, masks, strict=True), every)
        for bias in BIASES:
            found = assign_labels(votes, bias)
            drawn = [label_map(gaussians, found, SPLATTING, view.camera) for view in made.scene.test_views]
            records.append({"masks": name, "bias": bias, "iou": mean_iou(drawn, truth)})
    return records


def spoil(masks: list[Ints], shifted: float, lost: float, rng: np.random.Generator) -> list[Ints]:
    """Return masks of which shares, at random and rounded, are shifted along both axes, or show no object."""
    order = rng.permutation(len(masks))
    n_shifted, n_lost = round(shifted * len(masks)), round(lost * len(masks))
    spoiled = [mask.copy() for mask in masks]
    for row in order[:n_shifted]:
        y, x = rng.integers(SHIFTS[0], SHIFTS[1] + 1, 2) * rng.choice([-1, 1], 2)
        spoiled[row] = shift(masks[row], int(y), int(x))
    for row in order[len(order) - n_lost :]:
        spoiled[row][:] = 0
    return spoiled


def shift(mask: Ints, y: int, x: int) -> Ints:
    """Return a mask moved down by y and to the right by x pixels; background moves in."""
    moved = np.zeros_like(mask)
    height, width = mask.shape
    moved[max(y, 0) : height + min(y, 0), max(x, 0) : width + min(x, 0)] = mask[
        max(-y, 0) : height + min(-y, 0), max(-x, 0) : width + min(-x, 0)
    ]
    return moved


def spill(masks: list[Ints], share: float, pixels: float, rng: np.random.Generator) -> list[Ints]:
    """Return masks of which a share, at random and rounded, has objects that are grown."""
    grown = rng.permutation(len(masks))[: round(share * len(masks))]
    return [grow(mask, pixels) if row in grown else mask for row, mask in enumerate(masks)]


def grow(mask: Ints, pixels: float) -> Ints:
    """Return a mask whose objects take what is background up to some pixels beside them, each what is nearest to it."""
    distances, nearest = distance_transform_edt(mask == 0, return_indices=True)
    found: Ints = np.where(distances <= pixels, mask[tuple(nearest)], 0)
    return found


def _at(bias: float) -> Callable[[dict[str, Any]], float | None]:
    return lambda record: record["iou"] if record["bias"] == bias else None


def draw(records: list[dict[str, Any]]) -> Figure:
    """Draw the mean IoU over the bias for every kind of masks."""
    figure, axes = subplots((6.5, 3.6))
    colors = dict(zip((*CONDITIONS, *SPILLS), (*SERIES, MIDDLE_BLUE), strict=False))
    plot_curves(axes, records, "bias", "iou", colors, key="masks")
    axes.set(title="Labels at held-out views", xlabel="bias to the background", ylabel="mean IoU")
    axes.legend()
    return figure


CLAIMS = (
    declare(
        "masks",
        "labels at held-out views, from clean, shifted, lost and grown masks, over the bias",
        run,
        *(OUT, iterations(1000), seeds(3)),
    ),
)
