"""VDGS: what a network of place and direction does to opacities and colours, the renderer, and the recipe.

With the centre mu of a Gaussian, the direction d from which it is seen, and the hash grid E::

    y = MLP([d, E(p)]),   p = (contract((mu - c) / r) + 2) / 4

c is the median of the scene's points, and nine tenths of them are within r. The last layer starts at 0, so y does. The
effect of y on opacities and coefficients is in NumPy alone: a few operations per Gaussian are negligible compared with
the network and the hash grid, which have kernels.

``--set modulation=NAME`` chooses one of the modes, which are functions.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.networks.contraction import contract, contract_vjp
from minisplat_ref.mechanisms.networks.directions import directions, directions_vjp
from minisplat_ref.mechanisms.networks.hash_grid import Levels, make_levels, make_table
from minisplat_ref.mechanisms.networks.mlp import Layer, from_shared, make_network, network_rates, to_shared
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY, Networks, networks_for
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Model, RenderOutput, Scene, View

OPACITY_MAX = 0.99  # for opacities that the network raises
OPACITY_MIN = 1e-4  # below 1/255, which no pixel shows
N_LEVELS, N_ROWS, N_FEATURES = 4, 2**12, 2  # of the hash grid
COARSEST, FINEST = 16, 128  # cells along a side
HIDDEN = 32
N_COLORS = 48  # coefficients of degrees 0 to 3
NAME, TABLE, CENTER, RADIUS = "network", "hash_table", "place_center", "place_radius"


class Mode(NamedTuple):
    """The use of the network's outputs."""

    opacity: bool
    """The first output changes the opacity."""
    colors: bool
    """The others change the coefficients of colour."""
    is_sum: bool
    """``x + y`` instead of ``x (1 + y)``."""


def opacity_times() -> Mode:
    """Multiply the opacity, which is the paper's choice."""
    return Mode(True, False, is_sum=False)


def opacity_plus() -> Mode:
    """Add to the opacity."""
    return Mode(True, False, is_sum=True)


def colors_times() -> Mode:
    """Multiply the coefficients of colour."""
    return Mode(False, True, is_sum=False)


def colors_plus() -> Mode:
    """Add to the coefficients of colour."""
    return Mode(False, True, is_sum=True)


def both_times() -> Mode:
    """Multiply both."""
    return Mode(True, True, is_sum=False)


def both_plus() -> Mode:
    """Add to both."""
    return Mode(True, True, is_sum=True)


def modulate(x: Floats, y: Floats, is_sum: bool) -> Floats:
    """Return ``x + y``, or ``x (1 + y)``; both leave x where y is 0."""
    return x + y if is_sum else x * (1 + y)


def modulate_vjp(x: Floats, y: Floats, is_sum: bool, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`modulate` with respect to x and y: (v, v), or ``((1 + y) v, x v)``."""
    return (v, v) if is_sum else ((1 + y) * v, x * v)


class Opacities(NamedTuple):
    """Opacities of a view, and the values that their gradient needs."""

    logits: Floats
    """[N] l' = logit(o')."""
    own: Floats
    """[N] o, which all views share."""
    seen: Floats
    """[N] o'."""
    is_free: Bools
    """[N] where o' is at neither bound."""


def modulated_logits(logits: Floats, y: Floats, is_sum: bool) -> Opacities:
    """Return the logits l' of a view's opacities, from those of all views and the network's output.

    ::

        o = sigmoid(l),   o' = min(max(o (1 + y) or o + y, 1e-4), 0.99),   l' = log(o' / (1 - o'))

    Where y is 0, and where it would raise an opacity above 0.99 further, l' is l to the last bit.

    Parameters
    ----------
    logits, y : ndarray of shape (N,)
    is_sum : bool
        As for :func:`modulate`.
    """
    own = 1 / (1 + np.exp(-logits))
    raw = modulate(own, y, is_sum)
    seen = np.clip(raw, OPACITY_MIN, OPACITY_MAX)
    is_kept = (y == 0) | ((own > OPACITY_MAX) & (raw > own))
    found = np.where(is_kept, logits, np.log(seen) - np.log1p(-seen))
    is_free = ((raw > OPACITY_MIN) & (raw < OPACITY_MAX)) | (y == 0)
    return Opacities(found, own, np.where(is_kept, own, seen), is_free)


