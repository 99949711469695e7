"""The stages of the gradient check: both kinds of features, and the losses."""

import numpy as np

from minisplat_ref.extensions.style.reference import (
    FeatureWeights,
    feature_loss,
    nearest_rows,
    total_variation,
    unit_rows,
)
from minisplat_ref.mechanisms.features import network
from minisplat_ref.mechanisms.features.bank import FeatureBank
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.mechanisms.features.layers import max_pool_vjp
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats

Part = tuple[slice, slice]
WHOLE: Part = (slice(None), slice(None))
PATCH: Part = (slice(14, 21), slice(13, 20))  # all pixels would take minutes; every scale sees these


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the stages; there is one implementation, in NumPy, whatever the backend."""
    small, large = rng.uniform(size=(9, 8, 3)), rng.uniform(size=(37, 38, 3))
    return (
        feature_stage(CLASSICAL, large, PATCH, "classical features"),
        feature_stage(tiny_network(rng), small, WHOLE, "network features"),
        loss_stage(rng),
        Stage(
            "total_variation",
            {"image": small},
            ("loss",),
            lambda image: Point((np.asarray(total_variation(image)[0]),)),
            lambda v: (v * total_variation(small)[1],),
        ),
    )


def tiny_network(rng: np.random.Generator) -> FeatureBank:
    """Return a network of three random convolutions, two of one size and tapped, one of half the size."""
    sizes = ((4, 3, 3), (5, 4, 1), (6, 5, 3))
    arrays = {f"weight_{k}": rng.normal(size=(n, m, side, side)) for k, (n, m, side) in enumerate(sizes, 1)}
    arrays |= {f"bias_{k}": rng.normal(size=n) for k, (n, _, _) in enumerate(sizes, 1)}
    arrays |= {
        "pool_before": np.array([3]),
        "taps": np.array([1, 2, 3]),
        "mean": np.full(3, 0.45),
        "std": np.full(3, 0.3),
    }
    net = network.as_network(arrays, "a random network")
    return FeatureBank(
        "random",
        lambda image: network.features(net, image),
        lambda tape, v_maps: network.features_vjp(net, tape, v_maps),
        2,
    )


def feature_stage(bank: FeatureBank, image: Floats, moved: Part, name: str) -> Stage:
    """Return a bank's features as a stage, as a function of a part of the image.

    The sign of a ReLU's input is a threshold, and so is which of four pixels has the maximum.
    """

    def function(part: Floats) -> Point:
        copy = image.copy()
        copy[moved] = part
        maps, tape = bank.features(copy)
        if not isinstance(tape, network._Tape):
            return Point(tuple(maps))
        halved = ((y, x) for y, x in zip(tape.outputs, tape.inputs[1:], strict=False) if y.shape != x.shape)
        largest = (max_pool_vjp(y, 2, 2, np.ones_like(x)) for y, x in halved)
        return Point(tuple(maps), (*(y > 0 for y in tape.outputs), *largest))

    def vjp(*v_maps: Floats) -> tuple[Floats, ...]:
        return (bank.features_vjp(bank.features(image)[1], v_maps)[moved],)

    maps, _ = bank.features(image)
    return Stage(name, {"image": image[moved].copy()}, tuple(f"map {k}" for k in range(len(maps))), function, vjp)


def loss_stage(rng: np.random.Generator) -> Stage:
    """Return NNFM and content of two maps as a stage; where a nearest neighbour changes is a threshold."""
    shapes = ((4, 5, 6), (2, 3, 7))
    maps, content = ([rng.normal(size=shape) for shape in shapes] for _ in range(2))
    styles = [unit_rows(rng.normal(size=(9, shape[2])))[0] for shape in shapes]
    weights = FeatureWeights(1.3, 0.7)

    def function(*maps: Floats) -> Point:
        loss, _ = feature_loss(maps, content, styles, weights)
        near = (nearest_rows(m.reshape(-1, m.shape[2]), style) for m, style in zip(maps, styles, strict=True))
        return Point((np.asarray(loss),), tuple(near))

    def vjp(v: Floats) -> tuple[Floats, ...]:
        return tuple(v * v_map for v_map in feature_loss(maps, content, styles, weights)[1])

    return Stage("feature_loss", {f"map {k}": map_ for k, map_ in enumerate(maps)}, ("loss",), function, vjp)
