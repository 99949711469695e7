"""Times and errors in one run: contenders that are wrong are not timed, all others are timed alternately.

The machine's other work and its clock rate change from minute to minute. So every round runs each contender once, and
the report has the median and the minimum of its times; their ratios are more reliable than the times themselves.
"""

import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from minisplat_ref.bench.contenders import BASELINE_NAME, CHECKED_NAME, REFERENCE_NAME, Contender, all_contenders
from minisplat_ref.bench.judging import Expected, Verdict, backward, expect, failure, forward, judge, with_slack
from minisplat_ref.bench.workloads import Workload
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.rendering.backends import CPU, REFERENCE

SLOW_SECONDS = 4.0  # a contender that takes longer runs only once: it would heat the machine for the others
MILLI = 1e3


class Times(NamedTuple):
    """Times of one contender, seconds."""

    forward: list[float]
    """From parameters to image."""
    backward: list[float]
    """From the image's derivative to the parameters'."""

    @property
    def both(self) -> list[float]:
        """Return the sum of forward and backward for each run."""
        return [a + b for a, b in zip(self.forward, self.backward, strict=True)]


class Entry(NamedTuple):
    """A contender on a workload."""

    contender: Contender
    verdict: Verdict
    """Errors against the reference with the default cut-off."""
    failure: str
    """The error that makes it wrong, empty if it is right."""
    times: Times
    """Empty if it is wrong."""


def benchmark(
    workload: Workload, contenders: Iterable[Contender], repeats: int, report: Callable[[str], None] = lambda _: None
) -> list[Case]:
    """Judge every contender and time those that are right.

    Parameters
    ----------
    workload : Workload
    contenders : iterable of Contender
        The reference is not judged, and timed once, while it computes the expected answer.
    repeats : int
        Runs of each.
    report : callable
        Called with a line about the progress.

    Returns
    -------
    list of Case
        One per contender, named ``workload/contender``.
    """
    report(f"{workload.name}: the reference's answer")
    expected = expect(workload, REFERENCE)
    checked = all_contenders()[CHECKED_NAME]
    trust = failure(checked, judge(checked, workload, expected))
    entries = []
    for contender in contenders:
        report(f"{workload.name}: {contender.name}")
        if contender.name == REFERENCE_NAME:
            times = Times([expected.forward_seconds], [expected.backward_seconds])
            entries.append(Entry(contender, _flawless(), "", times))
        else:
            entries.append(_judge(contender, workload, expected, trust))
    for round_ in range(repeats):
        report(f"{workload.name}: round {round_ + 1} of {repeats}")
        for entry in entries:
            if not entry.failure and entry.contender.name != REFERENCE_NAME:
                _time_once(entry, workload)
    baseline = next((entry for entry in entries if entry.contender.name == BASELINE_NAME), None)
    return [_case(workload, entry, baseline.times if baseline else Times([], [])) for entry in entries]


def _judge(contender: Contender, workload: Workload, expected: Expected, trust: str) -> Entry:
    if contender.slack:  # its margins come from the float64 kernels, if those are right
        expected = with_slack(expected, workload, contender.conventions, contender.slack)
    verdict = judge(contender, workload, expected)
    if contender.conventions == GSPLAT_MAIN:
        wrong = (trust if contender.slack else "") or failure(contender, verdict)
    else:  # and so does the answer to another cut-off
        own = expect(workload, CPU, contender.conventions)
        wrong = trust or failure(contender, judge(contender, workload, own))
    return Entry(contender, verdict, wrong, Times([], []))


def _time_once(entry: Entry, workload: Workload) -> None:
    contender, times = entry.contender, entry.times
    if times.both and times.both[0] > SLOW_SECONDS:
        return
    start = time.perf_counter()
    _, tape = forward(contender, workload)
    rendered = time.perf_counter()
    backward(contender, tape, workload.v_image)
    times.forward.append(rendered - start)
    times.backward.append(time.perf_counter() - rendered)


def _case(workload: Workload, entry: Entry, baseline: Times) -> Case:
    v, times = entry.verdict, entry.times
    figures: dict[str, Figure] = {
        "forward ms": _median(times.forward),
        "backward ms": _median(times.backward),
        "both ms": _median(times.both),
        "least forward ms": _least(times.forward),
        "least both ms": _least(times.both),
        "turns": len(times.both),
        "x textbook": _ratio(baseline.both, times.both),
        "x textbook, forward": _ratio(baseline.forward, times.forward),
        "image max": v.image_max,
        "image RMS": v.image_rms,
        "flips": v.n_flips if entry.contender.conventions == GSPLAT_MAIN else None,
        "image max, no flips": v.quiet_image_max,
        "gradient": v.gradient,
        "gradient, no flips": v.quiet_gradient,
    }
    return Case(f"{workload.name}/{entry.contender.name}", not entry.failure, figures, entry.failure)


def _median(seconds: list[float]) -> float | None:
    return MILLI * float(np.median(seconds)) if seconds else None


def _least(seconds: list[float]) -> float | None:
    return MILLI * min(seconds) if seconds else None


def _ratio(baseline: list[float], own: list[float]) -> float | None:
    """Return its speed relative to the baseline, by the shortest times."""
    return min(baseline) / min(own) if baseline and own else None


def _flawless() -> Verdict:
    return Verdict(0.0, 0.0, 0.0, 0, 0, 0.0, 0.0, "")
