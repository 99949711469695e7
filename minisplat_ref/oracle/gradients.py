"""The gradient proof: check each stage of a backend with full Jacobians, inner products and automatic differentiation.

Besides the stages it checks the public call ``rasterization`` in every mode, with what that adds to the stages.

Full Jacobians on a tiny scene cover every entry of every gradient, including those that cancel along a random
direction; inner products on a larger scene cover many tiles and long lists. A check that cannot fail counts as failed:
an empty image, a zero gradient, a column for which every step crosses a threshold.
"""

from collections.abc import Sequence

import numpy as np

from minisplat_ref.constants import GSPLAT_1_5, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.oracle.cases import Case, Report
from minisplat_ref.oracle.differences import (
    STEPS,
    Differentiate,
    careful_derivative,
    check_inner_products,
    check_jacobians,
    largest_error,
    relative_error,
)
from minisplat_ref.oracle.pieces import PIECES, SEED, tiny_setting
from minisplat_ref.oracle.public_call import CALLS, Call, rasterization_stage
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.oracle.stages import Stage, backend_stages, composite_stage, project_stage, sh_stage
from minisplat_ref.oracle.tolerances import (
    COVERAGE_MIN,
    GRADIENT_FLOOR,
    GRADIENT_REL,
    GRADIENT_REL_NEAR_THRESHOLD,
    PEER_REL,
)
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import Floats

AUTOGRAD = "torch autograd"
"""Setting of the report: the peer of the comparison, or why there was none."""


def check_all_gradients(backends: Sequence[Backend], conventions: Conventions) -> Report:
    """Check several backends.

    Parameters
    ----------
    backends : sequence of Backend
        One after the other.
    conventions : Conventions
        As for :func:`check_gradients`.

    Returns
    -------
    Report
        The cases of all; their names begin with the backend's if there are several.
    """
    reports = [check_gradients(backend, conventions) for backend in backends]
    names = ", ".join(backend.name for backend in backends)
    settings = {**reports[0].settings, "backend": names}
    cases = by_backend(backends, [report.cases for report in reports])
    return Report(f"gradients of {names}, profile {conventions.name}, float64", cases, settings)


def by_backend(backends: Sequence[Backend], cases: Sequence[Sequence[Case]]) -> tuple[Case, ...]:
    """Return the cases of several backends as one sequence; if there are several, names begin with the backend's."""
    if len(backends) == 1:
        return tuple(cases[0])
    return tuple(
        case._replace(name=f"{backend.name}: {case.name}")
        for backend, own in zip(backends, cases, strict=True)
        for case in own
    )


def check_gradients(backend: Backend, conventions: Conventions) -> Report:
    """Check all stages of a backend.

    Parameters
    ----------
    backend : Backend
        Whose backward functions must match its forward ones; in float64.
    conventions : Conventions
        Profile of the check. The comparison with gsplat uses gsplat's.

    Returns
    -------
    Report
        A case for each stage and way of checking; for the reference, also for the formulas inside the stages.
    """
    rng = np.random.default_rng(SEED)
    tiny, larger = tiny_setting(conventions), make_setting(rng, 60, 40, 30, conventions, sh_degree=3)
    own = f"{backend.name}, Jacobians"
    cases = [jacobian_case(stage) for stage in with_progress(backend_stages(backend, tiny, rng), own, "stages")]
    if backend is REFERENCE:
        done = {case.name for case in cases}
        pieces = [stage for module, pieces_of in PIECES.items() for stage in pieces_of(module)]
        left = [stage for stage in pieces if f"{stage.name}: Jacobian" not in done]
        cases += [jacobian_case(stage) for stage in with_progress(left, own, "formulas")]
    stages = with_progress(backend_stages(backend, larger, rng), f"{backend.name}, inner products", "stages")
    cases += [inner_product_case(stage, rng) for stage in stages]
    cases += public_call_cases(backend, conventions)
    settings = {"backend": backend.name, "profile": conventions.name, "dtype": "float64", "seed": SEED}
    try:
        cases += autograd_cases(backend)
        settings[AUTOGRAD] = "through gsplat's functions, profile GSPLAT_1_5"
    except InputError as error:
        settings[AUTOGRAD] = f"not run: {error}"
    return Report(f"gradients of {backend.name}, profile {conventions.name}, float64", tuple(cases), settings)


def public_call_cases(backend: Backend, conventions: Conventions) -> list[Case]:
    """Check ``rasterization``: the expected depth of a view entry by entry, every mode along random directions."""
    rng = np.random.default_rng(SEED)
    tiny, larger = tiny_setting(conventions), make_setting(rng, 20, 20, 15, conventions, sh_degree=3)
    cases = [jacobian_case(rasterization_stage(backend, tiny, Call("ED"), rng, n_cameras=1))]
    calls = with_progress(CALLS, f"{backend.name}, rasterization", "modes")
    cases += [inner_product_case(rasterization_stage(backend, larger, call, rng), rng) for call in calls]
    return cases


