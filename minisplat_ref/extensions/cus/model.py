"""Anchors, the networks that decode each to Gaussians and queries, with the gradient, and their renderer.

An anchor v at the centre m_v of a voxel has a latent z_v and K offsets. Its other fields are those of one Gaussian of
3DGS, which viewers show instead of it: the colour of its points, an opacity and a rotation that are not trained, and
the scale that its Gaussians begin with. It is seen from the direction d_v in the photograph c, of embedding e_c.
Networks of one hidden layer of ReLUs, which all anchors share, read ``x_v = [z_v, d_v, e_c]``; their outputs join the
anchor's fields, before the activations of 3DGS. For each n of K::

    mu_vn = m_v + dx_vn,   dx_vn = 2 s_v u_vn
    l_vn  = l_v + opacity(x_v)_n                     logit of the opacity
    (ln s_vn, q_vn) = (ln s_v, q_v) + shape(x_v)_n
    c_vn  = c_v + color(x_v)_n                       coefficient of degree 0
    k_vn  = [query(x_v), u_vn] A + b                 what is blended to read the memory

A photograph that was not trained on has the mean of all embeddings. Networks that are missing, as beside a file alone,
have outputs of 0.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cus.memory import check_depths, feature_map, first_keys, remember, sample_rows
from minisplat_ref.mechanisms.networks.directions import directions, directions_vjp
from minisplat_ref.mechanisms.networks.mlp import Layer, Network, from_shared, make_network, network_rates, to_shared
from minisplat_ref.mechanisms.networks.networks import Networks, networks_for
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.strategy.initialization import INITIAL_OPACITY, N_NEIGHBOURS, gaussians_from_means
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import BlendStats, Floats, Gaussians, Model, RenderOutput, Scene, View

Shared = Mapping[str, Floats]

OPACITY, SHAPE, COLOR, QUERY = "opacity", "shape", "color", "query"
NETWORKS = {OPACITY: 1, SHAPE: 7, COLOR: 3}
"""Outputs of each network for a Gaussian: a logit; three logarithms of scales and a quaternion; a colour."""
CAMERAS, MIX, MEMORY, KEYS, ADAPTER = "camera_embeddings", "query_mix", "memory", "memory_keys", "adapter"
SPREAD = (
    2.0  # of the Gaussians of an anchor, in units of their scale at the start: the release's sigmoid(0) is one half
)
LATENT_SPREAD = 0.1  # standard deviation of first latents: equal ones would stay equal where photographs agree


class Anchors(NamedTuple):
    """Voxels with the latents that are decoded to Gaussians; the first six fields are those of :class:`Gaussians`."""

    means: Floats
    """[N, 3] centres of the voxels, world frame; not trained."""
    quats: Floats
    log_scales: Floats
    """[N, 3] to which the networks add."""
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    """[N, 0, 3]: the networks' colour depends on the direction."""
    latents: Floats
    """[N, L] z."""
    offsets: Floats
    """[N, 3 K] u of the K Gaussians from the centre, in units of ``SPREAD`` times the anchor's scales."""

    @property
    def n_children(self) -> int:
        """Return K, the Gaussians of an anchor."""
        return self.offsets.shape[1] // 3


def as_anchors(gaussians: Gaussians, rng: np.random.Generator, *, voxel: float, children: int, latent: int) -> Anchors:
    """Return an anchor for each voxel that has a Gaussian, with the mean colour of these.

    Its Gaussians are spread over the distance to the three nearest anchors, if there are three, and half as large.
    Voxels have the side ``l = voxel s``, where s is the median scale of the given Gaussians, at the start the distance
    of a point to its neighbours.

    Parameters
    ----------
    gaussians : Gaussians
    rng : numpy.random.Generator
    voxel : float
        Side in units of the median scale.
    children : int
        K.
    latent : int
        L, numbers of a latent.

    Raises
    ------
    InputError
        A number is below 1, or the side is not above 0.
    """
    if children < 1 or latent < 1 or not voxel > 0:
        raise InputError(f"children={children} and latent={latent} are numbers from 1 on, voxel={voxel:g} is above 0")
    side = voxel_side(gaussians, voxel)
    cells, rows = np.unique(np.round(gaussians.means.astype(np.float64) / side), axis=0, return_inverse=True)
    n, rows = len(cells), rows.ravel()
    counts = np.maximum(np.bincount(rows, minlength=n), 1)
    colors = np.stack([np.bincount(rows, weights=channel, minlength=n) for channel in gaussians.sh_dc.T], axis=1)
    dtype = gaussians.means.dtype
    latents = (LATENT_SPREAD * rng.normal(size=(n, latent))).astype(dtype)
    sh_dc = (colors / counts[:, None]).astype(dtype)
    anchors = at_rest(cells * side, sh_dc, latents, side, children, rng)
    if n <= N_NEIGHBOURS:
        return anchors
    spreads = gaussians_from_means(anchors.means, sh_dc, 0).log_scales
    return anchors._replace(log_scales=(spreads - np.log(SPREAD)).astype(dtype))


