"""The renderer of textured Gaussians, the recipes that train them, fine-tuning, and the gradient check.

Fine-tuning gives trained Gaussians textures; their number stays.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from minisplat_ref.extensions.textured.kernels import make_response, pad_textures
from minisplat_ref.extensions.textured.model import (
    LIMB,
    RESPONSE,
    TexturedFootprints,
    TexturedGaussians,
    add_textures,
    blank,
    bounds,
    shade,
    visible_frames,
    visible_frames_vjp,
)
from minisplat_ref.mechanisms.payload.gradient_checks import renderer_stage
from minisplat_ref.mechanisms.payload.renderer import Appearance, Payload, PayloadGradient, Projected, payload_renderer
from minisplat_ref.methods.gaussian_splatting import FINE_TUNING as GS_FINE_TUNING
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.metrics import Evaluation, evaluate
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.fine_tuning import fine_tune as train_further
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import GAUSSIANS, Representation
from minisplat_ref.training.schedule import scale_recipe
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Bools, Floats, Gaussians, Model, Scene, View

NEAR_LIMB = 0.06  # of 1 - q . q, whose root has large higher derivatives, which need small steps


def _is_plain(gaussians: TexturedGaussians) -> bool:
    return gaussians.opacity_textures.shape[1] == 0


def _bound_logits(gaussians: TexturedGaussians) -> Floats:
    """Return l + B [N], the logits of the opacities o_B."""
    return gaussians.opacity_logits + bounds(gaussians.opacity_textures)


def _footprints(projected: Projected) -> TexturedFootprints:
    g, projection = projected.gaussians, projected.projection
    seen = with_principal_point(projected.camera, projected.conventions)
    frames = visible_frames(g.means, g.quats, projected.primitives.scales, seen, projection.radii)
    return TexturedFootprints(projection, g.opacity_logits, g.opacity_textures, frames)


def _footprints_vjp(projected: Projected, v: tuple[Floats, ...]) -> PayloadGradient:
    """Gradient of :func:`_footprints`; that of the logits is the response's own, since o_B and m share it."""
    v_logits, v_opacity_textures, v_frames = v
    g, radii = projected.gaussians, projected.projection.radii
    seen = with_principal_point(projected.camera, projected.conventions)
    v_frame = visible_frames_vjp(g.means, g.quats, projected.primitives.scales, seen, radii, v_frames)
    return PayloadGradient({"opacity_logits": v_logits, "opacity_textures": v_opacity_textures}, *v_frame)


def _coefficients(projected: Projected, channels: Floats) -> Floats:
    """Return [N, D K], for each channel its colour and its texture; a depth has no texture. Kernels use K = 16."""
    g = projected.gaussians
    n, k = g.opacity_textures.shape
    is_compiled = projected.backend.is_compiled
    textures = pad_textures(g.color_textures, 3) if is_compiled else g.color_textures.reshape(n, 3, k)
    n_channels, n_coefficients = channels.shape[1], 1 + textures.shape[2]
    coefficients = np.zeros((n, n_channels, n_coefficients), channels.dtype)
    coefficients[:, :, 0], coefficients[:, :3, 1:] = channels, textures
    return coefficients.reshape(n, n_channels * n_coefficients)


def _coefficients_vjp(
    projected: Projected, v_coefficients: Floats, n_channels: int
) -> tuple[Floats, Mapping[str, Floats]]:
    """Gradient of :func:`_coefficients` with respect to channels and textures."""
    n, k = projected.gaussians.opacity_textures.shape
    v = v_coefficients.reshape(n, n_channels, v_coefficients.shape[1] // n_channels)  # [N, D, K]
    return v[:, :, 0], {"color_textures": np.ascontiguousarray(v[:, :3, 1 : k + 1]).reshape(n, 3 * k)}


PAYLOAD = Payload(
    "textured Gaussians",
    RESPONSE,
    make_response,
    _is_plain,
    _footprints,
    _footprints_vjp,
    appearance=Appearance(_bound_logits, _coefficients, _coefficients_vjp),
)

# Released, for the fine-tuning of a finished model.
RATES = Rates({"color_textures": 2.5e-3, "opacity_textures": 5e-3}, frozenset())

TEXTURED_GAUSSIANS = Representation(
    "textured Gaussians",
    population=TexturedGaussians,
    extend=blank,
    renderer=payload_renderer("textured", PAYLOAD),
    rates=RATES,
)

TEXTURED = GS_ACCEL._replace(name="textured")
"""The recipe ``textured``: 3DGS with textures from the first iteration on."""

FINE_TUNING = GS_FINE_TUNING._replace(name="textured-fine-tuning")
"""Fine-tuning as released: of a finished run only the number of Gaussians stays."""

FROZEN = FINE_TUNING._replace(
    name="textured-frozen",
    learning_rates=FINE_TUNING.learning_rates.change(means=0.0, quats=0.0, log_scales=0.0),
)
"""Fine-tuning as in the paper's text: opacities, colours and textures are trained, and nothing else changes."""


def prepare(gaussians: Gaussians, degree: int, replaces_view: bool) -> TexturedGaussians:
    """Return Gaussians with textures of zeros, and without view-dependent colour if textures replace it."""
    if replaces_view:
        gaussians = gaussians._replace(sh_rest=gaussians.sh_rest[:, :0])
    return add_textures(gaussians, degree)


def find_representation(population: Any) -> Representation:
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
        population, scene, recipe._replace(representation=find_representation(population)), seed, on_step
    )


def measure(population: Any, scene: Scene, views: tuple[View, ...]) -> Evaluation:
    """Compare images of a population with photographs."""
    renderer = find_representation(population).renderer
    return evaluate(Model(population), views, RenderSettings(scene.background, renderer=renderer))


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer as a stage; the reference finds hits, clamps, and the rays that pass the limb."""
    return (renderer_stage(backend, setting, TEXTURED_GAUSSIANS, _sides, rng),)


def _sides(tile: TileHits, coefficients: Floats) -> tuple[Bools | Floats, ...]:
    """Return which hits count, which hits and colours are clamped, and near the limb eighths of octaves of the root."""
    is_hit, place = tile.alphas > 0, tile.hit.place
    colors = shade(coefficients[tile.ids], place)  # [G, P, D]
    left = 1 - np.sum(place.meeting.q**2, axis=2)  # [G, P]
    is_near = is_hit & (left > LIMB**2) & (left < NEAR_LIMB)
    octaves = np.where(is_near, np.floor(8 * np.log2(np.where(is_near, left, 1))), is_hit & (left > LIMB**2))
    return is_hit, tile.is_clamped, is_hit[:, :, None] & (colors > 0), octaves
