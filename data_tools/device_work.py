"""Count what a call asks of the device: launches, what they pass, allocations, copies and synchronisations.

The fixed cost of a pass is made of these, whatever the number of Gaussians. They are counted where Python asks for
them, so that the simulator counts what a card would be asked for. ``NUMBA_ENABLE_CUDASIM=1 python -m
data_tools.device_work`` counts both passes over a million Gaussians without running a kernel, times the Python around
the launches, and prints one JSON. On a card, ``data_tools.check_gpu`` counts and times what runs.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any
from unittest.mock import patch

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.errors import InputError
from minisplat_ref.types import Gaussians

DESCRIPTION = "Count what both passes of the backend cuda ask of a GPU, in Numba's simulator; print one JSON."
LAUNCH_US = (7.0, 14.0)  # of a launch by numba-cuda, microseconds, its arguments included


@dataclass
class Work:
    """What was asked of the device.

    Attributes
    ----------
    kernels : list of str
        Names of the kernels that were launched, in order.
    arrays, numbers : int
        Arguments of all launches: each array, and each number, is marshalled in Python.
    allocations : int
        Arrays allocated on the device.
    copies : int
        Arrays copied between host and device, in either direction; those from the device wait for all kernels.
    synchronizations : int
        Calls that only wait.
    """

    kernels: list[str] = field(default_factory=list)
    arrays: int = 0
    numbers: int = 0
    allocations: int = 0
    copies: int = 0
    synchronizations: int = 0

    @property
    def n_launches(self) -> int:
        """Number of launches."""
        return len(self.kernels)

    @property
    def launch_ms(self) -> tuple[float, float]:
        """The least and the most time that the launches alone are predicted to take, in ms."""
        return LAUNCH_US[0] * self.n_launches / 1e3, LAUNCH_US[1] * self.n_launches / 1e3

    def as_counts(self) -> dict[str, Any]:
        """Return the counts by name, the launches as their number, and the predicted time."""
        counts = asdict(self)
        del counts["kernels"]
        return {"launches": self.n_launches, **counts, "predicted_launch_ms": [round(t, 3) for t in self.launch_ms]}

    def launch(self, kernel: Any, args: tuple[Any, ...]) -> None:
        """Count a launch. Numba copies an array of the host to the device, and back."""
        self.kernels.append(kernel.function.__name__)
        for leaf in leaves(args):
            is_host_array = isinstance(leaf, np.ndarray)
            is_array = is_host_array or hasattr(leaf, "copy_to_host")
            self.arrays += is_array
            self.numbers += not is_array
            self.allocations += is_host_array
            self.copies += 2 * is_host_array


def leaves(value: Any) -> Iterator[Any]:
    """Yield the arrays and numbers of nested tuples."""
    if isinstance(value, tuple):
        for part in value:
            yield from leaves(part)
    else:
        yield value


@contextmanager
def count_work(*, runs: bool = True) -> Iterator[Work]:
    """Count what is asked of the device within a ``with`` statement.

    Parameters
    ----------
    runs : bool
        Whether kernels run; without, sizes can be counted for which the simulator is too slow.
    """
    from minisplat_ref.cuda import arrays
    from minisplat_ref.cuda.target import GpuKernel, cuda

    work, kind = Work(), type(arrays.empty(1, np.float32))
    compiled = GpuKernel.__dict__["compiled"]

    class Counted:
        """Takes the place of a compiled kernel, which it launches."""

        def __init__(self, kernel: GpuKernel) -> None:
            self.kernel = kernel

        def __getitem__(self, grid: Any) -> Any:
            dispatcher = compiled.__get__(self.kernel, GpuKernel)[grid]

            def run(*args: Any) -> None:
                work.launch(self.kernel, args)
                if runs:
                    dispatcher(*args)

            return run

    def counting(function: Any, *names: str) -> Any:
        def counted(*args: Any, **named: Any) -> Any:
            for name in names:
                setattr(work, name, getattr(work, name) + 1)
            return function(*args, **named)

        return counted

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("an array was copied to the host behind the counter's back")

    with ExitStack() as stack:
        for place, name, counts in (
            (cuda, "to_device", ("allocations", "copies")),
            (cuda, "device_array", ("allocations",)),
            (cuda, "synchronize", ("synchronizations",)),
            (kind, "copy_to_host", ("copies",)),
            (kind, "copy_to_device", ("copies",)),
        ):
            stack.enter_context(patch.object(place, name, counting(getattr(place, name), *counts)))
        stack.enter_context(patch.object(kind, "__array__", refuse, create=True))
        stack.enter_context(patch.object(GpuKernel, "compiled", property(Counted)))
        yield work


def rounds_of_passes(n: int, size: tuple[int, int], number: float | None = None) -> tuple[Callable[[], Any], ...]:
    """Return both passes over ``n`` Gaussians as functions without arguments.

    Parameters
    ----------
    n : int
    size : tuple of int
        Width and height of the image, pixels.
    number : float, optional
        Written everywhere in the parameters; by default they are not initialised, for passes whose kernels do not run.
    """
    from minisplat_ref.cuda.arrays import empty, to_device
    from minisplat_ref.cuda.passes import Options, Passes

    shapes = (n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, 15, 3)
    g = Gaussians(
        *(
            empty(shape, np.float32) if number is None else to_device(np.full(shape, number, np.float32))
            for shape in shapes
        )
    )
    passes, (width, height) = Passes(is_deterministic=True), size
    v_image, v_alpha = empty((height, width, 3), np.float32), empty((height, width), np.float32)
    camera = look_at(np.array([0.0, -3.0, 0.5]), np.zeros(3), 1.2 * width, width, height)
    options, tapes = Options(np.zeros(3, np.float32), 3, GSPLAT_MAIN), list[Any]()

    def forward() -> None:
        tapes[:] = [passes.render(g, camera, options)]

    return forward, lambda: passes.render_vjp(tapes[0], v_image, v_alpha)


def count_rounds(functions: tuple[Callable[[], Any], ...], *, runs: bool) -> list[list[Work]]:
    """Return what functions ask of the device in a first and in a second round."""
    rounds: list[list[Work]] = [[], []]
    for counts in rounds:
        for function in functions:
            with count_work(runs=runs) as work:
                function()
            counts.append(work)
    return rounds


def time_python(functions: tuple[Callable[[], Any], ...], repeats: int) -> list[float]:
    """Return the median time, in ms, that each function takes when no kernel runs and no argument is marshalled."""
    from minisplat_ref.cuda.target import GpuKernel

    class Nothing:
        def __getitem__(self, grid: Any) -> Any:
            return lambda *args: None

    times: list[list[float]] = [[] for _ in functions]
    with patch.object(GpuKernel, "compiled", property(lambda kernel: Nothing())):
        for _ in range(repeats):
            for function, taken in zip(functions, times, strict=True):
                start = time.perf_counter()
                function()
                taken.append(1e3 * (time.perf_counter() - start))
    return [round(statistics.median(taken), 3) for taken in times]


def main(arguments: list[str] | None = None) -> int:
    """Count both passes without running them, and print one JSON."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.device_work", description=DESCRIPTION)
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="default 1000000")
    parser.add_argument("--width", type=int, default=1920, help="of the image, pixels (default 1920)")
    parser.add_argument("--height", type=int, default=1080, help="of the image, pixels (default 1080)")
    parser.add_argument("--repeats", type=int, default=50, help="of which the median time is taken (default 50)")
    args = parser.parse_args(arguments)
    try:
        from minisplat_ref.cuda.target import is_simulated
    except InputError as error:
        print(f"device_work: {error}", file=sys.stderr)
        return 2
    if not is_simulated:
        print("device_work: this counts in Numba's simulator; set NUMBA_ENABLE_CUDASIM=1", file=sys.stderr)
        return 2
    functions = rounds_of_passes(args.gaussians, (args.width, args.height))
    first, later = ([work.as_counts() for work in counts] for counts in count_rounds(functions, runs=False))
    found = {name: {"first": first[i], "later": later[i]} for i, name in enumerate(("forward", "backward"))}
    python_ms = time_python(functions, args.repeats)
    print(json.dumps(found | {"python_ms": dict(zip(found, python_ms, strict=True))}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
