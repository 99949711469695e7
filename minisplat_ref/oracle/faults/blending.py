"""Backends that blend wrongly: other footprints, other alphas, another order, another background.

Those whose gradient is the derivative of what they compute change it, too; the others are compared by their images.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from minisplat_ref.oracle.planted import Stage, change_stages
from minisplat_ref.reference.hits import TileHits, is_accepted, tile_hits, transmit
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import CompositeGradient, Floats, Projection, RenderOutput


def _change_footprints(
    change: Callable[[Projection], Projection], back: Callable[[CompositeGradient], CompositeGradient]
) -> Backend:
    """Return a backend that blends other footprints."""

    def composite(stage: Stage, projection: Projection, *rest: Any, **asked: bool) -> RenderOutput:
        return stage(change(projection), *rest, **asked)

    def composite_vjp(stage: Stage, projection: Projection, *rest: Any) -> CompositeGradient:
        return back(stage(change(projection), *rest))

    return change_stages(REFERENCE, composite=composite, composite_vjp=composite_vjp)


def with_blended_conics(*factors: float) -> Backend:
    """Return a backend that blends conics times three factors."""
    by = np.array(factors)
    return _change_footprints(
        lambda p: p._replace(conics=(p.conics * by).astype(p.conics.dtype)), lambda v: v._replace(conics=v.conics * by)
    )


def with_blended_opacities(factor: float) -> Backend:
    """Return a backend that blends opacities times a factor."""
    return _change_footprints(
        lambda p: p._replace(opacities=p.opacities * p.opacities.dtype.type(factor)),
        lambda v: v._replace(opacities=factor * v.opacities),
    )


def with_blended_positions(dx: float, dy: float) -> Backend:
    """Return a backend that blends footprints at other places, in pixels."""
    by = np.array([dx, dy])
    return _change_footprints(lambda p: p._replace(means2d=(p.means2d + by).astype(p.means2d.dtype)), lambda v: v)


def with_other_opacities(change: Callable[[Floats], Floats]) -> Backend:
    """Return a backend that blends other opacities."""
    return _change_footprints(lambda p: p._replace(opacities=change(p.opacities)), lambda v: v)


def with_weights(weigh: Callable[[TileHits, Any], tuple[Floats, Floats]]) -> Backend:
    """Return a backend that blends with other weights.

    ``weigh(hits, conventions)`` returns the weights [G, P] of the hits and the share [P] of the background.
    """

    def composite(
        stage: Stage, p: Projection, colors: Floats, background: Floats, bins: Any, conventions: Any, **_: bool
    ) -> RenderOutput:
        output = stage(p, colors, background, bins, conventions)
        for tile in tile_hits(p, bins, conventions):
            weights, T_end = weigh(tile, conventions)
            output.image[tile.ys, tile.xs] = weights.T @ colors[tile.ids] + T_end[:, None] * background
            output.alpha[tile.ys, tile.xs] = 1 - T_end
        return output

    return change_stages(REFERENCE, composite=composite)


def behind_each_hit(tile: TileHits, _: Any) -> tuple[Floats, Floats]:
    """Weigh a hit by the transmittance behind it in place of that in front."""
    return tile.alphas * tile.transmittances[1:], tile.transmittances[-1]


def without_transmittance(tile: TileHits, _: Any) -> tuple[Floats, Floats]:
    """Weigh a hit by its alpha alone."""
    return tile.alphas, tile.transmittances[-1]


def by_mean_alphas(tile: TileHits, _: Any) -> tuple[Floats, Floats]:
    """Weigh hits by alpha over the sum of alphas, whatever their order."""
    total = np.maximum(tile.alphas.sum(axis=0), 1e-12)
    return tile.alphas / total * (1 - tile.transmittances[-1]), tile.transmittances[-1]


def with_the_last_hit(tile: TileHits, conventions: Any) -> tuple[Floats, Floats]:
    """Blend the hit that takes the transmittance below its stop, too, and end behind it."""
    alphas = np.minimum(conventions.alpha_max, tile.hit.unclamped)
    alphas = np.where(alphas >= conventions.alpha_min, alphas, 0)
    T = transmit(alphas)
    alphas = np.where(is_accepted(T[:-1], conventions), alphas, 0)
    T = transmit(alphas)
    return alphas * T[:-1], T[-1]


def cut_at(deviations: float) -> Callable[[TileHits, Any], tuple[Floats, Floats]]:
    """Leave hits out beyond so many standard deviations."""

    def weigh(tile: TileHits, _: Any) -> tuple[Floats, Floats]:
        alphas = np.where(tile.hit.place.falloffs >= np.exp(-(deviations**2) / 2), tile.alphas, 0)
        T = transmit(alphas)
        return alphas * T[:-1], T[-1]

    return weigh


def with_nearest(n: int) -> Callable[[TileHits, Any], tuple[Floats, Floats]]:
    """Blend no more than the nearest ``n`` Gaussians of a pixel."""

    def weigh(tile: TileHits, _: Any) -> tuple[Floats, Floats]:
        alphas = np.where(np.cumsum(tile.alphas > 0, axis=0) <= n, tile.alphas, 0)
        T = transmit(alphas)
        return alphas * T[:-1], T[-1]

    return weigh


def with_behind(share: Callable[[Floats], Floats]) -> Backend:
    """Return a backend that adds the background with another share [H, W] than the transmittance that is left."""

    def composite(
        stage: Stage, p: Projection, colors: Floats, background: Floats, *rest: Any, **asked: bool
    ) -> RenderOutput:
        output = stage(p, colors, 0 * background, *rest, **asked)
        return output._replace(image=output.image + share(1 - output.alpha)[..., None] * background)

    return change_stages(REFERENCE, composite=composite)


def with_alpha(change: Callable[[Floats], Floats]) -> Backend:
    """Return a backend whose image of alpha is another; colours are right."""

    def composite(stage: Stage, *args: Any, **asked: bool) -> RenderOutput:
        output = stage(*args, **asked)
        return output._replace(alpha=change(output.alpha))

    return change_stages(REFERENCE, composite=composite)


def sorted_by(key: Callable[[Projection], Floats]) -> Backend:
    """Return a backend that sorts by something else; depths themselves are right."""

    def bin_gaussians(stage: Stage, projection: Projection, *rest: Any) -> Any:
        return stage(projection._replace(depths=key(projection)), *rest)

    return change_stages(REFERENCE, bin_gaussians=bin_gaussians)


def with_background(factor: float) -> Backend:
    """Return a backend with the background times a factor."""

    def composite(
        stage: Stage, p: Projection, colors: Floats, background: Floats, *rest: Any, **asked: bool
    ) -> RenderOutput:
        return stage(p, colors, factor * background, *rest, **asked)

    def composite_vjp(stage: Stage, p: Projection, colors: Floats, background: Floats, *rest: Any) -> CompositeGradient:
        v = stage(p, colors, factor * background, *rest)
        return v._replace(background=factor * v.background)

    return change_stages(REFERENCE, composite=composite, composite_vjp=composite_vjp)
