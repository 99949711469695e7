"""Claims ``satellite/boxes``, by part, and ``satellite/distance``, where affine cameras fail (arXiv 2412.13047)."""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import group, show, subplots, with_deviation
from data_tools.claims.kit.tables import spread, table
from data_tools.claims.satellite.boxes import HIGH, SCALE, SIZE, Truth, make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.satellite.cameras import fit_residual
from minisplat_ref.extensions.satellite.model import RADIOMETRY, SATELLITE
from minisplat_ref.extensions.satellite.surface import surface_model
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.rendering import Request
from minisplat_ref.training.loop import train
from minisplat_ref.training.rates import LogLinear
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Floats, Model, Scene, View

ARMS = (
    "all",
    "without shadows",
    "without radiometry",
    "without sparsity",
    "without view consistency",
    "without entropy",
    "an opaque start",
    "means at the rate of 3DGS",
    "a black background",
    "limits 8 m below the ground",
)
COLUMNS = (
    ("height MAE (m)", spread("height_mae", 2)),
    ("shadow IoU", spread("shadow_iou", 2)),
    ("gain error", spread("gain_error", 3)),
)
PLANE, BELOW = "a plane", 8.0  # metres
N_POINTS = 10_000
_TERMS = {ARMS[3]: "opacity_sparsity", ARMS[4]: "view_consistency", ARMS[5]: "shadow_entropy"}
DISTANCES, OFF_NADIR = (500e3, 50e3, 5e3), (0.0, 25.0)  # metres, degrees
GSD, SPAN, HEIGHT = 0.3, 500.0, 100.0  # metres


class Measured(NamedTuple):
    """What a training has found."""

    height_mae: float
    """Metres, after the median difference is taken off."""
    shadow_iou: float
    """Of pixels with s < 0.5 in all photographs; 0 without a shadow map."""
    gain_error: float
    """Root mean square of the entries of C relative to the first photograph's."""


def arm_of(arm: str, recipe: Recipe, scene: Scene) -> tuple[Recipe, Scene]:
    """Return what an arm trains with."""
    if arm == "without shadows":
        return recipe, scene._replace(train_views=tuple(map(_without_sun, scene.train_views)))
    if arm == "without radiometry":
        still = recipe.representation._replace(rates=recipe.representation.rates.change(radiometry=0.0))
        return recipe._replace(representation=still), scene
    if arm == "an opaque start":
        return recipe._replace(events=recipe.events[1:]), scene
    if arm == "means at the rate of 3DGS":
        slow = LogLinear(1.6e-4, 1.6e-6, recipe.iterations)
        return recipe._replace(learning_rates=recipe.learning_rates.change(means=slow)), scene
    if arm == "a black background":
        return recipe._replace(has_random_background=False), scene
    losses = tuple(term for term in recipe.losses if term.name != _TERMS.get(arm))
    return recipe._replace(losses=losses), scene


def _without_sun(view: View) -> View:
    """Return a photograph whose camera knows of no sun."""
    optics = view.camera.optics
    assert optics is not None
    dark = optics._replace(coefficients=(*optics.coefficients[:2], 0.0, 0.0, 0.0))
    return view._replace(camera=view.camera._replace(optics=dark))


def measure(model: Model, truth: Truth) -> tuple[Measured, Floats]:
    """Return how far a model is from the truth, and its surface model [H, W]."""
    heights = surface_model(model, (SIZE, SIZE), SCALE, min_alpha=0.0)
    off = heights - truth.heights
    found = []
    for view in truth.scene.train_views:
        image = SATELLITE.render(model, view, Request(wants=frozenset({"shadow"})))[0].image
        found.append(image[..., 3] < 0.5)
    both, either = np.array(found) & truth.is_shadow, np.array(found) | truth.is_shadow
    radiometry = model.shared[RADIOMETRY].astype(np.float64)
    relative = radiometry[1:, :, :3] @ np.linalg.inv(radiometry[0, :, :3])
    gain = float(np.sqrt(np.mean((relative - truth.radiometry[1:, :, :3]) ** 2)))
    return Measured(float(np.abs(off - np.median(off)).mean()), float(both.sum() / either.sum()), gain), heights


