"""Refitting: the two numbers of all fans at once, or every vertex by itself."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import minimize

from minisplat_ref.extensions.fans.method import FANS_OF_GAUSSIANS, FINE_TUNING
from minisplat_ref.extensions.fans.shapes import Fans, FanShape, converted
from minisplat_ref.metrics import Evaluation, evaluate
from minisplat_ref.rendering import Request
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.representation import GAUSSIANS
from minisplat_ref.training.schedule import scaled
from minisplat_ref.training.state import StepReport, TrainState
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View

REACHES = 1.0, 4.0  # between which k is sought
EVALUATIONS = 40  # at most, of one search


def tuned(
    fans: Fans, scene: Scene, iterations: int, seed: int, on_step: Callable[[StepReport], None] | None = None
) -> Fans:
    """Return fans after some iterations of ``FINE_TUNING`` of their vertices; the given ones are not changed."""
    copy = Fans(*(field.copy() for field in fans))
    state = TrainState(copy, zero_moments(copy), step=0, view_order=[], rng=np.random.default_rng(seed), stats={})
    recipe = scaled(FINE_TUNING, iterations)._replace(representation=FANS_OF_GAUSSIANS)
    result: Fans = train(scene, recipe, seed=seed, state=state, on_step=on_step).gaussians
    return result


def best_shape(gaussians: Gaussians, shape: FanShape, views: list[View], targets: list[Floats]) -> FanShape:
    """Return the shape with the reach and the rim whose pictures are nearest to targets, by the simplex method.

    Parameters
    ----------
    gaussians : Gaussians
    shape : FanShape
        Where the search begins; sides, and whether fans are flat, stay.
    views : list of View
        From where.
    targets : list of ndarray of shape (H, W, 3)
        Photographs or pictures in [0, 1]; the sum of squared differences counts.
    """

    def clipped(x: Floats) -> FanShape:
        return shape._replace(reach=float(np.clip(x[0], *REACHES)), rim=float(np.clip(x[1], 0, 1)))

    def cost(x: Floats) -> float:
        fans = converted(gaussians, clipped(x))
        return sum(float(np.mean((drawn(fans, v) - target) ** 2)) for v, target in zip(views, targets, strict=True))

    simplex = np.array([[shape.reach, shape.rim], [0.8 * shape.reach, shape.rim], [shape.reach, shape.rim + 0.2]])
    options = {"maxfev": EVALUATIONS, "xatol": 0.01, "fatol": 1e-9, "initial_simplex": simplex}
    return clipped(minimize(cost, simplex[0], method="Nelder-Mead", options=options).x)


def representation_of(population: Any) -> Any:
    """Return what a population of fans, or of Gaussians, is drawn by."""
    return FANS_OF_GAUSSIANS if isinstance(population, Fans) else GAUSSIANS


def drawn(population: Any, view: View, **request: Any) -> Floats:
    """Return the picture [H, W, 3] of fans or Gaussians, clipped to [0, 1]; ``request`` as for :class:`Request`."""
    image = representation_of(population).renderer.render(Model(population), view, Request(**request))[0].image
    clipped: Floats = np.clip(image, 0, 1)
    return clipped


def alpha_of(population: Any, view: View, **request: Any) -> Floats:
    """Return the accumulated opacity [H, W] of fans or Gaussians."""
    output, _ = representation_of(population).renderer.render(Model(population), view, Request(**request))
    alpha: Floats = output.alpha
    return alpha


def measured(population: Any, scene: Scene, views: tuple[View, ...]) -> Evaluation:
    """Compare pictures of fans or Gaussians with photographs."""
    renderer = representation_of(population).renderer
    return evaluate(Model(population), views, background=scene.background, renderer=renderer)
