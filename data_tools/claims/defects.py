"""Planted defects: whether ``adaptive`` finds them, and none where there are none.

The claim is ours. Photographs of a scene are disturbed in a known way, differently in every trial, and the scene is
trained until the iteration in which ``adaptive`` has decided about exposures (before the first one), a sky,
anti-aliasing and poses. A trial records what was switched on. Its seed is used for the disturbance and the training.

=========  ========================================================================================================
``clean``  the scene as it is; a real one may have other defects
``gains``  each photograph is multiplied by its own gain, from 0.9 to 1.1
``poses``  each camera is rotated about a random axis in its image plane, so that its image moves by half a pixel
``sizes``  each photograph has the half width and height, or not, by chance
``sky``    what is higher than 1.2 m becomes sky: two random colours, from the horizon to the zenith (synthetic scenes)
=========  ========================================================================================================
"""

import argparse
import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import CONTINUES, NAMES, RESUMED_SCENE, argument, declare, number
from data_tools.claims.kit.figures import group, subplots
from data_tools.claims.pose import move
from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import BLUE, GREEN, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io.scene import half_size
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.methods.adaptive.switches import SWITCHES
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import firing_steps
from minisplat_ref.training.sky import unit_rays
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Bools, Floats, Scene, View

LARGEST_GAIN = 0.1
PIXELS = 0.5
COLORS = {"sky": GREEN, "exposure": BLUE, "pose": RED, "antialiasing": OCHRE}
"""By the name of each calibration that can be asked about."""
HEIGHT = 0.2  # of a bar
CUT = 1.2  # metres


