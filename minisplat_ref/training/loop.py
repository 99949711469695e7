"""The training loop: one photograph, one gradient step, and whatever the recipe says is due.

Order inside an iteration: render, loss, gradients, Adam, then the events that are due. 3DGS runs its density control
*before* Adam, and because it replaces the parameter tensors, that iteration's step is silently lost (likewise in
Mini-Splatting; gsplat steps first, as here). Here no step is lost, the last iteration's included.

While a recipe warms up on views of half the size, they are the scene's views to everything in the loop. A culling table
of Mini-Splatting2, if an event has made one, says which Gaussians take part in a view.

Left out: exposure compensation.
"""

import json
import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from minisplat_ref.backends import CPU, Backend
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.io.checkpoint import load_checkpoint, save_checkpoint
from minisplat_ref.io.scene import half_size
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.training.adam import AdamState, adam_step, zero_moments
from minisplat_ref.training.rates import active_sh_degree
from minisplat_ref.training.schedule import During, Recipe, describe
from minisplat_ref.training.state import Iteration, StepReport, TrainState
from minisplat_ref.types import Gaussians, Scene

LEAST_HALF_SIZE = 100  # pixels a side

__all__ = ["StepReport", "TrainState", "initial_state", "load_state", "save_state", "train"]


def initial_state(scene: Scene, recipe: Recipe, seed: int) -> TrainState:
    """Return the state before the first iteration.

    Raises
    ------
    InputError
        The scene has no training views, or fewer than the recipe needs.
    """
    n_views = len(scene.train_views)
    if n_views == 0:
        raise InputError(f"scene {scene.name} has no training views: lower the share of test views or add photographs")
    if n_views < recipe.least_views:
        raise InputError(
            f"scene {scene.name} has {n_views} training views, recipe {recipe.name} compares what at least"
            f" {recipe.least_views} see: add photographs or use 3dgs-accel"
        )
    rng = np.random.default_rng(seed)
    gaussians = initial_gaussians(scene, recipe.sh_degree, rng)
    return TrainState(gaussians, zero_moments(gaussians), step=0, view_order=[], rng=rng, stats={})


def train(
    scene: Scene,
    recipe: Recipe,
    *,
    seed: int,
    state: TrainState | None = None,
    on_step: Callable[[StepReport], None] | None = None,
    backend: Backend = CPU,
    conventions: Conventions = GSPLAT_MAIN,
) -> TrainState:
    """Train until ``recipe.iterations``.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    seed : int
        Seed of the whole run; without effect when ``state`` is given, which carries its generator.
    state : TrainState, optional
        Where to start or continue, changed in place and returned; default ``initial_state(scene, recipe, seed)``.
    on_step : callable, optional
        Called with a :class:`StepReport` after every iteration.
    backend : Backend
    conventions : Conventions

    Returns
    -------
    state : TrainState
        The same seed gives the same bytes, and so does a state that was saved, loaded and continued, once the kernels
        are in the cache: a process that compiles them itself can differ in the last digit.

    Raises
    ------
    InputError
        The scene has no training views, is not the one that ``state`` was trained on, or lacks what a loss term needs.
    KeyboardInterrupt
        After Ctrl-C, at the end of the running iteration: the ``state`` that was passed in is whole and can be saved.
    """
    state = initial_state(scene, recipe, seed) if state is None else state
    if recipe.geometry.sfm_depth and any(view.point_ids is None for view in scene.train_views):
        raise InputError(
            f"scene {scene.name} does not say which view sees which point, as COLMAP scenes do: leave the points' depth"
            " out of the loss"
        )
    if max(state.view_order, default=0) >= len(scene.train_views):
        raise InputError(f"scene {scene.name} has fewer training views than the run to continue: give the same scene")
    small_scene = _half_size(scene) if state.step < recipe.half_size_until else scene
    with _interrupts_held_back() as raise_if_interrupted:
        while state.step < recipe.iterations:
            seen = small_scene if state.step < recipe.half_size_until else scene
            report = _iterate(state, seen, recipe, backend, conventions)
            if on_step is not None:
                on_step(report)
            del report  # and with it the image, before the next is made
            raise_if_interrupted()
    return state


