"""Gaussians with few features, the networks that read them, and codebooks: population, decoding, and the renderer.

Three parts of a training follow one another. At first the population is that of 3DGS: ``features`` and ``codes`` have
no columns. Then six features replace opacity and colour, and networks compute these. In the end scales, rotations and
features are indices into codebooks, and the codebooks are trained. The shapes of the arrays alone determine which part
it is.

With the place p of a Gaussian in the contracted scene, its static features T and view features V::

    F  = space(gamma(p))               13 features of the place; gamma has 16 octaves
    c  = color([T, F])                 degree 0
    l  = opacity([T, F])               the opacity's logit
    h  = harmonics([V, F])             degrees 1 to 3

where the four are networks of one hidden layer of 64 leaky ReLUs. Where a Gaussian has codes, a vector x is made of
the rows of its parts' codebooks, ``x = (B_1[i_1], B_2[i_2], ...)``.

The derivative through gamma is left out: p is a constant of the gradient. The highest octave turns 2^15 times as fast
as the lowest, and its value at a centre is noise.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.mechanisms.networks.contraction import contract
from minisplat_ref.mechanisms.networks.mlp import Layer, Network, from_shared, make_network, network_rates, to_shared
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY, Networks, networks_for
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import SPLATTING, Inputs, Renderer, RenderGradient, Request, wrap
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Gaussians, Ints, Model, Scene, View

N_STATIC, N_VIEW = 3, 3  # features of a Gaussian: T, for colour and opacity, and V, for view dependence
N_SPACE = 13  # features of a place, F
N_OCTAVES = 16
HIDDEN = 64
SPACE, COLOR, OPACITY, HARMONICS = "space", "color", "opacity", "harmonics"
SIZES = {
    SPACE: (6 * N_OCTAVES, HIDDEN, N_SPACE),
    COLOR: (N_STATIC + N_SPACE, HIDDEN, 3),
    OPACITY: (N_STATIC + N_SPACE, HIDDEN, 1),
    HARMONICS: (N_VIEW + N_SPACE, HIDDEN, 45),
}
"""Inputs, hidden layer and outputs of each network, as in the paper."""
PLACE = "place"
"""Name of the shared array [4]: a centre of the scene, and one over its radius, in which networks read places."""
CODEBOOKS = {"scale_codes": (3, 64, 1), "rotation_codes": (2, 512, 2), "feature_codes": (3, 1024, 2)}
"""Parts, codes of each and numbers of a code, as in the paper. The parts in this order are the columns of ``codes``."""

SLOPE = 0.01  # of the leaky ReLU

Shared = Mapping[str, Floats]

FIELDS = {"scale_codes": "log_scales", "rotation_codes": "quats", "feature_codes": "features"}
"""The field of the population that a codebook is for."""
Encode = Callable[[Floats, Any, Networks], Floats]
SMALL_HIDDEN, SMALL_SPACE, SMALL_OCTAVES = 4, 2, 2
N_CODES = 3  # of each part
REPLACED = ("opacity_logits", "sh_dc", "sh_rest")  # by networks


class OmgGaussians(NamedTuple):
    """Gaussians whose attributes may be features and codes; the other fields are those of :class:`Gaussians`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    features: Floats
    """[N, 6] T and V, from which networks compute opacity and colour; [N, 0] where these are the fields above."""
    codes: Floats
    """[N, 8] whole numbers: rows of the codebooks, in which scales, rotations and features then are; 5 columns without
    features, 0 before there are codes. An event sets them; they have no gradient."""


def without_features(gaussians: Gaussians, rng: np.random.Generator) -> OmgGaussians:
    """Return the Gaussians as those of 3DGS."""
    nothing = np.zeros((len(gaussians.means), 0), gaussians.means.dtype)
    fields = {name: getattr(gaussians, name) for name in Gaussians._fields}
    return OmgGaussians(**fields, features=nothing, codes=nothing.copy())


def add_features(gaussians: Gaussians, rng: np.random.Generator) -> OmgGaussians:
    """Return the Gaussians with random features around their colours, without codes."""
    view = 0.1 * rng.normal(size=(len(gaussians.means), N_VIEW)).astype(gaussians.means.dtype)
    features = np.concatenate([gaussians.sh_dc, view], axis=1)
    return without_features(gaussians, rng)._replace(features=features)


def save_plain(path: str | Path, gaussians: Any, label: Label) -> None:
    """Write the six fields of 3DGS, into which the recipe's last event has decoded features and codes."""
    save_ply(path, Gaussians(*gaussians[: len(Gaussians._fields)]), label)


