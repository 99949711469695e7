"""Networks of random weights for LPIPS, as arrays and as files."""

import math

import numpy as np

from minisplat_ref.metrics.lpips import ALEXNET, Network, expected_shapes


def random_weights(rng, backbone=ALEXNET):
    """He's initialisation, so that no layer's features fade; heads are not negative, as trained ones are."""
    weights = {}
    for name, shape in expected_shapes(backbone).items():
        if name.startswith("lin"):
            values = rng.random(shape) / shape[1]
        else:
            values = (
                rng.normal(size=shape) * math.sqrt(2 / max(1, math.prod(shape[1:]))) * (0.1 if len(shape) == 1 else 1)
            )
        weights[name] = values.astype(np.float32)
    return weights


def random_network(rng, backbone=ALEXNET):
    return Network(backbone, random_weights(rng, backbone))


def write_network(path, rng, backbone=ALEXNET):
    """What the package lpips has in its state dict: the weights, the scaling, and the heads a second time."""
    weights = random_weights(rng, backbone)
    again = {f"lins.{name[3]}.{name[5:]}": values for name, values in weights.items() if name.startswith("lin")}
    np.savez(path, **{"scaling_layer.shift": np.zeros((1, 3, 1, 1), np.float32)}, **weights, **again)
    return path
