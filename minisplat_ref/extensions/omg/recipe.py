"""The distinctiveness of Gaussians and the pruning by it, the start of networks and codebooks, and the recipe.

With the colours c_i of degree 0, in Morton order of the centres::

    LD_i = 1/3 sum_channels |c_i - c_prev| + |c_i - c_next|
    S_i  = I_i LD_i^lambda

Morton order replaces a neighbour search and costs only a sort. It misses neighbours across the faces of large cells.
Its cells have the proportions of the box that the centres fill, as in the released code.
"""

from collections.abc import Iterable
from functools import partial

import numpy as np

from minisplat_ref.extensions.omg.codes import QUAT_MIN, fit_codes, nearest, unit_quats
from minisplat_ref.extensions.omg.model import (
    CODEBOOKS,
    COLOR,
    FIELDS,
    HARMONICS,
    N_SPACE,
    N_STATIC,
    N_VIEW,
    OPACITY,
    PLACE,
    SIZES,
    SLOPE,
    SPACE,
    decode,
)
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.mechanisms.networks.mlp import Layer, forward, from_shared
from minisplat_ref.mechanisms.networks.networks import networks_for
from minisplat_ref.methods.mini_splatting import (
    MINI_SPLATTING,
    ImportanceMetric,
    candidates,
    measure_importance,
    prune_tail,
    restart_from_means,
)
from minisplat_ref.strategy import importance
from minisplat_ref.strategy.ops import contiguous, keep, n_rows
from minisplat_ref.training.schedule import At, During, Event, does
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats

POWER = 2.0  # lambda
MASS = 0.99  # tau of the paper's model M; XS has 0.96, XL 0.9999
NETWORKS_FROM, PRUNING, CODES_FROM = 15_000, 20_000, 29_000  # iterations
# The paper's scenes have hundreds of Gaussians for each code. With much fewer, a code takes more bytes than it saves.
ROWS_PER_CODE = 8


def local_distinctiveness(means: Floats, colors: Floats) -> Floats:
    """Return the difference of each colour from those before and after it in Morton order.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    colors : ndarray of shape (N, 3)
        Coefficients of degree 0, or any other features; the number of channels is arbitrary.

    Returns
    -------
    ndarray of shape (N,)
        LD, float64, not negative. At either end of the order the only neighbour counts twice; 0 for N = 1.
    """
    n = len(means)
    if n < 2:
        return np.zeros(n)
    order = morton_order(means, is_cubic=False)
    ordered = colors[order].astype(np.float64)  # [N, C]
    steps = np.abs(np.diff(ordered, axis=0)).mean(axis=1)  # [N - 1]
    around = np.concatenate([steps[:1], steps, steps[-1:]])  # [N + 1] before and after each
    distinctiveness = np.empty(n)
    distinctiveness[order] = around[:-1] + around[1:]  # back to the rows: the inverse permutation
    return distinctiveness


def distinct_importance(importance: Floats, distinctiveness: Floats, power: float) -> Floats:
    """Return the score ``S = I LD^lambda``.

    Parameters
    ----------
    importance, distinctiveness : ndarray of shape (N,)
        I and LD, not negative.
    power : float
        lambda; at 0 the score is the importance.
    """
    return importance * distinctiveness**power


def prune_indistinct(
    state: TrainState, iteration: Iteration, *, metric: ImportanceMetric, distinct_mass: float, distinct_power: float
) -> str | None:
    """Keep the Gaussians of the largest scores that together carry the fraction ``distinct_mass`` of the sum.

    The score is ``importance distinctiveness^distinct_power``; Gaussians that dominate no pixel of a training view have
    none. Colours are compared, or static features where there are some.
    """
    stats = measure_importance(state, iteration)
    important = candidates(stats, metric, 0, is_intersecting=True)  # [N]
    g = state.gaussians
    has_features = getattr(g, "features", np.zeros((0, 0))).shape[1] > 0
    distinctiveness = local_distinctiveness(g.means, g.features[:, :N_STATIC] if has_features else g.sh_dc)
    score = distinct_importance(important, distinctiveness, distinct_power)
    if not score.any():
        return "nothing done: all colours are alike"
    apply_edit(state, keep(state.gaussians, np.flatnonzero(importance.mass_mask(score, distinct_mass))))
    return None


def start_networks(state: TrainState, iteration: Iteration) -> None:
    """Replace opacity and colour by features: static ones that are the colours, and view features of zero.

    The networks begin with the outputs that the Gaussians had, as nearly as their last layers can be fitted, and
    without an influence of the place. The paper does not define the start of its networks.
    """
    g, n = state.gaussians, n_rows(state.gaussians)
    features = np.concatenate([g.sh_dc, np.zeros((n, N_VIEW), g.means.dtype)], axis=1)
    for array in from_shared(SPACE, state.shared)[1]:
        array[:] = 0
    space = np.zeros((n, N_SPACE), g.means.dtype)
    static, view = (np.concatenate([own, space], axis=1) for own in np.split(features, [N_STATIC], axis=1))
    for name, inputs, target in (
        (COLOR, static, g.sh_dc),
        (OPACITY, static, g.opacity_logits[:, None]),
        (HARMONICS, view, g.sh_rest.reshape(n, 3 * g.sh_rest.shape[1])),
    ):
        network = from_shared(name, state.shared)
        last = fit_last_layer(forward(network, inputs, SLOPE)[1][1], target)
        network[1].weights[:, : target.shape[1]] = last.weights
        network[1].biases[: target.shape[1]] = last.biases
    state.gaussians = g._replace(features=features)
    state.adam = state.adam._replace(
        first=state.adam.first._replace(features=np.zeros_like(features)),
        second=state.adam.second._replace(features=np.zeros_like(features)),
    )
    _join(state, [f"{name}_{kind}_{k}" for name in SIZES for kind in Layer._fields for k in range(2)])