def modulated_logits_vjp(opacities: Opacities, y: Floats, is_sum: bool, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`modulated_logits` with respect to l and y.

    ::

        v_o' = v / (o' (1 - o')) between the bounds, 0 at them
        v_o, v_y = those of modulate,   v_l = o (1 - o) v_o

    Where an opacity above 0.99 is kept, v_l = v and v_y = 0.

    Parameters
    ----------
    opacities : Opacities
        From the forward function.
    y, is_sum
        As there.
    v : ndarray of shape (N,)
        Derivative with respect to l'.
    """
    own, seen = opacities.own, opacities.seen
    v_seen = np.zeros_like(v)
    np.divide(v, seen * (1 - seen), out=v_seen, where=opacities.is_free)
    v_own, v_y = modulate_vjp(own, y, is_sum, v_seen)
    is_kept = ~opacities.is_free & (seen == own) & (own > OPACITY_MAX)
    return np.where(is_kept, v, own * (1 - own) * v_own), v_y


class Tape(NamedTuple):
    """Record of a modulation, for its gradient."""

    model: Model
    mode: Mode
    networks: Networks
    camera: Camera
    d: Floats
    distances: Floats
    y: Floats
    """[N, outputs]."""
    inputs: list[Floats]
    """Of the network's layers."""
    opacities: Opacities | None


def n_outputs(mode: Mode) -> int:
    """Return the number of a network's outputs: one for the opacity, one for each coefficient of colour."""
    return mode.opacity + N_COLORS * mode.colors


def initial_shared(scene: Scene, rng: np.random.Generator, *, modulation: Callable[[], Mode]) -> Mapping[str, Floats]:
    """Return the network, whose last layer is 0, the hash grid, and the bounds of the scene, float32."""
    (rng,) = rng.spawn(1)  # so that the training gets the random numbers of one of 3DGS
    levels = make_levels(N_LEVELS, COARSEST, FINEST, n_rows=N_ROWS, n_features=N_FEATURES)
    network = make_network((3 + N_LEVELS * N_FEATURES, HIDDEN, n_outputs(modulation())), rng)
    last = Layer(*(np.zeros_like(array) for array in network[-1]))
    center, radius = np.zeros(3), scene.extent
    if len(scene.points):
        center = np.median(scene.points.astype(np.float64), axis=0)
        radius = np.quantile(np.linalg.norm(scene.points - center, axis=1), 0.9) or scene.extent
    shared = {
        **to_shared(NAME, (*network[:-1], last)),
        TABLE: make_table(levels, rng),
        CENTER: center,
        RADIUS: np.array([radius]),
    }
    return {name: array.astype(np.float32) for name, array in shared.items()}


def find_levels(table: Floats) -> Levels:
    """Return the levels of a table [L, T, F]."""
    return make_levels(table.shape[0], COARSEST, FINEST, n_rows=table.shape[1], n_features=table.shape[2])


def _cast(shared: Mapping[str, Floats], means: Floats) -> dict[str, Floats]:
    return {name: np.ascontiguousarray(array, means.dtype) for name, array in shared.items()}


def modulate_model(model: Model, camera: Camera, mode: Mode, networks: Networks) -> tuple[Gaussians, Tape]:
    """Return the Gaussians of 3DGS that a camera sees, and the tape."""
    g, shared = model.gaussians, _cast(model.shared, model.gaussians.means)
    d, distances = directions(g.means, camera)
    places = (contract((g.means - shared[CENTER]) / shared[RADIUS]) + 2) / 4
    encoding = networks.hash_grid(shared[TABLE], places, find_levels(shared[TABLE]))
    y, inputs = networks.forward(from_shared(NAME, shared), np.concatenate([d, encoding], axis=1))
    opacities, seen = None, g
    if mode.opacity:
        opacities = modulated_logits(g.opacity_logits, y[:, 0], mode.is_sum)
        seen = seen._replace(opacity_logits=opacities.logits)
    if mode.colors:
        y_dc, y_rest = _split_colors(y, mode, g)
        seen = seen._replace(
            sh_dc=modulate(g.sh_dc, y_dc, mode.is_sum), sh_rest=modulate(g.sh_rest, y_rest, mode.is_sum)
        )
    return seen, Tape(model, mode, networks, camera, d, distances, y, inputs, opacities)


def _split_colors(y: Floats, mode: Mode, g: Gaussians) -> tuple[Floats, Floats]:
    """Return the outputs for the coefficients of degree 0 [N, 3] and of the others that are stored [N, K-1, 3]."""
    n, n_rest = g.sh_rest.shape[:2]
    first = int(mode.opacity)
    return y[:, first : first + 3], y[:, first + 3 : first + 3 + 3 * n_rest].reshape(n, n_rest, 3)


def modulate_model_vjp(tape: Tape, v: RenderGradient) -> RenderGradient:
    """Gradient of :func:`modulate_model`, added to that of the rendering.

    ::

        v_y         = those of opacity and colours
        v_[d, E]    = MLP^T v_y
        v_mu       += directions^T v_d + contract^T (E^T v_E / 4) / r
    """
    g, shared, mode, y = tape.model.gaussians, _cast(tape.model.shared, tape.y), tape.mode, tape.y
    v_g, v_y = v.gaussians, np.zeros_like(y)
    if tape.opacities is not None:
        v_logits, v_y[:, 0] = modulated_logits_vjp(tape.opacities, y[:, 0], mode.is_sum, v_g.opacity_logits)
        v_g = v_g._replace(opacity_logits=v_logits)
    if mode.colors:
        (y_dc, y_rest), (into_dc, into_rest) = _split_colors(y, mode, g), _split_colors(v_y, mode, g)
        v_dc, v_y_dc = modulate_vjp(g.sh_dc, y_dc, mode.is_sum, v_g.sh_dc)
        v_rest, v_y_rest = modulate_vjp(g.sh_rest, y_rest, mode.is_sum, v_g.sh_rest)
        first, end = int(mode.opacity), int(mode.opacity) + into_dc.shape[1] + into_rest[0].size
        v_y[:, first:end] = np.concatenate([v_y_dc, v_y_rest.reshape(len(y), -1)], axis=1)
        v_g = v_g._replace(sh_dc=v_dc, sh_rest=v_rest)
    v_network, v_inputs = tape.networks.forward_vjp(from_shared(NAME, shared), tape.inputs, v_y)
    v_d, v_encoding = v_inputs[:, :3], np.ascontiguousarray(v_inputs[:, 3:])
    scaled = (g.means - shared[CENTER]) / shared[RADIUS]
    places = (contract(scaled) + 2) / 4
    v_table, v_places = tape.networks.hash_grid_vjp(shared[TABLE], places, find_levels(shared[TABLE]), v_encoding)
    v_means, v_R, v_t = directions_vjp(tape.d, tape.distances, tape.camera, v_d)
    v_means = v_means + contract_vjp(scaled, v_places / 4) / shared[RADIUS]
    return v._replace(
        gaussians=v_g._replace(means=v_g.means + v_means),
        cam_from_world_R=v.cam_from_world_R + v_R,
        cam_from_world_t=v.cam_from_world_t + v_t,
        shared={**v.shared, **to_shared(NAME, v_network), TABLE: v_table},
    )


def render_modulated(
    model: Model, view: View, request: Request, *, modulation: Callable[[], Mode]
) -> tuple[RenderOutput, tuple[Any, Tape | None]]:
    """Render the Gaussians as the view's camera sees them; without a network, as in a file alone, those of 3DGS."""
    if TABLE not in model.shared or not len(model.gaussians.means):
        output, inner = SPLATTING.render(model, view, request)
        return output, (inner, None)
    seen, tape = modulate_model(model, view.camera, modulation(), networks_for(request.backend))
    output, inner = SPLATTING.render(model._replace(gaussians=seen), view, request)
    return output, (inner, tape)


def render_modulated_vjp(tapes: tuple[Any, Tape | None], v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
    """Gradient of :func:`render_modulated`: that of 3DGS, carried on to the network."""
    inner, tape = tapes
    v = SPLATTING.render_vjp(inner, v_image, v_alpha)
    return v if tape is None else modulate_model_vjp(tape, v)


VIEW_DEPENDENT = Representation(
    "vdgs",
    shared=partial(initial_shared, modulation=opacity_times),
    renderer=Renderer(
        "vdgs", partial(render_modulated, modulation=opacity_times), render_modulated_vjp, SPLATTING.channels
    ),
    rates=Rates(
        {
            TABLE: LogLinear(1e-2, 1e-3, 30_000),
            CENTER: 0.0,
            RADIUS: 0.0,
            **network_rates(NAME, 2, LogLinear(5e-3, 5e-4, 30_000)),
        },
        frozenset(),
    ),
    units={**WORLD_UNITS, CENTER: Unit.PLACE, RADIUS: Unit.LENGTH},
)

VDGS = GS_ACCEL._replace(name="vdgs")
"""``vdgs``: 3DGS whose opacities, or colours, a network changes with the view."""

SMALL_HIDDEN, SMALL_LEVELS, SMALL_ROWS = 3, 1, 8  # of one coarse level: between many faces, steps would round
MODES = (opacity_times, colors_plus, both_times, both_plus)  # the other two are parts of those that change both


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return one stage for each mode, with a small network and table; the first replaces that of the whole renderer.

    ReLUs, the faces of the grid's cells and the bounds of opacity are kinks, whose sides are part of a point.
    """
    return tuple(_stage(backend, setting, modulation, rng) for modulation in MODES)


def small_shared(modulation: Callable[[], Mode], n_colors: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return a network and a table of which every number can be checked."""
    mode = modulation()
    n = mode.opacity + n_colors * mode.colors
    network = make_network((3 + SMALL_LEVELS, SMALL_HIDDEN, min(n, n_outputs(mode))), rng)
    shared = {name: 0.3 * array for name, array in to_shared(NAME, network).items()}
    table = rng.normal(size=(SMALL_LEVELS, SMALL_ROWS, 1))
    return {**shared, TABLE: table, CENTER: np.zeros(3), RADIUS: np.array([2.0])}


def _stage(backend: Backend, setting: Setting, modulation: Callable[[], Mode], rng: np.random.Generator) -> Stage:
    shared = small_shared(modulation, 3 * (1 + setting.gaussians.sh_rest.shape[1]), rng)
    is_first = modulation is MODES[0]
    representation = VIEW_DEPENDENT._replace(
        name=VIEW_DEPENDENT.name if is_first else f"{VIEW_DEPENDENT.name}, {modulation.__name__}",
        shared=lambda scene, rng: shared,
        renderer=VIEW_DEPENDENT.renderer._replace(render=partial(render_modulated, modulation=modulation)),
    )
    return model_stage(backend, setting, representation, rng, sides_of=lambda drawn: _sides(drawn.tape[1]))


def _sides(tape: Tape) -> tuple[Any, ...]:
    """Return the ReLUs that are on, the cells of the grid, and which opacities are at no bound."""
    means, shared = tape.model.gaussians.means, tape.model.shared
    places = (contract((means - shared[CENTER]) / shared[RADIUS]) + 2) / 4
    cells = [np.floor(places * n) for n in find_levels(shared[TABLE]).resolutions]
    bounds = () if tape.opacities is None else (tape.opacities.is_free,)
    hidden = modulate_model(tape.model, tape.camera, tape.mode, IN_NUMPY)[1].inputs[1]  # kernels keep them otherwise
    return (hidden > 0, *cells, *bounds)
