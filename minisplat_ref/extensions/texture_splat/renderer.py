"""Rendering of textured surfels: textures are blended into the channels of normals and materials, then shaded.

Shading, occlusion of the environment, and the light from around, which has one value for a whole surfel, are those of
:mod:`minisplat_ref.mechanisms.gbuffer.renderer`. Textures of one texel are blended as materials are there.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.texture_splat import kernels, reference
from minisplat_ref.extensions.texture_splat.population import texels_of
from minisplat_ref.extensions.texture_splat.reference import N_CHANNELS, tangent_normals, tangent_normals_vjp
from minisplat_ref.mechanisms.gbuffer import renderer as shaded
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL, STAGE, sigmoid
from minisplat_ref.mechanisms.surfels import renderer as discs
from minisplat_ref.mechanisms.surfels.renderer import Shown
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.types import Floats, Model, RenderOutput, View


class TextureTape(NamedTuple):
    """The values that :func:`blend` keeps for :func:`blend_vjp`."""

    discs: discs.BlendTape
    texels: Floats  # [N, T^2, 8]
    image: Floats  # [H, W, 8] their sums; no pixels where T = 1

    @property
    def shown(self) -> Shown:
        """The input of blending."""
        return self.discs.shown


def read_textures(seen: discs.Seen) -> Floats:
    """Return normals, in the camera's frame and towards it, and materials of all texels, [N, T^2, 8]."""
    g, n, dtype = seen.gaussians, len(seen.gaussians.means), seen.gaussians.means.dtype
    size = texels_of(g)
    texels = np.empty((n, size * size, N_CHANNELS), dtype)
    x, y, z = np.moveaxis(tangent_normals(_by_texel(g.normal_textures, 2))[:, None], 3, 0)  # [N, 1, T^2] each
    axes, signs = disc_axes(seen)
    tilted = signs[:, :, None] * (axes[:, :, :1] * x + axes[:, :, 1:2] * y)
    texels[:, :, :3] = np.moveaxis(tilted + seen.surfels.normals[:, :, None] * z, 1, 2)
    texels[:, :, 3:6] = sigmoid(_by_texel(g.albedo_logits, 3))
    texels[:, :, 6], texels[:, :, 7] = sigmoid(g.metallic_logits), sigmoid(g.roughness_logits)
    return texels


def read_textures_vjp(seen: discs.Seen, v_texels: Floats) -> shaded.MaterialGradient:
    """Gradient of :func:`read_textures`.

    With the axes ``a_k = R r_k`` of a disc, the sign s that turns a_2 to the camera, and (x, y, z) of
    :func:`.reference.tangent_normals`::

        v_(x, y, z)_k = s a_k . v_n,   v_a_k = s sum over texels of (x, y, z)_k v_n
        v_r_k = R^T v_a_k,   v_R = sum_k v_a_k r_k^T
    """
    g, dtype = seen.gaussians, seen.gaussians.means.dtype
    raw = _by_texel(g.normal_textures, 2)
    axes, signs = disc_axes(seen)
    v_n = v_texels[:, :, :3] * signs[:, None]  # [N, T^2, 3]
    v_raw = tangent_normals_vjp(raw, v_n @ axes)
    v_axes = np.swapaxes(v_n, 1, 2) @ tangent_normals(raw)  # [N, 3, 3], columns
    quats, R = seen.primitives.quats.astype(np.float64), seen.camera.cam_from_world_R
    v_logits = {}
    for name, part in (("albedo_logits", slice(3, 6)), ("metallic_logits", 6), ("roughness_logits", 7)):
        shares = sigmoid(getattr(g, name))
        v_logits[name] = shares * (1 - shares) * v_texels[:, :, part].reshape(shares.shape)
    fields = {"normal_textures": v_raw.reshape(g.normal_textures.shape), **v_logits}
    return shaded.MaterialGradient(
        {name: field.astype(dtype) for name, field in fields.items()},
        rotation_matrices_vjp(quats, R.T @ v_axes).astype(dtype),
        np.einsum("nik,njk->ij", v_axes, rotation_matrices(quats)),
    )


