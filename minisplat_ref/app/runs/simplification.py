"""``simplify``: a finished run made smaller, and the loss of quality, measured on views that take no part.

A size is reached by merging near neighbours, those of small blend weight first
(:func:`minisplat_ref.strategy.simplify.merge_neighbours`), and is then fine-tuned. The population of an extension,
whose further fields may have no mean, keeps its Gaussians of the largest blend weight instead. Either way the weight is
summed over pixels and views (equation 12 of Mini-Splatting).

The loss of a size is measured by cross-validation: the *training* views are divided into folds
(:attr:`.opened_run.Run.folds`), and the views of each fold measure a copy that was fine-tuned without them. So
every training view counts, and the standard error is as small as the photographs allow. The model that is delivered
begins with the same Gaussians, and is fine-tuned in the same way by all training views. (Weights depend on the cameras
only, not on the photographs.) The test views stay sealed until then.

Fine-tuning alone changes a copy: it may continue to learn, and it forgets details of the held-out views, which the run
was trained on. So the drop of a size is not from the run, but from *all* its Gaussians, fine-tuned in the same way.
Since neither copy forgets all of them, and the larger one retains more, the drop is rather too large than too small.

Where every smaller size loses more than the limit, the run is as small as it gets, and stays as it is. This may happen
after ``adaptive``, which has already removed what is not worth its place.

Fine-tuning has the run's losses, all degrees of the spherical harmonics, no events, and moments of zero. Of a recipe
with a schedule it has the last rates; one that decides its own length cools down once more, from the rates before its
cool-down, which repairs more than its last rates do.
"""

import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.app.runs.model_file import make_label
from minisplat_ref.app.runs.opened_run import Run, check_renderer, check_views
from minisplat_ref.app.runs.rate_distortion import (
    PlySize,
    Point,
    count_sizes,
    next_size,
    paired_drop,
    smallest_within,
)
from minisplat_ref.app.runs.simplification_time import SimplificationTime, Sizes
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import CORE
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io.frames import return_population
from minisplat_ref.metrics import ViewMetrics, evaluate
from minisplat_ref.strategy.importance import collect_importance, indoor
from minisplat_ref.strategy.ops import contiguous, n_rows, take
from minisplat_ref.strategy.simplify import merge_neighbours, most_important
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import Pace
from minisplat_ref.training.rates import Rates, present_degrees
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import DEGREES, TrainState
from minisplat_ref.types import Floats, Model, View

DEFAULT_DROP = 0.1  # dB, the default limit of the loss


class Target(NamedTuple):
    """The request; a drop of at most ``DEFAULT_DROP`` where all is None."""

    max_drop: float | None = None
    """dB that may be lost on held-out training views, with one standard error."""
    budget: int | None = None
    """Gaussians, at most."""
    max_bytes: int | None = None
    """Of the PLY, at most."""

    @property
    def limit(self) -> float | None:
        """The largest loss, dB; None where the size is given."""
        if self.budget is not None or self.max_bytes is not None:
            return None
        return DEFAULT_DROP if self.max_drop is None else self.max_drop

    def __str__(self) -> str:
        """Return it as it is typed."""
        given = [f"--{name.replace('_', '-')} {value}" for name, value in self._asdict().items() if value is not None]
        return given[0] if given else f"--max-drop {DEFAULT_DROP}"


class Decision(NamedTuple):
    """The measured sizes, and which of them was chosen."""

    reference: Point
    """All Gaussians, fine-tuned in the same way."""
    points: tuple[Point, ...]
    """The smaller sizes, ascending."""
    chosen: Point
    """One of these; the reference where the run stays as it is."""
    run_psnr: float
    """dB, of the run as it is on its training views, which it was trained on."""
    is_all_that_matter: bool
    """Whether the budget, or the bytes, suffice for all Gaussians that any view sees."""

    @property
    def is_unchanged(self) -> bool:
        """Whether the run stays as it is."""
        return self.chosen is self.reference


def ply_size(run: Run) -> PlySize:
    """Return the size of the PLY of the run's population, measured on files of one row and of two."""
    n_bytes = []
    with tempfile.TemporaryDirectory() as folder:
        for n in (1, 2):
            path = Path(folder, f"{n}.ply")
            rows, units = take(run.model.gaussians, np.arange(n)), run.owner.representation.units
            label = make_label(run.owner, run.model.shared, run.settings.set)
            run.owner.save(path, return_population(rows, units, run.scene.frame), label)
            n_bytes.append(path.stat().st_size)
    row = n_bytes[1] - n_bytes[0]
    return PlySize(n_bytes[0] - row - 1, row)


