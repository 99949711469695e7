"""Run the catalogue of hard cases with memory that is full of nonsense wherever nobody has written yet.

glibc can fill every block that it hands out, and so what kernels allocate for themselves, in the very kernels that
users run. Blocks that wait in a thread's own list for the next of their size are not filled, so the process has to be
started without such lists: with :data:`ENVIRONMENT`. NumPy keeps small blocks, too; what ``empty`` returns is filled
here.

Prints the name of every case, and of every output that changes.
"""

import ctypes

import numpy as np

from minisplat_ref.jit.compile import kernel
from minisplat_ref.oracle.hard_cases import HARD_CASES
from minisplat_ref.oracle.hard_cases.subjects import render_subject
from minisplat_ref.rendering.backends import CPU, CPU_EXACT, PLAIN

ENVIRONMENT = {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}
M_PERTURB = -6  # of mallopt: fill with the other byte, b ^ 0xff
NAN, HUGE, PLAUSIBLE = 0x100, 0x80, 0xC0  # in float32 of all bytes 0xff, 0x7f and 0x3f: NaN, 3.4e38 and 0.747
FLOATS = {NAN: np.nan, HUGE: 1e38, PLAUSIBLE: 0.75}  # of the last, a record is an opaque Gaussian like any other
RUNS = (
    (CPU, np.float32),
    (CPU, np.float64),
    (CPU_EXACT, np.float32),
    (PLAIN, np.float32),
)


EMPTY, EMPTY_LIKE = np.empty, np.empty_like


@kernel(parallel=False)
def unwritten(n, like):
    """Return memory as kernels get it."""
    return np.empty(n, like.dtype)


def poison(pattern):
    """Fill new memory by a pattern from now on; 0 for none."""

    def filled(array):
        array.reshape(-1).view(np.uint8)[:] = pattern & 0xFF ^ 0xFF
        if array.dtype.kind == "f":
            array.fill(FLOATS[pattern])
        return array

    assert ctypes.CDLL(None).mallopt(M_PERTURB, pattern) == 1
    np.empty, np.empty_like = EMPTY, EMPTY_LIKE
    arrays = [unwritten(n, np.zeros(1, np.float32)) for n in (3, 100, 10_000)]
    if pattern:
        # Only Python sees these: a kernel that was not yet compiled could not be compiled now.
        np.empty = lambda *args, **options: filled(EMPTY(*args, **options))
        np.empty_like = lambda *args, **options: filled(EMPTY_LIKE(*args, **options))
        for array in (*arrays, np.empty(3, np.float32)):
            assert {NAN: np.isnan(array), HUGE: array > 9e37, PLAUSIBLE: np.abs(array - 0.75) < 0.01}[pattern].all()


def results(case, backend, dtype):
    """Outputs and gradients of a case as bytes, by name."""
    drawn = render_subject(case.build(), backend, np.dtype(dtype))
    rng = np.random.default_rng(0)
    v = {name: rng.normal(size=drawn.outputs[name].shape).astype(dtype) for name in drawn.differentiable}
    named = {**drawn.outputs, **{f"v_{name}": value for name, value in drawn.vjp(v).items()}}
    return {name: np.asarray(value).tobytes() for name, value in named.items()}


def main(patterns=(NAN, HUGE, PLAUSIBLE)):
    np.seterr(all="ignore")
    for case in HARD_CASES:
        if case.refusal is not None:
            continue
        print(case.name)
        for backend, dtype in RUNS:
            poison(0)
            expected = results(case, backend, dtype)
            for pattern in patterns:
                poison(pattern)
                found = results(case, backend, dtype)
                changed = [name for name in expected if found[name] != expected[name]]
                if changed:
                    print("CHANGED", case.name, backend.name, np.dtype(dtype), hex(pattern), *changed)
    poison(0)


if __name__ == "__main__":
    main()
