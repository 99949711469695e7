"""The signature of an error in the arrays of a comparison, and the planted faults whose signatures are most similar.

An error in one formula leaves its traces downstream: some arrays are wrong, others right, and each wrong one is off in
a characteristic way. Of each array that was given a *mark* is kept: whether it is wrong, how much of it relative to the
others, whether it is off along itself (by a factor) or across, and in which columns. None of these depends much on the
size of the error, or on the scene. The *signature* of a renderer is the mean of its marks over the scenes, with the
scenes in which an array is wrong.

The signatures of the faults of :mod:`minisplat_ref.oracle.faults` are measured by ``python -m data_tools.signatures``
and kept in ``signatures.json``: once with every stage fed with the truth's input, once with each stage after the other.
The distance of two signatures is a sum over the arrays that both have, so that a renderer that gives few arrays is
compared by these.
"""

import functools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.oracle.golden.format import SPECS
from minisplat_ref.types import Bools, Floats

FILE = Path(__file__).with_name("signatures.json")
N_LIKELIEST = 3
N_SHOWN = 6  # arrays in a line
INTERMEDIATE = {
    "means2d": "means2d",
    "depths": "depths",
    "conics": "conics",
    "opacities2d": "opacities",
    "radii": "radii",
}
"""The entries that a function can return in its meta, by gsplat's names."""
GRADIENTS = {f"v_{array}": f"a gradient of {key}" for array, key in INTERMEDIATE.items() if array != "radii"}
LEAST_SHARE = 1e-4  # relative error, of the largest of all arrays, below which all errors have the same mark
FAR = 2.0  # difference of common logarithms of sizes from which on it counts in full
WEIGHTS = {"wrong": 1.0, "size": 0.5, "along": 1.0, "columns": 1.0}
"""Of the parts of a distance, each from 0 to 1. Chosen among a dozen by the scenes of seed 1, and judged on others."""


class Mark(NamedTuple):
    """The error of an array in one scene."""

    is_wrong: bool
    size: float = 0.0
    """Norm of the error over the norm of the truth."""
    along: float = 0.0
    """Cosine of the angle between error and truth: 1 and -1 where the array is too large or small by a factor."""
    columns: tuple[float, ...] = ()
    """Part of the squared error in each of at most four columns."""


class Trace(NamedTuple):
    """The error of an array over several scenes."""

    check_step: frozenset[str]
    """Scenes."""
    size: float = 0.0
    """Mean over these of the common logarithm of its size over the largest of the scene, at least ``LEAST_SHARE``."""
    along: float = 0.0
    columns: tuple[float, ...] = ()


Signature = Mapping[str, Trace]
"""Of each array that was given."""


def mark(given: Floats, expected: Floats, *, is_wrong: bool, set_aside: Bools | None = None) -> Mark:
    """Return the mark of an array.

    Parameters
    ----------
    given, expected : ndarray
        Of one shape.
    is_wrong : bool
        Whether it was judged to be off.
    set_aside : ndarray of bool, optional
        Places, along the first axes, at which rounding decides.
    """
    if not is_wrong:
        return Mark(False)
    given, expected = np.asarray(given, np.float64), np.asarray(expected, np.float64)
    error = given - expected
    if set_aside is not None:
        error = np.where(set_aside.reshape(set_aside.shape + (1,) * (error.ndim - set_aside.ndim)), 0, error)
    error = np.where(np.isfinite(error), error, 0)
    norms = float(np.linalg.norm(error)), float(np.linalg.norm(expected))
    if not norms[0]:  # NaN and infinities alone
        return Mark(True, 1.0)
    along = float(np.vdot(error, expected) / (norms[0] * norms[1])) if norms[1] else 0.0
    columns: tuple[float, ...] = ()
    if expected.ndim == 2 and 2 <= expected.shape[1] <= 4:
        columns = tuple((np.sum(error**2, axis=0) / norms[0] ** 2).tolist())
    return Mark(True, norms[0] / norms[1] if norms[1] else norms[0], along, columns)


def signature(marks: Mapping[str, Mapping[str, Mark]]) -> Signature:
    """Return the signature of marks by scene, then array."""
    sizes = {
        scene: max((m.size for m in of_scene.values() if m.is_wrong), default=1.0) for scene, of_scene in marks.items()
    }
    traces = {}
    for array in dict.fromkeys(array for of_scene in marks.values() for array in of_scene):
        wrong = {s: of_scene[array] for s, of_scene in marks.items() if array in of_scene and of_scene[array].is_wrong}
        if not wrong:
            traces[array] = Trace(frozenset())
            continue
        shares = [np.log10(max(m.size / sizes[scene], LEAST_SHARE)) for scene, m in wrong.items()]
        widths = {len(m.columns) for m in wrong.values()}
        columns = np.mean([m.columns for m in wrong.values()], axis=0) if len(widths) == 1 else np.zeros(0)
        traces[array] = Trace(
            frozenset(wrong),
            float(np.mean(shares)),
            float(np.mean([m.along for m in wrong.values()])),
            tuple(np.atleast_1d(columns).tolist()),
        )
    return traces


def distance(found: Signature, known: Signature, scenes: Sequence[str]) -> float:
    """Return the distance of two signatures, in units of one array that is wrong in one and right in the other.

    An error of the other sign is the same error: it is the smaller of the two distances.

    Parameters
    ----------
    found : mapping
        Of a renderer.
    known : mapping
        Of a fault; an array that it does not have is right.
    scenes : sequence of str
        That both have.
    """
    return min(_distance(found, known, frozenset(scenes), sign) for sign in (1.0, -1.0))


