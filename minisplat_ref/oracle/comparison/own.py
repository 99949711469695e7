"""Our own renderers: the backends, a backend with a planted error, and the reference by other conventions."""

import numpy as np

from minisplat_ref.backends import CPU, REFERENCE, Backend
from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.comparison.renderers import Renderer
from minisplat_ref.oracle.golden.arrays import Arrays
from minisplat_ref.oracle.golden.scenes import Golden
from minisplat_ref.oracle.golden.stages import run_stages
from minisplat_ref.oracle.planted import planted


def from_backend(backend: Backend, dtype: str, conventions: Conventions | None = None) -> Renderer:
    """Compare a backend, every stage by itself.

    Parameters
    ----------
    backend : Backend
        Its stages.
    dtype : str
        ``"float32"`` or ``"float64"``.
    conventions : Conventions, optional
        Those that it follows, whatever the scene asks for; by default those of the scene.
    """

    def arrays(truth: Golden) -> Arrays:
        scene = truth if conventions is None else truth._replace(conventions=conventions)
        return run_stages(backend, scene, dtype, fed=truth.arrays)

    name = f"{backend.name} {dtype}" if conventions is None else f"{backend.name} {dtype} by {conventions.name}"
    return Renderer(name, dtype, True, arrays)


def with_planted_error(name: str, dtype: str) -> Renderer:
    """Compare the cpu backend with one error in it."""
    renderer = from_backend(planted(name, CPU), dtype)

    def arrays(truth: Golden) -> Arrays:
        with np.errstate(all="ignore"):  # an error may divide by zero, and is then found
            return renderer.arrays(truth)

    return renderer._replace(arrays=arrays)


def by_profile(conventions: Conventions, dtype: str) -> Renderer:
    """Compare the reference by other conventions than the scene's: what a choice of conventions costs."""
    return from_backend(REFERENCE, dtype, conventions)