def voxel_side(gaussians: Gaussians, voxel: float) -> float:
    """Return the side l of voxels, world units: ``voxel`` times the median scale of Gaussians, 1 if there are none."""
    if not len(gaussians.means):
        return 1.0
    return voxel * float(np.exp(np.median(gaussians.log_scales.astype(np.float64))))


def at_rest(
    centers: Floats, sh_dc: Floats, latents: Floats, side: float, children: int, rng: np.random.Generator
) -> Anchors:
    """Return anchors as they begin.

    Gaussians are spread over the voxel, and half as large as it; the offsets are drawn evenly. The release has zeros,
    which its networks tell apart; here last layers start at 0, so that Gaussians of one place would stay together.

    Parameters
    ----------
    centers : ndarray of shape (N, 3)
        World frame.
    sh_dc : ndarray of shape (N, 3)
    latents : ndarray of shape (N, L)
        Of the dtype that all fields get.
    side : float
        Of the voxels, world units.
    children : int
        K.
    rng : numpy.random.Generator
    """
    n, dtype = len(centers), latents.dtype
    return Anchors(
        means=centers.astype(dtype),
        quats=np.tile(np.array([1.0, 0, 0, 0], dtype), (n, 1)),
        log_scales=np.full((n, 3), np.log(side / SPREAD), dtype),
        opacity_logits=np.full(n, logit(INITIAL_OPACITY), dtype),
        sh_dc=sh_dc,
        sh_rest=np.zeros((n, 0, 3), dtype),
        latents=latents,
        offsets=rng.uniform(-0.5, 0.5, size=(n, 3 * children)).astype(dtype),
    )


def initial_shared(
    scene: Scene,
    rng: np.random.Generator,
    *,
    children: int,
    latent: int,
    hidden: int,
    embedding: int,
    query: int,
    features: str,
    similarity: float,
) -> Mapping[str, Floats]:
    """Return networks whose outputs are 0, embeddings of 0, and the memory of the photographs' features; float32.

    Parameters
    ----------
    scene : Scene
    rng : numpy.random.Generator
    children, latent
        As for :func:`as_anchors`.
    hidden : int
        Units of each network's hidden layer.
    embedding : int
        E, numbers of the embedding of a photograph.
    query : int
        d, numbers of a query.
    features : str
        Folder of feature maps; empty for the classical ones (:mod:`.memory`).
    similarity : float
        gamma: cosine from which on a feature counts as present in the memory (:mod:`.memory`).

    Raises
    ------
    InputError
        A number is below 1, or the similarity no cosine; a map cannot be read, or has another depth than the others.
    """
    if min(hidden, embedding, query) < 1:
        raise InputError(f"hidden={hidden}, embedding={embedding} and query={query} are numbers from 1 on")
    if not -1 < similarity <= 1:
        raise InputError(f"similarity={similarity:g} is a cosine: give a number above -1, at most 1")
    (rng,) = rng.spawn(1)
    shared: dict[str, Floats] = {}
    for name, width in NETWORKS.items():
        shared |= to_shared(name, _starting_at_zero((latent + 3 + embedding, hidden, width * children), rng))
    shared |= to_shared(QUERY, make_network((latent + 3 + embedding, hidden, query), rng))
    shared |= to_shared(MIX, (Layer(np.eye(query + 3, query), np.zeros(query)),))
    shared[CAMERAS] = np.zeros((len(scene.train_views), embedding))
    n_channels: dict[str, int] = {}
    rows = []
    for view in scene.train_views:
        of_view = feature_map(view, features)
        n_channels[view.name] = of_view.shape[2]
        rows.append(sample_rows(of_view, rng))
    check_depths(n_channels, features)
    memory = remember(rows, similarity)
    shared |= {MEMORY: memory, KEYS: first_keys(memory, query), ADAPTER: np.eye(memory.shape[1])}
    return {name: array.astype(np.float32) for name, array in shared.items()}


