"""The predictor of initial centres: a network that maps noisy points to the points themselves.

It is trained on the points of the scene alone, which makes it in effect a denoising autoencoder: its output is smoother
than its input, because a small network cannot follow every point.
"""

import numpy as np

from minisplat_ref.mechanisms.networks.mlp import forward, make_network, train_step, zero_moments
from minisplat_ref.types import Floats

HIDDEN = (64, 64)
STEPS, BATCH, RATE = 600, 1024, 3e-3
NOISE = 0.01  # of the inputs, in units of the points' deviation


def predict_centers(points: Floats, rng: np.random.Generator) -> Floats:
    """Train the predictor on points [P, 3], and return its centres for them."""
    middle, spread = points.mean(axis=0), float(points.std()) or 1.0
    x = (points - middle) / spread
    network = make_network((3, *HIDDEN, 3), rng)
    moments = zero_moments(network)
    for step in range(1, STEPS + 1):
        rows = rng.integers(0, len(x), min(BATCH, len(x)))
        noisy = x[rows] + NOISE * rng.normal(size=(len(rows), 3))
        train_step(network, noisy, x[rows], RATE * (1 - (step - 1) / STEPS), moments, step)
    return middle + spread * forward(network, x)[0]
