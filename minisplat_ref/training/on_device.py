"""The twin of :mod:`minisplat_ref.training.iteration` for arrays that stay on a device through render, loss and Adam.

Parameters, moments, photographs and gradients stay there, and the loop and the events are those of every training. An
:class:`OnDevice` copies its parameters and moments into the state at these places, and nowhere else:

- before events that read parameters: all dated ones, and those of every iteration that do not deny it;
- when an action or a callback calls ``fetch``, which ``report.state`` does;
- where a number is not finite, for the check that names it;
- before an iteration that has no kernels, and at the end of the training.

Until then the arrays of the state are older, of the same shapes. From then on they count, and the next iteration copies
them to the device: whoever fetches them may change them.

What runs here is plain 3DGS: its renderer, one photometric term, no shared parameters. Everything else that a recipe
may have (another renderer, further terms, calibrations) is computed with arrays in memory, by the same stages.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import memory
from minisplat_ref.errors import InputError
from minisplat_ref.rendering import SPLATTING, RenderGradient, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training import iteration
from minisplat_ref.training.adam import AdamState, adam_step
from minisplat_ref.training.case import Case
from minisplat_ref.training.guard import Guard, Wrong
from minisplat_ref.training.iteration import Stepped, Training, draw_case, due_events, restore_draws, run_events
from minisplat_ref.training.losses import Loss, LossTerm, photometric
from minisplat_ref.training.rates import n_coefficients
from minisplat_ref.training.schedule import BLEND_STATS, DatedEvent, Recipe
from minisplat_ref.training.state import DEGREES, StepReport, TrainState
from minisplat_ref.types import NOTHING, Floats, Gaussians, Ints, RenderOutput, View

PHOTOGRAPHS_SHARE = 0.25  # of the free memory of the device, for photographs that stay there

NO_ROWS: Ints = np.empty(0, np.int64)  # rows


@contextmanager
def on_device(backend: Backend, state: TrainState) -> Iterator["OnDevice"]:
    """Return the iterations of a training on a device; copy its arrays into the state in the end, whatever happens."""
    engine = OnDevice(backend)
    try:
        yield engine
    finally:
        engine.fetch(state)
        engine.gaussians = engine.adam = None


class Differentiated(NamedTuple):
    """One view, rendered and differentiated; all arrays are on the device but the statistics of the output."""

    output: RenderOutput
    loss: float
    gradient: Any  # Gaussians
    v_image: Floats  # [H, W, 3]
    v_means2d: Floats  # [N, 2]
    radii: Ints  # [N, 2]


class OnDevice:
    """The arrays of a training on a device, and its iterations."""

    def __init__(self, backend: Any) -> None:
        self.backend, self.device = backend, backend.residence
        self.gaussians: Any = None
        self.adam: Any = None
        self._passes: Any = None
        self.is_newer = False
        """Whether these are newer than those of the state."""
        self._photographs: dict[tuple[str, tuple[int, ...]], Any] = {}
        self._room = PHOTOGRAPHS_SHARE * self.device.free_bytes()
        self._nothing: Any = None  # [H, W] zeros
        self._noted: set[str] = set()

    def iterate(self, state: TrainState, training: Training) -> StepReport:
        """Do one iteration; an error before the step leaves the state as if the iteration had not begun."""
        guard, step = training.guard, state.step + 1
        if why := find_obstacle(state, training.recipe, step):
            report = iteration.iterate(self.fetch(state), training)
            return report._replace(notes=(*self._note_once(why), *report.notes))
        with restore_draws(state):
            case = draw_case(state, training)
            found = self.differentiate(state, case)
            wrong = self.check_step(state, case, found, guard)
            training.interruptions.defer()
        state.is_whole = False
        if wrong is None:
            self.take_step(state, case, found)
        if (guard.is_due(step) or case.recipe.may_edit(step)) and self.has_wrong():
            guard.check_parameters(case._replace(model=self.fetch(state).model), "Adam")
        due, visible_ids, v_means2d = due_events(case, wrong), NO_ROWS, found.v_means2d
        if due:
            visible_ids = np.flatnonzero(self.device.to_host(found.radii)[:, 0] > 0)
            v_means2d = self.device.to_host(v_means2d)
        if any(isinstance(event, DatedEvent) or event.reads_parameters for event in due):
            self.fetch(state)
        return run_events(state, training, Stepped(case, found.loss, found.output, visible_ids, v_means2d, wrong))

    def fetch(self, state: TrainState) -> TrainState:
        """Copy parameters and moments into the state, and return it."""
        if self.is_newer:
            state.gaussians, first, second = map(self.device.to_host, (self.gaussians, *self.adam[:2]))
            state.adam = AdamState(first, second, self.adam.step, self.adam.joined)
            self.is_newer = False
        return state

    def differentiate(self, state: TrainState, case: Case) -> Differentiated:
        """Render a view, compare it with its photograph, and chain the gradient to the parameters."""
        view, request, (term,) = case.view, case.request, case.terms
        self._take(state, view)
        g = self.gaussians
        assert request.background is not None
        options = self.device.Options(
            request.background.astype(g.means.dtype),
            _degree(request, g.sh_rest),
            request.conventions,
            request.is_visible,
            bool(request.wants),
        )
        dssim_weight = term.function.keywords["dssim_weight"]  # type: ignore[attr-defined]
        photograph, passes = self._photograph(view), self._passes
        while True:
            tape = passes.render(g, view.camera, options)
            compared = passes.compare(tape.output.image, photograph, dssim_weight)
            v = passes.render_vjp(tape, compared.v_image, self._zeros(tape.output.alpha))
            # The first number that is read waits for all of this. Where there was no room for all pairs, now there is.
            if (n_pairs := passes.count_pairs(tape)) <= tape.capacity:
                break
        loss, output = self.device.read_loss(compared, photograph.n_values, dssim_weight), tape.output
        output = output._replace(n_pairs=n_pairs)
        return Differentiated(output, loss, v.gaussians, compared.v_image, v.means2d, tape.footprints.radii)

    def check_step(self, state: TrainState, case: Case, found: Differentiated, guard: Guard) -> Wrong | None:
        """Check the loss, and the arrays when they are due; as :meth:`~minisplat_ref.training.guard.Guard.check_step`.

        Only where something is wrong are the arrays copied back, for the check that names it.
        """
        if math.isfinite(found.loss) and not (guard.is_due(case.step) and self.has_wrong(found.gradient)):
            return None
        there = self.device.to_host(found)
        nothing: Any = np.zeros(0)
        gradient = RenderGradient(there.gradient, nothing, nothing, nothing, there.v_means2d)
        loss = Loss(found.loss, there.v_image, None, NOTHING, NOTHING)
        return guard.check_step(case._replace(model=self.fetch(state).model), loss, gradient)

    def has_wrong(self, *bundles: Any) -> bool:
        """Return whether a parameter, or a number of further bundles, is not finite."""
        return self.device.has_wrong(self.gaussians, *bundles)

    def take_step(self, state: TrainState, case: Case, found: Differentiated) -> None:
        """Move all parameters by one step of Adam."""
        rule, rates = case.recipe.adam, case.recipe.rates_at(case.step, case.scene.extent, state.pace)
        limits = 3 * n_coefficients(state.stats[DEGREES]).astype(np.int32) if DEGREES in state.stats else None
        widths = {}
        if rule.is_visible_only:
            widths = dict.fromkeys(self.gaussians._fields, self._passes.visible_widths(found.radii, None))
            if limits is not None:
                widths["sh_rest"] = self._passes.visible_widths(found.radii, limits)
        elif limits is not None:
            widths = {"sh_rest": self.device.to_device(limits)}
        dense: Any = rule._replace(is_visible_only=False)  # the widths select the rows
        parameters = self.gaussians, found.gradient, self.adam
        self.adam = adam_step(*parameters, rates, dense, NO_ROWS, self.backend, widths=widths)
        self.is_newer = True

    def _take(self, state: TrainState, view: View) -> None:
        """Copy parameters and moments to the device, unless it has the newest."""
        if self.is_newer:
            return
        self.gaussians = self.adam = None  # frees their memory first
        camera, g = view.camera, state.gaussians
        n, n_bytes = len(g.means), sum(field.nbytes for field in g)
        needs = memory.training_bytes(n, n_bytes, memory.PAIRS_PER_GAUSSIAN * n)
        needs += memory.IMAGE_BYTES * camera.width * camera.height
        if needs > (free := self.device.free_bytes()):
            raise InputError(
                f"the GPU has no memory for {n:,} Gaussians in {camera.width} x {camera.height} pixels: some"
                f" {needs / 1e9:.2f} GB are needed, {free / 1e9:.2f} GB are free; train on smaller photographs"
                " (--downscale), by a recipe that keeps to a --budget, or with --backend cpu"
            )
        self._passes = self._passes or self.device.Passes(self.backend.is_deterministic)
        adam, to_device = state.adam, self.device.to_device
        self.gaussians = to_device(g)
        self.adam = AdamState(to_device(adam.first), to_device(adam.second), adam.step, adam.joined)

    def _photograph(self, view: View) -> Any:
        """Return a photograph and its mask on the device; they stay there while there is room."""
        key = view.name, view.image.shape
        if key not in self._photographs:
            photograph = self.device.prepare_photograph(view.image, view.mask)
            n_bytes = view.image.nbytes + (0 if view.mask is None else view.mask.nbytes)
            if n_bytes > self._room:
                return photograph
            self._room -= n_bytes
            self._photographs[key] = photograph
        return self._photographs[key]

    def _note_once(self, why: str) -> list[str]:
        """Return a note with the reason why arrays are in memory, once for each reason."""
        if why in self._noted:
            return []
        self._noted.add(why)
        stay = "arrays stay on the host, and stages that have kernels copy them"
        return [f"backend {self.backend.name}: {why} has no kernels for the GPU; {stay}"]

    def _zeros(self, like: Any) -> Any:
        """Return zeros of the shape and dtype of alpha."""
        if self._nothing is None or (self._nothing.shape, self._nothing.dtype) != (like.shape, like.dtype):
            self._nothing = self.device.zeros(like.shape, like.dtype)
        return self._nothing


def find_obstacle(state: TrainState, recipe: Recipe, step: int) -> str | None:
    """Return the part of an iteration that has no kernels for the device; None if all of it can stay there."""
    if recipe.renderer is not SPLATTING or type(state.gaussians) is not Gaussians:
        return f"the renderer {recipe.renderer.name}"
    if recipe.dropout:
        return "dropout"
    if state.shared:
        return f"the shared parameters {', '.join(state.shared)}"
    terms = recipe.due_terms(step)
    others = [term.name for term in terms if not _is_photometric(term)]
    if others or len(terms) != 1:
        return f"the loss {', '.join(others) or 'of ' + str(len(terms)) + ' terms'}"
    further = recipe.wants(step) - BLEND_STATS
    return f"the channel {', '.join(sorted(further))}" if further else None


def _is_photometric(term: LossTerm) -> bool:
    return isinstance(term.function, partial) and term.function.func is photometric and term.weight == 1


def _degree(request: Request, sh_rest: Any) -> Any:
    """Return the degree to compute with, at most the stored one."""
    stored = math.isqrt(sh_rest.shape[1] + 1) - 1
    return stored if request.sh_degree is None else np.minimum(request.sh_degree, stored)
