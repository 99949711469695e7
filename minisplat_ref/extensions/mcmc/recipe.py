"""The actions of MCMC densification, its loss terms, and the recipe ``mcmc`` that schedules them."""

from functools import partial
from typing import Any

import numpy as np
from scipy.special import expit, logit

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.mcmc.model import (
    draw_noise,
    mean_opacity,
    mean_opacity_vjp,
    mean_scale,
    mean_scale_vjp,
    share_among_copies,
)
from minisplat_ref.methods.gaussian_splatting import GS
from minisplat_ref.strategy.ops import Edit, concat, n_rows, take
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit, n_pixels
from minisplat_ref.types import Floats, Gaussians, Ints


def begin_small(
    gaussians: Gaussians, rng: np.random.Generator, *, initial_opacity: float, initial_size: float
) -> Gaussians:
    """Return Gaussians with another opacity, and with their sizes multiplied by ``initial_size``.

    Raises
    ------
    InputError
        The opacity is not between 0 and 1, or the size not above 0.
    """
    if not (0 < initial_opacity < 1 and 0 < initial_size < np.inf):
        raise InputError(
            f"mcmc begins with initial_opacity={initial_opacity} and initial_size={initial_size}: give an opacity"
            " between 0 and 1, and a size above 0"
        )
    dtype = gaussians.log_scales.dtype
    return gaussians._replace(
        opacity_logits=np.full_like(gaussians.opacity_logits, logit(initial_opacity)),
        log_scales=gaussians.log_scales + dtype.type(np.log(initial_size)),
    )


def relocate(state: TrainState, iteration: Iteration, *, dead_opacity: float) -> str | None:
    """Make each Gaussian of at most this opacity a copy of one of the others, drawn by opacity.

    What it is copied from forgets its moments; the copy keeps its own, as released.
    """
    opacities = _opacities(state.gaussians)
    is_dead = opacities <= dead_opacity
    dead, alive = np.flatnonzero(is_dead), np.flatnonzero(~is_dead)
    if len(dead) == 0 or len(alive) == 0:
        return f"nothing done: {len(dead):,} of {len(opacities):,} are dead"
    sources = _draw(state.rng, alive, opacities, len(dead))
    shared, is_source = _share(state.gaussians, sources)
    from_rows = np.arange(len(opacities))
    from_rows[dead] = sources
    apply_edit(state, Edit(take(shared, from_rows), np.arange(len(opacities)), is_source))
    return f"{len(dead):,} relocated"


def add_copies(
    state: TrainState, iteration: Iteration, *, growth: float, budget: int | None, per_pixel: float
) -> str | None:
    """Add a fraction ``growth`` of the Gaussians as copies, drawn by opacity, up to ``budget`` Gaussians.

    Without a budget the cap is ``per_pixel`` for each pixel of the training views.
    """
    g, n = state.gaussians, n_rows(state.gaussians)
    cap = round(per_pixel * n_pixels(iteration.scene)) if budget is None else budget
    n_new = min(cap, int((1 + growth) * n)) - n
    if n_new <= 0:
        return f"nothing done: the cap is {cap:,}" if n >= cap else "nothing done: so few do not grow"
    sources = _draw(state.rng, np.arange(n), _opacities(g), n_new)
    shared, is_source = _share(g, sources)
    apply_edit(
        state,
        Edit(
            concat(shared, take(shared, sources)),
            np.concatenate([np.arange(n), sources]),
            np.concatenate([is_source, np.ones(n_new, bool)]),
        ),
    )
    return None


def add_noise(state: TrainState, iteration: Iteration, *, noise: float) -> None:
    """Move the means at random, with ``noise`` times their learning rate; see :func:`draw_noise`."""
    means = state.gaussians.means
    means += draw_noise(state.gaussians, noise * iteration.rates()["means"], state.rng)


def opacity_reg(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean of the opacities, and its gradient."""
    logits = rendered.model.gaussians.opacity_logits
    return mean_opacity(logits), Cotangents(gaussians={"opacity_logits": mean_opacity_vjp(logits)})


def scale_reg(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean of the scales, world units, and its gradient."""
    log_scales = rendered.model.gaussians.log_scales
    return mean_scale(log_scales), Cotangents(gaussians={"log_scales": mean_scale_vjp(log_scales)})


def _opacities(gaussians: Any) -> Floats:
    return expit(gaussians.opacity_logits.astype(np.float64))


def _draw(rng: np.random.Generator, rows: Ints, opacities: Floats, n: int) -> Ints:
    """Return n of the rows, drawn by opacity, with replacement."""
    weights = opacities[rows]
    return rng.choice(rows, n, p=weights / weights.sum())


def _share(gaussians: Any, sources: Ints) -> tuple[Any, Any]:
    """Return the population with each source as one of its copies and itself, and which rows [N] are sources."""
    counts = np.bincount(sources, minlength=n_rows(gaussians))  # [N]
    is_source = counts > 0
    logits, log_scales = gaussians.opacity_logits.copy(), gaussians.log_scales.copy()
    logits[is_source], log_scales[is_source] = share_among_copies(
        logits[is_source], log_scales[is_source], counts[is_source] + 1
    )
    return gaussians._replace(opacity_logits=logits, log_scales=log_scales), is_source


SMALL = Representation("mcmc", extend=partial(begin_small, initial_opacity=0.5, initial_size=0.1))

LEAST_GAP = 10
"""Iterations: photographs that are seen from one relocation to the next, at least. Longer gaps would end the growth of
a short run, which is 5 % each time, far below the cap."""
_relocating = partial(Every, 100, start=500, stop=25_000, min_gap=LEAST_GAP)

MCMC = GS._replace(
    name="mcmc",
    losses=(
        *GS.losses,
        LossTerm("opacity_reg", opacity_reg, weight=0.01),
        LossTerm("scale_reg", scale_reg, weight=0.01),
    ),
    events=(
        _relocating(partial(relocate, dead_opacity=0.005)),
        _relocating(partial(add_copies, growth=0.05, budget=None, per_pixel=0.03)),
        During(partial(add_noise, noise=5e5), stop=30_000),
    ),
)
"""``mcmc``."""