def _starting_at_zero(sizes: tuple[int, ...], rng: np.random.Generator) -> tuple[Layer, ...]:
    """Return a random network whose last layer is 0."""
    *first, last = make_network(sizes, rng)
    return (*first, Layer(np.zeros_like(last.weights), np.zeros_like(last.biases)))


# --- decoding ---


class Decoded(NamedTuple):
    """The Gaussians of a view, and the values that their gradient needs."""

    gaussians: Gaussians
    """N K rows, those of an anchor one after another."""
    queries: Floats | None
    """[N K, d] k; None if not requested."""
    model: Model
    view: View
    networks: Networks
    d: Floats
    """[N, 3] directions."""
    distances: Floats
    tapes: Mapping[str, list[Floats]]
    """Of the networks that ran, by name."""
    joined: Floats | None
    """[N K, d + 3] what A mixes."""


class DecodedGradient(NamedTuple):
    """Gradient with respect to everything that is decoded."""

    anchors: Anchors
    shared: dict[str, Floats]
    cam_from_world_R: Floats
    cam_from_world_t: Floats


def decode(model: Model, view: View, networks: Networks, *, with_queries: bool = False) -> Decoded:
    """Return the Gaussians that a view sees.

    Parameters
    ----------
    model : Model
        Anchors, and the shared parameters of :func:`initial_shared`, or none.
    view : View
        Its camera and ``view_id`` count.
    networks : Networks
        That run the networks.
    with_queries : bool
        Whether Gaussians get queries instead of their colours.
    """
    g: Anchors = model.gaussians
    (n, k), dtype = (len(g.means), g.n_children), g.means.dtype
    d, distances = directions(g.means, view.camera)
    x = np.concatenate(
        [g.latents, d, np.broadcast_to(_embedding(model.shared, view, dtype), (n, _width(model)))], axis=1
    )
    y: dict[str, Floats] = {}
    tapes: dict[str, list[Floats]] = {}
    for name, width in NETWORKS.items():
        network = _network(name, model.shared, dtype)
        y[name] = np.zeros((n * k, width), dtype)
        if network and n and not (with_queries and name == COLOR):
            found, tapes[name] = networks.forward(network, x)
            y[name] = found.reshape(n * k, width)
    gaussians = Gaussians(
        means=np.repeat(g.means, k, axis=0) + steps(g),
        quats=np.repeat(g.quats, k, axis=0) + y[SHAPE][:, 3:],
        log_scales=np.repeat(g.log_scales, k, axis=0) + y[SHAPE][:, :3],
        opacity_logits=np.repeat(g.opacity_logits, k) + y[OPACITY][:, 0],
        sh_dc=np.repeat(g.sh_dc, k, axis=0) + y[COLOR],
        sh_rest=np.zeros((n * k, 0, 3), dtype),
    )
    queries = joined = None
    if with_queries:
        of_voxels, tapes[QUERY] = networks.forward(_network(QUERY, model.shared, dtype), x)
        joined = np.concatenate([np.repeat(of_voxels, k, axis=0), g.offsets.reshape(n * k, 3)], axis=1)
        (mix,) = _network(MIX, model.shared, dtype)
        queries = joined @ mix.weights + mix.biases
    return Decoded(gaussians, queries, model, view, networks, d, distances, tapes, joined)


