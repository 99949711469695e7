"""From anchors to Gaussians and their queries, and the gradient back.

An anchor v at m_v with the latent z_v is seen from the direction d_v in the photograph c, of embedding e_c. Networks of
one hidden layer of ReLUs read ``x_v = [z_v, d_v, e_c]``; their outputs join the anchor's fields, before the activations
of 3DGS. For each n of K::

    mu_vn = m_v + dx_vn
    l_vn  = l_v + opacity(x_v)_n                     logit of the opacity
    (ln s_vn, q_vn) = (ln s_v, q_v) + shape(x_v)_n
    c_vn  = c_v + color(x_v)_n                       coefficient of degree 0
    k_vn  = [query(x_v), dx_vn / s_v] A + b          what is blended to read the memory

A photograph that was not trained on has the mean of all embeddings. Networks that are missing, as beside a file alone,
have outputs of 0.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.cus.population import CAMERAS, COLOR, MIX, NETWORKS, OPACITY, QUERY, SHAPE, Anchors
from minisplat_ref.mechanisms.networks.directions import directions, directions_vjp
from minisplat_ref.mechanisms.networks.mlp import Layer, Network, from_shared, to_shared
from minisplat_ref.mechanisms.networks.networks import Networks
from minisplat_ref.types import Floats, Gaussians, Model, View

Shared = Mapping[str, Floats]


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
        Anchors, and the shared parameters of :func:`.population.initial_shared`, or none.
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
        means=np.repeat(g.means, k, axis=0) + g.offsets.reshape(n * k, 3),
        quats=np.repeat(g.quats, k, axis=0) + y[SHAPE][:, 3:],
        log_scales=np.repeat(g.log_scales, k, axis=0) + y[SHAPE][:, :3],
        opacity_logits=np.repeat(g.opacity_logits, k) + y[OPACITY][:, 0],
        sh_dc=np.repeat(g.sh_dc, k, axis=0) + y[COLOR],
        sh_rest=np.zeros((n * k, 0, 3), dtype),
    )
    queries = joined = None
    if with_queries:
        of_voxels, tapes[QUERY] = networks.forward(_network(QUERY, model.shared, dtype), x)
        joined = np.concatenate([np.repeat(of_voxels, k, axis=0), _steps(g)], axis=1)
        (mix,) = _network(MIX, model.shared, dtype)
        queries = joined @ mix.weights + mix.biases
    return Decoded(gaussians, queries, model, view, networks, d, distances, tapes, joined)


def decode_vjp(decoded: Decoded, v: Gaussians, v_queries: Floats | None = None) -> DecodedGradient:
    """Gradient of :func:`decode`.

    ::

        v_m, v_ln s, v_q, v_l, v_c = sums over the K Gaussians,   v_dx = v_mu
        v_A = joined^T v_k,  v_b = sum v_k,  v_[q, u] = v_k A^T         (u = dx / s)
        v_dx += v_u / s,     v_ln s -= sum_n v_u u
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

    v_offsets, v_log_scales = v.means.reshape(n, 3 * k), sums(v.log_scales)
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
        v_steps = v_joined[:, -3:]
        v_offsets = v_offsets + (v_steps / np.repeat(np.exp(g.log_scales), k, axis=0)).reshape(n, 3 * k)
        v_log_scales = v_log_scales - sums(v_steps * _steps(g))
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


def _steps(g: Anchors) -> Floats:
    """Return u [N K, 3], the offsets in units of the anchors' scales."""
    offsets = g.offsets.reshape(-1, 3)
    steps: Floats = offsets / np.repeat(np.exp(g.log_scales), g.n_children, axis=0)
    return steps


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
