"""The precision that a training needs: the same recipe and seeds in float64, float32 and with colours in float16.

The claim is ours. Rounding changes a training long before it harms it: after a few hundred iterations two precisions
have different Gaussians, like two seeds. So this compares the PSNR of the test views, over seeds, with that of float32
with fast kernels, which is what ``train`` uses; it also reports processor time and the bytes of the parameters.

=======================  =========================================================================================
``float64``              parameters, moments and kernels
``float32, exact``       backend ``cpu-exact``: the exponential of the C library
``float32, fast``        backend ``cpu``: a polynomial for the exponential
``float16 throughout``   fast; after every iteration the colours are rounded to float16, the moments are not
``float16 in the end``   fast; the finished colours are rounded, for a file of half the size
=======================  =========================================================================================

float16 has eleven bits: a step of Adam that is smaller than 1/4096 of a coefficient leaves it as it was.
"""

import argparse
import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import DTypeLike

from data_tools.claims import kit
from data_tools.claims.adaptive import WARM_UP
from data_tools.claims.kit.claim import CONTINUES, RESUMED_SCENE, SEEDS, declare, iterations, recipe
from data_tools.claims.kit.figures import plus_minus, standard_error, subplots, summarise
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import BLUE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import CPU, CPU_EXACT, Backend
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import match_calibrations
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import StepReport, TrainState
from minisplat_ref.types import Model, Scene

COLOURS = ("sh_dc", "sh_rest")
FAST, STORED = "float32, fast", "float16 in the end"
HEADING = ["precision", "PSNR (dB)", f"difference from {FAST} (dB)", "SSIM", "Gaussians", "MB", "processor time (s)"]


class Precision(NamedTuple):
    """How a training computes and stores its parameters."""

    dtype: DTypeLike
    """Of parameters and moments."""
    backend: Backend
    has_half_colours: bool = False
    """Whether the colours are rounded to float16 after every iteration."""


PRECISIONS: Mapping[str, Precision] = {
    FAST: Precision(np.float32, CPU),
    "float32, exact": Precision(np.float32, CPU_EXACT),
    "float64": Precision(np.float64, CPU_EXACT),
    "float16 throughout": Precision(np.float32, CPU, has_half_colours=True),
}
"""The trainings; :data:`STORED` is a rounding of the first."""


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        The scene, the recipe or the output folder cannot be used.
    """
    scene = kit.read_scene(args.scene, args.downscale)
    recipe = get_recipe(args.recipe, args.iterations)
    description = kit.describe_scene(scene)
    settings = {"scene": description["scene"], **kit.settings_of(args, "downscale", "recipe", "iterations")}

    def warm_up(missing: list[Mapping[str, Any]]) -> None:
        for name in dict.fromkeys(job["precision"] for job in missing):
            with contextlib.suppress(InputError):  # so short a schedule may ask for what cannot be
                train_in_precision(scene, get_recipe(args.recipe, WARM_UP), PRECISIONS[name], 0)

    jobs = kit.jobs_of(seed=args.seeds, precision=PRECISIONS)
    records = kit.resume_all(args.out, settings, jobs, partial(measure, scene, recipe), warm_up)  # has STORED, too
    records = [record for record in records if record["seed"] in args.seeds]
    rows = compare(records)
    result = {**description, **settings, "seeds": list(args.seeds), "summary": rows, "runs": records}
    length = f"{args.recipe}, {args.iterations} iterations, {kit.seeds_of(args)}"
    table = markdown_table(HEADING, [_cells(name, row) for name, row in rows.items()])
    arms = kit.arms_of(records, "precision", ("psnr", "ssim", "n_gaussians"))
    return kit.Report(result, draw(rows), f"{kit.title(description)}\n{length}\n\n{table}", arms)


def train_in_precision(scene: Scene, recipe: Recipe, precision: Precision, seed: int) -> TrainState:
    """Train in a precision and return the state after the last iteration.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    precision : Precision
    seed : int
    """
    state = initial_state(scene, recipe, seed)
    population = state.gaussians
    state.gaussians = type(population)(*(field.astype(precision.dtype) for field in population))
    state.adam = zero_moments(state.gaussians)
    return train(
        scene,
        recipe,
        seed=seed,
        state=state,
        on_step=round_colours if precision.has_half_colours else _do_nothing,
        backend=precision.backend,
    )


def round_colours(report: StepReport) -> None:
    """Round the colours of a training to float16, in place."""
    for name in COLOURS:
        array = getattr(report.state.gaussians, name)
        array[...] = array.astype(np.float16)


def _do_nothing(report: StepReport) -> None:
    pass


def with_half_colours(model: Model) -> Model:
    """Return the model with its colours rounded to float16, in the dtype that they had."""
    g = model.gaussians
    rounded = {name: getattr(g, name).astype(np.float16).astype(g.means.dtype) for name in COLOURS}
    return model._replace(gaussians=g._replace(**rounded))


def n_bytes(population: Any, *, has_half_colours: bool) -> int:
    """Return the bytes of the parameters; a float16 colour takes two."""
    sizes = {name: field.nbytes for name, field in population._asdict().items()}
    if has_half_colours:
        sizes |= {name: 2 * getattr(population, name).size for name in COLOURS}
    return sum(sizes.values())


def measure(scene: Scene, recipe: Recipe, precision: str, seed: int) -> list[dict[str, Any]]:
    """Train once; return the record of the training, and that of its rounded colours if these are evaluated."""
    computed = PRECISIONS[precision]
    start = time.process_time()
    state = train_in_precision(scene, recipe, computed, seed)
    seconds = time.process_time() - start

    def record(name: str, model: Model, *, has_half_colours: bool) -> dict[str, Any]:
        quality = evaluate(
            model,
            scene.test_views,
            RenderSettings(scene.background, renderer=match_calibrations(recipe, model).renderer),
        )
        return {
            "precision": name,
            "psnr": quality.psnr,
            "ssim": quality.ssim,
            "n_gaussians": len(model.gaussians.means),
            "megabytes": n_bytes(model.gaussians, has_half_colours=has_half_colours) / 1e6,
            "seconds": seconds,
        }

    records = [record(precision, state.model, has_half_colours=computed.has_half_colours)]
    if precision == FAST:
        records.append(record(STORED, with_half_colours(state.model), has_half_colours=True))
    return records


def compare(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each precision mean and deviation over the seeds, and the difference from the fast one of each seed.

    ``difference`` is a mean with its standard error, None for a single seed.
    """
    fast = {record["seed"]: record["psnr"] for record in records if record["precision"] == FAST}
    summary = summarise(records, "precision", ("psnr", "ssim", "n_gaussians", "megabytes", "seconds"))
    rows: dict[str, dict[str, Any]] = {}
    for name in (*PRECISIONS, STORED):
        differences = [record["psnr"] - fast[record["seed"]] for record in records if record["precision"] == name]
        rows[name] = {**summary[name], "difference": (float(np.mean(differences)), standard_error(differences))}
    return rows


