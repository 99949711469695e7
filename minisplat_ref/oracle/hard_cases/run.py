"""Run each hard case in every precision, forward and backward, and compare it with the reference in float64.

A case passes if every precision refuses it with the expected message; or if all outputs and all gradients are finite
and within its tolerance of the reference. Derivatives with respect to the outputs are random, fixed and the same in all
precisions, and zero at pixels on a threshold: see :mod:`minisplat_ref.oracle.thresholds`. The summary has a line for
each kind: the number of cases, how many are refused, and the largest error against the reference.
"""

import fnmatch
import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.hard_cases.subjects import Arrays, Drawing, HardCase, Subject, render_subject, splat_tapes
from minisplat_ref.oracle.thresholds import Thresholds, span_of, thresholds
from minisplat_ref.oracle.tolerances import BLOCK_FLOOR, OWN_KERNELS
from minisplat_ref.rendering.backends import CPU, CPU_EXACT, REFERENCE, Backend
from minisplat_ref.rendering.splatting import SplatTape
from minisplat_ref.types import Bools


class Precision(NamedTuple):
    """A backend with a dtype."""

    label: str
    backend: Backend
    dtype: type


PRECISIONS = (
    Precision("f64", CPU, np.float64),
    Precision("f32 exact", CPU_EXACT, np.float32),
    Precision("f32", CPU, np.float32),
)


class Outcome(NamedTuple):
    """The results of one precision for a case."""

    outputs: Arrays
    gradients: Arrays


def run_hard_cases(cases: Sequence[HardCase], precisions: Sequence[Precision] = PRECISIONS) -> Report:
    """Run cases.

    Parameters
    ----------
    cases : sequence of HardCase
        From the catalogue.
    precisions : sequence of Precision
        Compared with the reference in float64.

    Returns
    -------
    Report
        A :class:`Case` for each; columns are image and gradient errors by precision, pixels on a threshold and flips.
    """
    return Report(
        "Hard cases: every precision against the reference in float64, forward and backward",
        tuple(run_hard_case(case, precisions) for case in with_progress(cases, "hard cases", "cases")),
        {"precisions": [precision.label for precision in precisions]},
    )


def select_cases(cases: Sequence[HardCase], pattern: str) -> tuple[HardCase, ...]:
    """Return the cases whose name contains the pattern, in which ``*`` and ``?`` are wildcards.

    Raises
    ------
    InputError
        If there is none.
    """
    found = tuple(case for case in cases if fnmatch.fnmatch(case.name, f"*{pattern}*"))
    if not found:
        raise InputError(f"no hard case is named like {pattern!r}; run without --only to see all names")
    return found


def run_hard_case(case: HardCase, precisions: Sequence[Precision] = PRECISIONS) -> Case:
    """Run one case; see :func:`run_hard_cases`."""
    subject = case.build()
    if case.refusal is not None:
        return _refusal(case, case.refusal, subject, precisions)
    try:
        return _comparison(case, subject, precisions)
    except InputError as error:
        return Case(case.name, False, {}, f"refused: {error}")


def _refusal(case: HardCase, refusal: str, subject: Subject, precisions: Sequence[Precision]) -> Case:
    """Check that the reference and every precision refuse the subject, in one line with the expected text."""
    for precision in (Precision("reference", REFERENCE, np.float64), *precisions):
        try:
            render_subject(subject, precision.backend, np.dtype(precision.dtype))
        except InputError as error:
            message = str(error)
            if refusal not in message or "\n" in message:
                return Case(case.name, False, {}, f"{precision.label} says {message!r}, not {refusal!r}")
        else:
            return Case(case.name, False, {}, f"{precision.label} does not refuse it")
    return Case(case.name, True, {}, f"refused: {refusal}")


def _comparison(case: HardCase, subject: Subject, precisions: Sequence[Precision]) -> Case:
    expected_drawing = render_subject(subject, REFERENCE, np.dtype(np.float64))
    tapes = splat_tapes(subject, REFERENCE)
    at = _thresholds(tapes[0], _size(expected_drawing.outputs)) if tapes else None
    at_threshold = None if at is None else at.is_near | at.medians
    cotangents = _cotangents(case.name, subject.cotangent_scale, expected_drawing, at_threshold)
    expected = _outcome(expected_drawing, cotangents, np.float64)
    problems = _problems_of_reference(case, expected)
    figures: dict[str, Figure] = {}
    n_flips = 0
    for precision in precisions:
        actual = _outcome(
            render_subject(subject, precision.backend, np.dtype(precision.dtype)), cotangents, precision.dtype
        )
        image_error, flips = _image_error(actual.outputs, expected.outputs, at_threshold)
        block, gradient_error = _gradient_error(actual.gradients, expected.gradients, expected_drawing.gradient_size)
        is_wide = precision.dtype is np.float64
        image_max = case.tolerance.image64 if is_wide else case.tolerance.image32
        gradient_max = case.tolerance.gradient64 if is_wide else case.tolerance.gradient32
        if (name := _not_finite(actual)) is not None:
            problems.append(f"{precision.label}: {name} is not finite")
        if not image_error <= image_max:
            problems.append(f"{precision.label}: image off by {image_error:.1e}, allowed are {image_max:.0e}")
        if not gradient_error <= gradient_max:
            problems.append(f"{precision.label}: v_{block} off by {gradient_error:.1e}, allowed are {gradient_max:.0e}")
        figures |= {f"image {precision.label}": image_error, f"grad {precision.label}": gradient_error}
        n_flips = max(n_flips, int((flips > image_max).sum()))
        if at is not None and (flips > image_max + at.allowance[at_threshold]).any():
            problems.append(f"{precision.label}: a pixel on a threshold is off by {flips.max():.1e}, more than one hit")
    n_near = 0 if at_threshold is None else int(at_threshold.sum())
    figures |= {"on threshold": n_near, "flips": n_flips}
    order = ("image", "grad", "on", "flips")
    columns = {key: figures[key] for prefix in order for key in figures if key.startswith(prefix)}
    return Case(case.name, not problems, columns, "; ".join(problems))


