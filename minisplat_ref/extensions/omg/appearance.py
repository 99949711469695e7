"""View-dependent colour in few numbers: the higher harmonics of a scene, [N, 45], as features and a shared decoder.

With the mean m of all rows and orthonormal rows b_k, the principal directions,

    h_i = m + sum_k f_ik b_k,   f_ik = b_k . (h_i - m)

is the linear decoder with the least squared error for its number of features (principal component analysis). It
replaces the paper's small networks, which read a position and three features and are trained with the scene.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Floats


class Decoder(NamedTuple):
    """A linear map from features to harmonics, in float16 as it is stored."""

    mean: Floats
    """[D] m."""
    directions: Floats
    """[F, D] b_k."""

    def harmonics(self, features: Floats) -> Floats:
        """Return ``h = m + f b`` [N, D] of features [N, F], float32."""
        directions = self.directions.astype(np.float32)
        return (self.mean.astype(np.float32) + features.astype(np.float32) @ directions).astype(np.float32)


def fit_decoder(harmonics: Floats, n_features: int) -> Decoder:
    """Return the linear decoder of harmonics [N, D] with the least squared error.

    Parameters
    ----------
    harmonics : ndarray of shape (N, D)
        h.
    n_features : int
        F; it is reduced to D or N where these are smaller.
    """
    n, d = harmonics.shape
    rows = harmonics.astype(np.float64)
    mean = rows.mean(axis=0) if n else np.zeros(d)
    values, vectors = np.linalg.eigh((rows - mean).T @ (rows - mean))  # ascending
    strongest = np.argsort(-values, kind="stable")[: min(n_features, d)]
    return Decoder(mean.astype(np.float16), vectors[:, strongest].T.astype(np.float16))


def features_of(harmonics: Floats, decoder: Decoder) -> Floats:
    """Return the features ``f_ik = b_k . (h_i - m)`` [N, F] of harmonics [N, D], float64."""
    mean, directions = decoder.mean.astype(np.float64), decoder.directions.astype(np.float64)
    return (harmonics.astype(np.float64) - mean) @ directions.T
