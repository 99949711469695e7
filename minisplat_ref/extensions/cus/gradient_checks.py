"""Stages for the gradient check: the renderer with small networks, blended queries and their loss, reads of a memory.

Everything that the recipe keeps fixed is differentiated, too. A ReLU has a kink at 0, whose sides are part of a point.

Steps of differences have to be large relative to rounding, and small relative to the distance to the next threshold. So
there are few anchors, with Gaussians so large that few of their rims, where alpha falls below its minimum, are in the
image; most ReLUs are on; and features are large, and near those that are wanted, so that the loss is no larger than its
gradients. The oracle's own check of the loss, which this one replaces, has photographs of noise, whose features are all
similar, and the recipe's networks: gradients there are a thousandth of the loss, so that the last digit of the loss
uses up the tolerance.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.cus.memory import feature_error, read, read_vjp
from minisplat_ref.extensions.cus.model import (
    ADAPTER,
    ANCHORS,
    KEYS,
    MEMORY,
    MIX,
    Anchors,
    as_anchors,
    decode,
    initial_shared,
)
from minisplat_ref.extensions.cus.recipe import (
    FeatureTape,
    blended_queries,
    blended_queries_vjp,
    error_at_pixels,
    read_memory,
)
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage, noisy_model, training_view
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage, watch
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.losses import Cotangents
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View

CHILDREN, LATENT, HIDDEN, EMBEDDING, QUERY = 2, 2, 5, 4, 4
N_REMEMBERED, N_CHANNELS = 3, 5
SPREAD = 0.5  # of random weights
VOXEL, N_ANCHORS = 8.0, 8  # side in units of the median scale, and the most that are taken
WIDER = 3.0  # than anchors begin with
ON = 0.5  # is added to the inputs of ReLUs
LONG, SHORT = 10.0, 0.02  # memory and keys of the loss: large features, and attention to more than one row
NEAR = 1.0  # standard deviation of features from those that are wanted
MODELS = 3  # seed of the models: with it no gradient is small relative to the values of which differences are taken
N_PIXELS = 12  # that the loss compares, at most


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return all; the first replaces that of the renderer as a whole, the last the oracle's of the loss of features.

    The models have a separate seed, so that earlier checks do not change the point of this one.
    """
    own = np.random.default_rng(MODELS)
    return (
        _renderer_stage(backend, setting, own),
        _queries_stage(backend, setting, own),
        _reading_stage(own),
        _loss_stage(backend, setting, own),
    )


def small(rng: np.random.Generator) -> Representation:
    """Return the representation with few numbers, all of which can be checked."""

    def shared(scene: Scene, own: np.random.Generator) -> Mapping[str, Floats]:
        found = initial_shared(
            scene,
            own,
            children=CHILDREN,
            latent=LATENT,
            hidden=HIDDEN,
            embedding=EMBEDDING,
            query=QUERY,
            features="",
            similarity=1.0,
        )
        found = {name: array + SPREAD * rng.normal(size=array.shape) for name, array in found.items()}
        found |= {name: found[name] + ON for name in found if name.endswith("biases_0") and not name.startswith(MIX)}
        return {**found, **memory_of(rng)}

    def extend(gaussians: Gaussians, own: np.random.Generator) -> Anchors:
        found = as_anchors(gaussians, own, voxel=VOXEL, children=CHILDREN, latent=LATENT)
        rows = np.unique(np.linspace(0, len(found.means) - 1, N_ANCHORS).astype(int))
        return take(found._replace(log_scales=found.log_scales + np.log(WIDER)), rows)

    return ANCHORS._replace(extend=extend, shared=shared, rates=Rates({"sh_rest": 0.0}, frozenset()))


def memory_of(rng: np.random.Generator) -> dict[str, Floats]:
    """Return a random memory with its keys and its adapter."""
    shapes = {MEMORY: (N_REMEMBERED, N_CHANNELS), KEYS: (N_CHANNELS, QUERY), ADAPTER: (N_CHANNELS, N_CHANNELS)}
    return {name: rng.normal(size=shape) for name, shape in shapes.items()}


OF_QUERIES = ("query_mix_weights_0", "query_mix_biases_0", MEMORY, KEYS, ADAPTER)


def _renderer_stage(backend: Backend, setting: Setting, rng: np.random.Generator) -> Stage:
    representation = small(rng)
    unseen = [name for name in representation.shared(_scene(setting), rng) if name.startswith("query")]
    representation = representation._replace(
        rates=Rates(dict.fromkeys(("sh_rest", *unseen, *OF_QUERIES), 0.0), frozenset())
    )
    return model_stage(backend, setting, representation, rng, sides_of=lambda drawn: _sides(drawn.model, drawn.view))