def _distance(found: Signature, known: Signature, scenes: frozenset[str], sign: float) -> float:
    """Return the distance to a fault of the same sign or of the other one."""
    total, right = 0.0, Trace(frozenset())
    for array, trace in found.items():
        other = known.get(array, right)
        ours, theirs = trace.check_step & scenes, other.check_step & scenes
        if not ours | theirs:
            continue
        n_differing = len(ours ^ theirs)
        total += WEIGHTS["wrong"] * 0.5 * (n_differing / len(scenes) + n_differing / len(ours | theirs))
        if not (ours and theirs):
            continue
        total += WEIGHTS["size"] * min(1.0, abs(trace.size - other.size) / FAR)
        total += WEIGHTS["along"] * 0.5 * abs(sign * trace.along - other.along)
        if len(trace.columns) == len(other.columns) > 0:
            total += WEIGHTS["columns"] * 0.5 * float(np.abs(np.subtract(trace.columns, other.columns)).sum())
    return total


class Likely(NamedTuple):
    """A fault whose signature is like that of a renderer."""

    what: str
    where: str
    distance: float
    known: Signature


def likeliest(found: Signature, scenes: Sequence[str], *, is_fed: bool, n: int = N_LIKELIEST) -> list[Likely]:
    """Return the faults that look most like a renderer, the likeliest first; none where nothing is wrong.

    Parameters
    ----------
    found : mapping
        Signature of the renderer.
    scenes : sequence of str
        In which it was compared.
    is_fed : bool
        Whether each of its stages was given the truth's input.
    n : int
        How many.
    """
    table = known_signatures("fed" if is_fed else "unfed")
    traces = {array: trace for array, trace in found.items() if array in _arrays_of_faults()}
    common = [scene for scene in scenes if scene in table.scenes]
    if not common or not any(trace.check_step for trace in traces.values()):
        return []
    ranked = [
        Likely(what, where, distance(traces, known, common), known) for (what, where), known in table.faults.items()
    ]
    return sorted(ranked, key=lambda likely: likely.distance)[:n]


class Table(NamedTuple):
    """Signatures of planted faults."""

    scenes: tuple[str, ...]
    faults: Mapping[tuple[str, str], Signature]
    """By the error and its place."""


@functools.cache
def known_signatures(mode: str) -> Table:
    """Return the measured signatures, ``fed`` or ``unfed``."""
    content = json.loads(FILE.read_text(encoding="utf-8"))
    return table_of(content[mode], content["scenes"])


def table_of(rows: Sequence[Mapping[str, Any]], scenes: Sequence[str]) -> Table:
    """Return the table from the rows of :func:`rows_of`."""
    faults = {}
    for row in rows:
        traces = {}
        for array, (wrong, size, along, columns) in row["arrays"].items():
            check_step = frozenset(s for s, letter in zip(scenes, wrong, strict=True) if letter == "x")
            traces[array] = Trace(check_step, size, along, tuple(columns))
        faults[row["what"], row["where"]] = traces
    return Table(tuple(scenes), faults)


def rows_of(table: Table) -> list[dict[str, Any]]:
    """Return a table as JSON has it: of each array that is wrong somewhere, the scenes as letters, and its numbers."""
    return [
        {
            "what": what,
            "where": where,
            "arrays": {
                array: [
                    "".join("x" if scene in trace.check_step else "." for scene in table.scenes),
                    round(trace.size, 2),
                    round(trace.along, 2),
                    [round(share, 2) for share in trace.columns],
                ]
                for array, trace in known.items()
                if trace.check_step
            },
        }
        for (what, where), known in table.faults.items()
    ]


@functools.cache
def _arrays_of_faults() -> frozenset[str]:
    """Return the arrays that some fault makes wrong; losses, statistics and Adam are told by their own stage."""
    tables = [known_signatures(mode) for mode in ("fed", "unfed")]
    return frozenset(array for table in tables for known in table.faults.values() for array in known)


def in_words(found: Signature, likely: Sequence[Likely], not_given: Iterable[str]) -> list[str]:
    """Return the wrong and right arrays, the faults of a similar signature, and arrays that would distinguish them.

    Parameters
    ----------
    found : mapping
        Signature of the renderer.
    likely : sequence of Likely
        From :func:`likeliest`; at least one.
    not_given : iterable of str
        Arrays that the renderer could give and does not.
    """
    wrong = [array for array, trace in found.items() if trace.check_step]
    is_forward = any(SPECS[array].role == "output" for array in wrong)
    role = "output" if is_forward else "gradient"
    right = [a for a in found if a not in wrong and SPECS[a].role == role and a in _arrays_of_faults()]
    kept = f" and {', '.join(right[:N_SHOWN])} right" if right else ""
    more = " ..." if len(wrong) > N_SHOWN else ""
    lines = [f"{', '.join(wrong[:N_SHOWN])}{more} wrong{kept}: as with"]
    lines += [f"  {k}. {one.what}" for k, one in enumerate(likely, 1)]
    telling = [array for array in not_given if len({bool(one.known.get(array)) for one in likely}) > 1]
    keys = [INTERMEDIATE[array] for array in telling if array in INTERMEDIATE]
    keys += [GRADIENTS[array] for array in telling if array in GRADIENTS]
    if keys:
        lines.append(f"to tell these apart, return {', '.join(keys)} as well (a function: in its meta)")
    return lines
