"""Claim ``micro/checker`` (arXiv 2504.05740): a test chart that is half a fine checkerboard and half a smooth ramp.

Several cameras look straight at the chart. Every variant starts from the same points and gets the same number of new
Gaussians at each densification, from those with the largest scaled gradients. So all end with the same count, and
differ in the places and shapes of their Gaussians.
"""

import argparse
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import show, with_deviation
from minisplat_ref.extensions.micro.model import detail_map
from minisplat_ref.extensions.micro.recipe import collect_detail, trace
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE, RED, TITLE_COLOR
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL, collect_gradients
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy import clone_split
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.schedule import During, Every, scale_recipe
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Model, Scene, View, number_views

WIDTH, HEIGHT, FOCAL, DISTANCE = 96, 64, 96.0, 4.0  # pixels, world units
CELL = 4.5 * DISTANCE / FOCAL  # side of a square of the checkerboard, world units; not a whole number of pixels
N_VIEWS, N_TEST, SHIFT = 12, 4, 0.3  # cameras, test cameras, and their largest distance from the axis
N_POINTS, N_STEPS, N_NEW = 120, 12, 60  # initial Gaussians, densifications, new Gaussians in each
EXTENT = 2.0
BORDER = 4  # pixels beside the border of the halves that count as neither
SAMPLES = 8  # per pixel and side, of the photographs


class Variant(NamedTuple):
    """The changes to 3DGS that are switched on."""

    beta: float
    weight: float
    """Weight of the trace penalty."""
    color: str


class Outcome(NamedTuple):
    """The measurements of one training."""

    n: int
    psnr_edges: float
    """Over pixels of the checkerboard with more edges than on average, dB."""
    psnr_smooth: float
    """Over the ramp, dB."""
    psnr: float
    anisotropy: float
    """Median ratio of the largest to the middle scale; no camera sees the thickness across the chart."""
    n_smooth: int
    """Number of Gaussians on the ramp."""
    image: Floats
    gaussians: Gaussians


def variants(beta: float, weight: float) -> dict[str, Variant]:
    """Return the variants that are compared, by name."""
    return {
        "3dgs": Variant(0.0, 0.0, GREY),
        "detail": Variant(beta, 0.0, BLUE),
        "trace": Variant(0.0, weight, OCHRE),
        "both": Variant(beta, weight, RED),
    }


def card(x: Floats, y: Floats) -> Floats:
    """Return the colour [..., 3] of the chart: a checkerboard at x < 0, a ramp at x >= 0."""
    dark = (np.floor(x / CELL) + np.floor(y / CELL)) % 2
    checker = np.stack([0.1 + 0.8 * dark, 0.15 + 0.6 * dark, 0.8 - 0.6 * dark], axis=-1)
    ramp = np.stack([0.35 + 0.2 * x, 0.5 + 0.15 * y, 0.6 - 0.15 * x], axis=-1)
    return np.clip(np.where(x[..., None] < 0, checker, ramp), 0, 1)


