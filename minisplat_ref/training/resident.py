"""A training whose parameters, moments, photographs and gradients stay on a device through render, loss and Adam.

The loop and the events are those of every training. While a :class:`Residence` has the newest parameters, the state has
none: the first use of ``state.gaussians`` or ``state.adam`` copies them back, and after that the state's are the
newest, which the next iteration copies to the device. So whoever looks, an event, a checkpoint, a user's callback, sees
what is true and may change it, and an iteration in which nobody looks copies no parameter.

What runs here is plain 3DGS: its renderer, one photometric term, no shared parameters. Everything else that a recipe
may have (another renderer, further terms, calibrations) is computed with arrays on the host, by the same stages.
"""

import contextlib
import math
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import memory
from minisplat_ref.errors import InputError
from minisplat_ref.rendering import SPLATTING, RenderGradient, Request
from minisplat_ref.rendering.splatting import splat
from minisplat_ref.training.adam import AdamRule, AdamState, adam_step
from minisplat_ref.training.case import Case
from minisplat_ref.training.guard import Guard, Wrong
from minisplat_ref.training.losses import Loss, LossTerm, photometric
from minisplat_ref.training.rates import n_coefficients
from minisplat_ref.training.schedule import BLEND_STATS
from minisplat_ref.training.state import DEGREES, TrainState
from minisplat_ref.types import Floats, Gaussians, Ints, ProjectionGradient, RenderOutput, View

PHOTOGRAPHS_SHARE = 0.25  # of the free memory of the device, for photographs that stay there


class Differentiated(NamedTuple):
    """One view, rendered and differentiated; all arrays are on the device but the statistics of the output."""

    output: RenderOutput
    loss: float
    gradient: Any  # Gaussians
    v_image: Floats  # [H, W, 3]
    v_means2d: Floats  # [N, 2]
    radii: Ints  # [N, 2]


@contextlib.contextmanager
def residing(residence: "Residence | None", state: TrainState) -> Iterator[None]:
    """Copy parameters and moments back to the state in the end, whatever happened."""
    try:
        yield
    finally:
        if residence is not None:
            residence.leave(state)


