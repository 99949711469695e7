"""What a difference looks like: the planted faults that give the same arrays, or come nearest to them.

Each fault of :mod:`minisplat_ref.oracle.faults` is planted in the reference and rendered as the renderer was. Its size
is fitted. Those that give the same arrays are named, and where the data cannot tell two places apart, both are. If none
does, the nearest are named with the part of the error that they explain. Faults of gradients are tried only where all
images are right, and none is named that changes nothing of what was given.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.oracle.comparison.trials import Evidence, Fit, Trace, fit_of, run_fault, traces_of
from minisplat_ref.oracle.faults import FAULTS, Fault
from minisplat_ref.oracle.golden.format import SPECS, Arrays
from minisplat_ref.types import Floats

N_NAMED = 3
N_REFINED = 8
N_STEPS = 5
N_OTHER_SCENES = 2
N_SHOWN = 6  # arrays in a line
LEAST = 0.1  # part of the error that a fault must explain to be named
REACH = 6.0  # times the usual sizes, that a fitted size may have
CLOSE = 1e-3  # misfits that differ by less are equal
INTERMEDIATE = {
    "means2d": "means2d",
    "depths": "depths",
    "conics": "conics",
    "opacities2d": "opacities",
    "radii": "radii",
}
"""The entries that a function can return in its meta, by gsplat's names."""
GRADIENTS = {f"v_{array}": f"a gradient of {key}" for array, key in INTERMEDIATE.items() if array != "radii"}


class Hint(NamedTuple):
    """A fault that looks like a renderer's."""

    what: str
    """With its size."""
    places: tuple[str, ...]
    """Where it may be; the data does not tell them apart."""
    explained: float
    """Part of the error."""
    is_exact: bool
    """Whether it gives the renderer's arrays."""

    @property
    def words(self) -> str:
        """Return one line."""
        places = [place if place.startswith("gradient") else f"in the {place}" for place in self.places]
        where = f", {' or '.join(places)}" if not self.places[0].startswith("gradient") else ""
        return f"{self.what}{where}" + ("" if self.is_exact else f" (explains {self.explained:.0%} of the error)")


class _Trial(NamedTuple):
    """A fault of a size, and how well it explains a scene."""

    fault: Fault
    order: int
    size: float
    fit: Fit
    arrays: Arrays


class Scene(NamedTuple):
    """The evidence of a scene, with the names of the arrays that are wrong."""

    evidence: Evidence
    wrong: frozenset[str]


def find_hints(scenes: Sequence[Scene], first: int) -> tuple[list[Hint], list[str]]:
    """Return the faults that look like a renderer's, the likeliest first, and arrays that would tell them apart.

    Parameters
    ----------
    scenes : sequence of Scene
        In which it was compared.
    first : int
        Index of the one in which it differs first, by which the faults are searched; some others confirm them.
    """
    evidence, wrong = scenes[first]
    is_forward = any(SPECS[name].role == "output" for name in wrong)
    traces = traces_of(evidence, wrong, is_forward=is_forward)
    if not any(trace.is_wrong for trace in traces):
        return [], []
    trials = [
        _usual(fault, order, evidence, traces) for order, fault in enumerate(FAULTS) if fault.is_forward == is_forward
    ]
    best = sorted(trials, key=lambda trial: trial.fit.misfit)[:N_REFINED]
    best = [_refined(trial, evidence, traces) for trial in best]
    best = [_confirmed(trial, _others(scenes, first), is_forward) for trial in best]
    named = sorted((t for t in best if 1 - t.fit.misfit >= LEAST), key=_rank)
    if named and named[0].fit.is_exact:
        named = [trial for trial in named if trial.fit.is_exact]
    return _merged(named)[:N_NAMED], _telling(named, evidence)


def _rank(trial: _Trial) -> tuple[bool, int, int]:
    """Exact ones first, then by misfit; equal ones in the order of the pipeline."""
    least = 1e-4 if trial.fit.is_exact else CLOSE  # below, it is rounding that differs
    return not trial.fit.is_exact, round(10 * np.log10(max(trial.fit.misfit, 10 * least))), trial.order


def _run(fault: Fault, order: int, size: float, evidence: Evidence, traces: list[Trace]) -> _Trial:
    arrays = run_fault(fault, size, evidence.truth, is_fed=evidence.is_fed)
    return _Trial(fault, order, size, fit_of(traces, arrays, evidence.truth), arrays)


def _usual(fault: Fault, order: int, evidence: Evidence, traces: list[Trace]) -> _Trial:
    """Return the best of the usual sizes, and of the one between which they lead to."""
    trials = [_run(fault, order, size, evidence, traces) for size in fault.sizes]
    best = min(trials, key=lambda trial: trial.fit.misfit)
    if fault.null is None or best.fit.is_exact:
        return best
    return min(best, _step(best, fault.null, _expected(traces), evidence, traces), key=lambda trial: trial.fit.misfit)


def _refined(trial: _Trial, evidence: Evidence, traces: list[Trace]) -> _Trial:
    """Fit the size by secants, to least squares."""
    if trial.fault.null is None:
        return trial
    best, from_size, from_values = trial, trial.fault.null, _expected(traces)
    current = trial
    for _ in range(N_STEPS):
        if best.fit.misfit < CLOSE / 10:
            break
        new = _step(current, from_size, from_values, evidence, traces)
        if new.size == current.size:
            break
        from_size, from_values, current = current.size, _values(current.arrays, evidence, traces), new
        best = min(best, new, key=lambda trial: trial.fit.misfit)
    return best