def _thresholds(tape: SplatTape, size: float) -> Thresholds:
    """Find the pixels at thresholds; errors are relative to the size of the image, and those of alpha to 1."""
    span = max(1.0, span_of(tape) / size)
    return thresholds(tape.projection, tape.bins, tape.conventions, OWN_KERNELS, span=span)


def _outcome(drawn: Drawing, cotangents: Arrays, dtype: type) -> Outcome:
    with np.errstate(all="ignore"):  # a cotangent below float32's range becomes 0
        v: Arrays = {name: array.astype(dtype) for name, array in cotangents.items()}
        return Outcome(drawn.outputs, drawn.vjp(v))


def _cotangents(name: str, scale: float, drawn: Drawing, at_threshold: Bools | None) -> Arrays:
    """Return random derivatives that are exact in float32, the same in every precision and every run."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    cotangents: Arrays = {}
    for key in drawn.differentiable:
        v = scale * rng.normal(size=drawn.outputs[key].shape).astype(np.float32).astype(np.float64)
        if at_threshold is not None:
            v[at_threshold] = 0
        cotangents[key] = v
    return cotangents


def _problems_of_reference(case: HardCase, expected: Outcome) -> list[str]:
    """Return an error of the reference itself, or a note that the case checks nothing."""
    if (name := _not_finite(expected)) is not None:
        return [f"reference: {name} is not finite"]
    moved = [key for key, v in expected.gradients.items() if "background" not in key and v.any()]
    if case.is_background and (moved or expected.outputs["alpha"].any()):
        return ["reference: something is drawn, or has a gradient"]
    if not case.is_background and "alpha" in expected.outputs and not expected.outputs["alpha"].any():
        return ["nothing is drawn: the case checks nothing"]
    return []


def _not_finite(outcome: Outcome) -> str | None:
    named = {**outcome.outputs, **{f"v_{key.removeprefix('v_')}": value for key, value in outcome.gradients.items()}}
    return next((name for name, value in named.items() if not np.isfinite(value).all()), None)


def _size(outputs: Arrays) -> float:
    return max(1.0, max(float(np.abs(value).max(initial=0.0)) for value in outputs.values()))


def _image_error(actual: Arrays, expected: Arrays, at_threshold: Bools | None) -> tuple[float, np.ndarray]:
    """Return the outputs' largest error away from thresholds, relative to their sizes, and the errors at them [P]."""
    worst, on_threshold = 0.0, np.zeros(0 if at_threshold is None else at_threshold.sum())
    for name, value in expected.items():
        with np.errstate(invalid="ignore"):
            error = np.abs(actual[name] - value) / _size({name: value})
        if at_threshold is not None:
            if name in ("image", "alpha"):
                worst_channel = error.reshape(*at_threshold.shape, error[0, 0].size).max(axis=2)  # [H, W]
                on_threshold = np.maximum(on_threshold, worst_channel[at_threshold])
            error = error[~at_threshold]
        worst = max(worst, float(error.max(initial=0.0)))  # NaN is found by _not_finite
    return worst, on_threshold


def _gradient_error(actual: Arrays, expected: Arrays, least: float) -> tuple[str, float]:
    """Return the block with the largest relative L2 error, and that error."""
    norms = {key: float(np.linalg.norm(value)) for key, value in expected.items()}
    present = [norm for norm in norms.values() if norm > 0]
    floor = max(least, BLOCK_FLOOR * float(np.median(present)) if present else 0.0)
    errors = {}
    for key, value in expected.items():
        difference = float(np.linalg.norm(actual[key].astype(np.float64) - value))
        size = max(norms[key], floor, float(np.finfo(np.float32).tiny))
        errors[key] = difference / size
    worst = max(errors, key=lambda key: errors[key])
    return worst.removeprefix("v_"), errors[worst]


def by_group(report: Report, groups: Mapping[str, Sequence[HardCase]]) -> Report:
    """Summarise a report, a row for each group that has cases in it.

    Parameters
    ----------
    report : Report
        From :func:`run_hard_cases`.
    groups : mapping
        The catalogue by kind.

    Returns
    -------
    Report
        Its figures: number of cases, how many were refused, the largest of each error, the sum of the flips.
    """
    rows = []
    for name, members in groups.items():
        names = {member.name for member in members}
        cases = [case for case in report.cases if case.name in names]
        if cases:
            rows.append(Case(name, all(case.passed for case in cases), _figures(cases)))
    return Report(report.title, tuple(rows), report.settings)


def _figures(cases: Sequence[Case]) -> dict[str, Figure]:
    drawn = [case.figures for case in cases if case.figures]
    figures: dict[str, Figure] = {"cases": len(cases), "refused": sum(not case.figures for case in cases)}
    for key in drawn[0] if drawn else ():
        values = [value for row in drawn if isinstance(value := row[key], int | float)]
        figures[key] = sum(values) if isinstance(values[0], int) else max(values)
    return figures
