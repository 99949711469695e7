"""Texels from maps: normals and materials of some views, baked into the textures of surfels that stay where they are.

The blended values are linear in the texels X, so the best ones for targets m, weighed by the opacity A of pixels, are
those of a linear least-squares problem::

    min over X of sum over pixels |sum_gt w_g h_gt X_gt - A m|^2

with the weight w of a hit times the share h of a texel in its value. The first guess is the mean of the targets
that a texel is read for, ``sum w h m / sum w h``. Accelerated projected gradients (Beck and Teboulle 2009) continue
from there, among texels that can be stored: shares between 0 and 1, normals of unit length. The step of a texel is ``1
/ sum w h``, which is short enough, as the w h of a pixel are positive and sum up to at most 1. Both products with the
matrix are the blend and its gradient, so it is never stored.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.texture_splat.model import TexturedSurfels, choose_twin, count_texels, disc_axes
from minisplat_ref.extensions.texture_splat.textures import raw_normals, tangent_normals
from minisplat_ref.mechanisms.gbuffer.population import sigmoid
from minisplat_ref.mechanisms.surfels import renderer as discs
from minisplat_ref.mechanisms.surfels.projection import Surfels
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import Backend, get_backend
from minisplat_ref.types import Bools, Camera, Floats, Model, TileBins, view_from

SHARE_MIN = 1e-3  # of a material, so that its logit is finite
READ_MIN = 1e-6  # sum of w h, in pixels, below which a texel is not seen


class Maps(NamedTuple):
    """The targets of baking in a view."""

    camera: Camera
    normals: Floats
    """[H, W, 3] unit, world frame, towards the camera."""
    materials: Floats
    """[H, W, 5] albedo, metallic share, roughness."""
    is_known: Bools
    """[H, W] pixels that count."""


class _Sight(NamedTuple):
    """The linear map from texels, with normals in the world and turned as the discs are, to the channels of a view."""

    surfels: Surfels
    bins: TileBins
    conventions: Conventions
    module: Any  # kernels or textures
    signs: Floats  # [N, 1, 1] of normals: whether that of the disc, or its opposite, is towards the camera
    is_known: Bools  # [H, W, 1]

    def forward(self, texels: Floats) -> Floats:
        """Return the channels [H, W, 8]."""
        image: Floats = self.module.blend_texels(self.surfels, self._turn(texels), self.bins, self.conventions)
        return image

    def adjoint(self, image: Floats, texels: Floats) -> Floats:
        """Return the product of the transposed map with the channels of pixels that count, in the shape of texels."""
        v = self.module.blend_texels_vjp(
            self.surfels,
            np.zeros_like(texels),
            self.bins,
            self.conventions,
            np.zeros_like(image),
            np.where(self.is_known, image, 0),
        )
        return self._turn(v.texels)

    def _turn(self, texels: Floats) -> Floats:
        return np.concatenate([texels[:, :, :3] * self.signs, texels[:, :, 3:]], axis=2)


def bake(
    population: TexturedSurfels, views: Sequence[Maps], *, steps: int = 50, backend: Backend | None = None
) -> TexturedSurfels:
    """Return the surfels with textures that show the maps of the views best.

    Parameters
    ----------
    population : TexturedSurfels
        Texels that no view sees keep their values.
    views : sequence of Maps
        Normals and materials as they should be seen.
    steps : int
        Of the gradient; with 0 each texel is the mean of the targets that it is read for.
    backend : Backend, optional
        ``cpu`` by default.

    Raises
    ------
    InputError
        There are no views, or the maps of one do not have the size of its camera's image or are not finite.
    """
    if not views:
        raise InputError("textures are baked from the maps of views: give at least one view")
    backend = get_backend("cpu") if backend is None else backend
    texels = _world_texels(population)
    sights = [_look(population, maps, backend) for maps in views]
    targets = [np.concatenate([maps.normals, maps.materials], axis=2).astype(texels.dtype) for maps in views]
    read, wanted, means = np.zeros_like(texels), np.zeros_like(texels), np.zeros_like(texels)
    for sight, target in zip(sights, targets, strict=True):
        ones = np.ones_like(target)
        unsigned = sight._replace(signs=np.ones_like(sight.signs))
        read += unsigned.adjoint(ones, texels)
        alpha = unsigned.forward(np.ones_like(texels))
        means += sight.adjoint(target, texels)
        wanted += sight.adjoint(alpha * target, texels)
    is_read = read > READ_MIN
    steps_of = np.where(is_read, 1 / np.where(is_read, read, 1), 0)
    axes = rotation_matrices(population.quats)
    best = ahead = _nearest(np.where(is_read, means * steps_of, texels), axes)
    momentum = 1.0
    for _ in range(steps):
        moved = _nearest(ahead - steps_of * (_normal_product(sights, ahead) - wanted), axes)
        before, momentum = momentum, (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        best, ahead = moved, moved + (before - 1) / momentum * (moved - best)
    return _store_texels(population, best, is_read[:, :, 0])


def _nearest(texels: Floats, axes: Floats) -> Floats:
    """Return texels that can be stored: shares within their bounds, unit normals on the side of the disc's normal."""
    normals = tangent_normals(raw_normals(texels[:, :, :3] @ axes)) @ np.swapaxes(axes, 1, 2)
    return np.concatenate([normals, np.clip(texels[:, :, 3:], SHARE_MIN, 1 - SHARE_MIN)], axis=2)


