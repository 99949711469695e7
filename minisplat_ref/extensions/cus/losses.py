"""The losses beside the photometric one: of the blended features, and of the size of anchors."""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cus.bank import Reading, feature_error, read, read_vjp
from minisplat_ref.extensions.cus.decoding import Decoded, decode, decode_vjp
from minisplat_ref.extensions.cus.maps import at_pixels, feature_map
from minisplat_ref.extensions.cus.population import ADAPTER, KEYS, MEMORY, Anchors
from minisplat_ref.mechanisms.features.blending import BlendTape, blend_channels, blend_channels_vjp
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.mechanisms.networks.networks import networks_for
from minisplat_ref.rendering import Request, activate, activate_vjp
from minisplat_ref.training.losses import Cotangents, Rendered
from minisplat_ref.types import Floats, Gaussians, Ints, Model, View

UNIT = 0.01  # of the scene's extent: the side of voxels in the paper


class FeatureTape(NamedTuple):
    """The values that :func:`blended_queries` keeps for its gradient."""

    decoded: Decoded
    blended: BlendTape


def blended_queries(model: Model, view: View, request: Request) -> tuple[Floats, FeatureTape]:
    """Return the queries that a view blends, [H, W, d]."""
    decoded = decode(model, view, networks_for(request.backend), with_queries=True)
    is_visible = None
    if request.is_visible is not None:
        is_visible = np.repeat(request.is_visible, model.gaussians.n_children)
    assert decoded.queries is not None, "they were asked for"
    image, tape = blend_channels(activate(decoded.gaussians, is_visible), decoded.queries, view.camera, request)
    return image, FeatureTape(decoded, tape)


def blended_queries_vjp(tape: FeatureTape, v_image: Floats) -> tuple[Anchors, dict[str, Floats]]:
    """Gradient of :func:`blended_queries` with respect to the anchors and the shared parameters.

    ::

        v_k and those of means, quaternions, scales and opacities by blending;   from these by decoding
    """
    v_queries, v = blend_channels_vjp(tape.blended, v_image)
    g = tape.decoded.gaussians
    v_log_scales, v_logits = activate_vjp(tape.blended.primitives, g.opacity_logits, v.scales, v.opacities)
    v_gaussians = Gaussians(v.means, v.quats, v_log_scales, v_logits, np.zeros_like(g.sh_dc), np.zeros_like(g.sh_rest))
    found = decode_vjp(tape.decoded, v_gaussians, v_queries)
    return found.anchors, found.shared


def read_memory(queries: Floats, shared: Any) -> tuple[Floats, Reading]:
    """Return the features [B, D] that queries [B, d] read in the memory of a model."""
    memory, keys, adapter = (shared[name].astype(queries.dtype, copy=False) for name in (MEMORY, KEYS, ADAPTER))
    return read(queries, memory, keys, adapter)


def feature_loss(rendered: Rendered, *, features: str, samples: int) -> tuple[float, Cotangents]:
    """Compare features that the blended queries read with those of the photograph: ``L2 + (1 - cos)``.

    Photographs that are smaller than the classical bank's filters have none, and no error.

    Parameters
    ----------
    rendered : Rendered
    features : str
        Folder of the maps; empty for the classical ones.
    samples : int
        Pixels that are compared in an iteration, at most; they are drawn at random.

    Raises
    ------
    InputError
        The map of the photograph cannot be read, or has another number of channels than the memory.
    """
    view, model = rendered.view, rendered.model
    if not features and min(view.camera.width, view.camera.height) < CLASSICAL.min_side:
        return 0.0, Cotangents()
    target = feature_map(view, features)
    if target.shape[2] != model.shared[MEMORY].shape[1]:
        raise InputError(
            f"features={features}: the map of photograph {view.name} has {target.shape[2]} channels, those that the"
            f" training began with {model.shared[MEMORY].shape[1]}; give the same maps"
        )
    pixels = drawn_pixels(view, samples, rendered.step)
    if not len(pixels):
        return 0.0, Cotangents()
    wanted = at_pixels(target, pixels, view.camera.height, view.camera.width)
    return error_at_pixels(model, view, rendered.request, pixels, wanted)


def error_at_pixels(
    model: Model, view: View, request: Request, pixels: Ints, wanted: Floats
) -> tuple[float, Cotangents]:
    """Return the error of the features that a view reads at pixels, and its derivatives.

    Parameters
    ----------
    model, view, request
        As for :func:`blended_queries`.
    pixels : ndarray of shape (B, 2)
        Rows and columns.
    wanted : ndarray of shape (B, D)
        Features of the photograph there.
    """
    image, tape = blended_queries(model, view, request)
    rows, columns = pixels.T
    found, reading = read_memory(image[rows, columns], model.shared)
    value, v_found = feature_error(found, wanted.astype(found.dtype))
    v_queries, v_memory, v_keys, v_adapter = read_vjp(reading, v_found)
    v_image = np.zeros_like(image)
    v_image[rows, columns] = v_queries
    v_anchors, v_shared = blended_queries_vjp(tape, v_image)
    fields = ("means", "quats", "log_scales", "opacity_logits", "latents", "offsets")
    return value, Cotangents(
        gaussians={name: getattr(v_anchors, name) for name in fields},
        shared={**v_shared, MEMORY: v_memory, KEYS: v_keys, ADAPTER: v_adapter},
    )


def drawn_pixels(view: View, n: int, step: int) -> Ints:
    """Return at most n pixels [B, 2], rows and columns, that the mask of a view lets count."""
    is_counted = np.ones((view.camera.height, view.camera.width), bool) if view.mask is None else view.mask
    pixels = np.argwhere(is_counted)
    if len(pixels) <= n:
        return pixels
    return pixels[np.random.default_rng(step).choice(len(pixels), n, replace=False)]


def anchor_scale(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean volume of anchors, ``mean_v prod_a s_va / u``, with u a hundredth of the scene's extent.

    ::

        v_ln s_va = prod_a (s_va / u) / N
    """
    log_scales = rendered.model.gaussians.log_scales
    unit = log_scales.dtype.type(np.log(UNIT * rendered.scene.extent))
    volumes = np.exp(np.sum(log_scales - unit, axis=1))
    v = np.repeat(volumes[:, None], 3, axis=1) / len(volumes)
    return float(volumes.mean()), Cotangents(gaussians={"log_scales": v})
