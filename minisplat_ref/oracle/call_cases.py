"""Hard cases of a call of gsplat's: chosen by name, and run by our backends in both precisions."""

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.tolerances import CALL_HARD

BACKENDS = ("reference", "cpu")


def select(cases: Sequence[Any], pattern: str) -> tuple[Any, ...]:
    """Return the cases whose name holds a pattern, in which * and ? are wildcards.

    Raises
    ------
    InputError
        There is none.
    """
    found = tuple(case for case in cases if fnmatchcase(case.name, f"*{pattern}*"))
    if not found:
        raise InputError(f"no hard case holds {pattern!r}: there are {', '.join(case.name for case in cases)}")
    return found


def run_cases(call: str, run: Callable[[Any, str, str], tuple[float, bool]], cases: Sequence[Any]) -> Report:
    """Run cases through backends in float64, and through the kernels in float32 too.

    Parameters
    ----------
    call : str
        Name of the call.
    run : callable
        ``run(case, backend, dtype)``: the largest error of the pixels that are known, and whether all images and
        gradients are finite.
    cases : sequence
        What is run; each has a ``name``.
    """
    found = []
    for case in cases:
        for backend in BACKENDS:
            for dtype in ("float64",) if backend == "reference" else ("float64", "float32"):
                error, is_finite = run(case, backend, dtype)
                figures: dict[str, Figure] = {"largest error": error, "limit": CALL_HARD.of(dtype)}
                note = "" if is_finite else "an image or a gradient is not finite"
                passed = is_finite and error <= CALL_HARD.of(dtype)
                found.append(Case(f"{case.name}: {backend} {dtype}", passed, figures, note))
    return Report(f"hard cases of {call}", tuple(found), {"backends": list(BACKENDS)})