def photograph(camera: Camera) -> Floats:
    """Return the photograph of the chart at z = 0, [H, W, 3] in [0, 1]: means over the pixels."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    u = (np.arange(WIDTH)[:, None] + steps).ravel()
    v = (np.arange(HEIGHT)[:, None] + steps).ravel()
    x, y = ((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    center = camera.center
    grid_x, grid_y = np.meshgrid(center[0] + DISTANCE * x, center[1] + DISTANCE * y)
    colors = card(grid_x, grid_y).reshape(HEIGHT, SAMPLES, WIDTH, SAMPLES, 3)
    means: Floats = colors.mean(axis=(1, 3))
    return means


def checker_scene(seed: int) -> Scene:
    """Return the scene of the chart: its photographs, and grey points on it."""
    rng = np.random.default_rng(seed)
    views = []
    for i in range(N_VIEWS + N_TEST):
        x, y = rng.uniform(-SHIFT, SHIFT, 2)
        t = np.array([-x, -y, DISTANCE])
        camera = Camera(np.eye(3), t, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
        views.append(View(f"{i:02d}", camera, np.rint(255 * photograph(camera)).astype(np.uint8), None))
    half = DISTANCE / FOCAL * np.array([WIDTH / 2, HEIGHT / 2]) + SHIFT
    points = np.column_stack([rng.uniform(-half, half, (N_POINTS, 2)), np.zeros(N_POINTS)])
    gray = np.full(points.shape, 128, np.uint8)
    return Scene("card", number_views(views[:N_VIEWS]), tuple(views[N_VIEWS:]), points, gray, np.zeros(3), EXTENT)


def grow(state: TrainState, iteration: Iteration, *, beta: float) -> None:
    """Clone or split the ``N_NEW`` Gaussians of the largest gradient, scaled as in the method."""
    views = np.maximum(state.stats.pop("view_count"), 1)
    detail = state.stats.pop("detail_sum") / views
    gradients = state.stats.pop("gradient_sum") / views * (1 + beta * detail)
    edit = clone_split.clone_and_split(
        state.gaussians,
        gradients,
        threshold=float(np.sort(gradients)[-N_NEW]),
        size_limit=1.5 * DISTANCE / FOCAL,  # of a pixel and a half
        rng=state.rng,
    )
    apply_edit(state, edit)


def train_variant(variant: Variant, scene: Scene, iterations: int, seed: int) -> Gaussians:
    """Train the chart with a variant; densification ends after three quarters of the iterations."""
    base = scale_recipe(GS_ACCEL, iterations)
    period = iterations * 3 // 4 // (N_STEPS + 1)
    stop = period * (N_STEPS + 1)
    recipe = base._replace(
        sh_degree=0,
        losses=(*base.losses, LossTerm("trace", partial(trace, trace_limit=0.03), weight=variant.weight)),
        events=(
            During(collect_gradients, stop=stop),
            During(collect_detail, stop=stop),
            Every(period, partial(grow, beta=variant.beta), stop=stop),
        ),
    )
    gaussians: Gaussians = train(scene, recipe, seed=seed, backend=CPU).gaussians
    return gaussians


def halves(view: View) -> tuple[Bools, Bools]:
    """Return which pixels [H, W] are at edges of the checkerboard, and which on the ramp."""
    camera = view.camera
    border = camera.cx - camera.fx * camera.center[0] / DISTANCE  # pixels: where x = 0 is seen
    columns = np.arange(WIDTH) + 0.5
    is_checker = np.broadcast_to(columns < border - BORDER, (HEIGHT, WIDTH))
    is_ramp = np.broadcast_to(columns > border + BORDER, (HEIGHT, WIDTH))
    return is_checker & (detail_map(view.image) > 1), is_ramp


def outcome(gaussians: Gaussians, scene: Scene) -> Outcome:
    """Measure the held-out views, pooling errors over them."""
    squares: dict[str, list[Floats]] = {"edges": [], "smooth": [], "all": []}
    image = np.zeros((HEIGHT, WIDTH, 3))
    for view in scene.test_views:
        image = np.clip(SPLATTING.render(Model(gaussians), view, Request(backend=CPU))[0].image, 0, 1)
        square = np.mean((image - view.image / 255) ** 2, axis=2)  # [H, W]
        edges, ramp = halves(view)
        for name, part in (("edges", square[edges]), ("smooth", square[ramp]), ("all", square.ravel())):
            squares[name].append(part)
    psnrs = {name: float(-10 * np.log10(np.concatenate(parts).mean())) for name, parts in squares.items()}
    scales = np.sort(np.exp(gaussians.log_scales.astype(np.float64)), axis=1)  # [N, 3]
    return Outcome(
        len(gaussians.means),
        psnrs["edges"],
        psnrs["smooth"],
        psnrs["all"],
        float(np.median(scales[:, 2] / scales[:, 1])),
        int(np.count_nonzero(gaussians.means[:, 0] > 0)),
        image,
        gaussians,
    )


def measure(iterations: int, seeds: int, beta: float, weight: float) -> dict[str, list[Outcome]]:
    """Return the outcomes of each variant, one per seed."""
    outcomes: dict[str, list[Outcome]] = {name: [] for name in variants(beta, weight)}
    for seed in range(seeds):
        scene = checker_scene(seed)
        for name, variant in kit.with_progress(variants(beta, weight).items(), f"trainings, seed {seed}"):
            outcomes[name].append(outcome(train_variant(variant, scene, iterations, seed), scene))
    return outcomes


NUMBERS = {
    "n": "Gaussians",
    "psnr_edges": "PSNR at edges",
    "psnr_smooth": "PSNR of the ramp",
    "psnr": "PSNR",
    "anisotropy": "largest / middle scale",
    "n_smooth": "on ramp",
}


def run(args: argparse.Namespace) -> kit.Report:
    """Train the chart with every variant and seed."""
    outcomes = measure(args.iterations, args.seeds, args.beta, args.trace)
    found = {name: {key: [getattr(one, key) for one in own] for key in NUMBERS} for name, own in outcomes.items()}
    rows = [[name, *(with_deviation(numbers[key], 2) for key in NUMBERS)] for name, numbers in found.items()]
    table = markdown_table(["variant", *NUMBERS.values()], rows)
    result = {**kit.settings_of(args, "iterations", "seeds", "beta", "trace"), "variants": found}
    text = f"mean over the seeds ± standard deviation\n\n{table}"
    return kit.Report(result, draw(outcomes, args.beta, args.trace), text, arms=found)


def draw(outcomes: dict[str, list[Outcome]], beta: float, weight: float) -> Figure:
    """Draw the photograph and, for each variant, its image and its Gaussians on the chart."""
    figure = Figure(figsize=(12, 3.7), layout="constrained")
    target = checker_scene(0).test_views[-1].image / 255
    rows = figure.subplots(2, len(outcomes) + 1)
    show(rows[0, 0], target, "held-out photograph")
    rows[1, 0].axis("off")
    for (upper, lower), (name, own) in zip(rows.T[1:], outcomes.items(), strict=True):
        result = own[0]
        edges = kit.psnr_of(result.image[:, : WIDTH // 2], target[:, : WIDTH // 2])
        show(upper, result.image, f"{name}: edges {edges:.1f}, ramp {result.psnr_smooth:.1f} dB")
        lower.scatter(*result.gaussians.means[:, :2].T, s=3, color=variants(beta, weight)[name].color, lw=0)
        lower.axvline(0, color=TITLE_COLOR, lw=0.8)
        lower.set(xlim=(-2.2, 2.2), ylim=(1.6, -1.6), aspect="equal", xticks=[], yticks=[])
        lower.spines[:].set_visible(True)
        lower.set_title(f"{result.n} Gaussians, {result.n_smooth} on the ramp", fontsize=8)
    return figure
