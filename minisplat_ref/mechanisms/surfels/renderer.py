"""A renderer of surfels, and its gradient: colours, normals, depths and the terms of the distortion as channels."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing import hits as kernel_hits
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.surfels import projection, projection_kernels, ray_kernels, ray_measures
from minisplat_ref.mechanisms.surfels.kernels import response_for
from minisplat_ref.mechanisms.surfels.projection import (
    RELEASED,
    SurfelGradient,
    Surfels,
    centers_moved,
)
from minisplat_ref.mechanisms.surfels.ray_measures import RayMeasures
from minisplat_ref.mechanisms.surfels.response import Layout, surfel_response
from minisplat_ref.reference.compositing import composite_hits, composite_hits_vjp
from minisplat_ref.reference.removal import removal_changes_of_hits
from minisplat_ref.rendering import (
    Renderer,
    RenderGradient,
    Request,
    activate,
    add_light_behind,
    choose_degree,
    parameters_vjp,
)
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.rendering.box_lists import list_boxes
from minisplat_ref.types import (
    BlendGradient,
    Camera,
    Floats,
    Ints,
    Model,
    PrimitiveGradient,
    Primitives,
    RenderOutput,
    TileBins,
    View,
)

CHANNELS = {"depth": 1, "normal": 3, "spread": 2, "median": 1}
"""The channels beside ``rgb`` in their order, and how many each has. The median is the last: it is not blended."""
EXTRAS = frozenset({"stats", "median_depth", "removal_changes"})  # what the output has besides its image


class Shown(NamedTuple):
    """A view of surfels after projection and shading, ready to be blended."""

    surfels: Surfels
    colors: Floats
    """[N, D] values that are constant on a surfel; 0 in channels of depths."""
    background: Floats
    """[D]."""
    bins: TileBins
    conventions: Conventions
    backend: Backend
    layout: Layout

    def blend(self, with_stats: bool = False) -> RenderOutput:
        """Return the image, blended by kernels or by the reference, and blend statistics on request."""
        inputs = self.surfels, self.colors, self.background, self.bins, self.conventions
        if self.backend.is_compiled:
            response = response_for(self.colors.dtype, self.surfels, self.layout)
            return kernel_hits.composite_hits(response, *inputs, with_stats=with_stats)
        return composite_hits(surfel_response(self.layout), *inputs, with_stats=with_stats)

    def removal_changes(self, output: RenderOutput) -> Floats:
        """Return the squared change of the colours [N] without each surfel."""
        inputs = self.surfels, self.colors, self.bins, self.conventions, output
        if self.backend.is_compiled:
            response = response_for(self.colors.dtype, self.surfels, self.layout)
            return kernel_hits.removal_changes_of_hits(response, *inputs)
        return removal_changes_of_hits(surfel_response(self.layout), *inputs)

    def blend_vjp(self, output: RenderOutput, v_image: Floats, v_alpha: Floats) -> BlendGradient:
        """Gradient of :meth:`blend`."""
        inputs = self.surfels, self.colors, self.background, self.bins, self.conventions, output, (v_image, v_alpha)
        if self.backend.is_compiled:
            return kernel_hits.composite_hits_vjp(response_for(self.colors.dtype, self.surfels, self.layout), *inputs)
        return composite_hits_vjp(surfel_response(self.layout), *inputs)

    def measure_rays(self) -> RayMeasures:
        """Return median depths and gsplat's distortion."""
        if self.backend.is_compiled:
            return ray_kernels.measure_rays(self.surfels, self.bins, self.conventions, self.colors.dtype)
        return ray_measures.measure_rays(self.surfels, self.bins, self.conventions)

    def measure_rays_vjp(self, measures: RayMeasures, v_median: Floats, v_distortion: Floats) -> tuple[Floats, ...]:
        """Gradient of :meth:`measure_rays` with respect to transforms, means2d, opacities and depths."""
        module: Any = ray_kernels if self.backend.is_compiled else ray_measures
        fields: tuple[Floats, ...] = module.measure_rays_vjp(
            self.surfels, self.bins, self.conventions, measures, v_median, v_distortion
        )
        return fields


def list_tiles(surfels: Surfels, camera: Camera, conventions: Conventions, backend: Backend) -> TileBins:
    """Return the surfels of every tile, nearest centres first."""
    return list_boxes(surfels.depths, surfels.radii, surfels.boxes, camera, conventions, backend)


class Seen(NamedTuple):
    """A population as a camera sees it."""

    gaussians: Any
    primitives: Primitives
    camera: Camera
    surfels: Surfels


