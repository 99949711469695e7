"""Checks of gradients: central differences against VJPs; a check of nothing does not pass.

A function under test maps arrays to a :class:`Point`: its outputs, and the side of each threshold on which its values
lie. A renderer is full of thresholds (skip, stop, clamp, order), and a difference across one is not a derivative: it is
refused and tried again with a smaller step, never averaged in.

The sixth-order stencil makes tight checks possible. At a step h the plain central difference is wrong by
``h^2 f''' / 6``, rounding by ``1e-16 f / h``: no h makes both smaller than about 1e-10 f. With six points the first
becomes ``h^6 f^(7) / 140``, and h can be a hundred times larger.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from minisplat_ref.oracle.tolerances import GRADIENT_FLOOR, GRADIENT_REL
from minisplat_ref.types import Floats

CENTRAL = (1 / 2,)
"""Weights of ``f(x + k h) - f(x - k h)``, k = 1, ...; error h^2 f''' / 6."""
SIXTH_ORDER = (3 / 4, -3 / 20, 1 / 60)
"""The same for six points; error h^6 f^(7) / 140."""

STEPS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
"""Steps to try: the first is best for values of order 1, the next are used only where the one before is refused."""
SETTLED = GRADIENT_REL
"""Relative difference of the derivatives from two steps, ten times apart, below which neither has met a threshold, and
the larger step is small enough for what the proof asks."""
ROUNDINGS = 30.0
"""Units in the last place by which a value may be off that sums hundreds of terms."""


class Point(NamedTuple):
    """The result of a function under test."""

    outputs: tuple[Floats, ...]
    sides: tuple[np.ndarray, ...] = ()
    """Arrays, of any shape, that change if and only if a threshold is crossed."""


Function = Callable[..., Point]
Vjp = Callable[..., tuple[Floats, ...]]
Differentiate = Callable[..., tuple[tuple[Floats, ...], float]]
"""As :func:`careful_derivative`: a derivative along a direction, and the step that gave it."""


class ThresholdCrossed(Exception):
    """The points of a stencil lie on different sides of a threshold."""


class Block(NamedTuple):
    """Derivative of one output with respect to one input."""

    output: str
    input: str
    size: float
    """Largest entry, by differences."""
    error: float
    """Largest difference of the VJP from it, relative to ``size``; absolute where the block is zero."""

    @property
    def is_zero(self) -> bool:
        """Return whether the block is zero; the VJP has to agree."""
        return self.size <= GRADIENT_FLOOR


def largest_error(errors: Sequence[float]) -> float:
    """Return the largest error; NaN if one is NaN, or if there is none."""
    return float(np.max(errors)) if len(errors) else np.nan


def relative_error(got: Floats, expected: Floats, floor: float = 0.0) -> float:
    """Return the largest difference of two arrays relative to the largest value expected.

    It is absolute where nothing expected is above ``floor``, and infinite where the shapes differ.
    """
    if np.shape(got) != np.shape(expected):
        return np.inf
    size = float(np.abs(expected).max(initial=0.0))
    with np.errstate(invalid="ignore"):  # infinity minus infinity is NaN, which fails any tolerance
        return float(np.abs(got - expected).max(initial=0.0)) / (size if size > floor else 1.0)


class JacobianCheck(NamedTuple):
    """Full Jacobians of a function, by differences and by its VJP."""

    blocks: tuple[Block, ...]
    """Every pair of an output and an input."""
    step: float
    """Smallest step that a threshold forced."""
    n_refused: int
    """Columns for which every step crossed a threshold, so that they are unchecked."""

    @property
    def error(self) -> float:
        """Largest error of a block; NaN if one is NaN."""
        return largest_error([block.error for block in self.blocks])

    @property
    def vacuous(self) -> tuple[str, ...]:
        """Return the inputs and outputs with zero blocks only: nothing was checked about them."""
        names = dict.fromkeys(name for block in self.blocks for name in (block.input, block.output))
        alive = {name for block in self.blocks if not block.is_zero for name in (block.input, block.output)}
        return tuple(name for name in names if name not in alive)


class InnerProduct(NamedTuple):
    """Derivative along one direction of one input, weighted by cotangents."""

    input: str
    size: float
    """Sum of the sizes of its terms, so that a direction that happens to cancel is not judged by the remainder."""
    error: float
    """Difference between the two sides, relative to ``size``."""
    step: float
    """Step that was used; 0 if all crossed a threshold, so that it is unchecked."""


def inner(a: Sequence[Floats], b: Sequence[Floats]) -> float:
    """Return the sum of products over two tuples of arrays."""
    return sum(float(np.vdot(x, y)) for x, y in zip(a, b, strict=True))


def derivative(
    function: Function,
    inputs: Sequence[Floats],
    index: int,
    direction: Floats,
    step: float,
    weights: Sequence[float] = SIXTH_ORDER,
) -> tuple[Floats, ...]:
    """Return the derivative of all outputs along a direction of one input.

    Parameters
    ----------
    function : callable
        Maps ``inputs`` to a :class:`Point`.
    inputs : sequence of ndarray
        Where.
    index : int
        Of the input that moves.
    direction : ndarray
        Of its shape.
    step : float
        The input moves by ``+-step direction``, and multiples.
    weights : sequence of float
        :data:`CENTRAL` or :data:`SIXTH_ORDER`.

    Returns
    -------
    tuple of ndarray
        One per output.

    Raises
    ------
    ThresholdCrossed
        If the points lie on different sides of a threshold.
    """
    points = []
    for k in range(1, len(weights) + 1):
        for sign in (1, -1):
            moved = list(inputs)
            moved[index] = inputs[index] + sign * k * step * direction
            points.append(function(*moved))
    if not all(_same(point.sides, points[0].sides) for point in points[1:]):
        raise ThresholdCrossed
    pairs = [(weight / step, points[2 * k].outputs, points[2 * k + 1].outputs) for k, weight in enumerate(weights)]
    return tuple(
        sum((w * (np.asarray(up[o]) - np.asarray(down[o])) for w, up, down in pairs), start=np.zeros(()))
        for o in range(len(points[0].outputs))
    )


def careful_derivative(
    function: Function, inputs: Sequence[Floats], index: int, direction: Floats, steps: Sequence[float] = STEPS
) -> tuple[tuple[Floats, ...], float]:
    """Return :func:`derivative` with the first of ``steps`` that crosses no threshold, and that step."""
    for step in steps:
        try:
            return derivative(function, inputs, index, direction, step), step
        except ThresholdCrossed:
            continue
    raise ThresholdCrossed


def settled_derivative(
    function: Function, inputs: Sequence[Floats], index: int, direction: Floats, steps: Sequence[float] = STEPS
) -> tuple[tuple[Floats, ...], float]:
    """Return :func:`derivative` with the first of ``steps`` that the next smaller one confirms, and that step.

    For functions that do not report the sides of their thresholds: a kink or a jump inside the stencil
    changes the two estimates by different amounts. They agree if they differ by less than ``SETTLED`` of the larger, or
    by the rounding error.
    """
    size = max(float(np.max(np.abs(output), initial=0)) for output in function(*inputs).outputs)
    estimates = [derivative(function, inputs, index, direction, steps[0])]
    for step, smaller in pairwise(steps):
        estimates.append(derivative(function, inputs, index, direction, smaller))
        noise = ROUNDINGS * float(np.finfo(np.float64).eps) * size / smaller
        if all(_agree(a, b, noise) for a, b in zip(*estimates[-2:], strict=True)):
            return estimates[-2], step
    raise ThresholdCrossed


def _agree(a: Floats, b: Floats, noise: float) -> bool:
    return bool(np.max(np.abs(a - b), initial=0) <= SETTLED * np.max(np.abs(a), initial=0) + noise)


def analytic_jacobians(vjp: Vjp, outputs: Sequence[Floats]) -> tuple[Floats, ...]:
    """Return derivatives [n_outputs, n_inputs] with respect to each input: one VJP for every entry of the outputs."""
    rows = []
    for o, output in enumerate(outputs):
        for k in range(np.size(output)):
            cotangents = [np.zeros_like(np.asarray(other, dtype=float)) for other in outputs]
            cotangents[o].flat[k] = 1
            rows.append([np.ravel(gradient) for gradient in vjp(*cotangents)])
    return tuple(np.stack(column) for column in zip(*rows, strict=True))


def check_jacobians(
    function: Function,
    vjp: Vjp,
    inputs: Sequence[Floats],
    *,
    names: Sequence[str],
    output_names: Sequence[str],
    steps: Sequence[float] = STEPS,
    differentiate: Differentiate = careful_derivative,
) -> JacobianCheck:
    """Compare full Jacobians, block by block, so that a small block does not hide behind a large one.

    Parameters
    ----------
    function : callable
        Maps ``inputs`` to a :class:`Point`.
    vjp : callable
        Maps one cotangent per output to one gradient per input.
    inputs : sequence of ndarray
        Where, float64.
    names, output_names : sequence of str
        Of the inputs and of the outputs.
    steps : sequence of float
        As for :func:`careful_derivative`.
    differentiate : callable
        :func:`careful_derivative`, or :func:`settled_derivative` for a function that does not report its thresholds.

    Returns
    -------
    JacobianCheck
        What to judge.
    """
    outputs = function(*inputs).outputs
    analytic = analytic_jacobians(vjp, outputs)
    ends = np.cumsum([np.size(output) for output in outputs])[:-1]  # where the rows of one output end
    blocks, used, n_refused = [], [], 0
    for index, name in enumerate(names):
        columns, known = [], []
        for k in range(inputs[index].size):
            direction = np.zeros_like(inputs[index])
            direction.flat[k] = 1
            try:
                column, step = differentiate(function, inputs, index, direction, steps)
            except ThresholdCrossed:
                n_refused += 1
                continue
            columns.append(np.concatenate([np.ravel(output) for output in column]))
            known.append(k)
            used.append(step)
        if not known:
            continue
        pairs = zip(np.split(np.stack(columns, 1), ends), np.split(analytic[index][:, known], ends), strict=True)
        for output, (expected, got) in zip(output_names, pairs, strict=True):
            size = float(np.abs(expected).max())
            error = float(np.abs(got - expected).max())  # NaN stays NaN and fails any tolerance
            blocks.append(Block(output, name, size, error / size if size > GRADIENT_FLOOR else error))
    return JacobianCheck(tuple(blocks), min(used, default=0.0), n_refused)


def check_inner_products(
    function: Function,
    vjp: Vjp,
    inputs: Sequence[Floats],
    rng: np.random.Generator,
    *,
    names: Sequence[str],
    steps: Sequence[float] = STEPS,
    differentiate: Differentiate = careful_derivative,
) -> tuple[InnerProduct, ...]:
    """Compare <v, df(direction)> with <gradient, direction>, one random direction of each input by itself.

    Parameters
    ----------
    function, vjp, inputs, names, steps, differentiate
        As for :func:`check_jacobians`.
    rng : Generator
        For the cotangents v and the directions, whose entries are below 1.

    Returns
    -------
    tuple of InnerProduct
        One per input.
    """
    cotangents = [rng.normal(size=np.shape(output)) for output in function(*inputs).outputs]
    gradients = vjp(*cotangents)
    results = []
    for index, (name, gradient) in enumerate(zip(names, gradients, strict=True)):
        direction = rng.uniform(-1, 1, size=inputs[index].shape)
        size = float(np.abs(gradient * direction).sum())
        try:
            moved, step = differentiate(function, inputs, index, direction, steps)
            error = abs(inner(cotangents, moved) - float(np.vdot(gradient, direction)))
        except ThresholdCrossed:
            error, step = np.inf, 0.0
        results.append(InnerProduct(name, size, error / size if size > 0 else error, step))
    return tuple(results)


def _same(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
