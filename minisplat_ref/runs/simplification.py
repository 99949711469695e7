"""``simplify``: a run made smaller after the fact, and how small it may be, measured on views that take no part.

Candidates keep the Gaussians of the largest blend weight, summed over pixels and views (equation 12 of Mini-Splatting),
at some ten sizes, and each is fine-tuned. Some *training* views decide (:func:`..training.pace.held_out_ids`): they
count neither for the importance nor for the fine-tuning while the sizes are measured. The test views stay sealed until
the size has been chosen, and ranked and fine-tuned once more by all training views.

Fine-tuning alone changes a run: it may continue to learn, and it forgets what is peculiar to the held-out views, which
it was trained on until then. So the drop of a size is not from the run, but from *all* its Gaussians, fine-tuned alike.

Fine-tuning continues where the run's schedule ends: its losses, its last rates, all degrees of the spherical harmonics,
no events, moments of zero.
"""

import tempfile
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import return_population
from minisplat_ref.metrics import evaluate
from minisplat_ref.runs.opened_run import HOLD_OUT_EVERY, Run, check_renderer, check_views
from minisplat_ref.runs.rate_distortion import (
    PlySize,
    Point,
    between,
    knee,
    paired_drop,
    sizes,
    smallest_within,
)
from minisplat_ref.strategy.importance import collect_importance, indoor
from minisplat_ref.strategy.ops import contiguous, n_rows, take
from minisplat_ref.strategy.simplify import most_important
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.pace import Cooling
from minisplat_ref.training.rates import Rates, present_degrees
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import DEGREES, TrainState
from minisplat_ref.types import Floats, Ints, Model, View

N_CLOSER = 2  # sizes that are measured besides, where the limit of --max-drop lies
HOLDING_OUT = Cooling(part=0.0, last=1.0, last_per_extent=1.0, hold_out_every=HOLD_OUT_EVERY)  # which never cools


class Target(NamedTuple):
    """What is asked for; the knee of the curve where all is None."""

    max_drop: float | None = None
    """dB that may be lost on the held-out training views, with one standard error."""
    budget: int | None = None
    """Gaussians, at most."""
    max_bytes: int | None = None
    """Of the PLY, at most."""

    def __str__(self) -> str:
        """Return it as it is typed."""
        given = [f"--{name.replace('_', '-')} {value}" for name, value in self._asdict().items() if value is not None]
        return given[0] if given else "the knee of the curve"


class Decision(NamedTuple):
    """The measured curve, and what was chosen by it."""

    reference: Point
    """All Gaussians, fine-tuned alike."""
    points: tuple[Point, ...]
    """The smaller sizes, ascending."""
    chosen: Point
    knee: Point
    run_psnr: float
    """dB, of the run as it is on the held-out training views, which it was trained on."""
    is_all_that_matter: bool
    """Whether the budget, or the bytes, are more than all Gaussians that any view sees take."""


def ply_size(run: Run) -> PlySize:
    """Return what the PLY of the run's population takes, measured on files of one row and of two."""
    n_bytes = []
    with tempfile.TemporaryDirectory() as folder:
        for n in (1, 2):
            path = Path(folder, f"{n}.ply")
            rows, units = take(run.model.gaussians, np.arange(n)), run.owner.representation.units
            run.owner.save(path, return_population(rows, units, run.scene.frame))
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
    limit_of(target, ply_size(run))


def limit_of(target: Target, size: PlySize) -> int | None:
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


def fine_tuning(recipe: Recipe, iterations: int, *, holds_out: bool) -> Recipe:
    """Return the recipe of this many iterations after the schedule's end, at its last rates and without events."""
    rates = Rates(recipe.rates.at(recipe.iterations, 1.0), recipe.rates.per_extent)
    if recipe.cooling is not None:
        rates = rates.scale(Fraction(1), recipe.cooling.last, recipe.cooling.last_per_extent)
    return recipe._replace(
        iterations=recipe.iterations + iterations,
        learning_rates=rates,
        events=(),
        cooling=HOLDING_OUT if holds_out else None,
    )


