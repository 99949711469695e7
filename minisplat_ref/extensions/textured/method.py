"""The renderer of textured Gaussians, and the recipes that train them."""

from collections.abc import Mapping

import numpy as np

from minisplat_ref.extensions.textured.kernels import pad_textures, response_for
from minisplat_ref.extensions.textured.population import TexturedGaussians, blank
from minisplat_ref.extensions.textured.reference import visible_frames, visible_frames_vjp
from minisplat_ref.extensions.textured.response import RESPONSE, TexturedFootprints, bounds
from minisplat_ref.mechanisms.payload.renderer import Appearance, Payload, PayloadGradient, Projected, payload_renderer
from minisplat_ref.methods.gaussian_splatting import FINE_TUNING as GS_FINE_TUNING
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats


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
    response_for,
    _is_plain,
    _footprints,
    _footprints_vjp,
    appearance=Appearance(_bound_logits, _coefficients, _coefficients_vjp),
)

# Chosen between those of 3DGS for a colour's degree 0 and, 20 times less, for its higher degrees.
RATES = Rates({"color_textures": 2.5e-3 / 4, "opacity_textures": 5e-2 / 4}, frozenset())

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