class BlendTape(NamedTuple):
    """The values that :func:`blend` keeps for :func:`blend_vjp`."""

    shown: Shown
    blended: RenderOutput
    measures: RayMeasures | None
    slices: dict[str, slice]


class BlendedGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`blend`."""

    surfels: SurfelGradient
    colors: Floats  # [N, 3]
    carried: Floats  # [N, K]
    background: Floats  # [3]


class SurfelTape(NamedTuple):
    """The values that :func:`render_surfels` keeps for :func:`render_surfels_vjp`."""

    seen: Seen
    sh_degree: int | Ints  # active
    blend: BlendTape

    @property
    def shown(self) -> Shown:
        """The input of blending."""
        return self.blend.shown


def channels(wants: frozenset[str]) -> dict[str, slice]:
    """Return the image's channels by name."""
    slices, first = {"rgb": slice(0, 3)}, 3
    for name, size in CHANNELS.items():
        if name in wants:
            slices[name] = slice(first, first + size)
            first += size
    return slices


def look(model: Model, view: View, request: Request, low_pass_cutoff: float = RELEASED.low_pass_cutoff) -> Seen:
    """Return a population as the camera of a view sees it, by the released rules but for the cutoff of the low-pass.

    Raises
    ------
    InputError
        Surfels lack a requested channel, or the conventions require compensated opacities.
    """
    if missing := request.wants - CHANNELS.keys() - EXTRAS:
        names = ", ".join(sorted(missing))
        raise InputError(f"surfels are drawn without {names}: train a recipe that does without")
    if request.conventions.is_antialiased:
        raise InputError("surfels have a low-pass without compensated opacities: leave the antialiased profile out")
    primitives = activate(model.gaussians, request.is_visible, request.opacity_factor)
    rules = RELEASED._replace(low_pass_cutoff=low_pass_cutoff)
    surfels = _projection(request.backend).project(primitives, view.camera, request.conventions, rules)
    return Seen(model.gaussians, primitives, view.camera, surfels)


def look_vjp(seen: Seen, conventions: Conventions, backend: Backend, v_surfels: SurfelGradient) -> PrimitiveGradient:
    """Gradient of :func:`look` with respect to the activated surfels and the pose."""
    gradient: PrimitiveGradient = _projection(backend).project_vjp(
        seen.primitives, seen.camera, conventions, seen.surfels, v_surfels
    )
    return gradient


def _projection(backend: Backend) -> Any:
    """Return the module that projects: kernels or the reference."""
    return projection_kernels if backend.is_compiled else projection


def blend(seen: Seen, colors: Floats, carried: Floats, request: Request) -> tuple[RenderOutput, BlendTape]:
    """Blend the surfels of a view.

    Parameters
    ----------
    seen : Seen
        From :func:`look`.
    colors : ndarray of shape (N, 3)
        RGB.
    carried : ndarray of shape (N, K)
        What else each surfel brings along, such as its material.
    request : Request
        As for :func:`render_surfels`.

    Returns
    -------
    output : RenderOutput
        Its image has the channels of :func:`channels`, and then the K that are carried, over a background of 0.
    tape : BlendTape

    Raises
    ------
    InputError
        ``removal_changes`` are wanted of more than colours: other channels have other units.
    """
    surfels, backend, dtype, slices = seen.surfels, request.backend, colors.dtype, channels(request.wants)
    if "removal_changes" in request.wants and (len(slices) > 1 or carried.shape[1]):
        raise InputError("removal_changes are those of colours alone: train a recipe that draws colours")
    parts = {"rgb": colors}
    for name in slices:
        if name not in ("rgb", "median"):
            parts[name] = surfels.normals if name == "normal" else np.zeros((len(surfels.depths), CHANNELS[name]))
    all_colors = np.column_stack([*parts.values(), carried]).astype(dtype)
    background = np.zeros(all_colors.shape[1], dtype)
    if request.background is not None:
        background[:3] = request.background
    layout = Layout(*(slices[name].start if name in slices else None for name in ("depth", "spread")))
    bins = list_tiles(surfels, seen.camera, request.conventions, backend)
    shown = Shown(surfels, all_colors, background, bins, request.conventions, backend, layout)
    blended = shown.blend(with_stats="stats" in request.wants)
    measures = shown.measure_rays() if request.wants & {"median", "median_depth"} else None
    image = blended.image
    if measures is not None and "median" in slices:
        at = slices["median"].start
        image = np.concatenate([image[:, :, :at], measures.median[:, :, None].astype(dtype), image[:, :, at:]], axis=2)
    extras = {}
    if "removal_changes" in request.wants:
        extras["removal_changes"] = shown.removal_changes(add_light_behind(blended, request))
    output = blended._replace(
        image=image,
        extras=extras,
        median_depth=None if measures is None else measures.median.astype(dtype),
        visible_ids=np.flatnonzero(surfels.radii[:, 0] > 0),
        n_pairs=len(bins.gaussian_ids),
    )
    return output, BlendTape(shown, blended, measures, slices)