def check_before_training(run: Run, target: Target) -> None:
    """Refuse, before the training, a simplification that could not follow it.

    Raises
    ------
    InputError
        There are too few training views, the renderer gives no blend weights, or not even one Gaussian fits.
    """
    check_views(run.scene, f"--{'max-drop' if target.max_bytes is None else 'max-bytes'}")
    check_renderer(run)
    find_limit(target, ply_size(run))


def find_limit(target: Target, size: PlySize) -> int | None:
    """Return the most Gaussians that a target allows; None where the curve decides.

    Raises
    ------
    InputError
        Not even one fits.
    """
    if target.max_bytes is None:
        return target.budget
    if size.max_rows(target.max_bytes) == 0:
        raise InputError(
            f"--max-bytes {target.max_bytes} is too little: a PLY with one Gaussian takes {size.of(1):,} bytes; allow"
            " more (minisplat-ref convert makes compact files, and has --max-bytes of its own)"
        )
    return size.max_rows(target.max_bytes)


def fine_tuning(recipe: Recipe, iterations: int) -> tuple[Recipe, Pace]:
    """Return the recipe of this many iterations after the schedule's end without events, and its stage of cooling."""
    end = recipe.iterations + iterations
    rates, pace = recipe.learning_rates, Pace(cooling_from=recipe.iterations, last_step=end)
    if recipe.cooling is None:
        rates = Rates(recipe.rates.at(recipe.iterations, 1.0), recipe.rates.per_extent)
    return recipe._replace(iterations=end, learning_rates=rates, events=()), pace


def is_merged(run: Run) -> bool:
    """Return whether Gaussians of the run can be merged: a further field of an extension may have no mean."""
    return run.owner is CORE


def reduce(run: Run, importance: Floats, n: int) -> Any:
    """Return a population of ``n`` rows, or of as many as have any importance if these are fewer: copies.

    Parameters
    ----------
    run : Run
    importance : ndarray of shape (N,)
        Blend weights of the run's Gaussians; not all 0.
    n : int
        All N stay as they are.
    """
    gaussians = run.model.gaussians
    if n == n_rows(gaussians):
        return take(gaussians, np.arange(n))
    n = min(n, int(np.count_nonzero(importance)))
    if is_merged(run):
        return merge_neighbours(gaussians, importance, n).gaussians
    return take(gaussians, most_important(importance, n))


def fine_tune(run: Run, gaussians: Any, iterations: int, *, views: Sequence[int], on_step: Callable[[], None]) -> Model:
    """Return Gaussians after fine-tuning, with the run's shared parameters.

    Parameters
    ----------
    run : Run
        Its model stays as it is.
    gaussians : Gaussians, or an extension's population
        Trained in place.
    iterations : int
        0 for the Gaussians as they are.
    views : sequence of int
        Numbers of the training views that are used.
    on_step : callable
        Called after every iteration.
    """
    gaussians = contiguous(gaussians)
    shared = {name: np.array(array, order="C") for name, array in run.model.shared.items()}
    has_own_degrees = run.recipe.cooling is not None and "sh_rest" in gaussians._fields
    rng = np.random.default_rng(run.settings.seed)  # all sizes see the same views in the same order
    recipe, pace = fine_tuning(run.recipe, iterations)
    state = TrainState(
        gaussians,
        zero_moments(gaussians),
        step=run.recipe.iterations,
        view_order=_shuffled(views, iterations, rng),
        rng=rng,
        stats={DEGREES: present_degrees(gaussians.sh_rest)} if has_own_degrees else {},
        shared=shared,
        shared_adam=zero_moments(shared),
        pace=pace,
        frame=run.scene.frame,
    )
    return train(
        run.scene,
        recipe,
        seed=run.settings.seed,
        state=state,
        on_step=lambda _: on_step(),
        backend=run.render_settings.backend,
        conventions=run.render_settings.conventions,
    ).model