def with_gains(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with every training photograph multiplied by its own gain."""
    return multiply(scene, rng.uniform(1 - LARGEST_GAIN, 1 + LARGEST_GAIN, len(scene.train_views)))


def multiply(scene: Scene, gains: Floats) -> Scene:
    """Return the scene with its training photographs multiplied by ``gains`` [V]; test photographs stay."""
    views = []
    for view, gain in zip(scene.train_views, gains, strict=True):
        view = view.load()
        views.append(view._replace(image=np.clip(np.round(gain * view.image), 0, 255).astype(np.uint8)))
    return scene._replace(train_views=tuple(views))


def with_rotated_cameras(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with every training camera rotated so that the middle of its image moves by half a pixel."""
    views = []
    for view, angle in zip(scene.train_views, rng.uniform(0, 2 * np.pi, len(scene.train_views)), strict=True):
        w = PIXELS * np.array([np.sin(angle) / view.camera.fy, np.cos(angle) / view.camera.fx, 0.0])
        views.append(view._replace(camera=move(view.camera, w, np.zeros(3))))
    return scene._replace(train_views=tuple(views))


def halve(scene: Scene, is_halved: Bools) -> Scene:
    """Return the scene with the training photographs ``is_halved`` [V] at half the width and height."""
    views = (half_size(view) if small else view for view, small in zip(scene.train_views, is_halved, strict=True))
    return scene._replace(train_views=tuple(views))


def _places(scene: Scene) -> Floats:
    """Return width and position [V, 4] of the training cameras."""
    return np.array([[view.camera.width, *view.camera.cam_from_world_t] for view in scene.train_views])


def under_a_sky(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return a synthetic scene cut off at a height of 1.2 m, under a sky whose two colours are drawn at random.

    Photographs show the sky where there was none, or something above the cut; the points above the cut go.

    Raises
    ------
    InputError
        The scene is not synthetic: the height of its pixels is unknown.
    """
    truth = make_scene(scene.name) if scene.name in SCENE_NAMES else None
    if truth is None or not np.array_equal(_places(truth.scene), _places(scene)):
        raise InputError(f"condition sky cuts off a synthetic scene: give the name of one, {', '.join(SCENE_NAMES)}")
    horizon, zenith = rng.uniform(0.2, 1.0, (2, 3))

    def cut_off(view: View, depth: Floats) -> View:
        camera = view.camera
        rays = unit_rays(camera, np.arange(camera.width * camera.height), np.dtype(float))  # [P, 3] camera frame
        up = rays @ camera.cam_from_world_R[:, 2]  # [P]
        heights = camera.center[2] + depth.ravel() / rays[:, 2] * up  # metres
        is_sky = (depth.ravel() == 0) | (heights > CUT)
        sky = np.round(255.0 * (horizon + np.sqrt(np.maximum(up, 0.0))[:, None] * (zenith - horizon)))
        image = np.where(is_sky[:, None], sky, view.image.reshape(-1, 3)).astype(np.uint8)
        return view._replace(image=image.reshape(view.image.shape), point_ids=None)

    below = scene.points[:, 2] <= CUT
    return scene._replace(
        train_views=tuple(map(cut_off, scene.train_views, truth.train_depths)),
        test_views=tuple(map(cut_off, scene.test_views, truth.test_depths)),
        points=scene.points[below],
        point_colors=scene.point_colors[below],
    )


CONDITIONS: Mapping[str, Callable[[Scene, np.random.Generator], Scene]] = {
    "clean": lambda scene, rng: scene,
    "gains": with_gains,
    "poses": with_rotated_cameras,
    "sizes": lambda scene, rng: halve(scene, rng.random(len(scene.train_views)) < 0.5),
    "sky": under_a_sky,
}


class _DecidedError(Exception):
    """Ends a training once it has decided."""


def run(args: argparse.Namespace) -> kit.Report:
    """Train until the decisions, and count them.

    Raises
    ------
    InputError
        The scene or the output folder cannot be used, or a name is unknown.
    """
    unknown = [name for name in args.conditions if name not in CONDITIONS]
    if unknown:
        raise InputError(f"condition {unknown[0]!r} does not exist: choose from {', '.join(CONDITIONS)}")
    unasked = [name for name in args.asked if name not in COLORS]
    if unasked:
        raise InputError(f"{unasked[0]!r} is nothing that adaptive switches on: choose from {', '.join(COLORS)}")
    scene = kit.read_scene(args.scene, args.downscale, is_tested=False)
    description = kit.describe_scene(scene)
    settings = {"scene": description["scene"], "downscale": args.downscale, "asked": list(args.asked)}
    names = args.conditions or [name for name in CONDITIONS if name != "sky" or not Path(args.scene).exists()]

    def measure(seed: int, condition: str) -> dict[str, Any]:
        return decide(CONDITIONS[condition](scene, np.random.default_rng(seed)), seed, args.asked)

    jobs = kit.jobs_of(seed=range(args.trials), condition=names)
    records = kit.resume(args.out, settings, jobs, measure)
    summary = summarise(records, args.asked)
    result = {**description, **settings, "trials": args.trials, "summary": summary, "runs": records}
    heading = ["photographs", "trials", *(f"{name} switched on" for name in args.asked)]
    n = decision_step(args.asked)
    text = f"{kit.title(description)}\nafter {n} iteration{'s'[: n > 1]} of adaptive\n\n"
    return kit.Report(result, draw(summary, args.asked), text + markdown_table(heading, to_rows(summary)))


def decision_step(asked: Sequence[str]) -> int:
    """Return the iteration after which it has been decided about all that is asked; exposures do not need one."""
    return max([1, *firing_steps(ADAPTIVE, *(SWITCHES[name] for name in asked if name in SWITCHES))])


def decide(scene: Scene, seed: int, asked: Sequence[str]) -> dict[str, Any]:
    """Train until the decisions; return what was switched on, with its evidence, and the seconds of the processor."""
    last, notes = decision_step(asked), {}
    switched_on: tuple[str, ...] = ()
    start = time.process_time()

    def on_step(report: StepReport) -> None:
        nonlocal switched_on
        notes.update({fired.action: fired.note for fired in report.fired if "switch" in fired.action})
        notes.update({first.what: first.why for first in report.state.pace.decisions if first.step == 0})
        switched_on = report.state.pace.switched_on
        if report.step == last:
            raise _DecidedError

    with contextlib.suppress(_DecidedError):
        train(scene, ADAPTIVE, seed=seed, on_step=on_step)
    return {"switched_on": list(switched_on), "evidence": notes, "seconds": time.process_time() - start}


def summarise(records: Sequence[Mapping[str, Any]], asked: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return for each condition the number of trials, and of those that switched on what is asked."""
    trials = dict.fromkeys(CONDITIONS, ()) | group(records, "condition")
    return {
        name: {"trials": len(own), **{what: sum(what in record["switched_on"] for record in own) for what in asked}}
        for name, own in trials.items()
    }


def to_rows(summary: Mapping[str, Mapping[str, int]]) -> list[list[str]]:
    """Return the lines of the table."""
    return [[name, *map(str, row.values())] for name, row in summary.items() if row["trials"]]


def draw(summary: Mapping[str, Mapping[str, int]], asked: Sequence[str]) -> Figure:
    """Draw the part of the trials that switched on what is asked."""
    summary = {name: row for name, row in summary.items() if row["trials"]}
    figure, axes = subplots((7, 2.6))
    for k, what in enumerate(asked):
        shares = [100 * row[what] / row["trials"] for row in summary.values()]
        places = np.arange(len(summary)) + HEIGHT * (k - 0.5 * (len(asked) - 1))
        axes.barh(places, shares, HEIGHT, color=COLORS[what], label=what)
    axes.set(xlim=(0, 100), xlabel="trials in which it is switched on (%)", yticks=range(len(summary)))
    axes.set_yticklabels(summary)
    axes.invert_yaxis()
    axes.legend()
    axes.grid(visible=False, axis="y")
    return figure


CLAIMS = (
    declare(
        "defects",
        "planted defects of photographs: found where they are, nowhere else",
        run,
        *RESUMED_SCENE,
        argument(
            "--conditions",
            type=NAMES,
            default=(),
            metavar="C,D",
            help="clean, gains, poses, sizes, sky (default: all, sky of synthetic scenes alone)",
        ),
        argument(
            "--asked",
            type=NAMES,
            default=tuple(COLORS),
            metavar="A,B",
            help="train until it is decided about these alone (default: all: sky,exposure,pose,antialiasing)",
        ),
        number("--trials", 10, "of each kind"),
        description=f"Disturb photographs of a scene in known ways, and count what adaptive switches on. {CONTINUES}",
    ),
)