def jacobian_case(stage: Stage, differentiate: Differentiate = careful_derivative) -> Case:
    """Compare full Jacobians of a stage, from its VJP and from differences; see :func:`check_jacobians`."""
    inputs, outputs = list(stage.inputs.values()), stage.function(*stage.inputs.values()).outputs
    check = check_jacobians(
        stage.function,
        stage.vjp,
        inputs,
        names=list(stage.inputs),
        output_names=list(stage.outputs),
        differentiate=differentiate,
    )
    limit = _limit(check.step)
    problems = [f"d {block.output} / d {block.input} is wrong" for block in check.blocks if not block.error <= limit]
    problems += [f"nothing was checked about {name}" for name in check.vacuous]
    problems += [f"{check.n_refused} columns cross a threshold at every step"] if check.n_refused else []
    figures = {
        "error": largest_error([block.error for block in check.blocks]),
        "limit": limit,
        "step": check.step,
        "entries": sum(map(np.size, outputs)) * sum(map(np.size, inputs)),
        "least block": min((block.size for block in check.blocks if not block.is_zero), default=0.0),
    }
    return _case(f"{stage.name}: Jacobian", stage, outputs, figures, problems)


def inner_product_case(
    stage: Stage, rng: np.random.Generator, differentiate: Differentiate = careful_derivative
) -> Case:
    """Compare directional derivatives of a stage, one for each input; see :func:`check_inner_products`."""
    inputs, outputs = list(stage.inputs.values()), stage.function(*stage.inputs.values()).outputs
    names = list(stage.inputs)
    products = check_inner_products(stage.function, stage.vjp, inputs, rng, names=names, differentiate=differentiate)
    problems = [f"{p.input}: every step crosses a threshold" for p in products if p.step == 0]
    problems += [f"the gradient with respect to {p.input} is zero" for p in products if p.size <= GRADIENT_FLOOR]
    problems += [
        f"gradient with respect to {p.input} is wrong" for p in products if p.step > 0 and not p.error <= _limit(p.step)
    ]
    step = min(p.step for p in products)
    figures = {
        "error": largest_error([p.error for p in products]),
        "limit": _limit(step),
        "step": step,
        "entries": sum(map(np.size, outputs)) * sum(map(np.size, inputs)),
        "least block": min(p.size for p in products),
    }
    return _case(f"{stage.name}: inner products", stage, outputs, figures, problems)


def autograd_cases(backend: Backend) -> list[Case]:
    """Compare the gradients of projection, colours and compositing with torch's autograd through gsplat's functions.

    Raises
    ------
    InputError
        If torch or gsplat is not installed.
    """
    from minisplat_ref.oracle.peers.gsplat_torch import gsplat_torch

    peer = gsplat_torch()
    setting = make_setting(np.random.default_rng(SEED), 20, 20, 15, GSPLAT_1_5, sh_degree=3)
    cases = []
    for make_stage in (project_stage, sh_stage, composite_stage):
        ours, theirs = make_stage(backend, setting), make_stage(peer, setting)
        outputs = ours.function(*ours.inputs.values()).outputs
        rng = np.random.default_rng(SEED)
        cotangents = [rng.normal(size=np.shape(output)) for output in outputs]
        gradients = zip(ours.vjp(*cotangents), theirs.vjp(*cotangents), strict=True)
        errors = [relative_error(got, expected, GRADIENT_FLOOR) for got, expected in gradients]
        wrong = zip(ours.inputs, errors, strict=True)
        problems = [f"gradient with respect to {name} differs" for name, error in wrong if not error <= PEER_REL]
        figures = {"error": largest_error(errors), "limit": PEER_REL}
        cases.append(_case(f"{ours.name}: {AUTOGRAD}", ours, outputs, figures, problems))
    return cases


def _case(name: str, stage: Stage, outputs: Sequence[Floats], figures: dict[str, float], problems: list[str]) -> Case:
    named = dict(zip(stage.outputs, outputs, strict=True))
    if "alpha" in named:
        coverage = float(named["alpha"].mean())
        figures = {**figures, "mean alpha": coverage}
        problems = [*problems, "the image is all but empty"] if coverage < COVERAGE_MIN else problems
    return Case(name, not problems, dict(figures), "; ".join(problems))


def _limit(step: float) -> float:
    return GRADIENT_REL if step >= STEPS[2] else GRADIENT_REL_NEAR_THRESHOLD
