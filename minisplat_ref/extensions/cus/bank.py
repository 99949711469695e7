"""The memory of features, and its readout by a pixel: few features in the memory instead of many stored ones.

The memory M [K, D] keeps a feature r of the photographs, one after the other, if it is like none that is kept::

    max_k (r . m_k) / (|r| |m_k|) < gamma

A blended query q [d] reads it by attention, and an adapter W [D, D] maps the result::

    a = softmax(q (M P)^T / sqrt(d)),   f = (a M) W

P [D, d] makes keys as wide as queries. Where D is d and P the identity, this is ``softmax(q M^T / sqrt(d))`` as in the
paper.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Floats

ROWS_MAX = 512  # of the memory
RANK_MIN = 1e-3  # of the largest singular value: smaller ones count as 0
CHUNK = 1_024  # features that are compared with the memory at once


def remember(features: Iterable[Floats], similarity: float) -> Floats:
    """Return the memory M [K, D] of features, scanned in their order; at most ``ROWS_MAX`` are kept.

    Parameters
    ----------
    features : iterable of ndarray of shape (R, D)
    similarity : float
        gamma.

    Returns
    -------
    memory : ndarray of shape (K, D)
        float64; the first feature, which may be zero, is always in it.
    """
    kept: list[Floats] = []
    directions: list[Floats] = []
    for rows in features:
        rows = rows.astype(np.float64)
        units = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
        for begin in range(0, len(rows), CHUNK):
            part = units[begin : begin + CHUNK]
            n_before = len(directions)
            cosines = part @ np.array(directions).T if directions else np.full((len(part), 1), -np.inf)
            for i in np.flatnonzero(cosines.max(axis=1) < similarity):
                newer = directions[n_before:]
                if len(kept) < ROWS_MAX and (not newer or (np.array(newer) @ part[i]).max() < similarity):
                    kept.append(rows[begin + i])
                    directions.append(part[i])
    return np.array(kept)


def first_keys(memory: Floats, n: int) -> Floats:
    """Return P [D, n]: the memory's n first principal axes, scaled so that keys have a mean square of 1 along each.

    There are zeros for axes beyond D, and for those in which the memory has nothing.
    """
    _, sizes, axes = np.linalg.svd(memory / np.sqrt(len(memory)), full_matrices=False)
    is_there = sizes > RANK_MIN * sizes.max(initial=0.0)
    axes = axes[is_there][:n] / sizes[is_there][:n, None]
    keys: Floats = np.pad(axes, ((0, n - len(axes)), (0, 0))).T
    return keys


class Reading(NamedTuple):
    """The values that :func:`read` keeps for its gradient."""

    queries: Floats
    memory: Floats
    keys: Floats
    adapter: Floats
    attention: Floats
    """[B, K] a."""


def read(queries: Floats, memory: Floats, keys: Floats, adapter: Floats) -> tuple[Floats, Reading]:
    """Return the features f [B, D] of queries.

    Parameters
    ----------
    queries : ndarray of shape (B, d)
    memory : ndarray of shape (K, D)
    keys : ndarray of shape (D, d)
        P.
    adapter : ndarray of shape (D, D)
        W.
    """
    scores = queries @ (memory @ keys).T / queries.dtype.type(np.sqrt(queries.shape[1]))
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    attention = weights / weights.sum(axis=1, keepdims=True)
    return attention @ memory @ adapter, Reading(queries, memory, keys, adapter, attention)


def read_vjp(reading: Reading, v_f: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Gradient of :func:`read` with respect to queries, memory, P and W.

    ::

        v_W = (a M)^T v_f,        v_o = v_f W^T              (o = a M)
        v_a = v_o M^T,            v_s = a (v_a - sum_k a_k v_a_k)
        v_q = v_s M P / sqrt(d),  v_(MP) = v_s^T q / sqrt(d)
        v_M = a^T v_o + v_(MP) P^T,   v_P = M^T v_(MP)
    """
    q, memory, keys, adapter, a = reading
    root = q.dtype.type(np.sqrt(q.shape[1]))
    v_o = v_f @ adapter.T
    v_a = v_o @ memory.T
    v_s = a * (v_a - np.sum(a * v_a, axis=1, keepdims=True))
    v_projected = v_s.T @ q / root  # [K, d]
    v_memory = a.T @ v_o + v_projected @ keys.T
    return v_s @ (memory @ keys) / root, v_memory, memory.T @ v_projected, (a @ memory).T @ v_f


LENGTH_MIN = 1e-3  # of a feature, where the cosine would have no derivative


def feature_error(found: Floats, target: Floats) -> tuple[float, Floats]:
    """Return ``mean_p mean_c (f - t)^2 + mean_p (1 - cos(f, t))`` of features [B, D], and its derivative v_f.

    ::

        cos = f . t / (n(f) n(t)),  n(x) = sqrt(x . x + eps^2)
        v_f = 2 (f - t) / (B D) - (t / (n(f) n(t)) - cos f / n(f)^2) / B
    """
    n, eps = len(found), found.dtype.type(LENGTH_MIN)
    of_found, of_target = (np.sqrt(np.sum(x * x, axis=1, keepdims=True) + eps**2) for x in (found, target))
    cosines = np.sum(found * target, axis=1, keepdims=True) / (of_found * of_target)
    difference = found - target
    v = 2 * difference / difference.size - (target / (of_found * of_target) - cosines * found / of_found**2) / n
    return float(np.mean(difference**2) + np.mean(1 - cosines)), v
