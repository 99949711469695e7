"""Claim ``vdgs/pane`` (VDGS, arXiv 2312.13729): whether the opacity of a pane comes to follow Schlick's formula.

A flat pane of white Gaussians stands before a wall of coloured ones. Seen at the angle theta from its normal, each
Gaussian of the pane has the opacity of Schlick's approximation of Fresnel's reflectance,

    F(theta) = F_0 + (1 - F_0) (1 - cos theta)^5

with an F_0 above that of glass, so that the pane is seen from the front, too. Trainings begin with this scene, but
with one opacity of the pane for all views, and keep their number of Gaussians. They compare harmonics alone with the
network in the two modes of opacity. Errors of opacity are over views that were held out, and over the Gaussians of the
pane.

The start is favourable, and the network has many more floats than these few Gaussians: :mod:`.floats` compares at
equal floats.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from data_tools.claims import kit
from data_tools.claims.kit.figures import subplots, summarise
from data_tools.claims.kit.tables import first, spread, table
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.extensions.vdgs.model import VDGS, VIEW_DEPENDENT, modulate_model, opacity_plus
from minisplat_ref.interface.palette import BLUE, OCHRE, RED
from minisplat_ref.mechanisms.networks.directions import directions
from minisplat_ref.mechanisms.networks.networks import COMPILED
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import SPLATTING, RenderSettings, Request, activate
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe, scale_recipe
from minisplat_ref.types import Camera, Floats, Gaussians, Model, Scene, View, number_views, view_from

WIDTH, HEIGHT, FOCAL = 48, 36, 60.0  # pixels
N_VIEWS, TEST_EVERY = 48, 4
DISTANCE = 4.0  # of the cameras from the pane's middle
ANGLE_MAX = np.radians(80)
SIDE = 5  # Gaussians along each side of the pane, which comes first in the population
F0 = 0.2
NORMAL = np.array([0.0, -1.0, 0.0])
HARMONICS, TIMES, PLUS = "harmonics", "opacity_times", "opacity_plus"
COLORS = {HARMONICS: BLUE, TIMES: RED, PLUS: OCHRE}
COLUMNS = (
    ("Gaussians", first("gaussians", ",")),
    ("floats", first("floats", ",")),
    ("PSNR dB", spread("psnr", 2)),
    ("error of opacity", spread("opacity_rmse", 3)),
)


def schlick(cosines: Floats, f0: float = F0) -> Floats:
    """Return ``F_0 + (1 - F_0) (1 - cos theta)^5``."""
    return f0 + (1 - f0) * (1 - cosines) ** 5


def make_pane(rng: np.random.Generator) -> Gaussians:
    """Return a pane of SIDE^2 white Gaussians in the plane y = 0, then a wall of coloured ones at y = 1; float32."""
    axis = np.linspace(-0.8, 0.8, SIDE)
    x, z = (a.ravel() for a in np.meshgrid(axis, axis))
    wall_x, wall_z = (a.ravel() for a in np.meshgrid(np.linspace(-3, 3, 10), np.linspace(-1.6, 1.6, 6)))
    pane, wall = np.stack([x, 0 * x, z], axis=1), np.stack([wall_x, 0 * wall_x + 1, wall_z], axis=1)
    n = len(pane) + len(wall)
    thin = np.array([1.0, 0.05, 1.0])
    colors = np.concatenate([np.full((len(pane), 3), 1.7), rng.uniform(-1.7, 1.0, size=(len(wall), 3))])
    found = Gaussians(
        means=np.concatenate([pane, wall]),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.log(np.concatenate([np.tile(0.2 * thin, (len(pane), 1)), np.tile(0.3 * thin, (len(wall), 1))])),
        opacity_logits=np.concatenate([np.zeros(len(pane)), np.full(len(wall), 3.0)]),
        sh_dc=colors,
        sh_rest=np.zeros((n, 15, 3)),
    )
    return Gaussians(*(field.astype(np.float32) for field in found))


def true_opacities(gaussians: Gaussians, camera: Camera) -> Floats:
    """Return the opacities [SIDE^2] of the pane in a view."""
    d, _ = directions(gaussians.means[: SIDE**2].astype(np.float64), camera)
    return schlick(np.abs(d @ NORMAL))


def photograph(gaussians: Gaussians, camera: Camera) -> NDArray[np.uint8]:
    """Return the 8-bit image of the scene, whose pane has the opacities of the view."""
    o = true_opacities(gaussians, camera)
    logits = np.concatenate([np.log(o / (1 - o)), gaussians.opacity_logits[SIDE**2 :]]).astype(np.float32)
    model = Model(gaussians._replace(opacity_logits=logits))
    image = SPLATTING.render(model, view_from(camera), Request(backend=CPU))[0].image
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def make_pane_scene(truth: Gaussians) -> Scene:
    """Return the photographs as a scene, every fourth held out; cameras are on an arc before the pane."""
    views = []
    for i, angle in enumerate(np.linspace(-ANGLE_MAX, ANGLE_MAX, N_VIEWS)):
        height = 0.5 * np.sin(2.4 * i)
        place = np.array([DISTANCE * np.sin(angle), -DISTANCE * np.cos(angle), height])
        camera = look_at(place, np.zeros(3), FOCAL, WIDTH, HEIGHT)
        views.append(View(f"{i:04d}", camera, photograph(truth, camera), None))
    return Scene(
        "pane",
        number_views(view for i, view in enumerate(views) if i % TEST_EVERY),
        tuple(view._replace(view_id=-1) for view in views[::TEST_EVERY]),
        truth.means.astype(np.float64),
        np.full(truth.means.shape, 128, np.uint8),
        np.zeros(3),
        extent=1.1 * DISTANCE,
    )


def arms(iterations: int) -> dict[str, Recipe]:
    """Return the recipes by arm, without density control."""
    ours = VDGS._replace(representation=VIEW_DEPENDENT)
    recipes = {
        HARMONICS: GS_ACCEL,
        TIMES: ours,
        PLUS: configure(ours, modulation=opacity_plus),
    }
    return {name: kit.drop_events(scale_recipe(recipe, iterations)) for name, recipe in recipes.items()}


def floats_of(model: Model) -> int:
    """Return the floats of a model: those of the Gaussians, and of what is shared."""
    return len(model.gaussians.means) * kit.count_floats(model.gaussians) + sum(a.size for a in model.shared.values())


def pane_opacities(model: Model, recipe: Recipe, camera: Camera) -> Floats:
    """Return the opacities [SIDE^2] of the pane in a view."""
    seen = model.gaussians
    if model.shared:
        mode = recipe.renderer.render.keywords["modulation"]()  # type: ignore[attr-defined]
        seen, _ = modulate_model(model, camera, mode, COMPILED)
    opacities: Floats = activate(seen).opacities[: SIDE**2]
    return opacities


def measure(seed: int, iterations: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Train every arm; return their records, and by arm the angles and opacities at the views that were held out."""
    rng = np.random.default_rng(seed)
    truth = make_pane(rng)
    scene = make_pane_scene(truth)
    start = truth._replace(opacity_logits=truth.opacity_logits.copy())
    start.opacity_logits[: SIDE**2] = np.log(F0 / (1 - F0))
    records: list[dict[str, Any]] = []
    curves: dict[str, Any] = {}
    for name, recipe in arms(iterations).items():
        state = initial_state(scene, recipe, seed)
        state.gaussians = Gaussians(*(field.copy() for field in start))
        train(scene, recipe, seed=seed, state=state, backend=CPU)
        shown = RenderSettings(scene.background, renderer=recipe.renderer, backend=CPU)
        cameras = [view.camera for view in scene.test_views]
        found = np.array([pane_opacities(state.model, recipe, camera) for camera in cameras])
        true = np.array([true_opacities(truth, camera) for camera in cameras])
        records.append(
            {
                "arm": name,
                "seed": seed,
                "psnr": evaluate(state.model, scene.test_views, shown).psnr,
                "opacity_rmse": float(np.sqrt(np.mean((found - true) ** 2))),
                "gaussians": len(start.means),
                "floats": floats_of(state.model),
            }
        )
        curves[name] = found
    angles = [directions(truth.means[: SIDE**2].astype(np.float64), camera)[0] @ NORMAL for camera in cameras]
    curves["angles"] = np.degrees(np.arccos(np.abs(np.array(angles))))
    return records, curves


