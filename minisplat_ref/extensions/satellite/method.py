"""The representation of a scene in satellite photographs, and the recipe ``satellite`` (EOGS)."""

from collections.abc import Mapping
from functools import partial

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.satellite.losses import ENTROPY, SPARSITY, view_consistency
from minisplat_ref.extensions.satellite.renderer import IN_SHADOW, RADIOMETRY, REFERENCE_VIEW, SATELLITE
from minisplat_ref.methods.gaussian_splatting import GS, lower_opacities, prune_faint
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At, During, Every
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Gaussians, Scene

ITERATIONS = 5_000
START_OPACITY, START_SIZE = 0.005, 0.5  # of points in the volume; size relative to the distance of neighbours
SKY_LIGHT = 0.05  # k at the start


def without_directions(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return Gaussians without the harmonics of degree 1 and above, which parallel rays cannot tell from the first."""
    return gaussians._replace(sh_rest=np.ascontiguousarray(gaussians.sh_rest[:, :0]))


def first_light(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return identity radiometry [V, 3, 4] and the light of the sky [V, 3] in each photograph's shadows."""
    n, dtype = len(scene.train_views), np.float32
    return {RADIOMETRY: np.tile(np.eye(3, 4, dtype=dtype), (n, 1, 1)), IN_SHADOW: np.full((n, 3), SKY_LIGHT, dtype)}


def begin_transparent(state: TrainState, iteration: Iteration, *, opacity: float, size: float) -> None:
    """Give all Gaussians one opacity, and multiply their sizes, so that light passes through the whole volume.

    Points that fill a volume are a fog if they are as opaque as those on a surface (0.1), and a fog explains a few
    photographs as well as a surface does. Of nearly transparent ones some grow, and the others are pruned. As long as
    nearly nothing is opaque, altitudes count as the lowest and nothing shades: this helps a ground that lies there.
    """
    g = state.gaussians
    lower_opacities(state, np.full_like(g.opacity_logits, np.log(opacity / (1 - opacity))))
    log_scales = g.log_scales + g.log_scales.dtype.type(np.log(size))
    state.gaussians = state.gaussians._replace(log_scales=log_scales)


def hold_sky(state: TrainState, iteration: Iteration) -> None:
    """Keep the light in shadows between none and the sun's: while surfaces are unsettled, its gradient is unbounded."""
    np.clip(state.shared[IN_SHADOW], 0, 1, out=state.shared[IN_SHADOW])


def fold_reference(state: TrainState, iteration: Iteration) -> str | None:
    """Give the colours the radiometry of the reference photograph, and every photograph its own relative to it.

    With C_0 and c_0 of the reference: ``a' = C_0 a + c_0``, ``C' = C C_0^-1``, ``c' = c - C' c_0``. All photographs
    stay the same where nothing of the background comes through.
    """
    radiometry = state.shared[RADIOMETRY]
    first = radiometry[REFERENCE_VIEW].astype(np.float64)
    C, c = first[:, :3], first[:, 3]
    if np.linalg.cond(C) > 1e6:
        return "nothing done: the reference's colour matrix cannot be inverted"
    g = state.gaussians
    colors = np.maximum(0.5 + SH_C0 * g.sh_dc.astype(np.float64), 0) @ C.T + c
    state.gaussians = g._replace(sh_dc=((colors - 0.5) / SH_C0).astype(g.sh_dc.dtype))
    matrices = radiometry[..., :3] @ np.linalg.inv(C)
    radiometry[..., 3] -= (matrices @ c).astype(radiometry.dtype)
    radiometry[..., :3] = matrices
    return None


CONSISTENCY = LossTerm(
    "view_consistency",
    partial(view_consistency, altitude=0.01, color=0.1, noise=0.01, limit=0.3),
    weight=1.0,
    wants=frozenset({"albedo", "altitude"}),
)

SEEN_FROM_ABOVE = Representation(
    "gaussians seen by satellites",
    extend=without_directions,
    shared=first_light,
    renderer=SATELLITE,
    rates=Rates({RADIOMETRY: 0.001, IN_SHADOW: 0.01}, frozenset()),
    takes_optics=True,
)

RECIPE = GS._replace(
    name="satellite",
    iterations=ITERATIONS,
    learning_rates=GS.learning_rates.change(means=LogLinear(6.4e-3, 6.4e-4, ITERATIONS), opacity_logits=0.1),
    sh_degree=0,
    sh_milestones=(),
    has_random_background=True,
    losses=(*GS.losses, SPARSITY, CONSISTENCY, ENTROPY),
    events=(
        At(1, partial(begin_transparent, opacity=START_OPACITY, size=START_SIZE)),
        During(hold_sky),
        Every(100, partial(prune_faint, min_opacity=0.005), start=500, min_gap=20),
        At(ITERATIONS, fold_reference),
    ),
)
"""``satellite``: no density control but pruning, colours without directions, 5,000 iterations."""