def load_plain(path: str | Path, population: Any) -> Gaussians:
    """Read the six fields, whatever the population's type: its renderer treats them as 3DGS does."""
    gaussians: Gaussians = load_ply(path)
    return gaussians


def initial_shared(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return random networks, empty codebooks, and the bounds of the scene, float32; ``rng`` itself is not advanced."""
    shared: dict[str, Floats] = {}
    (rng,) = rng.spawn(1)  # so that until there are features, a training is that of Mini-Splatting
    for name, sizes in SIZES.items():
        shared |= to_shared(name, make_network(sizes, rng))
    shared |= {name: np.zeros(shape) for name, shape in CODEBOOKS.items()}
    shared[PLACE] = measure_place(scene)
    return {name: array.astype(np.float32) for name, array in shared.items()}


def measure_place(scene: Scene) -> Floats:
    """Return the median of the scene's points and one over the radius in which nine tenths are, [4], float64."""
    if not len(scene.points):
        return np.array([0.0, 0.0, 0.0, 1 / scene.extent])
    center = np.median(scene.points.astype(np.float64), axis=0)
    radius = np.quantile(np.linalg.norm(scene.points - center, axis=1), 0.9)
    return np.append(center, 1 / (radius if radius > 0 else scene.extent))


_NETWORK_RATE = LogLinear(1e-3, 1e-4, 30_000)
RATES = Rates(
    {
        "features": 2.5e-3,
        "codes": 0.0,
        PLACE: 0.0,
        **{"scale_codes": 5e-3, "rotation_codes": 1e-3, "feature_codes": 2.5e-3},
        **{key: rate for name in SIZES for key, rate in network_rates(name, 2, _NETWORK_RATE).items()},
    },
    frozenset(),
)
"""Codes have the rates of 3DGS for the fields that they hold, features that of its colours. The networks' is chosen
here."""


class Decoded(NamedTuple):
    """The output of the networks, and the values that their gradient needs."""

    color: Floats
    """[N, 3] c."""
    logits: Floats
    """[N] l."""
    harmonics: Floats
    """[N, 45] h."""
    tapes: Mapping[str, Any]
    """Of each network by its name."""


def encode_places(means: Floats, shared: Shared, networks: Networks) -> Floats:
    """Return gamma [N, 6 K] of centres; the scene's place, and K, are those of the shared parameters."""
    place = shared[PLACE].astype(means.dtype)
    n_octaves = shared[f"{SPACE}_weights_0"].shape[0] // 6
    encoding: Floats = networks.fourier(contract((means - place[:3]) * place[3]), n_octaves)
    return encoding


def run_networks(features: Floats, encoding: Floats, shared: Shared, networks: Networks) -> Decoded:
    """Return colours, logits and harmonics of features [N, 6] at encoded places [N, 6 K]."""
    space, tape = networks.forward(_network(SPACE, shared, features), encoding, SLOPE)
    static = np.concatenate([features[:, :N_STATIC], space], axis=1)
    view = np.concatenate([features[:, N_STATIC:], space], axis=1)
    found, tapes = {}, {SPACE: tape}
    for name, inputs in ((COLOR, static), (OPACITY, static), (HARMONICS, view)):
        found[name], tapes[name] = networks.forward(_network(name, shared, features), inputs, SLOPE)
    return Decoded(found[COLOR], found[OPACITY][:, 0], found[HARMONICS], tapes)


def run_networks_vjp(
    shared: Shared, decoded: Decoded, v: tuple[Floats, Floats, Floats], networks: Networks
) -> tuple[Floats, dict[str, Floats]]:
    """Gradient of :func:`run_networks` with respect to the features and the networks.

    ::

        v_[T, F] = color^T v_c + opacity^T v_l,   v_[V, F] = harmonics^T v_h
        v_F      = both parts for F;   v_space = space^T v_F

    Parameters
    ----------
    shared, networks
        As in the forward function.
    decoded : Decoded
        Its result.
    v : tuple of ndarrays of shape (N, 3), (N,) and (N, 45)
        Derivatives with respect to colours, logits and harmonics.
    """
    v_color, v_logits, v_harmonics = v
    v_shared: dict[str, Floats] = {}

    def back(name: str, v_y: Floats) -> Floats:
        network = _network(name, shared, v_color)
        gradient, v_x = networks.forward_vjp(network, decoded.tapes[name], np.ascontiguousarray(v_y), SLOPE)
        v_shared.update(to_shared(name, gradient))
        return v_x

    v_static = back(COLOR, v_color) + back(OPACITY, v_logits[:, None])
    v_view = back(HARMONICS, v_harmonics)
    back(SPACE, v_static[:, N_STATIC:] + v_view[:, N_STATIC:])
    return np.concatenate([v_static[:, :N_STATIC], v_view[:, :N_STATIC]], axis=1), v_shared


def _network(name: str, shared: Shared, like: Floats) -> Network:
    """Return a network in the dtype of an array."""
    network = from_shared(name, shared)
    return tuple(Layer(*(array.astype(like.dtype, copy=False) for array in layer)) for layer in network)


def gather(codebooks: Floats, indices: Ints) -> Floats:
    """Return the vectors [N, P w] of indices [N, P] into codebooks [P, K, w]."""
    return np.concatenate([codes[rows] for codes, rows in zip(codebooks, indices.T, strict=True)], axis=1)


def gather_vjp(codebooks: Floats, indices: Ints, v_vectors: Floats) -> Floats:
    """Gradient of :func:`gather` with respect to the codebooks: each code has the sum of those of its vectors.

    Parameters
    ----------
    codebooks, indices
        As in the forward function.
    v_vectors : ndarray of shape (N, P w)
        Derivative with respect to the vectors.
    """
    v_codebooks, width = np.zeros_like(codebooks), codebooks.shape[2]
    for part, rows in enumerate(indices.T):
        np.add.at(v_codebooks[part], rows, v_vectors[:, part * width : (part + 1) * width])
    return v_codebooks


def split_codes(codes: Floats, shared: Shared, names: tuple[str, ...]) -> dict[str, Ints]:
    """Return the columns of the codes by the names of their codebooks; empty where there are no columns."""
    found: dict[str, Ints] = {}
    begin, rows = 0, np.rint(codes).astype(np.int64)
    for name in names if codes.shape[1] else ():
        found[name] = rows[:, begin : begin + len(shared[name])]
        begin += len(shared[name])
    return found


def coded_names(gaussians: OmgGaussians) -> tuple[str, ...]:
    """Return the codebooks that a population with codes has indices into."""
    names = ("scale_codes", "rotation_codes", "feature_codes")
    return names if gaussians.features.shape[1] else names[:2]


class Tape(NamedTuple):
    """Record of a decoding, for its gradient."""

    model: Model
    networks: Networks
    indices: dict[str, Ints]
    """[N, P] by codebook."""
    decoded: Decoded | None
    """None where no networks ran."""


def is_plain(gaussians: Any) -> bool:
    """Return whether a population is that of 3DGS: it has neither features nor codes."""
    return not isinstance(gaussians, OmgGaussians) or not (gaussians.features.shape[1] or gaussians.codes.shape[1])


def decode(model: Model, networks: Networks, encode: Encode = encode_places) -> tuple[OmgGaussians, Tape]:
    """Return the population with all fields of 3DGS as they are rendered, and the tape.

    ``encode`` returns the encoded places, which are constants of the gradient.
    """
    g, shared = model.gaussians, model.shared
    indices = split_codes(g.codes, shared, coded_names(g))
    for name, rows in indices.items():
        g = g._replace(**{FIELDS[name]: gather(shared[name].astype(g.means.dtype, copy=False), rows)})
    decoded = None
    if g.features.shape[1]:
        decoded = run_networks(g.features, encode(g.means, shared, networks), shared, networks)
        n, n_rest = g.sh_rest.shape[:2]
        rest = np.ascontiguousarray(decoded.harmonics[:, : 3 * n_rest]).reshape(n, n_rest, 3)
        g = g._replace(opacity_logits=decoded.logits, sh_dc=decoded.color, sh_rest=rest)
    return g, Tape(model, networks, indices, decoded)


def decode_vjp(tape: Tape, v: OmgGaussians) -> tuple[OmgGaussians, dict[str, Floats]]:
    """Gradient of :func:`decode` with respect to the population and the shared parameters.

    Fields that networks and codebooks replace get zeros: they are not read.
    """
    shared, v_shared = tape.model.shared, dict[str, Floats]()
    if tape.decoded is not None:
        n, n_rest = v.sh_rest.shape[:2]
        v_harmonics = np.zeros_like(tape.decoded.harmonics)
        v_harmonics[:, : 3 * n_rest] = v.sh_rest.reshape(n, 3 * n_rest)
        by_output = (v.sh_dc, v.opacity_logits, v_harmonics)
        v_features, v_shared = run_networks_vjp(shared, tape.decoded, by_output, tape.networks)
        v = v._replace(features=v_features)
        v = v._replace(**{name: np.zeros_like(getattr(v, name)) for name in ("opacity_logits", "sh_dc", "sh_rest")})
    for name, rows in tape.indices.items():
        field = getattr(v, FIELDS[name])
        v_shared[name] = gather_vjp(shared[name].astype(field.dtype, copy=False), rows, field)
        v = v._replace(**{FIELDS[name]: np.zeros_like(field)})
    return v, v_shared


def make_renderer(encode: Encode = encode_places) -> Renderer:
    """Return the renderer, which decodes and renders as 3DGS does; ``encode`` as for :func:`decode`."""

    def decode_inputs(model: Model, view: View, request: Request) -> tuple[Inputs, Tape | None]:
        if is_plain(model.gaussians):
            return (model, view, request), None
        gaussians, tape = decode(model, networks_for(request.backend), encode)
        return (model._replace(gaussians=gaussians), view, request), tape

    def decode_inputs_vjp(tape: Tape | None, v: RenderGradient) -> RenderGradient:
        if tape is None:
            return v
        v_gaussians, v_shared = decode_vjp(tape, v.gaussians)
        return v._replace(gaussians=v_gaussians, shared=v_shared)

    return wrap(SPLATTING, "omg", decode_inputs, decode_inputs_vjp)


COMPACT = Representation(
    "OMG",
    population=OmgGaussians,
    extend=without_features,
    shared=initial_shared,
    renderer=make_renderer(),
    rates=RATES,
)
"""Gaussians whose opacity and colour come to be computed by networks, and whose attributes come to be codes."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer with its networks, and with codebooks instead.

    The networks are as those of the recipe, but small: every weight is checked. A leaky ReLU has a kink at 0, where
    differences are refused.
    """
    n, n_rest = setting.gaussians.sh_rest.shape[:2]
    features = rng.normal(size=(n, N_STATIC + N_VIEW))
    shared = _networks(max(1, 3 * n_rest), rng)
    books = {
        "scale_codes": setting.gaussians.log_scales[:N_CODES].T[..., None].copy(),
        "rotation_codes": rng.normal(size=(2, N_CODES, 2)),
        "feature_codes": rng.normal(size=(3, N_CODES, 2)),
    }
    codes = np.stack([rng.permutation(n) % N_CODES for _ in range(8)], axis=1).astype(float)
    plain = without_features(setting.gaussians, rng)
    with_networks = plain._replace(features=features)
    with_codes = with_networks._replace(codes=codes)
    return (
        _stage(backend, setting, with_networks, shared, rng),
        _stage(backend, setting, with_codes, shared | books, rng)._replace(name=f"render {COMPACT.name} with codes"),
    )


def _networks(n_harmonics: int, rng: np.random.Generator) -> dict[str, Floats]:
    sizes = {
        SPACE: (6 * SMALL_OCTAVES, SMALL_HIDDEN, SMALL_SPACE),
        COLOR: (N_STATIC + SMALL_SPACE, SMALL_HIDDEN, 3),
        OPACITY: (N_STATIC + SMALL_SPACE, SMALL_HIDDEN, 1),
        HARMONICS: (N_VIEW + SMALL_SPACE, SMALL_HIDDEN, n_harmonics),
    }
    networks = {name: make_network(of_network, rng) for name, of_network in sizes.items()}
    return {key: array for name, network in networks.items() for key, array in to_shared(name, network).items()}


def _stage(
    backend: Backend, setting: Setting, population: OmgGaussians, shared: dict[str, Floats], rng: np.random.Generator
) -> Stage:
    """Return the renderer as a function of the fields of a population that are read, and of the shared parameters."""
    encoding = IN_NUMPY.fourier(setting.gaussians.means, SMALL_OCTAVES)
    has_codes = population.codes.shape[1] > 0
    held = (*REPLACED, "codes", *(FIELDS.values() if has_codes else ()))
    representation = COMPACT._replace(
        extend=lambda gaussians, rng: population._replace(
            **{name: getattr(gaussians, name) for name in Gaussians._fields}
        ),
        shared=lambda scene, rng: shared,
        renderer=make_renderer(lambda means, shared, networks: encoding),
        rates=Rates(dict.fromkeys(held, 0.0), frozenset()),
    )

    def sides(drawn: Drawn) -> list[np.ndarray]:
        features, shared = drawn.model.gaussians.features, drawn.model.shared
        if has_codes:
            rows = split_codes(population.codes, shared, tuple(FIELDS))["feature_codes"]
            features = gather(shared["feature_codes"], rows)
        tapes = run_networks(features, encoding, shared, IN_NUMPY).tapes
        return [inputs[1] > 0 for inputs in tapes.values()]

    return model_stage(backend, setting, representation, rng, sides_of=sides)
