"""The oracle's differences as assertions with the tests' tolerances; functions here have no thresholds to report."""

import numpy as np

from minisplat_ref.oracle.differences import CENTRAL, Point, analytic_jacobians, derivative, inner
from tolerances import GRADIENT_FLOOR, GRADIENT_REL, GRADIENT_STEP


def check_jacobian(function, vjp, inputs, *, names, rel=GRADIENT_REL):
    """Compare full Jacobians input by input; every block must be clearly non-zero.

    `function(*inputs)` returns a tuple of arrays, `vjp(*cotangents)` a tuple of gradients in the order of the inputs.
    """

    def point(*moved):
        return Point(function(*moved))

    analytic = analytic_jacobians(vjp, function(*inputs))
    for index, name in enumerate(names):
        columns = []
        for k in range(inputs[index].size):
            direction = np.zeros_like(inputs[index])
            direction.flat[k] = 1
            outputs = derivative(point, inputs, index, direction, GRADIENT_STEP, CENTRAL)
            columns.append(np.concatenate([np.ravel(output) for output in outputs]))
        numeric = np.stack(columns, axis=1)
        size = np.abs(numeric).max()
        assert size > GRADIENT_FLOOR, f"the Jacobian by {name} is zero: nothing was checked"
        error = np.abs(analytic[index] - numeric).max() / size
        assert error <= rel, f"Jacobian by {name}: relative error {error:.1e}"


def check_inner_products(function, gradients, inputs, cotangents, rng, *, names, rel=GRADIENT_REL, step=GRADIENT_STEP):
    """Compare <v, df(direction)> with <gradient, direction> for a random direction of each input by itself.

    The direction is normalised so that no entry moves by more than `step`.
    """
    for index, name in enumerate(names):
        direction = rng.uniform(-1, 1, size=inputs[index].shape)
        outputs = derivative(lambda *moved: Point(function(*moved)), inputs, index, direction, step, CENTRAL)
        numeric, analytic = inner(cotangents, outputs), float(np.vdot(gradients[index], direction))
        size = float(np.abs(gradients[index] * direction).sum())
        assert size > GRADIENT_FLOOR, f"the gradient with respect to {name} is zero: nothing was checked"
        assert abs(analytic - numeric) <= rel * size, f"gradient with respect to {name}: {analytic} against {numeric}"