def _scene(setting: Setting) -> Scene:
    view = training_view(setting.camera)
    return Scene("tiny", (view,), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), setting.background, extent=1.0)


def _sides(model: Model, view: View, *, with_queries: bool = False) -> tuple[Any, ...]:
    """Return the ReLUs that are on."""
    tapes = decode(model, view, IN_NUMPY, with_queries=with_queries).tapes
    return tuple(inputs[1] > 0 for inputs in tapes.values())


class _Movable(NamedTuple):
    """A small model, and the parts of it that are differentiated."""

    model: Model
    view: View
    inputs: dict[str, Floats]

    def at(self, args: tuple[Floats, ...]) -> Model:
        """Return the model with other inputs."""
        fields = self.model.gaussians._asdict()
        given = {**fields, **self.model.shared, **dict(zip(self.inputs, args, strict=True))}
        population = self.model.gaussians._make(given[name] for name in fields)
        return Model(population, {name: given[name] for name in self.model.shared})


def _movable(setting: Setting, rng: np.random.Generator, *unread: str) -> _Movable:
    """Return a model without inputs that are not read: colours, and those that are named."""
    view = training_view(setting.camera)
    model, _ = noisy_model(setting, view, small(rng), rng)
    everything = {**model.gaussians._asdict(), **model.shared}
    unread = (*unread, "sh_dc", "sh_rest", *(name for name in model.shared if name.startswith("color")))
    return _Movable(model, view, {name: array for name, array in everything.items() if name not in unread})


def _queries_stage(backend: Backend, setting: Setting, rng: np.random.Generator) -> Stage:
    movable = _movable(setting, rng, MEMORY, KEYS, ADAPTER)

    def blend(model: Model, used: Backend) -> tuple[Floats, FeatureTape]:
        return blended_queries(model, movable.view, Request(conventions=setting.conventions, backend=used))

    def function(*args: Floats) -> Point:
        on_watch, sides = watch(backend)
        moved = movable.at(args)
        image, _ = blend(moved, on_watch)
        return Point((image,), (*sides, *_sides(moved, movable.view, with_queries=True)))

    def vjp(v_image: Floats) -> tuple[Floats, ...]:
        anchors, shared = blended_queries_vjp(blend(movable.model, backend)[1], v_image)
        by_name = {**anchors._asdict(), **shared}
        return tuple(by_name[name] for name in movable.inputs)

    return Stage("blended_queries", movable.inputs, ("queries",), function, vjp)


def _loss_stage(backend: Backend, setting: Setting, rng: np.random.Generator) -> Stage:
    """Return the error of the features that a view reads as a function of everything that is read."""
    movable = _movable(setting, rng)
    for name, factor in ((MEMORY, LONG), (KEYS, SHORT)):
        movable.inputs[name] = movable.model.shared[name][:] = factor * movable.model.shared[name]
    width, height = setting.camera.width, setting.camera.height
    chosen = rng.choice(width * height, min(N_PIXELS, width * height), replace=False)
    pixels = np.stack(np.divmod(chosen, width), axis=1)
    image, _ = blended_queries(movable.model, movable.view, Request(conventions=setting.conventions))
    read_there, _ = read_memory(image[pixels[:, 0], pixels[:, 1]], movable.model.shared)
    wanted = read_there + NEAR * rng.normal(size=read_there.shape)

    def error(model: Model, used: Backend) -> tuple[float, Cotangents]:
        request = Request(conventions=setting.conventions, backend=used)
        return error_at_pixels(model, movable.view, request, pixels, wanted)

    def function(*args: Floats) -> Point:
        on_watch, sides = watch(backend)
        moved = movable.at(args)
        value, _ = error(moved, on_watch)
        return Point((np.asarray(value),), (*sides, *_sides(moved, movable.view, with_queries=True)))

    def vjp(v_error: Floats) -> tuple[Floats, ...]:
        _, v = error(movable.model, backend)
        by_name = {**v.gaussians, **v.shared}
        return tuple(float(v_error) * by_name[name] for name in movable.inputs)

    return Stage("loss term feature_loss", movable.inputs, ("error",), function, vjp)


def _reading_stage(rng: np.random.Generator) -> Stage:
    """Return the error of features that queries read, as a function of the queries, the memory and the parameters."""
    inputs = {"queries": rng.normal(size=(4, QUERY)), **memory_of(rng)}
    target = rng.normal(size=(4, N_CHANNELS))

    def function(*args: Floats) -> Point:
        found, _ = read(*args)
        return Point((found, np.asarray(feature_error(found, target)[0])))

    def vjp(v_found: Floats, v_error: Floats) -> tuple[Floats, ...]:
        found, reading = read(*inputs.values())
        return read_vjp(reading, v_found + float(v_error) * feature_error(found, target)[1])

    return Stage("read", inputs, ("features", "error"), function, vjp)