def _step(trial: _Trial, from_size: float, from_values: Floats, evidence: Evidence, traces: list[Trace]) -> _Trial:
    """Go along the secant through two sizes to where the arrays would be nearest to the renderer's."""
    values = _values(trial.arrays, evidence, traces)
    if trial.size == from_size:
        return trial
    slope = (values - from_values) / (trial.size - from_size)
    norm = float(slope @ slope)
    if not np.isfinite(norm) or norm == 0:
        return trial
    size = trial.size + float(slope @ (_given(traces) - values)) / norm
    null = trial.fault.null or 0.0
    reach = REACH * max(abs(usual - null) for usual in trial.fault.sizes)
    size = float(np.clip(size, null - reach, null + reach))
    return trial if not np.isfinite(size) else _run(trial.fault, trial.order, size, evidence, traces)


def _weighted(values: Sequence[Floats], traces: Sequence[Trace]) -> Floats:
    """Return the values of all wrong arrays, each of which counts the same."""
    parts = []
    for array, trace in zip(values, traces, strict=True):
        if trace.is_wrong:
            size = np.sqrt(np.nansum((trace.given - trace.expected) ** 2)) or 1.0
            parts.append(np.nan_to_num(array / size, nan=0.0, posinf=0.0, neginf=0.0))
    return np.concatenate(parts)


def _values(arrays: Arrays, evidence: Evidence, traces: list[Trace]) -> Floats:
    return _weighted([trace.of(arrays, evidence.truth) for trace in traces], traces)


def _given(traces: list[Trace]) -> Floats:
    return _weighted([trace.given for trace in traces], traces)


def _expected(traces: list[Trace]) -> Floats:
    return _weighted([trace.expected for trace in traces], traces)


def _others(scenes: Sequence[Scene], first: int) -> list[Scene]:
    """Return a scene in which all agrees, if there is one, and others in which it does not."""
    others = [scene for k, scene in enumerate(scenes) if k != first]
    agreeing, differing = ([scene for scene in others if bool(scene.wrong) == is_wrong] for is_wrong in (False, True))
    return [*agreeing[:1], *differing][:N_OTHER_SCENES]


def _confirmed(trial: _Trial, others: list[Scene], is_forward: bool) -> _Trial:
    """Return the trial with its mean misfit over other scenes as well."""
    fits = [trial.fit]
    for evidence, wrong in others:
        traces = traces_of(evidence, wrong, is_forward=is_forward)
        fits.append(_run(trial.fault, trial.order, trial.size, evidence, traces).fit)
    misfit = float(np.mean([fit.misfit for fit in fits]))
    return trial._replace(fit=Fit(misfit, all(fit.is_exact for fit in fits)))


def _merged(trials: list[_Trial]) -> list[Hint]:
    """Join the places of one fault."""
    hints: dict[str, Hint] = {}
    for trial in trials:
        what, where = trial.fault.what, trial.fault.where
        if what not in hints:
            hints[what] = Hint(trial.fault.words(trial.size), (where,), 1 - trial.fit.misfit, trial.fit.is_exact)
        elif where not in hints[what].places and abs(1 - trial.fit.misfit - hints[what].explained) < CLOSE:
            hints[what] = hints[what]._replace(places=(*hints[what].places, where))
    return list(hints.values())


def _telling(trials: list[_Trial], evidence: Evidence) -> list[str]:
    """Return the arrays that the renderer does not give and that differ between these faults."""
    known = {**INTERMEDIATE, **GRADIENTS}
    found = []
    for array in known:
        versions = [trial.arrays[array] for trial in trials if array in trial.arrays]
        if array in evidence.given or len(versions) < 2:
            continue
        unit = 1e-6 * (float(np.max(np.abs(evidence.truth.arrays[array]), initial=0)) or 1.0)
        if any(np.max(np.abs(version - versions[0]), initial=0) > unit for version in versions[1:]):
            found.append(known[array])
    return found


def in_words(scenes: Sequence[Scene], hints: Sequence[Hint], telling: Sequence[str]) -> list[str]:
    """Return the wrong and right arrays, the faults, and what would tell them apart."""
    given = list(dict.fromkeys(name for scene in scenes for name in scene.evidence.given))
    wrong = [name for name in given if any(name in scene.wrong for scene in scenes)]
    role = "output" if any(SPECS[name].role == "output" for name in wrong) else "gradient"
    right = [name for name in given if name not in wrong and SPECS[name].role == role]
    kept = f" and {', '.join(right[:N_SHOWN])} right" if right else ""
    start = f"{', '.join(wrong[:N_SHOWN])}{' ...' if len(wrong) > N_SHOWN else ''} wrong{kept}"
    n = sum(fault.is_forward == (role == "output") for fault in FAULTS)
    if not hints:
        return [f"{start}: unlike all {n} faults that were planted for comparison"]
    like = "as with" if hints[0].is_exact else f"unlike all {n} planted faults, of which the nearest are"
    lines = [f"{start}: {like}", *(f"  {k}. {hint.words}" for k, hint in enumerate(hints, 1))]
    if telling:
        lines.append(f"to tell these apart, return {', '.join(telling)} as well (a function: in its meta)")
    return lines