def decode_vjp(decoded: Decoded, v: Gaussians, v_queries: Floats | None = None) -> DecodedGradient:
    """Gradient of :func:`decode`.

    ::

        v_m, v_ln s, v_q, v_l, v_c = sums over the K Gaussians,   v_u = 2 s v_mu,   v_ln s += sum_n v_mu dx
        v_A = joined^T v_k,  v_b = sum v_k,  v_q = the first part of v_k A^T,   v_u += the rest
        v_x = sum over the networks;   its parts are v_z, v_d (to m_v and the pose) and v_e

    Parameters
    ----------
    decoded : Decoded
    v : Gaussians
        Derivatives with respect to the N K Gaussians.
    v_queries : ndarray of shape (N K, d), optional
        With respect to the queries; they are zero by default.
    """
    g: Anchors = decoded.model.gaussians
    shared, (n, k), dtype = decoded.model.shared, (len(g.means), g.n_children), g.means.dtype

    def sums(array: Floats) -> Floats:
        return array.reshape(n, k, *array.shape[1:]).sum(axis=1)

    v_offsets = (v.means * spreads(g)).reshape(n, 3 * k)
    v_log_scales = sums(v.log_scales) + sums(v.means * steps(g))
    v_y: dict[str, Floats] = {
        OPACITY: v.opacity_logits,
        SHAPE: np.concatenate([v.log_scales, v.quats], axis=1),
        COLOR: v.sh_dc,
    }
    v_shared: dict[str, Floats] = {}
    if v_queries is not None:
        assert decoded.joined is not None, "the queries were decoded"
        (mix,) = _network(MIX, shared, dtype)
        v_shared |= to_shared(MIX, (Layer(decoded.joined.T @ v_queries, v_queries.sum(axis=0)),))
        v_joined = v_queries @ mix.weights.T
        v_y[QUERY] = sums(v_joined[:, :-3])
        v_offsets = v_offsets + v_joined[:, -3:].reshape(n, 3 * k)
    v_x = np.zeros((n, g.latents.shape[1] + 3 + _width(decoded.model)), dtype)
    for name, tape in decoded.tapes.items():
        if name in v_y:
            of_network = np.ascontiguousarray(v_y[name].reshape(n, -1))
            v_network, v_own = decoded.networks.forward_vjp(_network(name, shared, dtype), tape, of_network)
            v_shared |= to_shared(name, v_network)
            v_x += v_own
    v_latents, v_d, v_embedding = np.split(v_x, [g.latents.shape[1], g.latents.shape[1] + 3], axis=1)
    v_seen, v_R, v_t = directions_vjp(decoded.d, decoded.distances, decoded.view.camera, v_d)
    if CAMERAS in shared:
        v_shared[CAMERAS] = _embedding_vjp(shared, decoded.view, v_embedding.sum(axis=0))
    anchors = Anchors(
        means=sums(v.means) + v_seen,
        quats=sums(v.quats),
        log_scales=v_log_scales,
        opacity_logits=sums(v.opacity_logits),
        sh_dc=sums(v.sh_dc),
        sh_rest=np.zeros_like(g.sh_rest),
        latents=np.ascontiguousarray(v_latents),
        offsets=v_offsets,
    )
    return DecodedGradient(anchors, v_shared, v_R, v_t)


def steps(g: Anchors) -> Floats:
    """Return dx [N K, 3], the offsets of the Gaussians from their anchors in world units."""
    found: Floats = g.offsets.reshape(-1, 3) * spreads(g)
    return found


def spreads(g: Anchors) -> Floats:
    """Return the unit of the offsets of each Gaussian, [N K, 3] world units."""
    return np.repeat(g.log_scales.dtype.type(SPREAD) * np.exp(g.log_scales), g.n_children, axis=0)


def _width(model: Model) -> int:
    return model.shared[CAMERAS].shape[1] if CAMERAS in model.shared else 0


def _embedding(shared: Shared, view: View, dtype: np.dtype) -> Floats:
    """Return e_c [E]."""
    if CAMERAS not in shared:
        return np.zeros(0, dtype)
    embeddings = shared[CAMERAS].astype(dtype, copy=False)
    found: Floats = embeddings[view.view_id] if view.view_id >= 0 else embeddings.mean(axis=0)
    return found


def _embedding_vjp(shared: Shared, view: View, v_embedding: Floats) -> Floats:
    v = np.zeros(shared[CAMERAS].shape, v_embedding.dtype)
    if view.view_id >= 0:
        v[view.view_id] = v_embedding
    else:
        v += v_embedding / len(v)
    return v


def _network(name: str, shared: Shared, dtype: np.dtype) -> Network:
    """Return a network in a dtype; without layers if there is none."""
    return tuple(Layer(*(array.astype(dtype, copy=False) for array in layer)) for layer in from_shared(name, shared))


