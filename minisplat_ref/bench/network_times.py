"""The time of small networks and encodings: kernels and NumPy, forward and gradient, on as many rows as a scene has.

The sizes are those of OMG's networks and of a hash grid of four levels. NumPy's products are BLAS's. Every kernel is
checked against NumPy in float64 in the same run, with a bound on the largest error relative to the largest result.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.bench.interleaving import time_interleaved
from minisplat_ref.mechanisms.networks import hash_grid
from minisplat_ref.mechanisms.networks.mlp import Layer, make_network
from minisplat_ref.mechanisms.networks.networks import COMPILED, IN_NUMPY, Networks
from minisplat_ref.oracle.cases import Case
from minisplat_ref.oracle.tolerances import BENCH_FLOAT64
from minisplat_ref.types import Floats

N_ROWS = 10_000
N_OCTAVES = 16
LEVELS = hash_grid.make_levels(4, 16, 128, n_rows=2**12, n_features=2)
MILLI = 1e3


class Work(NamedTuple):
    """A function with its gradient, on data."""

    name: str
    forward: Callable[[Networks], Any]
    backward: Callable[[Networks], tuple[Floats, ...]]
    """Returns everything that was differentiated."""


def network_cases(repeats: int) -> list[Case]:
    """Time each network and encoding in float32, and measure the errors of the kernels.

    Parameters
    ----------
    repeats : int
        Turns of each; NumPy and kernels alternate.
    """
    exact = {work.name: (_error(work.forward), _error(work.backward)) for work in _works(np.float64)}
    cases = []
    for work in _works(np.float32):
        steps = [work.forward, work.backward]
        tasks = [[_task(step, networks) for networks in (IN_NUMPY, COMPILED)] for step in steps]
        times = time_interleaved(tasks, repeats, 1)
        worst = max(exact[work.name])
        figures = {
            f"{step}, {kind} (ms)": MILLI * time.minimum
            for step, pair in zip(("forward", "gradient"), times, strict=True)
            for kind, time in zip(("NumPy", "kernel"), pair, strict=True)
        }
        wrong = "" if worst <= BENCH_FLOAT64 else f"off by {worst:.1e}, more than {BENCH_FLOAT64:.1e}"
        cases.append(Case(work.name, not wrong, {**figures, "error in float64": worst}, wrong))
    return cases


def _task(step: Callable[[Networks], Any], networks: Networks) -> Callable[[], Any]:
    return lambda: step(networks)


def _error(step: Callable[[Networks], Any]) -> float:
    """Return the largest difference between kernel and NumPy over the results, each relative to the largest number."""
    pairs = zip(_arrays(step(COMPILED)), _arrays(step(IN_NUMPY)), strict=True)
    return max(float(np.abs(found - expected).max() / np.abs(expected).max()) for found, expected in pairs)


def _arrays(value: Any) -> list[Floats]:
    return [value] if isinstance(value, np.ndarray) else [array for part in value for array in _arrays(part)]


def _works(dtype: type[np.floating]) -> list[Work]:
    """Return everything that is timed; the data are the same in every dtype, but for rounding."""
    rng = np.random.default_rng(0)
    places = rng.uniform(size=(N_ROWS, 3)).astype(dtype)
    works = [_network(sizes, rng, dtype) for sizes in ((6 * N_OCTAVES, 64, 13), (16, 64, 45))]
    v_gamma = rng.normal(size=(N_ROWS, 6 * N_OCTAVES)).astype(dtype)
    works.append(
        Work(
            f"Fourier, {N_OCTAVES} octaves of 3 numbers",
            lambda networks: networks.fourier(places, N_OCTAVES),
            lambda networks: (networks.fourier_vjp(places, N_OCTAVES, v_gamma),),
        )
    )
    table = rng.normal(size=hash_grid.make_table(LEVELS, rng).shape).astype(dtype)
    v_features = rng.normal(size=(N_ROWS, len(LEVELS.resolutions) * LEVELS.n_features)).astype(dtype)
    works.append(
        Work(
            f"hash grid, {len(LEVELS.resolutions)} levels",
            lambda networks: networks.hash_grid(table, places, LEVELS),
            lambda networks: networks.hash_grid_vjp(table, places, LEVELS, v_features),
        )
    )
    return works


def _network(sizes: tuple[int, ...], rng: np.random.Generator, dtype: type[np.floating]) -> Work:
    network = tuple(Layer(*(array.astype(dtype) for array in layer)) for layer in make_network(sizes, rng))
    x = rng.normal(size=(N_ROWS, sizes[0])).astype(dtype)
    v_y = rng.normal(size=(N_ROWS, sizes[-1])).astype(dtype)
    tapes = {id(networks): networks.forward(network, x)[1] for networks in (IN_NUMPY, COMPILED)}

    def backward(networks: Networks) -> tuple[Floats, ...]:
        gradient, v_x = networks.forward_vjp(network, tapes[id(networks)], v_y)
        return (*(array for layer in gradient for array in layer), v_x)

    return Work(" -> ".join(map(str, sizes)), lambda networks: networks.forward(network, x)[0], backward)