def _shuffled(views: Sequence[int], iterations: int, rng: np.random.Generator) -> list[int]:
    """Return the views of all iterations, so that the loop, which takes the last one first, never draws another."""
    n_rounds = -(-iterations // len(views))
    rounds = [rng.permutation(views) for _ in range(n_rounds)]
    return [int(view) for each in rounds for view in each][:iterations]


def blend_weights(run: Run) -> Floats:
    """Return the importance [N] of the run's Gaussians: blend weights, summed over the pixels of all training views."""
    return indoor(collect_importance(run.model, run.scene.train_views, run.render_settings))


def evaluate_views(run: Run, model: Model, views: Sequence[View]) -> list[ViewMetrics]:
    """Return the metrics of each view, with its own exposure and pose where the run has trained them."""
    return evaluate(model, views, run.render_settings).per_view


def expect_time(run: Run, iterations: int) -> SimplificationTime:
    """Return what tells how long the simplification of a run takes, with ``iterations`` of each fine-tuning."""
    return SimplificationTime(len(run.folds) * iterations, iterations)


def make_measure(run: Run, iterations: int, expected: SimplificationTime | None = None) -> Callable[[int], Point]:
    """Return the function that measures a number of Gaussians, each only once.

    Parameters
    ----------
    run : Run
    iterations : int
        Of each fine-tuning.
    expected : SimplificationTime, optional
        Counts the iterations.

    Raises
    ------
    InputError
        The views see no Gaussian.
    """
    size, n = ply_size(run), n_rows(run.model.gaussians)
    importance = blend_weights(run)
    if not importance.any():
        raise InputError(f"{run.folder}: no training view sees any Gaussian: train longer, or check the cameras")

    @cache
    def measure_size(count: int) -> Point:
        measured = cross_validate(run, reduce(run, importance, count), iterations, expected)
        psnrs, ssims = tuple(view.psnr for view in measured), tuple(view.ssim for view in measured)
        before = psnrs if count == n else measure_size(n).psnrs
        return Point(count, size.of(count), psnrs, ssims, *paired_drop(before, psnrs))

    return measure_size


def decide(
    run: Run, target: Target, measure_size: Callable[[int], Point], expected: SimplificationTime | None = None
) -> Decision:
    """Measure sizes until the target is met, and choose one.

    Parameters
    ----------
    run : Run
    target : Target
    measure_size : callable
        See :func:`make_measure`.
    expected : SimplificationTime, optional
        Is told which sizes are planned.

    Raises
    ------
    InputError
        Not even one Gaussian fits.
    """
    limit = find_limit(target, ply_size(run))
    n, n_candidates = n_rows(run.model.gaussians), int(np.count_nonzero(blend_weights(run)))
    points: list[Point] = []

    is_given = limit is not None and min(limit, n_candidates) < n

    def plan(n_before: int = 0) -> None:
        least, most = (
            (is_given, is_given) if target.limit is None else count_sizes(points, n, n_candidates, target.limit)
        )
        if expected is not None:
            expected.plan(Sizes(n_before + least, None if most is None else n_before + most))

    plan(n_before=1)
    reference = measure_size(n)
    plan()
    chosen: Point | None = None
    if target.limit is not None:
        while (count := next_size(points, n, n_candidates, target.limit)) is not None:
            points.append(measure_size(count))
            plan()
        chosen = smallest_within(points, target.limit)
    elif limit is not None and is_given:
        chosen = measure_size(min(limit, n_candidates))
        points.append(chosen)
    return Decision(
        reference,
        tuple(sorted(points, key=lambda point: point.n_gaussians)),
        reference if chosen is None else chosen,
        float(np.mean([view.psnr for view in evaluate_views(run, run.model, run.scene.train_views)])),
        limit is not None and limit > n_candidates,
    )


def cross_validate(
    run: Run, gaussians: Any, iterations: int, expected: SimplificationTime | None = None
) -> list[ViewMetrics]:
    """Return the metrics of every training view, each of a copy of the Gaussians that was fine-tuned without it."""
    views, every_row = run.scene.train_views, np.arange(n_rows(gaussians))
    measured: dict[int, ViewMetrics] = {}
    with progress_bar(f"measuring {len(every_row):,} Gaussians", "iterations", len(run.folds) * iterations) as bar:

        def count_step() -> None:
            bar.update()
            if expected is not None:
                expected.count_iteration()

        for fold in run.folds:
            copy = take(gaussians, every_row)
            model = fine_tune(run, copy, iterations, views=fold.trained, on_step=count_step)
            held_out = evaluate_views(run, model, [views[k] for k in fold.held_out])
            measured.update(zip(fold.held_out, held_out, strict=True))
    return [measured[k] for k in range(len(views))]


def finish(run: Run, n: int, iterations: int) -> Model:
    """Return ``n`` Gaussians instead of the run's, reduced and fine-tuned by all training views."""
    views = run.scene.train_views
    smaller = reduce(run, blend_weights(run), n)
    with progress_bar(f"fine-tuning {n:,} Gaussians", "iterations", iterations) as bar:
        return fine_tune(run, smaller, iterations, views=range(len(views)), on_step=bar.update)