# --- rendering ---


class _Tape(NamedTuple):
    """The values that :func:`render_anchors` keeps for :func:`render_anchors_vjp`."""

    inner: Any
    decoded: Decoded


def render_anchors(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
    """Decode the anchors for the view, and render their Gaussians as 3DGS does; statistics are those of anchors."""
    k = model.gaussians.n_children
    decoded = decode(model, view, networks_for(request.backend))
    is_visible = None if request.is_visible is None else np.repeat(request.is_visible, k)
    wanted = request._replace(is_visible=is_visible, sh_degree=0)
    output, inner = SPLATTING.render(Model(decoded.gaussians), view, wanted)
    return _join_children(output, k), _Tape(inner, decoded)


def _join_children(output: RenderOutput, k: int) -> RenderOutput:
    """Return the output with rows of anchors instead of those of their K Gaussians: sums, or the largest."""
    if output.stats is not None:
        s = output.stats
        stats = BlendStats(
            blend_weight_sum=s.blend_weight_sum.reshape(-1, k).sum(axis=1),
            blend_weight_max=s.blend_weight_max.reshape(-1, k).max(axis=1),
            hit_count=s.hit_count.reshape(-1, k).sum(axis=1, dtype=s.hit_count.dtype),
            dominant_count=s.dominant_count.reshape(-1, k).sum(axis=1, dtype=s.dominant_count.dtype),
            dominant_ids=s.dominant_ids // k,  # -1 stays
        )
        output = output._replace(stats=stats)
    if "removal_changes" in output.extras:
        changes = output.extras["removal_changes"].reshape(-1, k).sum(axis=1)
        output = output._replace(extras={**output.extras, "removal_changes": changes})
    assert output.visible_ids is not None, "3DGS lists the rows that a view sees"
    return output._replace(visible_ids=np.unique(output.visible_ids // k))


def render_anchors_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_anchors`: that of 3DGS, carried on to the anchors and the networks."""
    v = SPLATTING.render_vjp(tape.inner, v_image, v_alpha)
    found = decode_vjp(tape.decoded, v.gaussians)
    k = tape.decoded.model.gaussians.n_children
    return v._replace(
        gaussians=found.anchors,
        cam_from_world_R=v.cam_from_world_R + found.cam_from_world_R,
        cam_from_world_t=v.cam_from_world_t + found.cam_from_world_t,
        means2d=v.means2d.reshape(-1, 2 * k),
        shared={**v.shared, **found.shared},
    )


# --- representation ---


CHILDREN, LATENT = 10, 32  # Gaussians of a voxel, and numbers of its latent

FIXED = dict.fromkeys(("means", "quats", "opacity_logits", "sh_dc", "sh_rest", MEMORY), 0.0)
RATES: Mapping[str, Any] = {
    **FIXED,
    "latents": 7.5e-3,
    "offsets": LogLinear(1e-2, 1e-4, 30_000),
    CAMERAS: LogLinear(5e-2, 5e-4, 30_000),
    **network_rates(OPACITY, 2, LogLinear(2e-3, 2e-5, 30_000)),
    **network_rates(SHAPE, 2, 4e-3),
    **network_rates(COLOR, 2, LogLinear(8e-3, 5e-5, 30_000)),
    **network_rates(QUERY, 2, LogLinear(5e-3, 5e-5, 30_000)),
    **network_rates(MIX, 1, LogLinear(5e-3, 5e-5, 30_000)),
    KEYS: LogLinear(1e-2, 1e-4, 30_000),
    ADAPTER: LogLinear(1e-2, 1e-4, 30_000),
}
ANCHORS = Representation(
    "anchors",
    population=Anchors,
    extend=partial(as_anchors, voxel=1.0, children=CHILDREN, latent=LATENT),
    shared=partial(
        initial_shared,
        children=CHILDREN,
        latent=LATENT,
        hidden=32,
        embedding=32,
        query=15,
        features="",
        similarity=0.9,
    ),
    renderer=Renderer("cus", render_anchors, render_anchors_vjp, SPLATTING.channels),
    rates=Rates(RATES, frozenset({"offsets"})),
)
