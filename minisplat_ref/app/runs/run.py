"""Run a training in its folder: progress, checkpoints, and everything that the folder holds in the end.

Nothing that has taken time is ever deleted. The first checkpoint is written before the first iteration; Ctrl-C,
SIGTERM, a full disk, a number that is not finite or an error of the program end the training with the last whole state
saved, or with the checkpoint of at most a minute ago where the state is half changed. ``metrics.json`` comes last: a
folder whose metrics are not of its checkpoint's iteration has not ended.
"""

import contextlib
import math
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.runs import checkpoints, curve, events, fingerprint, run_folder
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.outlook import Outlook, make_plan
from minisplat_ref.app.runs.progress import Clock, Progress
from minisplat_ref.app.runs.scoring import score, to_metrics
from minisplat_ref.app.runs.settings import save_model, to_config
from minisplat_ref.constants import PROFILES
from minisplat_ref.datasets.synthetic.surface import Surface, surface_distance, true_surface
from minisplat_ref.errors import InputError
from minisplat_ref.metrics import Evaluation, evaluate
from minisplat_ref.metrics.lpips import Network
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import get_backend
from minisplat_ref.training.guard import Guard
from minisplat_ref.training.interruption import Interruptions
from minisplat_ref.training.loop import last_step, train
from minisplat_ref.training.pace import COOLED, FINER, Decision, pace_to_json
from minisplat_ref.training.recipe_settings import match_calibrations
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import StepReport, TrainState, begin_cooling
from minisplat_ref.types import Model, Scene

Watch = Callable[[Path, Scene, Settings, Progress], Callable[[StepReport], None]]
"""Makes a callback of the training loop that shows a person how a run in a folder is doing; it pauses the progress."""

RECENT = 100  # iterations by which the time of the next ones is foreseen


class Outcome(NamedTuple):
    """How a training ended."""

    evaluation: Evaluation | None
    """Of the test views; None when Ctrl-C came before they were measured."""
    seconds: float
    """Time in the training loop, compilation and the earlier parts of a continued run included."""
    is_complete: bool
    """False when Ctrl-C ended it; everything has been saved then, too."""


class Training(NamedTuple):
    """A training with everything that it needs."""

    folder: Path
    """The run; exists, and no other process writes there."""
    scene: Scene
    """The loaded scene."""
    settings: Settings
    """Of the run; ``iterations`` is where to stop."""
    recipe: Recipe
    """The recipe of the settings, scaled to ``settings.schedule_iterations``."""
    state: TrainState
    """Where to start; changed in place."""
    network: Network | None = None
    """Of the settings, to measure LPIPS with: read before the training, so that nothing can be wrong with it after."""
    check_every: int = Guard().every
    """Iterations after which parameters and gradients are checked for numbers that are not finite."""
    watches: Sequence[Watch] = ()
    """What shows the training to a person while it runs, such as :func:`.preview.make_preview`."""

    def render_settings(self, model: Model) -> RenderSettings:
        """Return the settings with which a model of this training is rendered."""
        conventions, backend = PROFILES[self.settings.profile], get_backend(self.settings.backend)
        renderer = match_calibrations(self.recipe, model).renderer
        return RenderSettings(self.scene.background, conventions, backend, renderer)


def run_training(training: Training) -> Outcome:
    """Train to the end or to Ctrl-C, save and measure.

    Raises
    ------
    InputError
        A file cannot be written, memory has no room, or a number is not finite; the message names the saved iteration.
    """
    folder, scene, settings, recipe, state = training[:5]
    with saving_on_error(folder, recipe, state):
        run_folder.write_json(folder / run_folder.CONFIG, to_config(settings, recipe, scene))
        run_folder.write_json(folder / run_folder.CAMERAS, fingerprint.take_fingerprint(scene))
        begins = not checkpoints.read_step(folder)  # none, or the one of step 0, after which a run may be killed
        if begins:
            checkpoints.save(folder, state, recipe)
        surface = true_surface(Path(settings.scene), scene) if settings.eval_every else None
        total = settings.iterations if recipe.cooling is None else state.pace.last_step
        progress = Progress(folder / run_folder.LOG, state.step, total, _make_outlook(training))
        on_step = _make_callback(training, progress, surface, begins)
        with progress:
            with contextlib.suppress(KeyboardInterrupt):
                train(
                    scene,
                    recipe._replace(iterations=settings.iterations),
                    seed=settings.seed,
                    state=state,
                    on_step=on_step,
                    backend=get_backend(settings.backend),
                    conventions=PROFILES[settings.profile],
                    guard=Guard(training.check_every, settings.drop_bad_steps, folder, asdict(settings)),
                )
            clock = progress.clock
        evaluation = _measure(training, clock, surface) if _save(training) else None
        return Outcome(evaluation, clock.seconds, state.step >= last_step(state, recipe, settings.iterations))


