"""Profile a training iteration: time every stage of a backend.

Everything else (activations, the photograph as floats, Python between the stages) is reported as the rest.
"""

import time
from collections.abc import Callable
from dataclasses import fields, replace
from functools import wraps
from typing import Any

from minisplat_ref.oracle.cases import Case
from minisplat_ref.rendering.backends import Backend

REST, WHOLE = "rest", "whole iteration"


def time_stages(backend: Backend, seconds: dict[str, float]) -> Backend:
    """Return the backend with a timer around each stage.

    Parameters
    ----------
    backend : Backend
    seconds : dict
        Receives the total time of every stage that is called, by its name.
    """
    stages: dict[str, Any] = {field.name: getattr(backend, field.name) for field in fields(backend)}
    watched: dict[str, Any] = {name: _add_timer(f, name, seconds) for name, f in stages.items() if callable(f)}
    return replace(backend, **watched)


def _add_timer(function: Callable, name: str, seconds: dict[str, float]) -> Callable:
    @wraps(function)
    def stage(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = function(*args, **kwargs)
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
        return result

    return stage


def profile_cases(seconds: dict[str, float], total: float, iterations: int) -> list[Case]:
    """Return a case per stage, in the order of the first calls, then the rest and the whole.

    Parameters
    ----------
    seconds : dict
        From :func:`time_stages`, of all iterations.
    total : float
        Seconds of all iterations.
    iterations : int
    """
    rows = {**seconds, REST: total - sum(seconds.values()), WHOLE: total}
    return [
        Case(f"iteration/{name}", True, {"ms": 1e3 * s / iterations, "share %": 100 * s / total})
        for name, s in rows.items()
    ]
