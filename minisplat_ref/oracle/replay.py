"""Render the view again in which a training found a number that is not finite, with every backend.

If the reference in float64 is finite where another backend is not, the error is in that one; if none is finite, it is
in the parameters, the formula or the data. If all are finite, the error has been fixed, or its cause was not in the
inputs of the view.
"""

from typing import Any

import numpy as np

from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.differences import relative_error
from minisplat_ref.rendering.backends import BACKENDS, REFERENCE, Backend
from minisplat_ref.training.adam import named_fields
from minisplat_ref.training.case import Case as View
from minisplat_ref.training.guard import Examination, examine
from minisplat_ref.types import Model

DTYPES = (np.float64, np.float32)


def replay(case: View, wrong: str) -> Report:
    """Render and differentiate the view with every backend in both precisions.

    Parameters
    ----------
    case : minisplat_ref.training.case.Case
    wrong : str
        What the training had found.

    Returns
    -------
    Report
        A case for each backend and precision, which fails where a number is not finite. Errors are relative to the
        largest value of the float64 reference; of the gradient, the worst parameter's.
    """
    truth = examine(_cast(case, REFERENCE, np.float64))
    cases = []
    for dtype in DTYPES:
        for backend in BACKENDS.values():
            is_truth = backend is REFERENCE and dtype is np.float64
            found = truth if is_truth else examine(_cast(case, backend, dtype))
            figures: dict[str, Figure] = {"loss": float(found.loss.value)}
            if not is_truth:
                figures |= {
                    "image error": relative_error(found.output.image, truth.output.image),
                    **_gradient_error(found, truth),
                }
            name = f"{backend.name} {np.dtype(dtype).name}"
            cases.append(Case(name, found.wrong is None, figures, "" if found.wrong is None else str(found.wrong)))
    title = f"iteration {case.step}, view {case.view.name}; the training found {wrong}"
    return Report(title, tuple(cases), {"step": case.step, "view": case.view.name, "found": wrong})


def _cast(case: View, backend: Backend, dtype: type[np.floating]) -> View:
    def cast(array: Any) -> Any:
        return array.astype(dtype) if array is not None and array.dtype.kind == "f" else array

    population = type(case.model.gaussians)._make(map(cast, case.model.gaussians))
    request = case.request._replace(backend=backend, background=cast(case.request.background))
    return case._replace(model=Model(population, case.model.shared), request=request)


def _gradient_error(found: Examination, truth: Examination) -> dict[str, Figure]:
    expected = named_fields(truth.gradient.gaussians)
    errors = {name: relative_error(v, expected[name]) for name, v in named_fields(found.gradient.gaussians).items()}
    worst = max(errors, key=lambda name: (np.isnan(errors[name]), errors[name]))
    return {"gradient error": errors[worst], "of": worst}