def run_boxes(args: argparse.Namespace) -> kit.Report:
    """Train every arm with every seed, which is also that of the scene; what is in ``--out`` already is kept."""
    settings = kit.settings_of(args, "iterations")

    def measure_job(seed: int, arm: str) -> dict[str, Any]:
        truth = make_scene(seed, N_POINTS, below=BELOW if arm == ARMS[-1] else 0.0)
        recipe, scene = arm_of(arm, find_recipe("satellite", args.iterations), truth.scene)
        # Photographs without a sun in their cameras have no shadows; the truth's masks still do.
        measured, heights = measure(train(scene, recipe, seed=seed).model, truth._replace(scene=scene))
        if seed == 0:
            np.save(args.out / f"{arm}.npy", heights.astype(np.float32))
        return measured._asdict()

    records = kit.resume(args.out, settings, kit.jobs_of(seed=range(args.seeds), arm=ARMS), measure_job)
    arms, text = kit.arms_of(records, "arm", Measured._fields), to_table(records)
    heights = [make_scene(seed).heights for seed in range(args.seeds)]
    planes = [float(np.abs(of_seed - np.median(of_seed)).mean()) for of_seed in heights]
    records += [{"seed": seed, "arm": PLANE, "height_mae": mae} for seed, mae in enumerate(planes)]
    text += f"\n\na plane at the median height has an MAE of {with_deviation(planes, 2)} m"
    shown = {"truth": make_scene(0).heights, **{arm: np.load(args.out / f"{arm}.npy") for arm in ARMS}}
    shown[ARMS[-1]] = shown[ARMS[-1]] - BELOW
    return kit.Report({**settings, "seeds": args.seeds, "records": records}, draw(shown), text, arms)


def to_table(records: list[dict[str, Any]]) -> str:
    """Return the table, the least favourable arm first."""
    maes = {arm: float(np.mean([record["height_mae"] for record in own])) for arm, own in group(records, "arm").items()}
    by_error = sorted(records, key=lambda record: (-maes[record["arm"]], ARMS.index(record["arm"])))
    return table(by_error, {"arm": ""}, COLUMNS)


def draw(shown: dict[str, Floats]) -> Figure:
    """Draw the heights of seed 0: black is the ground, white 24 m."""
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    axes = np.ravel(figure.subplots(2, 6))
    for ax in axes[len(shown) :]:
        ax.axis("off")
    for ax, (name, heights) in zip(axes, shown.items(), strict=False):
        show(ax, np.repeat(np.clip(heights / HIGH, 0, 1)[..., None], 3, axis=2), name)
    return figure


def run_distance(args: argparse.Namespace) -> kit.Report:
    """Fit affine cameras to perspective ones at several distances, straight above and at a slant."""
    records = [
        {"distance": distance, "off_nadir": angle, "residual": perspective_residual(distance, angle)}
        for angle in OFF_NADIR[::-1]
        for distance in DISTANCES[::-1]
    ]
    rows = [[f"{r['distance'] / 1e3:g}", f"{r['off_nadir']:g}", f"{r['residual']:.2f}"] for r in records]
    text = markdown_table(["distance (km)", "off nadir (degrees)", "largest residual (px)"], rows)
    figure, ax = subplots((4, 3))
    for angle in OFF_NADIR:
        chosen = [r for r in records if r["off_nadir"] == angle]
        ax.loglog([r["distance"] for r in chosen], [r["residual"] for r in chosen], "o-", label=f"{angle:g} degrees")
    ax.axhline(1, color="0.5", linewidth=1)
    ax.set(xlabel="distance (m)", ylabel="largest residual (px)")
    ax.legend()
    return kit.Report({"gsd": GSD, "span": SPAN, "height": HEIGHT, "records": records}, figure, text)


def perspective_residual(distance: float, off_nadir: float) -> float:
    """Return the largest residual in pixels of the affine fit to a pinhole that looks at the middle of the scene."""
    angle = np.radians(off_nadir)
    right, forward = np.array([1.0, 0, 0]), np.array([0, np.sin(angle), -np.cos(angle)])
    down, centre, n = np.cross(forward, right), -distance * forward, round(SPAN / GSD)

    def world_of(pixels: Floats, altitudes: Floats) -> Floats:
        slopes = (pixels - n / 2) * GSD / distance
        rays = forward + slopes[:, :1] * right + slopes[:, 1:] * down
        points: Floats = centre + ((altitudes - centre[2]) / rays[:, 2])[:, None] * rays
        return points

    return fit_residual(world_of, n, n, (-HEIGHT / 2, HEIGHT / 2)).worst
