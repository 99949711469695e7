"""The contenders: backends in their precisions, other exponentials, shorter cut-offs, the baseline.

A shorter cut-off gives another image on purpose. It is judged by the float64 kernels with the same cut-off; the
reported error is the one that matters to its user, against the reference with the default cut-off.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from minisplat_ref.bench.exponentials import EXPONENTIALS, relative_errors
from minisplat_ref.bench.passes import RASTERIZATION, RENDER, Passes
from minisplat_ref.bench.textbook import TEXTBOOK
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.cpu.compositing import composite_vjp_with, composite_with
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.tolerances import (
    BENCH_EXPONENTIAL_GRADIENT,
    BENCH_FLOAT32_GRADIENT,
    BENCH_FLOAT32_IMAGE,
    BENCH_FLOAT64,
)
from minisplat_ref.rendering.backends import (
    BACKENDS,
    CPU,
    CPU_EXACT,
    CUDA,
    CUDA_ATOMIC,
    PLAIN,
    REFERENCE,
    Backend,
    get_backend,
)
from minisplat_ref.types import CompositeGradient, Floats, Projection, RenderOutput, TileBins

DEGREE_IN_USE = 5


class Contender(NamedTuple):
    """A way to render, and its error bounds."""

    name: str
    """Unique."""
    backend: Backend
    """Implementation of the stages."""
    dtype: type[np.floating]
    """Of all data."""
    image_bound: float = BENCH_FLOAT32_IMAGE
    """Largest error of a channel at a pixel that is at no threshold."""
    gradient_bound: float = BENCH_FLOAT32_GRADIENT
    """Largest relative L2 error of a parameter's gradient, the same pixels."""
    conventions: Conventions = GSPLAT_MAIN
    """The default's, or with another cut-off."""
    slack: float = 0.0
    """Relative error of its exponential: this far from a threshold, hits may still fall on the other side."""
    passes: Passes = RENDER
    """The public functions through which it is called."""


REFERENCE_NAME = "reference-f64"
BASELINE_NAME = "textbook-f32"
CHECKED_NAME = "cpu-f64"  # judged first: it is the truth for a shorter cut-off


@functools.cache
def all_contenders() -> dict[str, Contender]:
    """Return every contender that needs no other program, by name, the reference first."""
    f32, f64 = np.float32, np.float64
    contenders = [
        Contender(REFERENCE_NAME, REFERENCE, f64, 0.0, 0.0),
        Contender(CHECKED_NAME, CPU, f64, BENCH_FLOAT64, BENCH_FLOAT64),
        Contender("cpu-exact-f32", CPU_EXACT, f32),
        Contender("cpu-f32", CPU, f32),
        Contender("rasterization-f32", CPU, f32, passes=RASTERIZATION),
        *(_of_degree(degree) for degree in EXPONENTIALS if degree != DEGREE_IN_USE),
        *(Contender(f"cpu-f32-{name}", CPU, f32, conventions=cut) for name, cut in CUT_OFFS.items()),
        Contender("plain-f64", PLAIN, f64, BENCH_FLOAT64, BENCH_FLOAT64),
        Contender("plain-f32", PLAIN, f32),
        Contender(BASELINE_NAME, TEXTBOOK, f32),
        *(Contender(f"{name}-f32", backend, f32) for name, backend in BACKENDS.items() if name not in KNOWN),
    ]
    return {contender.name: contender for contender in contenders}


KNOWN = (REFERENCE.name, CPU.name, CPU_EXACT.name)  # backends that the list already has; others may be installed

CUT_OFFS = {
    "cut-1/128": GSPLAT_MAIN._replace(name="CUT_1_128", alpha_min=1 / 128),
    "cut-1/64": GSPLAT_MAIN._replace(name="CUT_1_64", alpha_min=1 / 64),
    "3-sigma": GSPLAT_MAIN._replace(name="THREE_SIGMA", has_full_support=False),
}
"""Skip hits of higher alpha too; or cut a Gaussian off at three standard deviations, by INRIA's tiles."""


def choose(names: tuple[str, ...] | None) -> list[Contender]:
    """Return the named contenders with the reference, in the order of the list; all by default.

    Raises
    ------
    InputError
        A name is unknown.
    """
    contenders = all_contenders()
    if names is None:
        return list(contenders.values())
    names = tuple(name for given in names for name in (ON_GPU if given == CUDA else (given,)))
    contenders = contenders | {name: _gpu_contender(name) for name in names if name in ON_GPU}
    for name in names:
        if name not in contenders:
            raise InputError(f"contender {name!r} is unknown; choose from {', '.join((*contenders, CUDA))}")
    return [contenders[name] for name in contenders if name in (*names, REFERENCE_NAME)]


ON_GPU = {"cuda-f32": CUDA, "cuda-atomic-f32": CUDA_ATOMIC}
"""Contenders that need a GPU, only where they are named; ``cuda`` stands for both. Their times include copying."""


def _gpu_contender(name: str) -> Contender:
    """Return a contender for a GPU.

    Raises
    ------
    InputError
        There is none, or only the simulator, whose times are meaningless.
    """
    backend = get_backend(ON_GPU[name])
    if backend.residence.is_simulated:
        raise InputError(f"{name} would be timed in Numba's simulator, which says nothing: unset NUMBA_ENABLE_CUDASIM")
    return Contender(name, backend, np.float32)


def _of_degree(degree: int) -> Contender:
    exp = EXPONENTIALS[degree]
    error = float(relative_errors(exp, np.linspace(-6, 0, 601, dtype=np.float32)).max())  # exp(-6) < 1/255
    return Contender(
        f"cpu-f32-exp{degree}",
        with_exponential(exp, f"cpu-exp{degree}"),
        np.float32,
        BENCH_FLOAT32_IMAGE + error,  # a pixel is a mean of colours: relative errors e of alphas change it by at most e
        BENCH_FLOAT32_GRADIENT + BENCH_EXPONENTIAL_GRADIENT * error,
        slack=error,
    )


def with_exponential(exp: Callable, name: str) -> Backend:
    """Return the CPU backend with another exponential for blending."""

    def composite(
        projection: Projection,
        colors: Floats,
        background: Floats,
        bins: TileBins,
        conventions: Conventions,
        *,
        with_stats: bool = False,
        with_median_depth: bool = False,
    ) -> RenderOutput:
        return composite_with(exp, projection, colors, background, bins, conventions, with_stats, with_median_depth)

    def composite_vjp(
        projection: Projection,
        colors: Floats,
        background: Floats,
        bins: TileBins,
        conventions: Conventions,
        output: RenderOutput,
        v_image: Floats,
        v_alpha: Floats,
    ) -> CompositeGradient:
        return composite_vjp_with(exp, projection, colors, bins, conventions, output, v_image, v_alpha)

    return replace(CPU, name=name, composite=composite, composite_vjp=composite_vjp)
