"""From features and codes to the Gaussians of 3DGS, and the gradient back.

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

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.omg.population import (
    COLOR,
    HARMONICS,
    N_STATIC,
    OPACITY,
    PLACE,
    SPACE,
    OmgGaussians,
)
from minisplat_ref.mechanisms.networks.contraction import contract
from minisplat_ref.mechanisms.networks.mlp import Layer, Network, from_shared, to_shared
from minisplat_ref.mechanisms.networks.networks import Networks
from minisplat_ref.types import Floats, Ints

SLOPE = 0.01  # of the leaky ReLU

Shared = Mapping[str, Floats]


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