def _cells(name: str, row: Mapping[str, Any]) -> list[str]:
    mean, error = row["difference"]
    difference = f"{mean:+.3f}" + ("" if error is None else f" ± {error:.3f}")
    return [
        name,
        plus_minus(row["psnr"], 2),
        "" if name == FAST else difference,
        f"{row['ssim'][0]:.4f}",
        f"{row['n_gaussians'][0]:,.0f}",
        f"{row['megabytes'][0]:.2f}",
        "" if name == STORED else f"{row['seconds'][0]:.0f}",
    ]


def draw(rows: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw the PSNR with its deviation against the seconds, and against the bytes."""
    figure, panels = subplots((9, 3.2), 1, 2, sharey=True)
    measures: dict[str, tuple[str, Callable[[str], bool]]] = {
        "seconds": ("processor time (s)", lambda name: name != STORED),
        "megabytes": ("parameters (MB)", lambda name: True),
    }
    for axes, (key, (label, is_shown)) in zip(panels, measures.items(), strict=True):
        for name, row in rows.items():
            if not is_shown(name):
                continue
            color = RED if name == FAST else BLUE
            axes.errorbar(row[key][0], row["psnr"][0], yerr=row["psnr"][1], color=color, marker="o", capsize=4)
            axes.annotate(name, (row[key][0], row["psnr"][0]), (6, 4), textcoords="offset points", fontsize=8)
        axes.set(xlabel=label, xlim=(0, None))
        axes.margins(x=0.3)
    panels[0].set_ylabel("PSNR of the test views (dB)")
    return figure


CLAIMS = (
    declare(
        "precision",
        "float64, float32 exact and fast, colours in float16: what it takes",
        run,
        *RESUMED_SCENE,
        iterations(3000),
        recipe("mini-splatting2"),
        SEEDS,
        description="Train a scene in float64, in float32 with exact and with fast kernels, and with colours in"
        f" float16. {CONTINUES}",
    ),
)