def blend(seen: discs.Seen, colors: Floats, texels: Floats, request: Request) -> tuple[RenderOutput, TextureTape]:
    """Blend surfels with textures; see :func:`minisplat_ref.mechanisms.surfels.renderer.blend`.

    Parameters
    ----------
    seen, colors, request
        As there; the request wants normals.
    texels : ndarray of shape (N, T^2, 8)
        From :func:`read_textures`.
    """
    if texels.shape[1] == 1:
        flat = seen._replace(surfels=seen.surfels._replace(normals=texels[:, 0, :3]))
        output, tape = discs.blend(flat, colors, texels[:, 0, 3:], request)
        return output, TextureTape(tape, texels, np.zeros((0, 0, N_CHANNELS)))
    # As many channels as without textures, so that the same kernel blends the others.
    output, tape = discs.blend(seen, colors, np.zeros_like(texels[:, 0, 3:]), request)
    image = _module(request).blend_texels(tape.shown.surfels, texels, tape.shown.bins, request.conventions)
    mixed = output.image.copy()
    for part, values in zip(_parts(tape), (image[:, :, :3], image[:, :, 3:]), strict=True):
        mixed[:, :, part] = values
    return output._replace(image=mixed), TextureTape(tape, texels, image)


def blend_vjp(tape: TextureTape, v_image: Floats, v_alpha: Floats | None) -> discs.BlendedGradient:
    """Gradient of :func:`blend`; ``carried`` is that of the texels. Both blends add to the gradient of the surfels."""
    if tape.texels.shape[1] == 1:
        v = discs.blend_vjp(tape.discs, v_image, v_alpha)
        v_texels = np.column_stack([v.surfels.normals, v.carried])[:, None]
        return v._replace(surfels=v.surfels._replace(normals=np.zeros_like(v.surfels.normals)), carried=v_texels)
    shown, parts, others = tape.shown, _parts(tape.discs), v_image.copy()
    for part in parts:
        others[:, :, part] = 0
    v = discs.blend_vjp(tape.discs, others, v_alpha)
    module: Any = kernels if shown.backend.is_compiled else reference
    v_T, v_c, v_o, v_texels = module.blend_texels_vjp(
        shown.surfels,
        tape.texels,
        shown.bins,
        shown.conventions,
        tape.image,
        np.concatenate([v_image[:, :, part] for part in parts], axis=2),
    )
    s = v.surfels
    return v._replace(
        surfels=s._replace(transforms=s.transforms + v_T, means2d=s.means2d + v_c, opacities=s.opacities + v_o),
        carried=v_texels,
    )


TEXTURES = shaded.Materials(read_textures, read_textures_vjp, blend, blend_vjp)


def render(
    model: Model, view: View, request: Request, visibility: Floats | None = None
) -> tuple[RenderOutput, shaded.ReflectiveTape]:
    """Render a view; see :func:`minisplat_ref.mechanisms.gbuffer.renderer.render_reflective`.

    Textures are shaded pixel by pixel, whatever stage the model has. The channel ``normal`` is that of the textures.
    """
    stage = np.maximum(model.shared[STAGE], PER_PIXEL) if STAGE in model.shared else None
    deferred = model if stage is None else model._replace(shared={**model.shared, STAGE: stage})
    return shaded.render_reflective(deferred, view, request, visibility, mirrors=True, materials=TEXTURES)


def disc_axes(seen: discs.Seen) -> tuple[Floats, Floats]:
    """Return the axes of discs in the camera's frame, [N, 3, 3] by columns, and the signs [N, 1] of the third.

    A disc that is culled has the sign 0.
    """
    axes = seen.camera.cam_from_world_R @ rotation_matrices(seen.primitives.quats.astype(np.float64))
    return axes, np.sign(np.sum(axes[:, :, 2] * seen.surfels.normals, axis=1, keepdims=True))


def _by_texel(field: Floats, n_channels: int) -> Floats:
    return field.reshape(len(field), field.shape[1] // n_channels, n_channels)


def _module(request: Request) -> Any:
    return kernels if request.backend.is_compiled else reference


def _parts(tape: discs.BlendTape) -> tuple[slice, slice]:
    """Return the channels of normals and of materials among those that surfels blend."""
    first = max(part.stop for part in tape.slices.values())
    return tape.slices["normal"], slice(first, first + N_CHANNELS - 3)


TEXTURED = Renderer("textured surfels", render, shaded.render_reflective_vjp, shaded.channels)