def _make_outlook(training: Training) -> Outlook | None:
    """Return what estimates the rest of a training that decides its own length."""
    plan = make_plan(training.recipe, training.settings.iterations, len(training.scene.train_views))
    minutes = training.settings.minutes
    return None if plan is None else Outlook(plan, training.state, None if minutes is None else 60 * minutes)


@contextmanager
def saving_on_error(folder: Path, recipe: Recipe, state: TrainState) -> Iterator[None]:
    """Save the state if an error leaves it whole, and add to the error where the run can continue."""
    try:
        yield
    except Exception as error:
        if state.is_whole and checkpoints.read_step(folder) != state.step:
            with contextlib.suppress(InputError):  # a full disk, perhaps, which the error reports already
                checkpoints.save(folder, state, recipe)
        step = checkpoints.read_step(folder)
        saved = f"; iteration {step} is saved; to continue: minisplat-ref train --resume {folder}" if step else ""
        if isinstance(error, MemoryError):
            raise InputError(f"memory is full: train on smaller photographs (--downscale){saved}") from error
        if isinstance(error, InputError):
            raise InputError(f"{error}{saved}") from error
        error.add_note(f"minisplat-ref: stopped{saved}")
        raise


def _make_callback(
    training: Training, progress: Progress, surface: Surface | None, begins: bool
) -> Callable[[StepReport], None]:
    """Return the callback of the loop: records, measurements and checkpoints."""
    folder, scene, settings, recipe, state = training[:5]
    callbacks: list[Callable[[StepReport], None]] = [progress]
    if begins or (folder / run_folder.EVENTS).exists():  # else half a record would hide what fired before
        curve.keep_until(folder / run_folder.EVENTS, state.step)
        callbacks.append(_record_events(folder / run_folder.EVENTS))
    if settings.eval_every:
        curve.keep_until(folder / run_folder.CURVE, state.step)
        callbacks.append(_record_curve(training, progress, surface))
    callbacks.extend(watch(folder, scene, settings, progress) for watch in training.watches)
    if settings.minutes is not None:
        callbacks.append(_cool_within_minutes(settings, recipe, state, progress, len(scene.train_views)))
    callbacks.append(checkpoints.save_regularly(folder, recipe))  # after the records: what it continues from is in them

    def on_step(report: StepReport) -> None:
        for callback in callbacks:
            callback(report)

    return on_step


def _cool_within_minutes(
    settings: Settings, recipe: Recipe, state: TrainState, progress: Progress, n_views: int
) -> Callable[[StepReport], None]:
    """Return a callback of the loop that begins the cool-down in time to end after ``settings.minutes``.

    Halved views are left behind before that, because the cool-down shows the photographs as they are: when it would not
    end in time with iterations that take as many times longer as the photographs have more pixels. A pass of the prune
    over the training views is reckoned as an iteration for each.
    """
    cooling, minutes = recipe.cooling, settings.minutes
    assert cooling is not None and minutes is not None
    clock: deque[float] = deque(maxlen=RECENT)

    def on_step(report: StepReport) -> None:
        clock.append(progress.seconds)
        left = 60 * minutes - clock[-1]
        if state.pace.cooling_from is not None or len(clock) < 2:
            return
        length = math.ceil(cooling.part * report.step)
        pace = 4**report.n_halvings * (clock[-1] - clock[0]) / (len(clock) - 1)  # seconds an iteration, at full size
        left -= cooling.prune_passes * n_views * pace
        if left > length * pace:
            return
        why = f"--minutes {minutes:g} leaves no more time"
        if report.n_halvings:
            state.pace = state.pace.with_decision(Decision(report.step, FINER, why, None, None))
            clock.clear()  # of faster iterations
        else:
            length = max(1, min(length, round(left / pace)))
            begin_cooling(state, cooling, settings.iterations, Decision(report.step, COOLED, why, None, None), length)

    return on_step


