"""Gaussians with payloads for the tests, and the differences between them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.cuts.model import CUT_GAUSSIANS, CutGaussians, with_cuts
from minisplat_ref.extensions.cuts.model import stages as cuts_stages
from minisplat_ref.extensions.cuts.response import evaluate_cuts_vjp
from minisplat_ref.extensions.mixed.model import MIXED_GAUSSIANS, mix_kinds
from minisplat_ref.extensions.mixed.model import stages as mixed_stages
from minisplat_ref.extensions.mixed.population import make_ellipses
from minisplat_ref.extensions.mixed.projection import place_vertices_vjp
from minisplat_ref.extensions.textured.model import add_textures, meet_vjp
from minisplat_ref.extensions.textured.recipe import TEXTURED_GAUSSIANS
from minisplat_ref.extensions.textured.recipe import stages as textured_stages
from minisplat_ref.rendering import Request
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Gaussians, Model

BACKGROUND = np.full(3, 0.2)


class Case(NamedTuple):
    """One kind of payload: its functions and populations."""

    representation: Representation
    random: Callable[..., Any]
    """(rng, gaussians) -> a population whose payloads matter."""
    plain: Callable[[Gaussians], Any]
    """The same Gaussians without a payload."""
    harmless: Callable[[Gaussians], Any]
    """With payloads that change nothing."""
    stages: Callable[..., Any]
    formula: tuple[str, Callable[..., Any]]
    """A function of the reference that returns gradients, and where its caller finds it."""
    not_learnt: frozenset[str] = frozenset()
    has_own_depths: bool = False
    """Whether depths are not those of 3DGS even without a payload."""


def random_cuts(rng, gaussians, n_curves=1):
    """Return Gaussians with curves through them, a third with hard edges."""
    population, n = with_cuts(gaussians, rng, n_curves=n_curves), len(gaussians.means)
    curves = 0.4 * population.curves + 0.2 * rng.normal(size=population.curves.shape)
    return population._replace(curves=curves, widths=np.where(np.arange(n) % 3 == 0, 0.0, 0.7))


def uncut(gaussians, n_numbers=0):
    """Return Gaussians without curves, or with curves that are points, which cut nothing."""
    n = len(gaussians.means)
    return CutGaussians(*gaussians, curves=np.full((n, n_numbers), 0.3), widths=np.zeros(n))


def random_textures(rng, gaussians, degree=3):
    plain = add_textures(gaussians, degree)
    return plain._replace(
        color_textures=0.3 * rng.normal(size=plain.color_textures.shape),
        opacity_textures=0.5 * rng.normal(size=plain.opacity_textures.shape),
    )


def triangles_of_one_point(gaussians):
    return make_ellipses(gaussians)._replace(n_vertices=np.full(len(gaussians.means), 3.0))


CASES = {
    "cuts": Case(
        CUT_GAUSSIANS,
        random_cuts,
        uncut,
        lambda gaussians: uncut(gaussians, 8),
        cuts_stages,
        ("minisplat_ref.extensions.cuts.response.evaluate_cuts_vjp", evaluate_cuts_vjp),
        frozenset({"widths"}),
    ),
    "mixed": Case(
        MIXED_GAUSSIANS,
        lambda rng, gaussians: mix_kinds(gaussians, rng),
        make_ellipses,
        triangles_of_one_point,
        mixed_stages,
        ("minisplat_ref.extensions.mixed.projection.place_vertices_vjp", place_vertices_vjp),
        frozenset({"n_vertices"}),
        has_own_depths=True,
    ),
    "textured": Case(
        TEXTURED_GAUSSIANS,
        random_textures,
        lambda gaussians: add_textures(gaussians, 0),
        lambda gaussians: add_textures(gaussians, 3),
        textured_stages,
        ("minisplat_ref.extensions.textured.model.meet_vjp", meet_vjp),
    ),
}


def drawn(renderer, population, view, backend, compared_to=None, with_depth=True):
    """Return an image, and its gradient with random weights.

    In float64 with the depth, as the oracle renders, so that both share the compiled kernels; without it if it is
    compared to an image in float32.
    """
    rng, dtype = np.random.default_rng(1), population.means.dtype
    wants = frozenset({"depth"} if with_depth and np.dtype(compared_to or dtype) == np.float64 else ())
    output, tape = renderer.render(Model(population), view, Request(BACKGROUND, backend=backend, wants=wants))
    v_image, v_alpha = rng.normal(size=output.image.shape), rng.normal(size=output.alpha.shape)
    return output, renderer.render_vjp(tape, v_image.astype(dtype), v_alpha.astype(dtype))
