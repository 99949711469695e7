"""The layers of a view that can be shown: its colours, or a map of their components."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.app.reports.images import Image8, colorize, depth_image, depth_range, to_8_bits
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.constants import PROFILES
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.gbuffer.maps import map_image
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.rendering import Renderer, RenderSettings
from minisplat_ref.rendering.backends import get_backend
from minisplat_ref.types import BlendStats, Camera, Floats, Ints, RenderOutput, TileBins, view_from

SPREAD = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint64)  # odd: multiples of neighbours differ in high bits


class Picture(NamedTuple):
    """A layer of a view, ready to be shown."""

    image: Image8
    caption: str
    """The meaning of its colours, in a few words; empty for the colours themselves."""


class RenderedView(NamedTuple):
    """A rendered view."""

    output: RenderOutput
    tape: Any
    renderer: Renderer
    wants: frozenset[str]

    @property
    def stats(self) -> BlendStats:
        """Blend statistics; an InputError where the renderer has none."""
        if self.output.stats is None:
            raise InputError(f"renderer {self.renderer.name} gives no blend statistics: choose another layer")
        return self.output.stats

    def channel(self, name: str) -> Floats:
        """Return a channel [H, W, D] by name."""
        return self.output.image[..., self.renderer.channels(self.wants)[name]]


class Layer(NamedTuple):
    """A way of looking at a view."""

    wants: frozenset[str]
    """The outputs that it needs of the renderer, see :class:`minisplat_ref.rendering.Request`."""
    picture: Callable[[RenderedView], Picture]
    channel: str = "rgb"
    """That the renderer must have."""


def _colour(rendered: RenderedView) -> Picture:
    return Picture(to_8_bits(rendered.output.image[..., :3]), "")


def _depth(rendered: RenderedView) -> Picture:
    depth = expected_depth(rendered.channel("depth")[..., 0], rendered.output.alpha)  # [H, W]
    near, far = depth_range(depth)
    return Picture(depth_image(depth, near, far), f"bright is near: depth {near:.3g} to {far:.3g}")


def _alpha(rendered: RenderedView) -> Picture:
    return Picture(colorize(rendered.output.alpha, 0.0, 1.0, "gray"), "accumulated opacity: black 0, white 1")


def _transmittance(rendered: RenderedView) -> Picture:
    """Show 1 - alpha in powers of ten: the factor by which the background is visible."""
    left = np.maximum(1 - rendered.output.alpha, 1e-4)  # [H, W]; where the compositor stops
    return Picture(
        colorize(np.log10(left), -4.0, 0.0, "magma"), "light that passes: dark 0.0001, bright 1 (logarithmic)"
    )


def _normal(rendered: RenderedView) -> Picture:
    return Picture(
        map_image("normal", rendered.channel("normal"), rendered.output.alpha), "(normal + 1) / 2 as red, green, blue"
    )


def _importance(rendered: RenderedView) -> Picture:
    """Show the weight in the whole view of the Gaussian that dominates a pixel, ``sum w`` over its pixels."""
    ids = rendered.stats.dominant_ids
    weights = np.append(rendered.stats.blend_weight_sum, 0)[ids]  # [H, W]; id -1 gets 0
    highest = float(weights.max(initial=0.0))
    shown = colorize(np.log1p(weights), 0.0, float(np.log1p(highest)), "inferno")
    return Picture(
        shown, f"blend weight in this view of the dominant Gaussian: 0 to {highest:,.0f} pixels (logarithmic)"
    )


def _dominant(rendered: RenderedView) -> Picture:
    ids = rendered.stats.dominant_ids  # [H, W]
    return Picture(colors_of_ids(ids), f"{len(np.unique(ids[ids >= 0])):,} Gaussians dominate a pixel, one colour each")


def _tile_load(rendered: RenderedView) -> Picture:
    bins = find_bins(rendered.tape)
    if bins is None:
        raise InputError(f"renderer {rendered.renderer.name} lists no Gaussians by tile: choose another layer")
    loads = tile_loads(bins)
    highest = int(loads.max(initial=0))
    return Picture(
        colorize(loads.astype(np.float32), 0.0, float(highest), "inferno"),
        f"Gaussians listed in a tile: 0 to {highest:,}",
    )


LAYERS: dict[str, Layer] = {
    "colour": Layer(frozenset(), _colour),
    "depth": Layer(frozenset({"depth"}), _depth, "depth"),
    "alpha": Layer(frozenset(), _alpha),
    "transmittance": Layer(frozenset(), _transmittance),
    "normals": Layer(frozenset({"normal"}), _normal, "normal"),
    "importance": Layer(frozenset({"stats"}), _importance),
    "dominant Gaussian": Layer(frozenset({"stats"}), _dominant),
    "tile load": Layer(frozenset(), _tile_load),
}


def list_layers(renderer: Renderer) -> list[str]:
    """Return the names of the layers whose channels a renderer has."""
    return [name for name, layer in LAYERS.items() if layer.channel in renderer.channels(layer.wants)]


def render_layer(trained: Trained, camera: Camera, layer: str, time: float = 0.0) -> Picture:
    """Render a view and return one layer of it.

    Parameters
    ----------
    trained : Trained
    camera : Camera
        In the frame of the model.
    layer : str
        A key of :data:`LAYERS`.
    time : float
        Moment shown, of scenes that move.

    Raises
    ------
    InputError
        The renderer does not have the channel that the layer shows.
    """
    wants = LAYERS[layer].wants
    settings = RenderSettings(
        trained.background, PROFILES[trained.profile], get_backend(trained.backend), trained.renderer
    )
    output, tape = settings.render_view(trained.model, view_from(camera, time=time), wants)
    return LAYERS[layer].picture(RenderedView(output, tape, trained.renderer, wants))


def colors_of_ids(ids: Ints) -> Image8:
    """Return a colour [H, W, 3] for each index [H, W], always the same and unlike its neighbours'; black for -1."""
    hashed = (ids[..., None].astype(np.int64) + 1).astype(np.uint64) * SPREAD  # [H, W, 3]; id -1 gets 0
    image: Image8 = ((hashed >> np.uint64(24)) & np.uint64(0xFF)).astype(np.uint8)
    return image


def find_bins(tape: Any) -> TileBins | None:
    """Return the lists of Gaussians by tile in a tape, at any depth of nested tuples; None if there are none."""
    if isinstance(tape, TileBins):
        return tape
    parts = tape if isinstance(tape, tuple) else ()
    return next((found for part in parts if (found := find_bins(part)) is not None), None)


def tile_loads(bins: TileBins) -> Ints:
    """Return for each pixel [H, W] the number of Gaussians in its tile's list."""
    grid = bins.grid
    loads = np.diff(bins.tile_offsets).reshape(grid.n_tiles_y, grid.n_tiles_x)
    tiles = loads.repeat(grid.tile_height, axis=0).repeat(grid.tile_width, axis=1)
    return tiles[: grid.height, : grid.width]
