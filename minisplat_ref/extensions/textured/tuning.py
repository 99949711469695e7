"""Fine-tuning: trained Gaussians keep their number, and get textures."""

from collections.abc import Callable
from typing import Any

from minisplat_ref.extensions.textured.method import FINE_TUNING, FROZEN, TEXTURED_GAUSSIANS
from minisplat_ref.extensions.textured.population import TexturedGaussians, with_textures
from minisplat_ref.metrics import Evaluation, evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.fine_tuning import fine_tune as train_further
from minisplat_ref.training.representation import GAUSSIANS, Representation
from minisplat_ref.training.schedule import scale_recipe
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Gaussians, Model, Scene, View


def prepare(gaussians: Gaussians, degree: int, replaces_view: bool) -> TexturedGaussians:
    """Return Gaussians with textures of zeros, and without view-dependent colour if textures replace it."""
    if replaces_view:
        gaussians = gaussians._replace(sh_rest=gaussians.sh_rest[:, :0])
    return with_textures(gaussians, degree)


def representation_of(population: Any) -> Representation:
    """Return the representation of a population with or without textures."""
    return TEXTURED_GAUSSIANS if isinstance(population, TexturedGaussians) else GAUSSIANS


def fine_tune(
    population: Any,
    scene: Scene,
    iterations: int,
    seed: int,
    *,
    is_frozen: bool = False,
    on_step: Callable[[StepReport], None] | None = None,
) -> Any:
    """Return a population with or without textures after fine-tuning; the given one is not changed.

    Parameters
    ----------
    population : Gaussians or TexturedGaussians
    scene : Scene
    iterations, seed : int
        Of the training.
    is_frozen : bool
        Whether positions and shapes stay.
    on_step : callable, optional
        Called after each iteration.
    """
    recipe = scale_recipe(FROZEN if is_frozen else FINE_TUNING, iterations)
    return train_further(
        population, scene, recipe._replace(representation=representation_of(population)), seed, on_step
    )


def measure(population: Any, scene: Scene, views: tuple[View, ...]) -> Evaluation:
    """Compare images of a population with photographs."""
    renderer = representation_of(population).renderer
    return evaluate(Model(population), views, RenderSettings(scene.background, renderer=renderer))
