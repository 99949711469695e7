"""Parts of the measurement of a claim: a scene, trainings by seed, records that resume, the report that is written.

A claim's module measures, draws and returns a :class:`Report`; :func:`carry_out` gives figures their style, and writes
and prints the report. Trainings take long: with :func:`.records.resume` a claim stores the record of each as soon as it
ends, and continues with the missing ones when it is called again with the same folder.

Means over seeds, bars and curves are in :mod:`.figures`, tables of records in :mod:`.tables`. None of these modules
loads Numba or matplotlib by itself, so that commands can use them.
"""

import argparse
import contextlib
import json
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from data_tools.claims.kit.claim import FIGURE, RESULT
from data_tools.claims.kit.figures import STYLE, group
from data_tools.claims.kit.records import jobs_of as jobs_of
from data_tools.claims.kit.records import resume as resume
from data_tools.claims.kit.records import resume_all as resume_all
from minisplat_ref.datasets.named_scenes import read_scene as read_scene
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import PNG_DPI
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.interface.progress import with_progress as with_progress  # which claims take from here
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.io import load_ply, viewpoints
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.mechanisms.sampling import block_means
from minisplat_ref.training.fine_tuning import drop_events as drop_events
from minisplat_ref.training.fine_tuning import fine_tune as fine_tune
from minisplat_ref.training.representation import count_floats as count_floats
from minisplat_ref.types import NOTHING, Camera, Floats, Gaussians, Scene, View

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from minisplat_ref.training.schedule import Recipe
    from minisplat_ref.training.state import TrainState

REMEDY = "give more iterations, larger photographs or another scene, with which it acts"


class Report(NamedTuple):
    """What has been measured."""

    result: Mapping[str, Any]
    """For ``result.json``."""
    figure: "Figure"
    text: str
    """For the terminal: tables in Markdown, with a line about each."""
    arms: Mapping[str, Any] = NOTHING
    """What was measured with each choice, by its name. Two that agree in every digit are refused
    (:func:`refuse_idle`); empty where no choices are compared, or where equal outcomes are a result."""


def carry_out(measure: Callable[[argparse.Namespace], Any], args: argparse.Namespace, *, is_resumed: bool) -> None:
    """Measure, write the report to ``--out``, and print it.

    Parameters
    ----------
    measure : callable
        Returns a :class:`Report`, or only its text if there is no ``--out``.
    args : Namespace
    is_resumed : bool
        The folder may be there, with the records of an earlier call; otherwise it is new, and not there if the
        measurement fails.

    Raises
    ------
    InputError
        What is compared did not act; see :func:`refuse_idle`.
    """
    if "out" not in args:
        print(measure(args))
        return
    from matplotlib import rc_context

    with rc_context(STYLE), contextlib.nullcontext(args.out) if is_resumed else making_folder(args.out) as folder:
        report = measure(args)
        refuse_idle(report.arms)
        (folder / RESULT).write_text(json.dumps(report.result, indent=2) + "\n", encoding="utf-8")
        report.figure.savefig(folder / FIGURE, dpi=PNG_DPI, facecolor="white")
    print(report.text)


def find_idle(arms: Mapping[str, Any]) -> dict[str, str]:
    """Return the arms that measure exactly what one before does, with its name: what distinguishes them did not act.

    Parameters
    ----------
    arms : mapping
        What was measured by name, as lists, mappings and numbers; seconds are not compared. Trainings that differ in
        anything never agree in every digit.
    """
    firsts: dict[str, str] = {}
    idle = {}
    for name, arm in arms.items():
        first = firsts.setdefault(json.dumps(_without_seconds(arm), sort_keys=True, default=float), name)
        if first != name:
            idle[name] = first
    return idle


def _without_seconds(measured: Any) -> Any:
    if isinstance(measured, Mapping):
        return {str(key): _without_seconds(value) for key, value in measured.items() if key != "seconds"}
    if isinstance(measured, list | tuple | np.ndarray):
        return [_without_seconds(value) for value in measured]
    return measured


def refuse_idle(arms: Mapping[str, Any]) -> None:
    """Refuse to report a comparison in which an arm is another one again.

    Raises
    ------
    InputError
        :func:`find_idle` finds one.
    """
    if idle := find_idle(arms):
        raise InputError(f"{_in_words(idle)}; {REMEDY}")


def leave_out_idle(arms: Mapping[str, Any]) -> tuple[list[str], str]:
    """Return the names of the arms without those that did not act, and a paragraph about these; empty if all acted.

    Raises
    ------
    InputError
        None but the first acted.
    """
    idle = find_idle(arms)
    if idle and len(idle) == len(arms) - 1:
        refuse_idle(arms)
    return [name for name in arms if name not in idle], f"\n\n{_in_words(idle)}" if idle else ""


