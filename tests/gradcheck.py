"""Central differences against analytic gradients, refusing to pass on nothing.

A function under test maps arrays to a tuple of arrays. Differences are taken in float64 with a step that keeps both the
truncation (step^2) and the rounding (1e-16 / step) near 1e-10.
"""

import numpy as np
from tolerances import GRADIENT_FLOOR, GRADIENT_REL, GRADIENT_STEP


def inner(a, b):
    """Sum of products over two tuples of arrays."""
    return sum(float(np.vdot(x, y)) for x, y in zip(a, b, strict=True))


def numeric_jacobian(function, inputs, index, step=GRADIENT_STEP):
    """Derivatives [n_outputs, n_inputs] of all outputs by the entries of one input, by central differences."""
    columns = []
    for k in range(inputs[index].size):
        sides = []
        for sign in (1, -1):
            moved = list(inputs)
            moved[index] = moved[index].copy()
            moved[index].flat[k] += sign * step
            sides.append(np.concatenate([np.ravel(output) for output in function(*moved)]))
        columns.append((sides[0] - sides[1]) / (2 * step))
    return np.stack(columns, axis=1)


def analytic_jacobian(vjp, outputs, index):
    """The same from one call of the VJP for every output entry."""
    rows = []
    for o, output in enumerate(outputs):
        for k in range(np.size(output)):
            cotangents = [np.zeros_like(np.asarray(other, dtype=float)) for other in outputs]
            cotangents[o].flat[k] = 1
            rows.append(np.ravel(vjp(*cotangents)[index]))
    return np.stack(rows)


def check_jacobian(function, vjp, inputs, *, names, rel=GRADIENT_REL):
    """Compare full Jacobians input by input; every block must be clearly non-zero.

    `function(*inputs)` returns a tuple of arrays, `vjp(*cotangents)` a tuple of gradients in the order of the inputs.
    """
    outputs = function(*inputs)
    for index, name in enumerate(names):
        numeric = numeric_jacobian(function, inputs, index)
        analytic = analytic_jacobian(vjp, outputs, index)
        size = np.abs(numeric).max()
        assert size > GRADIENT_FLOOR, f"the Jacobian by {name} is zero: nothing was checked"
        error = np.abs(analytic - numeric).max() / size
        assert error <= rel, f"Jacobian by {name}: relative error {error:.1e}"


def check_inner_products(function, gradients, inputs, cotangents, rng, *, names, rel=GRADIENT_REL, step=GRADIENT_STEP):
    """Compare <v, df(direction)> with <gradient, direction> for a random direction of each input by itself.

    The direction is normalised so that no entry moves by more than `step`.
    """
    for index, name in enumerate(names):
        direction = rng.uniform(-1, 1, size=inputs[index].shape)
        sides = []
        for sign in (1, -1):
            moved = list(inputs)
            moved[index] = moved[index] + sign * step * direction
            sides.append(function(*moved))
        numeric = (inner(cotangents, sides[0]) - inner(cotangents, sides[1])) / (2 * step)
        analytic = float(np.vdot(gradients[index], direction))
        # The scale is that of the terms of the sum, so a direction that happens to cancel is not judged by its rest.
        size = float(np.abs(gradients[index] * direction).sum())
        assert size > GRADIENT_FLOOR, f"the gradient by {name} is zero: nothing was checked"
        assert abs(analytic - numeric) <= rel * size, f"gradient by {name}: {analytic} against {numeric}"