def _save(training: Training) -> bool:
    """Save the state and the model; return whether there is something to measure, and time."""
    folder, _, settings, recipe, state = training[:5]
    if not state.is_whole or state.step == 0:  # Ctrl-C twice, or before anything was learned
        return False
    try:
        with Interruptions() as interruptions:
            interruptions.defer()
            checkpoints.save(folder, state, recipe)
            save_model(folder, settings, state.model, state.frame)
            if recipe.cooling is not None or state.pace.decisions:
                run_folder.write_json(folder / run_folder.DECISIONS, pace_to_json(state.pace))
    except KeyboardInterrupt:
        return False
    return True


def _measure(training: Training, clock: Clock, surface: Surface | None) -> Evaluation | None:
    """Measure the model, write the page and then the measures, the last that a run does.

    Returns None when Ctrl-C comes meanwhile.
    """
    from minisplat_ref.app.runs.run_report import write_report  # imports matplotlib: a training would wait for that

    folder, scene, settings, _, state = training[:5]
    peak_mb = peak_rss_mb()  # before the network of LPIPS takes more than the training did
    model = state.model
    n_gaussians = len(model.gaussians.means)
    try:
        evaluation = score(folder, scene.test_views, model, training.render_settings(model), training.network)
        if settings.eval_every:
            further = {"cpu_seconds": clock.cpu_seconds, **_measure_chamfer(model.gaussians, surface)}
            curve.append(folder / run_folder.CURVE, state.step, clock.seconds, evaluation, n_gaussians, **further)
        metrics = {
            "n_gaussians": n_gaussians,
            "iterations": state.step,
            "has_ended_early": state.pace.last_step == state.step,
            "train_seconds": clock.seconds,
            "train_cpu_seconds": clock.cpu_seconds,
            "peak_rss_mb": peak_mb,
            **to_metrics(evaluation),
        }
        write_report(folder, scene, metrics)
    except KeyboardInterrupt:
        return None
    run_folder.write_json(folder / run_folder.METRICS, metrics)
    return evaluation


def _record_events(path: Path) -> Callable[[StepReport], None]:
    """Return a callback of the loop that records what fired."""
    return lambda report: events.append(path, report.step, report.fired)


def _record_curve(training: Training, progress: Progress, surface: Surface | None) -> Callable[[StepReport], None]:
    """Return a callback of the loop that measures the test views on the way, off the training's clock."""
    path = training.folder / run_folder.CURVE

    def on_step(report: StepReport) -> None:
        if report.step % training.settings.eval_every or report.step == report.last_step:  # the end is measured anyway
            return
        (seconds, cpu_seconds), model = progress.clock, report.state.model
        with progress.paused():
            evaluation = evaluate(model, training.scene.test_views, training.render_settings(model))
            further = {"cpu_seconds": cpu_seconds, **_measure_chamfer(model.gaussians, surface)}
            curve.append(
                path,
                report.step,
                seconds,
                evaluation,
                len(model.gaussians.means),
                **further,
            )

    return on_step


def _measure_chamfer(gaussians: Any, surface: Surface | None) -> dict[str, float | None]:
    return {} if surface is None else {"chamfer": surface_distance(gaussians, surface)}


def peak_rss_mb() -> float | None:
    """Return the peak memory of this process, MB; None on systems that do not report it.

    On Linux ``getrusage`` inherits the peak of the parent process, so /proc is read there.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = (line.split() for line in status.read_text().splitlines())
        return next((int(words[1]) * 1.024e-3 for words in lines if words[0] == "VmHWM:"), None)  # it counts in KiB
    try:
        import resource  # absent on Windows
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)  # macOS counts bytes, the others kB