def _in_words(idle: Mapping[str, str]) -> str:
    pairs = ", ".join(f"{name!r} measured exactly what {first!r} did" for name, first in idle.items())
    return f"{pairs}: what distinguishes them did not act, and nothing can be said of it"


def arms_of(records: Iterable[Mapping[str, Any]], key: str, measures: Sequence[str]) -> dict[str, Any]:
    """Return for each value of ``key`` the measures of its records, in their order."""
    return {
        arm: [[record[measure] for measure in measures] for record in own] for arm, own in group(records, key).items()
    }


def measure_arms(arms: Collection[str], n_seeds: int, measure: Callable[[str, int], Any]) -> list[dict[str, Any]]:
    """Return the records of all arms with all seeds from 0 on; ``measure`` gets the arm's name and the seed."""
    return [
        {"arm": arm, "seed": seed, **measure(arm, seed)}
        for arm in with_progress(arms, "arms")
        for seed in range(n_seeds)
    ]


def settings_of(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return arguments by their names, for the result."""
    return {name: getattr(args, name) for name in names}


def seeds_of(args: argparse.Namespace) -> str:
    """Return the seeds of a claim that names each of them."""
    return f"seeds {', '.join(map(str, args.seeds))}"


# Scenes and trainings


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Return what results depend on besides the method: photographs, their size, points, machine."""
    camera = scene.train_views[0].camera
    return {
        "scene": scene.name,
        "size": [camera.width, camera.height],
        "train_views": len(scene.train_views),
        "test_views": len(scene.test_views),
        "points": len(scene.points),
        "machine": describe_machine(),
    }


def title(description: Mapping[str, Any]) -> str:
    """Return the description in one line."""
    width, height = description["size"]
    return (
        f"{description['scene']}, {description['train_views']} training views of {width} x {height}; "
        f"{description['machine']}"
    )


def describe_trainings(args: argparse.Namespace, scene: Scene) -> dict[str, Any]:
    """Return the scene, and where the :func:`populations` come from."""
    origin = {"ply": str(args.ply)} if args.ply else settings_of(args, "recipe", "iterations")
    return {**describe_scene(scene), **origin, "seeds": 1 if args.ply else args.seeds}


def populations(args: argparse.Namespace, scene: Scene) -> list[Gaussians]:
    """Return the given Gaussians, or those of one training per seed.

    Raises
    ------
    InputError
        There is no such recipe, or the PLY cannot be read.
    """
    from minisplat_ref.methods import get_recipe

    if args.ply is not None:
        return [load_ply(args.ply)]
    recipe = get_recipe(args.recipe, args.iterations)
    return [train_with_progress(scene, recipe, seed).gaussians for seed in range(args.seeds)]


def train_with_progress(scene: Scene, recipe: "Recipe", seed: int, **arguments: Any) -> "TrainState":
    """Train with a progress bar; other arguments as for :func:`~minisplat_ref.training.loop.train`."""
    from minisplat_ref.training.loop import train

    with progress_bar(f"{recipe.name}, seed {seed}", "iterations", recipe.iterations) as bar:
        return train(scene, recipe, seed=seed, on_step=lambda _: bar.update(), **arguments)


def read_run(ply: Path) -> tuple[Gaussians, Camera]:
    """Read the Gaussians of a run, and its first test camera.

    Raises
    ------
    InputError
        The PLY or the cameras beside it cannot be used.
    """
    gaussians = load_ply(ply)
    cameras = [view.camera for view in viewpoints.read(ply.parent / "cameras.json") if view.split == "test"]
    if not cameras or not len(gaussians.means):
        raise InputError(f"{ply} has no Gaussians, or its cameras.json no test views: give the PLY of a run")
    return gaussians, cameras[0]


# Measurements


def psnr_of(image: Floats, target: Floats) -> float:
    """Return the PSNR of an image clipped to [0, 1], dB."""
    return float(-10 * np.log10(np.mean((np.clip(image, 0, 1).astype(np.float64) - target) ** 2)))


def photograph_at(view: View, n: int) -> Floats:
    """Return a photograph at 1/n of its size, [H / n, W / n, 3] in [0, 1]: the means of its blocks of n x n pixels."""
    return block_means(view.load().image.astype(np.float64) / 255, n)


def angles(found: Floats, truth: Floats) -> Floats:
    """Return the angle in degrees between each direction found and the true one, [...].

    Parameters
    ----------
    found : (..., 3) array
        Of any length; 90 degrees where it is 0.
    truth : (..., 3) array
        Of unit length.
    """
    cosines = np.sum(found * truth, axis=-1) / np.maximum(np.linalg.norm(found, axis=-1), 1e-12)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def min_seconds(function: Callable[[], Any], repeats: int) -> float:
    """Return the least processor time of a call, summed over all threads, seconds."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)