def _iterate(state: TrainState, scene: Scene, recipe: Recipe, backend: Backend, conventions: Conventions) -> StepReport:
    step = state.step + 1
    view_id = _next_view(state, len(scene.train_views))
    view = scene.train_views[view_id]
    due = [event for event in recipe.events if event.is_due(step)]
    stored_degree = math.isqrt(state.gaussians.sh_rest.shape[1] + 1) - 1
    background = state.rng.random(3) if recipe.has_random_background else scene.background
    output, tape = render(
        state.gaussians,
        view.camera,
        background=background.astype(np.float32),
        sh_degree=active_sh_degree(step, recipe.sh_milestones, stored_degree),
        conventions=conventions,
        backend=backend,
        is_visible=state.stats["is_visible"][:, view_id] if "is_visible" in state.stats else None,
        with_depth=any(recipe.geometry),
        with_stats=any(isinstance(event, During) and event.needs_blend_stats for event in due),
    )
    image = np.ascontiguousarray(output.image[..., :3])
    loss, loss_tape = backend.photometric_loss(image, view.image, recipe.dssim_weight, view.mask)
    v_image, v_alpha = backend.photometric_loss_vjp(loss_tape), None
    if any(recipe.geometry):
        points = scene.points[view.point_ids] if view.point_ids is not None else scene.points[:0]
        target = view.image * np.float32(1 / 255)  # [H, W, 3]
        term, term_tape = backend.geometric_loss(
            output.image[..., 3], output.alpha, target, view.camera, points, recipe.geometry, view.mask
        )
        v_depth, v_alpha = backend.geometric_loss_vjp(term_tape)
        del term_tape
        loss, v_image = loss + term, np.dstack([v_image, v_depth])
        output = output._replace(image=image)
    gradient = render_vjp(tape, v_image, v_alpha)

    visible_ids = np.flatnonzero(tape.projection.radii[:, 0] > 0)
    rates = recipe.learning_rates.at(step, scene.extent)
    state.adam = adam_step(state.gaussians, gradient.gaussians, state.adam, rates, recipe.adam, visible_ids, backend)
    iteration = Iteration(scene, view, output, visible_ids, gradient.means2d, backend, conventions)
    for event in due:
        event.action(state, iteration)
    state.step = step
    return StepReport(step, loss, view, output, state)


def _next_view(state: TrainState, n_views: int) -> int:
    """Draw without replacement; when all views have been seen, shuffle them anew."""
    if not state.view_order:
        state.view_order = state.rng.permutation(n_views).tolist()
    return state.view_order.pop()


def _half_size(scene: Scene) -> Scene:
    """Halve the training views, unless they are so small that no structure would be left in them."""
    sizes = [min(view.camera.width, view.camera.height) for view in scene.train_views]
    if min(sizes) < 2 * LEAST_HALF_SIZE:
        return scene
    return scene._replace(train_views=tuple(half_size(view) for view in scene.train_views))


@contextmanager
def _interrupts_held_back() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the yielded function is called: half an Adam step must not be saved."""
    is_interrupted = False

    def note(signal_number: int, frame: FrameType | None) -> None:
        nonlocal is_interrupted
        is_interrupted = True

    def raise_if_interrupted() -> None:
        if is_interrupted:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # where Python delivers no signals
        yield raise_if_interrupted
        return
    previous = signal.signal(signal.SIGINT, note)
    try:
        yield raise_if_interrupted
    finally:
        signal.signal(signal.SIGINT, previous)


def save_state(path: str | Path, state: TrainState, recipe: Recipe) -> None:
    """Write a checkpoint from which :func:`load_state` continues bit by bit."""
    groups = {"gaussians": state.gaussians, "first": state.adam.first, "second": state.adam.second}
    arrays = {f"{group}.{name}": field for group, fields in groups.items() for name, field in fields._asdict().items()}
    arrays |= {f"stats.{name}": field for name, field in state.stats.items()}
    metadata = {
        "step": state.step,
        "adam_step": state.adam.step,
        "view_order": state.view_order,
        "rng": state.rng.bit_generator.state,
        "recipe": describe(recipe),
    }
    save_checkpoint(path, arrays, metadata)


def load_state(path: str | Path, recipe: Recipe) -> TrainState:
    """Read what :func:`save_state` wrote.

    Raises
    ------
    InputError
        The file is missing or damaged, or was written under another recipe.
    """
    arrays, metadata = load_checkpoint(path)
    if metadata["recipe"] != json.loads(json.dumps(describe(recipe))):
        was = metadata["recipe"]
        raise InputError(
            f"{path} was written by recipe {was['name']} of {was['iterations']} iterations with other settings than "
            f"{recipe.name} of {recipe.iterations} iterations: continue with the recipe of the run"
        )
    rng = np.random.default_rng()
    rng.bit_generator.state = metadata["rng"]

    def population(group: str) -> Gaussians:
        return Gaussians(*(arrays[f"{group}.{name}"] for name in Gaussians._fields))

    stats: dict[str, Any] = {name.removeprefix("stats."): a for name, a in arrays.items() if name.startswith("stats.")}
    adam = AdamState(population("first"), population("second"), metadata["adam_step"])
    return TrainState(population("gaussians"), adam, metadata["step"], metadata["view_order"], rng, stats)