class Residence:
    """The arrays of a training on a device."""

    def __init__(self, backend: Any) -> None:
        self.backend, self.device = backend, backend.residence
        self.gaussians: Any = None
        self.adam: Any = None
        self._photographs: dict[tuple[str, tuple[int, ...]], Any] = {}
        self._room = PHOTOGRAPHS_SHARE * self.device.free_bytes()
        self._nothing: Any = None  # [H, W] zeros
        self._said: set[str] = set()
        self._notes: list[str] = []

    def stays_here(self, state: TrainState, request: Request, recipe: Any, terms: list[LossTerm]) -> bool:
        """Return whether an iteration can stay on the device; if it cannot, note once why."""
        why = self.why_not(state, request, recipe, terms)
        if why is not None and why not in self._said:
            self._said.add(why)
            self._notes.append(
                f"backend {self.backend.name}: {why} has no kernels for the GPU; arrays stay on the host, and stages"
                " that have kernels copy them"
            )
        return why is None

    def take_notes(self) -> list[str]:
        """Return what is to be said, once."""
        notes, self._notes = self._notes, []
        return notes

    def why_not(self, state: TrainState, request: Request, recipe: Any, terms: list[LossTerm]) -> str | None:
        """Return what of an iteration has no kernels for the device, None if all of it can stay there."""
        if recipe.renderer is not SPLATTING or type(state.layout) is not Gaussians:
            return f"the renderer {recipe.renderer.name}"
        if state.shared:
            return f"the shared parameters {', '.join(state.shared)}"
        others = [term.name for term in terms if not _is_photometric(term)]
        if others or len(terms) != 1:
            return f"the loss {', '.join(others) or 'of ' + str(len(terms)) + ' terms'}"
        further = request.wants - BLEND_STATS
        return f"the channel {', '.join(sorted(further))}" if further else None

    def differentiate(self, state: TrainState, view: View, request: Request, term: LossTerm) -> Differentiated:
        """Render a view, compare it with its photograph, and chain the gradient to the parameters."""
        self._take(state, view)
        g, backend, camera, conventions = self.gaussians, self.backend, view.camera, request.conventions
        degree, dtype = _degree(request, g.sh_rest), g.means.dtype
        primitives = self.device.activate(g, request.is_visible)
        assert request.background is not None
        splats = splat(
            primitives,
            lambda radii: backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, degree, radii),
            camera,
            request.background.astype(dtype),
            conventions,
            backend,
            with_stats=bool(request.wants),
        )
        dssim_weight = term.function.keywords["dssim_weight"]  # type: ignore[attr-defined]
        target, mask = self._photograph(view)
        loss, tape = backend.photometric_loss(splats.output.image, target, dssim_weight, mask)
        v_image, projection = backend.photometric_loss_vjp(tape), splats.projection
        blended = projection, splats.channels, splats.background, splats.bins, conventions, splats.output
        v = backend.composite_vjp(*blended, v_image, self._zeros(splats.output.alpha))
        v_projection = ProjectionGradient(v.means2d, self._depth_zeros(len(g.means), dtype), v.conics, v.opacities)
        v_primitives = backend.project_vjp(*primitives, camera, conventions, projection, v_projection)
        v_sh = backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, degree, projection.radii, v.colors)
        gradient = self.device.chain(g, primitives, v_primitives, v_sh)
        output = splats.output._replace(n_pairs=len(splats.bins.gaussian_ids))
        return Differentiated(output, loss, gradient, v_image, v.means2d, projection.radii)

    def wrong_in(self, found: Differentiated, state: TrainState, case: Case, guard: Guard) -> Wrong | None:
        """Check the loss, and the numbers when they are due; see :meth:`~minisplat_ref.training.guard.Guard.wrong_in`.

        Only where something is wrong are the arrays copied back, for the check that names it.
        """
        if math.isfinite(found.loss) and not (guard.is_due(case.step) and self.has_wrong(found.gradient)):
            return None
        host = self.device.to_host(found)
        nothing: Any = np.zeros(0)
        gradient = RenderGradient(host.gradient, nothing, nothing, nothing, host.v_means2d)
        return guard.wrong_in(case._replace(model=state.model), Loss(found.loss, host.v_image, None, {}, {}), gradient)

    def has_wrong(self, *bundles: Any) -> bool:
        """Return whether a parameter, or a number of further bundles, is not finite."""
        return self.device.has_wrong(self.gaussians, *bundles)

    def step(self, state: TrainState, rates: Any, rule: AdamRule, found: Differentiated) -> None:
        """Move all parameters by one step of Adam."""
        limits = 3 * n_coefficients(state.stats[DEGREES]).astype(np.int32) if DEGREES in state.stats else None
        widths = {}
        if rule.is_visible_only:
            widths = dict.fromkeys(self.gaussians._fields, self.device.visible_widths(found.radii, None))
            if limits is not None:
                widths["sh_rest"] = self.device.visible_widths(found.radii, limits)
        elif limits is not None:
            widths = {"sh_rest": self.device.to_device(limits)}
        dense: Any = rule._replace(is_visible_only=False)  # the widths say which rows are seen
        nobody = np.empty(0, np.int64)
        parameters = self.gaussians, found.gradient, self.adam
        self.adam = adam_step(*parameters, rates, dense, nobody, self.backend, widths=widths)
        for name in ("gaussians", "adam"):
            state.__dict__.pop(name, None)
        state.resident = self

    def what_events_need(self, found: Differentiated) -> tuple[Ints, Floats]:
        """Return the visible rows [V] and the gradient with respect to the projected centres [N, 2], on the host."""
        return np.flatnonzero(self.device.to_host(found.radii)[:, 0] > 0), self.device.to_host(found.v_means2d)

    def bring_back(self, state: TrainState) -> None:
        """Copy parameters and moments to the state, whose they are from now on."""
        state.gaussians = self.device.to_host(self.gaussians)
        moments = self.device.to_host(self.adam.first), self.device.to_host(self.adam.second)
        state.adam = AdamState(*moments, self.adam.step, self.adam.joined)

    def leave(self, state: TrainState) -> None:
        """Copy what the state does not have yet, and forget it here."""
        if state.resident is not None:
            _ = state.gaussians
            state.resident = None
        self.gaussians = self.adam = None

    def _take(self, state: TrainState, view: View) -> None:
        """Copy parameters and moments to the device if the state has them."""
        if "gaussians" not in state.__dict__:
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
        adam, to_device = state.adam, self.device.to_device
        self.gaussians = to_device(g)
        self.adam = AdamState(to_device(adam.first), to_device(adam.second), adam.step, adam.joined)

    def _photograph(self, view: View) -> tuple[Any, Any]:
        """Return a photograph and its mask on the device; they stay there while there is room."""
        key = view.name, view.image.shape
        if key not in self._photographs:
            both = self.device.to_device(view.image), self.device.to_device(view.mask)
            n_bytes = view.image.nbytes + (0 if view.mask is None else view.mask.nbytes)
            if n_bytes > self._room:
                return both
            self._room -= n_bytes
            self._photographs[key] = both
        return self._photographs[key]

    def _zeros(self, like: Any) -> Any:
        """Return zeros of the shape and dtype of alpha."""
        if self._nothing is None or (self._nothing.shape, self._nothing.dtype) != (like.shape, like.dtype):
            self._nothing = self.device.zeros(like.shape, like.dtype)
        return self._nothing

    def _depth_zeros(self, n: int, dtype: Any) -> Any:
        return self.device.zeros((n, 1), dtype).reshape(n)


def _is_photometric(term: LossTerm) -> bool:
    return isinstance(term.function, partial) and term.function.func is photometric and term.weight == 1


def _degree(request: Request, sh_rest: Any) -> Any:
    """Return the degree to compute with, at most the stored one."""
    stored = math.isqrt(sh_rest.shape[1] + 1) - 1
    return stored if request.sh_degree is None else np.minimum(request.sh_degree, stored)
