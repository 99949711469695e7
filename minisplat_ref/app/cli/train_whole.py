"""``train`` of a whole scene: begun, continued, and its results printed."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.errors import InputError

if TYPE_CHECKING:
    from minisplat_ref.app.cli.train import TrainOptions
    from minisplat_ref.app.runs.options import Settings
    from minisplat_ref.app.runs.run import Training, Watch
    from minisplat_ref.app.runs.simplification import Target
    from minisplat_ref.training.state import TrainState

SIMPLIFIED = "simplified"  # the run inside of a run that --max-drop and --max-bytes leave


def begin(folder: Path, settings: "Settings", options: "TrainOptions") -> int:
    """Begin a training in a new folder; return the exit code."""
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.first_use import compile_kernels
    from minisplat_ref.app.runs.notices import report_inventory, warn_of_scene
    from minisplat_ref.app.runs.preparation import check_memory, check_simplification, prepare
    from minisplat_ref.app.runs.proposed_size import propose

    run_folder.check_free(folder)
    training = prepare(folder, settings)
    check_simplification(training)
    memory_note = check_memory(training)
    compile_kernels(settings.backend)
    run_folder.create(folder)
    scene, state = training.scene, training.state
    warn_of_scene(scene, is_dense=training.recipe.starts_densely)
    if settings.block is None:  # else the training of the whole has reported it
        report_inventory(Path(settings.scene), scene, settings.model)
    if "downscale" not in options.given:
        proposal = propose(scene, state.model, training.render_settings(state.model), settings.downscale)
        if proposal is not None:
            print(f"minisplat-ref: {proposal}", file=sys.stderr)
    with run_folder.hold_folder(folder):
        run_folder.check_free(folder)  # another process may have trained there meanwhile
        try:
            return complete(training, options, memory_note)
        except InputError:
            if state.step == 0:
                run_folder.remove(folder)
            raise


def resume(folder: Path, options: "TrainOptions") -> int:
    """Continue the training in a folder; return the exit code."""
    from minisplat_ref.app.runs import checkpoints, run_folder
    from minisplat_ref.app.runs.first_use import compile_kernels
    from minisplat_ref.app.runs.preparation import check_memory, prepare_continued
    from minisplat_ref.app.runs.settings import load

    saved = load(folder)  # before the folder is held, which has to exist
    with run_folder.hold_folder(folder):
        settings = options.continued_settings(saved)
        state = checkpoints.load(folder, settings) if run_folder.has_begun(folder) else None
        if state is not None:
            _check_unfinished(folder, state, settings.iterations)
        training = prepare_continued(folder, settings, state)
        memory_note = check_memory(training)
        compile_kernels(settings.backend)
        print(_describe_schedule(training.state.step, settings, is_rescaled=options.rescale))
        return complete(training, options, memory_note)


def _check_unfinished(folder: Path, state: "TrainState", iterations: int) -> None:
    """Refuse to continue a run that has nothing left to do."""
    from minisplat_ref.app.runs.run_folder import is_finished

    if state.pace.last_step == state.step and is_finished(folder, state.step):
        raise InputError(
            f"{folder} has ended after {state.step} iterations, of which the last had falling rates: train again"
        )
    if state.step > iterations or (state.step == iterations and is_finished(folder, state.step)):
        raise InputError(
            f"{folder} has done {state.step} iterations: give --iterations above {state.step} to train further"
        )


def _describe_schedule(step: int, settings: "Settings", is_rescaled: bool) -> str:
    """Return a line about the schedule by which a run continues."""
    if step >= settings.iterations:
        return f"all {step} iterations are done: measuring"
    length = settings.schedule_iterations
    how = f"going on from iteration {step} to {settings.iterations} by the schedule of {length}"
    if is_rescaled:
        return f"{how}, to which it has been stretched: what was done before stays"
    if step >= length:
        return f"{how}, which is over: rates stay at their last; --rescale would stretch it"
    return how


def complete(training: "Training", options: "TrainOptions", memory_note: str = "") -> int:
    """Train to the end, print the results, and simplify them on request; return the exit code."""
    from minisplat_ref.app.runs import checkpoints, run_folder
    from minisplat_ref.app.runs.model_file import describe_parts, missing_parts
    from minisplat_ref.app.runs.next_steps import ways_to_look
    from minisplat_ref.app.runs.notices import describe_place, describe_sizes
    from minisplat_ref.app.runs.preparation import simplification_target
    from minisplat_ref.app.runs.run import run_training
    from minisplat_ref.app.runs.scoring import summary

    folder, scene, settings, _, state = training[:5]
    views = (*scene.train_views, *scene.test_views)
    print(
        f"{scene.name}: {len(scene.train_views)} training and {len(scene.test_views)} test views of"
        f" {describe_sizes([(view.camera.width, view.camera.height) for view in views])}, {len(scene.points):,} points"
    )
    if place := describe_place(scene):
        print(place)
    if memory_note:
        print(memory_note)
    training = training._replace(watches=_make_watches(options))
    if options.check_every is not None:
        training = training._replace(check_every=options.check_every)
    outcome = run_training(training)
    if outcome.evaluation is None or not outcome.is_complete:
        if state.is_whole:
            measured = "" if outcome.evaluation else " but not measured"
            how = f"stopped after {state.step} of {settings.iterations} iterations, all saved{measured}"
        else:
            how = f"stopped in the middle of iteration {state.step + 1}, saved is {checkpoints.read_step(folder)}"
        print(f"minisplat-ref: {how}; to continue: minisplat-ref train --resume {folder}", file=sys.stderr)
        return 130
    print(
        f"{summary(outcome.evaluation)}, {len(state.gaussians.means):,} Gaussians, {outcome.seconds:.0f} s of training"
    )
    print(f"results in {folder}: point_cloud.ply (SuperSplat opens it, too), metrics.json, renders/")
    if parts := missing_parts(state.shared):
        print(
            f"point_cloud.ply does not hold {describe_parts(parts)}, which other programs therefore leave out;"
            f" minisplat-ref render {folder} has all"
        )
    for step in ways_to_look(folder, state.gaussians._fields):
        print(f"{step.purpose.lower()}: {step.line}")
    print(f"how good it is, and what to try next: open {(folder / run_folder.REPORT).resolve()}")
    target = simplification_target(settings)
    return 0 if target is None else _simplify(folder, target)


def _make_watches(options: "TrainOptions") -> "list[Watch]":
    """Return what shows the training to a person; print where."""
    from minisplat_ref.app.runs.preview import make_preview

    watches: list[Watch] = [make_preview] if options.preview else []
    if options.server is not None:
        from minisplat_ref.app.viewer.browser import address
        from minisplat_ref.app.viewer.live import make_live_view

        print(f"open {address(options.server)} in a browser to watch")
        watches.append(make_live_view(options.server))
    return watches


def _simplify(folder: Path, target: "Target") -> int:
    """Make the finished run smaller; return the exit code."""
    from minisplat_ref.app.cli.simplify import FINE_TUNE, simplify
    from minisplat_ref.app.runs.simplified_run import SimplifyOptions

    out = folder / SIMPLIFIED
    if out.exists():
        command = f"minisplat-ref simplify {folder} --out NEW {target}"
        print(f"minisplat-ref: {out} is of an earlier end of the run; for a new one: {command}", file=sys.stderr)
        return 0
    try:
        simplify(SimplifyOptions(folder, out, target, FINE_TUNE))
    except KeyboardInterrupt:
        command = f"minisplat-ref simplify {folder} --out {out} {target}"
        print(f"minisplat-ref: trained, but not simplified; to do so: {command}", file=sys.stderr)
        return 130
    return 0
