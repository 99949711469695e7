"""Surfels with textures: population and file, the renderer, the recipe, and what the gradient check covers.

A texture has T x T texels. A field holds those of all its channels in a row of numbers: the texel in row j, along the
disc's second axis, and column i, along the first, has its channel c in column ``(j T + i) C + c``. In a PLY texels are
further columns, which other readers skip.

Textures (:mod:`.textures`) are blended into the channels of normals and materials, then shaded. Shading, occlusion of
the environment, and the light from around, which has one value for a whole surfel, are those of
:mod:`minisplat_ref.mechanisms.gbuffer.renderer`. Textures of one texel are blended as materials are there.
"""

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.texture_splat import kernels, texel_kernels, textures
from minisplat_ref.extensions.texture_splat.textures import (
    N_CHANNELS,
    REACH,
    TILT_MAX,
    tangent_normals,
    tangent_normals_vjp,
)
from minisplat_ref.io.ply import load_ply
from minisplat_ref.mechanisms.gbuffer import renderer as shaded
from minisplat_ref.mechanisms.gbuffer.gradient_checks import shading_stage
from minisplat_ref.mechanisms.gbuffer.population import (
    PER_PIXEL,
    STAGE,
    WITH_OCCLUSION,
    ReflectiveSurfels,
    sigmoid,
    with_materials,
)
from minisplat_ref.mechanisms.gbuffer.population import first_light as first_light_of_reflective
from minisplat_ref.mechanisms.gbuffer.training import NORMALS, OWN_RATES, SHADING_RATES
from minisplat_ref.mechanisms.surfels import renderer as discs
from minisplat_ref.mechanisms.surfels.renderer import Shown
from minisplat_ref.mechanisms.surfels.response import Layout, surfel_response
from minisplat_ref.methods.gaussian_splatting import FINE_TUNING
from minisplat_ref.oracle.models import Drawn
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, Scene, View

CHANNELS = {"metallic_logits": 1, "roughness_logits": 1, "albedo_logits": 3, "normal_textures": 2}
"""The textures, and the number of channels of each."""

TEXELS = 4  # along each side of a texture, as released
RATES = SHADING_RATES.join(Rates({"normal_textures": 1e-3}, frozenset()))

CHECKED_TEXELS = 3  # the smallest texture that has a kink inside


class TexturedSurfels(NamedTuple):
    """Surfels with textures; the fields without a comment are those of surfels with one material."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    normal_textures: Floats
    """[N, 2 T^2]; their tanh is the normal's part along the axes of the disc."""
    albedo_logits: Floats
    """[N, 3 T^2] linear RGB."""
    metallic_logits: Floats
    """[N, T^2]."""
    roughness_logits: Floats
    """[N, T^2]."""
    around_dc: Floats
    around_rest: Floats


def count_texels(population: Any) -> int:
    """Return T.

    Raises
    ------
    InputError
        The numbers of columns are not those of square textures of one size.
    """
    n_columns = {name: getattr(population, name).shape[1] for name in CHANNELS}
    size = math.isqrt(n_columns["metallic_logits"])
    for name, n_channels in CHANNELS.items():
        if size == 0 or n_columns[name] != n_channels * size * size:
            square = f"{n_channels} T^2" if n_channels > 1 else "T^2"
            raise InputError(
                f"{name} has {n_columns[name]} columns, where square textures of one size have {square}: the file is"
                " damaged, take another"
            )
    return size


