"""Kernels free what they allocate: Numba counts the arrays that compiled code holds.

A generator of compiled code never frees the arrays that it holds; trainings with the plain kernels once filled the
memory in this way.
"""

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Model, view_from
from scenes import as_dtype, make_camera, make_gaussians


def n_held():
    """Return how many arrays compiled code holds."""
    stats = rtsys.get_allocation_stats()
    return stats.mi_alloc - stats.mi_free


@pytest.mark.parametrize("name", ["3dgs", "textured", "pixel-order", "rays", "fans"])
def test_nothing_is_held_after_a_view_and_its_gradient(name, rng):
    """Tuned kernels, plain ones, those that sort each pixel, those that trace, and those that peel."""
    representation = find_recipe(name).representation
    population = representation.extend(as_dtype(make_gaussians(rng, 20), np.float32), rng)
    view, request = view_from(make_camera()), Request(backend=CPU)

    def draw():
        output, tape = representation.renderer.render(Model(population), view, request)
        representation.renderer.render_vjp(tape, np.ones_like(output.image), None)

    draw()  # compiles, and fills what is kept once
    _nrt_python.memsys_enable_stats()
    try:
        draw()
        before = n_held()
        for _ in range(5):
            draw()
        assert n_held() == before
    finally:
        _nrt_python.memsys_disable_stats()