def blend_vjp(tape: BlendTape, v_image: Floats, v_alpha: Floats | None) -> BlendedGradient:
    """Gradient of :func:`blend`."""
    shown, slices, v_median = tape.shown, tape.slices, None
    v_alpha = np.zeros_like(tape.blended.alpha) if v_alpha is None else v_alpha
    if "median" in slices:
        v_median = np.ascontiguousarray(v_image[:, :, slices["median"].start])
        v_image = np.delete(v_image, slices["median"].start, axis=2)
    v = shown.blend_vjp(tape.blended, np.ascontiguousarray(v_image), v_alpha)
    v_fields = v.primitives
    if tape.measures is not None and v_median is not None:
        v_rays = shown.measure_rays_vjp(tape.measures, v_median, np.zeros_like(v_median))
        v_fields = tuple(a + b for a, b in zip(v_fields, v_rays, strict=True))
    v_normals = v.colors[:, slices["normal"]] if "normal" in slices else np.zeros((len(v.colors), 3))
    n_own = sum(part.stop - part.start for name, part in slices.items() if name != "median")
    return BlendedGradient(
        SurfelGradient(v_fields[0], v_fields[1], v_fields[2], v_fields[3], v_normals),
        np.ascontiguousarray(v.colors[:, :3]),
        v.colors[:, n_own:],
        v.background[:3],
    )


def render_surfels(
    model: Model, view: View, request: Request, *, low_pass_cutoff: float = RELEASED.low_pass_cutoff
) -> tuple[RenderOutput, SurfelTape]:
    """Render a view of surfels.

    Parameters
    ----------
    model : Model
        A population that has the six fields of :class:`Gaussians`; the third scale is not read.
    view : View
        Its camera is used.
    request : Request
        Wants: ``depth``, ``sum w z`` with the depths of the hits; ``normal``, ``sum w n`` in the camera's frame,
        towards the camera; ``spread``, ``sum w q`` and ``sum w q^2`` of
        :class:`~minisplat_ref.mechanisms.surfels.response.Layout`; ``median``, the median depth as a channel with a
        gradient; ``median_depth``, the same in the output; ``stats`` and ``removal_changes`` of :class:`Request`.
    low_pass_cutoff : float
        Of :class:`.projection.SurfelRules`: 3 in the paper's code, 0 in its text, 1 in gsplat.

    Returns
    -------
    output : RenderOutput
    tape : SurfelTape

    Raises
    ------
    InputError
        As :func:`look`.
    """
    seen, g = look(model, view, request, low_pass_cutoff), model.gaussians
    sh_degree = choose_degree(g.sh_rest, request.sh_degree)
    radii = seen.surfels.radii
    colors = request.backend.sh_colors(g.means, g.sh_dc, g.sh_rest, seen.camera, sh_degree, radii)
    output, tape = blend(seen, colors, np.zeros((len(colors), 0)), request)
    return output, SurfelTape(seen, sh_degree, tape)


def render_surfels_vjp(tape: SurfelTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_surfels`, by the chain rule.

    The means and the pose are used twice, by the projection and by the viewing direction, so two gradients are summed.
    """
    (g, primitives, camera, surfels), shown = tape.seen, tape.shown
    v = blend_vjp(tape.blend, v_image, v_alpha)
    v_primitives = look_vjp(tape.seen, shown.conventions, shown.backend, v.surfels)
    v_sh = shown.backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, tape.sh_degree, surfels.radii, v.colors)
    return RenderGradient(
        gaussians=parameters_vjp(g, primitives, v_primitives, v_sh),
        background=v.background,
        cam_from_world_R=v_primitives.cam_from_world_R + v_sh.cam_from_world_R,
        cam_from_world_t=v_primitives.cam_from_world_t + v_sh.cam_from_world_t,
        means2d=centers_moved(v.surfels, surfels).astype(g.means.dtype),
    )


SURFELS = Renderer(
    "surfels",
    partial(render_surfels, low_pass_cutoff=RELEASED.low_pass_cutoff),
    render_surfels_vjp,
    channels,
    scales_opacities=True,
)
"""2D Gaussian Splatting: any population that has the six fields of :class:`Gaussians`."""