def with_textures(
    surfels: Gaussians | ReflectiveSurfels | TexturedSurfels, rng: np.random.Generator, *, texels: int
) -> TexturedSurfels:
    """Return surfels with textures of ``texels`` x ``texels``, with the former materials of the surfels.

    Surfels with one material have it everywhere, and the normals of their discs; Gaussians first get the material of a
    new reflective surfel; textures of another size become larger or smaller.

    Raises
    ------
    InputError
        ``texels`` is below 1.
    """
    if isinstance(surfels, TexturedSurfels):
        return resize_textures(surfels, texels)
    g = surfels if isinstance(surfels, ReflectiveSurfels) else with_materials(surfels, rng)
    flat = TexturedSurfels(
        **{name: getattr(g, name) for name in Gaussians._fields},
        normal_textures=np.zeros((len(g.means), 2), g.means.dtype),
        albedo_logits=g.albedo_logits,
        metallic_logits=g.metallic_logits[:, None],
        roughness_logits=g.roughness_logits[:, None],
        around_dc=g.around_dc,
        around_rest=g.around_rest,
    )
    return resize_textures(flat, texels)


def first_light(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return an environment of 1, as for reflective surfels; shading is per pixel from the start."""
    return {**first_light_of_reflective(scene, rng), STAGE: np.full(1, PER_PIXEL, np.float32)}


def resize_textures(population: TexturedSurfels, size: int) -> TexturedSurfels:
    """Return the population with textures of ``size`` x ``size`` texels, bilinear between those it has.

    A texture of one texel is the same everywhere.

    Raises
    ------
    InputError
        ``size`` is below 1.
    """
    if not size or size < 1:  # --set texels=none is None
        raise InputError(f"a texture of {size} x {size} texels does not exist: give --set texels=1 or more")
    before, n = count_texels(population), len(population.means)
    at = np.linspace(0, before - 1, size) if size > 1 else np.array([(before - 1) / 2])
    hats = np.maximum(1 - np.abs(at[:, None] - np.arange(before)), 0)  # [size, before], rows sum to 1

    def enlarge(field: Floats, n_channels: int) -> Floats:
        grid = field.reshape(n, before, before, n_channels)
        found = np.einsum("jb,ia,nbac->njic", hats, hats, grid)
        return np.ascontiguousarray(found.reshape(n, size * size * n_channels), field.dtype)

    return population._replace(
        **{name: enlarge(getattr(population, name), n_channels) for name, n_channels in CHANNELS.items()}
    )


def load(path: str | Path, population: Any) -> Any:
    """Read textured surfels; see :func:`minisplat_ref.io.ply.load_ply`.

    Raises
    ------
    InputError
        As there, or the columns of texels are not those of square textures of one size.
    """
    found = load_ply(path, population)
    single = {name: getattr(found, name)[:, None] for name in CHANNELS if getattr(found, name).ndim == 1}
    found = found._replace(**single)
    try:
        count_texels(found)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return found


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
    """Return normals, in the camera's frame and towards it, and materials of texels, [N, T^2, 8].

    Those of a surfel that is culled are 0.
    """
    g, n, dtype = seen.gaussians, len(seen.gaussians.means), seen.gaussians.means.dtype
    size = count_texels(g)
    texels = np.empty((n, size * size, N_CHANNELS), dtype)
    x, y, z = np.moveaxis(tangent_normals(_split_texels(g.normal_textures, 2))[:, None], 3, 0)  # [N, 1, T^2] each
    axes, signs = disc_axes(seen)
    tilted = signs[:, :, None] * (axes[:, :, :1] * x + axes[:, :, 1:2] * y)
    texels[:, :, :3] = np.moveaxis(tilted + seen.surfels.normals[:, :, None] * z, 1, 2)
    texels[:, :, 3:6] = sigmoid(_split_texels(g.albedo_logits, 3))
    texels[:, :, 6], texels[:, :, 7] = sigmoid(g.metallic_logits), sigmoid(g.roughness_logits)
    texels[seen.surfels.radii[:, 0] == 0] = 0
    return texels


def read_textures_vjp(seen: discs.Seen, v_texels: Floats) -> shaded.MaterialGradient:
    """Gradient of :func:`read_textures`.

    With the axes ``a_k = R r_k`` of a disc, the sign s that turns a_2 to the camera, and (x, y, z) of
    :func:`.textures.tangent_normals`::

        v_(x, y, z)_k = s a_k . v_n,   v_a_k = s sum over texels of (x, y, z)_k v_n
        v_r_k = R^T v_a_k,   v_R = sum_k v_a_k r_k^T
    """
    g, dtype = seen.gaussians, seen.gaussians.means.dtype
    raw = _split_texels(g.normal_textures, 2)
    axes, signs = disc_axes(seen)
    v_texels = np.where(seen.surfels.radii[:, :1, None] > 0, v_texels, 0)
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


def blend(
    seen: discs.Seen, colors: Floats, texels: Floats, further: Floats, request: Request
) -> tuple[RenderOutput, TextureTape]:
    """Blend surfels with textures; see :func:`minisplat_ref.mechanisms.surfels.renderer.blend`.

    Parameters
    ----------
    seen, colors, request
        As there; the request wants normals.
    texels : ndarray of shape (N, T^2, 8)
        From :func:`read_textures`.
    further : ndarray of shape (N, K)
        What else each surfel brings along, the same for all of its points.
    """
    if texels.shape[1] == 1:
        flat = seen._replace(surfels=seen.surfels._replace(normals=texels[:, 0, :3]))
        output, tape = shaded.blend_flat(flat, colors, texels[:, 0, 3:], further, request)
        return output, TextureTape(tape, texels, np.zeros((0, 0, N_CHANNELS)))
    output, tape = discs.blend(seen, colors, further, request._replace(wants=request.wants - {"normal"}))
    image = choose_twin(request.backend).blend_texels(tape.shown.surfels, texels, tape.shown.bins, request.conventions)
    parts = {**{name: output.image[:, :, part] for name, part in tape.slices.items()}, "normal": image[:, :, :3]}
    n_own = max(part.stop for part in tape.slices.values())
    mixed = [*(parts[name] for name in discs.channels(request.wants)), image[:, :, 3:], output.image[:, :, n_own:]]
    return output._replace(image=np.concatenate(mixed, axis=2)), TextureTape(tape, texels, image)


def blend_vjp(tape: TextureTape, v_image: Floats, v_alpha: Floats | None) -> tuple[discs.BlendedGradient, Floats]:
    """Gradient of :func:`blend`; ``carried`` is that of the texels. Both blends add to the gradient of the surfels."""
    if tape.texels.shape[1] == 1:
        v, v_further = shaded.blend_flat_vjp(tape.discs, v_image, v_alpha)
        v_texels = np.column_stack([v.surfels.normals, v.carried])[:, None]
        flat = v.surfels._replace(normals=np.zeros_like(v.surfels.normals))
        return v._replace(surfels=flat, carried=v_texels), v_further
    shown, slices = tape.shown, discs.channels(frozenset(tape.discs.slices) | {"normal"})
    first = max(part.stop for part in slices.values())
    last = first + N_CHANNELS - 3
    others = [v_image[:, :, slices[name]] for name in tape.discs.slices]
    v = discs.blend_vjp(tape.discs, np.concatenate([*others, v_image[:, :, last:]], axis=2), v_alpha)
    v_T, v_c, v_o, v_texels = choose_twin(shown.backend).blend_texels_vjp(
        shown.surfels,
        tape.texels,
        shown.bins,
        shown.conventions,
        tape.image,
        np.concatenate([v_image[:, :, slices["normal"]], v_image[:, :, first:last]], axis=2),
    )
    s = v.surfels
    moved = s._replace(transforms=s.transforms + v_T, means2d=s.means2d + v_c, opacities=s.opacities + v_o)
    return v._replace(surfels=moved, carried=v_texels), v.carried


def materials_on(backend: Backend, size: int) -> shaded.Materials:
    """Return textures of ``size`` x ``size`` texels as materials, read and blended as a backend does.

    One texel is read in NumPy, as the material of a surfel is, so that both give the same numbers.
    """
    if backend.is_compiled and size > 1:
        return shaded.Materials(texel_kernels.read_textures, texel_kernels.read_textures_vjp, blend, blend_vjp)
    return shaded.Materials(read_textures, read_textures_vjp, blend, blend_vjp)


def render_textured(
    model: Model, view: View, request: Request, visibility: Floats | None = None
) -> tuple[RenderOutput, shaded.ReflectiveTape]:
    """Render a view; see :func:`minisplat_ref.mechanisms.gbuffer.renderer.render_reflective`.

    Textures are shaded pixel by pixel, whatever stage the model has. The channel ``normal`` is that of the textures.
    """
    stage = np.maximum(model.shared[STAGE], PER_PIXEL) if STAGE in model.shared else None
    deferred = model if stage is None else model._replace(shared={**model.shared, STAGE: stage})
    materials = materials_on(request.backend, count_texels(model.gaussians))
    return shaded.render_reflective(deferred, view, request, visibility, mirrors=True, materials=materials)


def disc_axes(seen: discs.Seen) -> tuple[Floats, Floats]:
    """Return the axes of discs in the camera's frame, [N, 3, 3] by columns, and the signs [N, 1] of the third.

    A disc that is culled has the sign 0.
    """
    axes = seen.camera.cam_from_world_R @ rotation_matrices(seen.primitives.quats.astype(np.float64))
    return axes, np.sign(np.sum(axes[:, :, 2] * seen.surfels.normals, axis=1, keepdims=True))


def _split_texels(field: Floats, n_channels: int) -> Floats:
    return field.reshape(len(field), field.shape[1] // n_channels, n_channels)


def choose_twin(backend: Backend) -> Any:
    """Return the module that blends textures on a backend: kernels, or the same in NumPy."""
    return kernels if backend.is_compiled else textures


TEXTURED = Renderer("textured surfels", render_textured, shaded.render_reflective_vjp, shaded.channels)

TEXTURED_SURFELS = Representation(
    "textured surfels",
    population=TexturedSurfels,
    extend=partial(with_textures, texels=TEXELS),
    shared=first_light,
    renderer=TEXTURED,
    rates=RATES,
    extends=frozenset({"reflective surfels", "textured surfels"}),
)

RECIPE = FINE_TUNING._replace(
    name="texture-splat",
    learning_rates=FINE_TUNING.learning_rates.change(means=0.0, **OWN_RATES),
    losses=(*FINE_TUNING.losses, NORMALS),
)
"""``texture-splat``: 30,000 iterations on a finished run; centres and their number stay, everything else is trained."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the whole renderer, by its own name, shaded with occlusion.

    Besides the kinks of shading, a hit has those between the cells of its textures, and a normal that of its largest
    tilt.
    """
    representation = TEXTURED_SURFELS._replace(extend=partial(with_textures, texels=CHECKED_TEXELS))
    stage = shading_stage(
        backend,
        setting,
        rng,
        representation,
        WITH_OCCLUSION,
        render=render_textured,
        shaded=lambda tape: tape,
        further=_sides,
    )
    return (stage,)


def _sides(drawn: Drawn) -> list[np.ndarray]:
    tilts = np.sum(np.tanh(drawn.model.gaussians.normal_textures.reshape(-1, 2)) ** 2, axis=1)
    return [*find_cells(drawn.tape.blend.shown, CHECKED_TEXELS), tilts < TILT_MAX]


def find_cells(shown: Shown, size: int) -> list[np.ndarray]:
    """Return between which texels the hits of a view are, along both axes, as the reference computes them."""
    cells = []
    for tile in tile_hits(shown.surfels, shown.bins, shown.conventions, surfel_response(Layout())):
        is_hit, place = tile.alphas > 0, tile.hit.place
        for coordinate in (place.u, place.v):
            x = (np.where(is_hit, coordinate, 0) / REACH + 1) * (size - 1) / 2
            cells.append((np.floor(x) * is_hit * place.is_met).ravel())
    return cells