def run(args: argparse.Namespace) -> kit.Report:
    """Train all arms for every seed."""
    records: list[dict[str, Any]] = []
    curves: dict[str, Any] = {}
    for seed in kit.with_progress(range(args.seeds), "seeds"):
        found, curves = measure(seed, args.iterations)
        records += found
    result = {**kit.settings_of(args, "seeds", "iterations"), "f0": F0, "records": records}
    result["summary"] = summarise(records, "arm", ("psnr", "opacity_rmse"))
    compared = kit.arms_of(records, "arm", ("psnr", "opacity_rmse"))
    return kit.Report(result, draw(curves), table(records, {"arm": "arm"}, COLUMNS), compared)


def draw(curves: dict[str, Any]) -> Figure:
    """Plot the opacities of the last seed over the angle, beside Schlick's formula."""
    figure, axes = subplots((10, 3.6), 1, len(COLORS), sharey=True)
    line = np.linspace(0, 85, 100)
    for ax, (name, color) in zip(axes, COLORS.items(), strict=True):
        ax.plot(curves["angles"].ravel(), curves[name].ravel(), ".", ms=3, color=color, label=name)
        ax.plot(line, schlick(np.cos(np.radians(line))), "k", lw=1, label="Schlick")
        ax.set(xlabel="angle from the normal (degrees)", ylim=(0, 1))
        ax.legend(loc="upper left")
    axes[0].set_ylabel("opacity at held-out views")
    return figure