def _normal_product(sights: Sequence[_Sight], texels: Floats) -> Floats:
    """Return the matrix of the normal equations times texels."""
    total = np.zeros_like(texels)
    for sight in sights:
        total += sight.adjoint(sight.forward(texels), texels)
    return total


def _look(population: TexturedSurfels, maps: Maps, backend: Backend) -> _Sight:
    """Return the weights with which a view reads the texels.

    Raises
    ------
    InputError
        A map does not have the size of the camera's image, or is not finite where it counts.
    """
    camera = maps.camera
    sizes = {name: getattr(maps, name).shape[:2] for name in ("is_known", "normals", "materials")}
    for name, size in sizes.items():
        if size != (camera.height, camera.width):
            raise InputError(
                f"{name} have {size[1]} x {size[0]} pixels and the camera {camera.width} x {camera.height}: make the"
                " maps as large as the image"
            )
        if not np.isfinite(getattr(maps, name)[maps.is_known]).all():
            raise InputError(f"{name} are not finite in some pixels that count: take these out of is_known")
    request = Request(backend=backend)
    seen = discs.look(Model(population), view_from(camera), request)
    bins = discs.list_tiles(seen.surfels, camera, request.conventions, backend)
    _, signs = disc_axes(seen)
    dtype = population.means.dtype
    return _Sight(
        seen.surfels,
        bins,
        request.conventions,
        choose_twin(backend),
        signs[:, :, None].astype(dtype),
        maps.is_known[:, :, None],
    )


def _world_texels(population: TexturedSurfels) -> Floats:
    """Return the texels [N, T^2, 8] that the population has, normals in the world."""
    n, size = len(population.means), count_texels(population)
    axes = rotation_matrices(population.quats)
    tangent = tangent_normals(population.normal_textures.reshape(n, size * size, 2))
    normals = tangent @ np.swapaxes(axes, 1, 2)
    albedo = sigmoid(population.albedo_logits).reshape(n, size * size, 3)
    shares = np.stack([sigmoid(population.metallic_logits), sigmoid(population.roughness_logits)], axis=2)
    return np.ascontiguousarray(np.concatenate([normals, albedo, shares], axis=2), population.means.dtype)


def _store_texels(population: TexturedSurfels, texels: Floats, is_read: Bools) -> TexturedSurfels:
    """Return the population with texels as :func:`_world_texels` has them, where ``is_read`` [N, T^2]."""
    raw = raw_normals(texels[:, :, :3] @ rotation_matrices(population.quats))
    logits = np.log(texels[:, :, 3:]) - np.log1p(-texels[:, :, 3:])
    found = {
        "normal_textures": raw,
        "albedo_logits": logits[:, :, :3],
        "metallic_logits": logits[:, :, 3:4],
        "roughness_logits": logits[:, :, 4:],
    }

    def chosen(name: str, values: Floats) -> Floats:
        before = getattr(population, name)
        return np.where(is_read[:, :, None], values, before.reshape(values.shape)).reshape(before.shape)

    return population._replace(
        **{name: chosen(name, values).astype(population.means.dtype) for name, values in found.items()}
    )