def fit_last_layer(hidden: Floats, target: Floats) -> Layer:
    """Return the layer from hidden values [N, H] to targets [N, D] with the least squared error."""
    inputs = np.concatenate([hidden, np.ones((len(hidden), 1))], axis=1).astype(np.float64)
    solution = np.linalg.lstsq(inputs, target.astype(np.float64), rcond=None)[0]
    return Layer(solution[:-1], solution[-1])


def start_codes(
    state: TrainState,
    iteration: Iteration,
    *,
    scale_codes: int,
    rotation_codes: int,
    feature_codes: int,
    rows_per_code: int,
) -> None:
    """Replace scales, rotations and features by the nearest codes, fitted to them; from now on codes are trained.

    Centres become half floats of their offset from the scene's, see :func:`round_centres`.

    Parameters
    ----------
    state, iteration
        As for every action.
    scale_codes, rotation_codes, feature_codes : int
        Codes of each part, at most.
    rows_per_code : int
        Gaussians that there are at least for each code: the codebooks of few Gaussians are smaller.
    """
    g = state.gaussians
    round_centres(state, iteration)
    limits = {"scale_codes": scale_codes, "rotation_codes": rotation_codes, "feature_codes": feature_codes}
    columns = []
    for name, codebooks in ((name, state.shared[name]) for name in FIELDS):
        vectors, (_, n_stored, width) = getattr(g, FIELDS[name]), codebooks.shape
        vectors = unit_quats(vectors) if name == "rotation_codes" else vectors
        n_codes = max(1, min(n_stored, limits[name], n_rows(g) // rows_per_code))
        for part, begin in enumerate(range(0, vectors.shape[1], width)):
            own = vectors[:, begin : begin + width].astype(np.float64)
            codes = fit_codes(own, n_codes)
            codebooks[part, : len(codes)] = codes
            columns.append(nearest(codes, own))
    is_zero = (state.shared["rotation_codes"][0] == 0).all(axis=1)
    state.shared["rotation_codes"][0, is_zero] = [QUAT_MIN, 0.0]
    indices = np.stack(columns, axis=1).astype(g.means.dtype)
    state.gaussians = g._replace(codes=indices)
    state.adam = state.adam._replace(
        first=state.adam.first._replace(codes=np.zeros_like(indices)),
        second=state.adam.second._replace(codes=np.zeros_like(indices)),
    )
    _join(state, CODEBOOKS)


def _join(state: TrainState, names: Iterable[str]) -> None:
    """Count the steps of shared parameters from now on, since their gradients were zero so far."""
    joined = dict.fromkeys(names, state.shared_adam.step)
    state.shared_adam = state.shared_adam._replace(joined={**state.shared_adam.joined, **joined})


def round_centres(state: TrainState, iteration: Iteration) -> None:
    """Round centres to half floats of their offset from the scene's centre, as files have them.

    The highest octaves of a place distinguish neighbouring half floats, so the networks have to be trained with them.
    """
    center = state.shared[PLACE][:3].astype(state.gaussians.means.dtype)
    state.gaussians.means[:] = center + (state.gaussians.means - center).astype(np.float16).astype(center.dtype)


def write_fields(state: TrainState, iteration: Iteration) -> None:
    """Write into the fields of 3DGS the values that networks and codebooks decode from features and codes.

    Nothing reads them during the training. But a file has these fields alone, and may be written after any iteration.
    """
    decoded, _ = decode(state.model, networks_for(iteration.render_settings.backend))
    state.gaussians = contiguous(decoded)


_prune = partial(prune_indistinct, metric=importance.indoor, distinct_mass=MASS, distinct_power=POWER)

_start_codes = partial(start_codes, scale_codes=64, rotation_codes=512, feature_codes=1024, rows_per_code=ROWS_PER_CODE)


def _exchange(event: Event) -> tuple[Event, ...]:
    """Return an event of Mini-Splatting as OMG has it, and the events after it."""
    if does(event, prune_tail):
        return (event._replace(action=_prune),)
    return (event, At(NETWORKS_FROM, start_networks)) if does(event, restart_from_means) else (event,)


OMG = MINI_SPLATTING._replace(
    name="omg",
    events=(
        *(ours for event in MINI_SPLATTING.events for ours in _exchange(event)),
        At(CODES_FROM, _start_codes),
        During(round_centres, start=CODES_FROM),
        During(write_fields, start=NETWORKS_FROM),
    ),
)
"""The recipe ``omg``: Mini-Splatting whose last pruning also considers distinctiveness, with networks and codebooks."""
