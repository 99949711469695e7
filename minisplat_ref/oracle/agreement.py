"""Agreement of backends: each stage of a model on the same input, compared with the first backend.

Gradients are checked against differences of the very backend that computes them, so an error in both, such as a wrong
order of Gaussians, passes there. It does not pass here, unless all backends are wrong in the same way.
"""

from collections.abc import Iterator, Mapping, Sequence

from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.oracle.differences import largest_error, relative_error
from minisplat_ref.oracle.models import Stages, model_settings, model_stages
from minisplat_ref.oracle.tolerances import COMPARE_FLOAT64
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats


def agreement_cases(
    backends: Sequence[Backend],
    conventions: Conventions,
    representation: Representation | None,
    stages: Stages | None,
) -> list[list[Case]]:
    """Compare the results of every stage on each backend with those on the first one.

    Parameters
    ----------
    backends : sequence of Backend
        In float64.
    conventions : Conventions
        Profile of the check.
    representation : Representation, optional
        Whose whole renderer is the first stage.
    stages : callable, optional
        ``stages(backend, setting, rng)``: further stages.

    Returns
    -------
    list of list of Case
        The cases of each backend, none for the first: a case for each stage on the larger scene, whose error is
        relative to the largest value of an output. Nothing is computed if there is one backend.
    """
    if len(backends) == 1:
        return [[]]
    of_backends = [dict(_outputs(backend, conventions, representation, stages)) for backend in backends]
    first, name = of_backends[0], backends[0].name
    rest = ([_case(stage, name, first[stage], got) for stage, got in own.items()] for own in of_backends[1:])
    return [[], *rest]


def _outputs(
    backend: Backend, conventions: Conventions, representation: Representation | None, stages: Stages | None
) -> Iterator[tuple[str, dict[str, Floats]]]:
    """Yield the name of each stage with its outputs, on the input that every backend gets."""
    _, larger, rng = model_settings(conventions)
    for stage in model_stages(backend, larger, representation, stages, rng):
        yield stage.name, dict(zip(stage.outputs, stage.function(*stage.inputs.values()).outputs, strict=True))


def _case(stage: str, first: str, expected: Mapping[str, Floats], got: Mapping[str, Floats]) -> Case:
    errors = {name: relative_error(got[name], expected[name]) for name in expected}
    wrong = [name for name, error in errors.items() if not error <= COMPARE_FLOAT64]
    note = f"{' and '.join(wrong)} not as on {first}" if wrong else ""
    figures: dict[str, Figure] = {"error": largest_error(list(errors.values())), "limit": COMPARE_FLOAT64}
    return Case(f"{stage}: as on {first}", not wrong, figures, note)