def fine_tune(run: Run, rows: Ints, iterations: int, *, holds_out: bool, on_step: Callable[[], None]) -> Model:
    """Return the chosen rows after fine-tuning; the run's model stays as it is.

    Parameters
    ----------
    run : Run
    rows : ndarray of shape (M,) of ids
    iterations : int
        0 for the rows as they are.
    holds_out : bool
        Whether the views that decide are left out.
    on_step : callable
        Called after every iteration.
    """
    gaussians = contiguous(take(run.model.gaussians, rows))
    shared = {name: np.array(array, order="C") for name, array in run.model.shared.items()}
    has_own_degrees = run.recipe.cooling is not None and "sh_rest" in gaussians._fields
    state = TrainState(
        gaussians,
        zero_moments(gaussians),
        step=run.recipe.iterations,
        view_order=[],
        rng=np.random.default_rng(run.settings.seed),  # all sizes see the same views in the same order
        stats={DEGREES: present_degrees(gaussians.sh_rest)} if has_own_degrees else {},
        shared=shared,
        shared_adam=zero_moments(shared),
        frame=run.scene.frame,
    )
    return train(
        run.scene,
        fine_tuning(run.recipe, iterations, holds_out=holds_out),
        seed=run.settings.seed,
        state=state,
        on_step=lambda _: on_step(),
        backend=run.render_settings.backend,
        conventions=run.render_settings.conventions,
    ).model


def blend_weights(run: Run, views: Sequence[View]) -> Floats:
    """Return the importance [N] of the run's Gaussians: their blend weights, summed over the pixels of the views."""
    return indoor(collect_importance(run.model, views, run.render_settings))


def psnrs_of(run: Run, model: Model, views: Sequence[View]) -> tuple[float, ...]:
    """Return the PSNR, dB, of each view, with its own exposure and pose where the run has trained them."""
    evaluation = evaluate(model, views, run.render_settings)
    return tuple(view.psnr for view in evaluation.per_view)


def decide(run: Run, target: Target, iterations: int) -> Decision:
    """Measure the curve, closer where a limit to the drop lies, and choose a size.

    Parameters
    ----------
    run : Run
    target : Target
    iterations : int
        Of each fine-tuning.

    Raises
    ------
    InputError
        The target cannot be met, or no view sees any Gaussian.
    """
    size = ply_size(run)
    limit = limit_of(target, size)
    n = n_rows(run.model.gaussians)
    importance = blend_weights(run, run.others)
    n_candidates = int(np.count_nonzero(importance))
    if n_candidates == 0:
        raise InputError(f"{run.folder}: no training view sees any Gaussian: train longer, or check the cameras")
    series = sizes(n, n_candidates)
    counts = series if limit is None else sizes(n, n_candidates, limit)
    n_closer = 0 if target.max_drop is None else N_CLOSER
    total = (1 + len(counts) + n_closer) * (iterations + 1)  # each is also measured
    with tqdm(total=total, leave=False, unit="it", dynamic_ncols=True, disable=None) as bar:

        def measured(rows: Ints) -> tuple[float, ...]:
            bar.set_description_str(f"measuring {len(rows):,} Gaussians")
            model = fine_tune(run, rows, iterations, holds_out=True, on_step=bar.update)
            psnrs = psnrs_of(run, model, run.held_out)
            bar.update()
            return psnrs

        def point_of(count: int) -> Point:
            psnrs = measured(most_important(importance, count))
            return Point(count, size.of(count), psnrs, *paired_drop(reference.psnrs, psnrs))

        reference = Point(n, size.of(n), measured(np.arange(n)), 0.0, 0.0)
        points = [point_of(count) for count in counts]
        for _ in range(n_closer):
            assert target.max_drop is not None
            count = between(points, reference, target.max_drop)
            if count is not None and count <= n_candidates:
                points.append(point_of(count))
    points.sort(key=lambda point: point.n_gaussians)
    bend = knee([point for point in (*points, reference) if point.n_gaussians in (*series, n)])
    return Decision(
        reference,
        tuple(points),
        _choose_by_target(points, target, bend, None if limit is None else min(limit, n_candidates)),
        bend,
        float(np.mean(psnrs_of(run, run.model, run.held_out))),
        limit is not None and limit > n_candidates,
    )


def _choose_by_target(points: Sequence[Point], target: Target, bend: Point, limit: int | None) -> Point:
    if limit is not None:
        return next(point for point in points if point.n_gaussians == limit)
    return bend if target.max_drop is None else smallest_within(points, target.max_drop)


def finish(run: Run, n: int, iterations: int) -> Model:
    """Return the ``n`` most important Gaussians, ranked and fine-tuned by all training views; or all, if ``n`` are."""
    is_all = n == n_rows(run.model.gaussians)
    rows = np.arange(n) if is_all else most_important(blend_weights(run, run.scene.train_views), n)
    name = f"fine-tuning {n:,} Gaussians"
    with tqdm(total=iterations, desc=name, leave=False, unit="it", dynamic_ncols=True, disable=None) as bar:
        return fine_tune(run, rows, iterations, holds_out=False, on_step=bar.update)
