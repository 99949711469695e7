"""What the gradient check looks at: the renderer and the blended queries with small networks, and how memory is read.

Everything that the recipe holds still is differentiated, too. A ReLU has a kink at 0, whose sides are part of a point.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.extensions.cus.bank import feature_error, read, read_vjp
from minisplat_ref.extensions.cus.decoding import decode
from minisplat_ref.extensions.cus.losses import blended_queries, blended_queries_vjp
from minisplat_ref.extensions.cus.method import ANCHORS
from minisplat_ref.extensions.cus.population import ADAPTER, KEYS, MEMORY, as_anchors, initial_shared
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage, noisy_model, training_view
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage, watch
from minisplat_ref.rendering import Request
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Model, RenderOutput, Scene, View

CHILDREN, LATENT, HIDDEN, EMBEDDING, QUERY = 2, 2, 3, 4, 4
N_REMEMBERED, N_CHANNELS = 3, 5
SPREAD = 0.5  # of random weights
VOXEL = 8.0  # few anchors: among many, steps between thresholds are so small that they round


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return all; the first replaces that of the renderer as a whole."""
    return _renderer_stage(backend, setting, rng), _queries_stage(backend, setting, rng), _reading_stage(rng)


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
        return {**found, **memory_of(rng)}

    extend = partial(as_anchors, voxel=VOXEL, children=CHILDREN, latent=LATENT)
    return ANCHORS._replace(extend=extend, shared=shared, rates=Rates({"sh_rest": 0.0}, frozenset()))


def memory_of(rng: np.random.Generator) -> dict[str, Floats]:
    """Return a random memory with its keys and its adapter."""
    shapes = {MEMORY: (N_REMEMBERED, N_CHANNELS), KEYS: (N_CHANNELS, QUERY), ADAPTER: (N_CHANNELS, N_CHANNELS)}
    return {name: rng.normal(size=shape) for name, shape in shapes.items()}


OF_QUERIES = ("query_mix_weights_0", "query_mix_biases_0", MEMORY, KEYS, ADAPTER)


def _renderer_stage(backend: Backend, setting: Setting, rng: np.random.Generator) -> Stage:
    recorded: list[tuple[Any, ...]] = []

    def watched(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        recorded[:] = [_sides(model, view)]
        return ANCHORS.renderer.render(model, view, request)

    representation = small(rng)
    unseen = [name for name in representation.shared(_scene(setting), rng) if name.startswith("query")]
    representation = representation._replace(
        renderer=ANCHORS.renderer._replace(render=watched),
        rates=Rates(dict.fromkeys(("sh_rest", *unseen, *OF_QUERIES), 0.0), frozenset()),
    )
    stage = model_stage(backend, setting, representation, rng)

    def function(*args: Floats) -> Point:
        point = stage.function(*args)
        return point._replace(sides=(*point.sides, *recorded[0]))

    return stage._replace(function=function)


def _scene(setting: Setting) -> Scene:
    view = training_view(setting.camera)
    return Scene("tiny", (view,), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), setting.background, extent=1.0)


def _sides(model: Model, view: View, *, with_queries: bool = False) -> tuple[Any, ...]:
    """Return the ReLUs that are on."""
    tapes = decode(model, view, IN_NUMPY, with_queries=with_queries).tapes
    return tuple(inputs[1] > 0 for inputs in tapes.values())


def _queries_stage(backend: Backend, setting: Setting, rng: np.random.Generator) -> Stage:
    view = training_view(setting.camera)
    model, _ = noisy_model(setting, view, small(rng), rng)
    unread = {MEMORY, KEYS, ADAPTER, *(name for name in model.shared if name.startswith("color"))}
    fields = model.gaussians._asdict()
    inputs = {name: array for name, array in fields.items() if name not in ("sh_dc", "sh_rest")}
    inputs |= {name: array for name, array in model.shared.items() if name not in unread}

    def draw(args: tuple[Floats, ...], used: Backend) -> tuple[Floats, Any, Model]:
        given = {**fields, **model.shared, **dict(zip(inputs, args, strict=True))}
        moved = Model(model.gaussians._make(given[name] for name in fields), {n: given[n] for n in model.shared})
        request = Request(conventions=setting.conventions, backend=used)
        return *blended_queries(moved, view, request), moved

    def function(*args: Floats) -> Point:
        on_watch, sides = watch(backend)
        image, _, moved = draw(args, on_watch)
        return Point((image,), (*sides, *_sides(moved, view, with_queries=True)))

    def vjp(v_image: Floats) -> tuple[Floats, ...]:
        anchors, shared = blended_queries_vjp(draw(tuple(inputs.values()), backend)[1], v_image)
        by_name = {**anchors._asdict(), **shared}
        return tuple(by_name[name] for name in inputs)

    return Stage("blended_queries", inputs, ("queries",), function, vjp)


def _reading_stage(rng: np.random.Generator) -> Stage:
    """Return the error of features that queries read, as a function of the queries, the memory and what is learned."""
    inputs = {"queries": rng.normal(size=(4, QUERY)), **memory_of(rng)}
    target = rng.normal(size=(4, N_CHANNELS))

    def function(*args: Floats) -> Point:
        found, _ = read(*args)
        return Point((found, np.asarray(feature_error(found, target)[0])))

    def vjp(v_found: Floats, v_error: Floats) -> tuple[Floats, ...]:
        found, reading = read(*inputs.values())
        return read_vjp(reading, v_found + float(v_error) * feature_error(found, target)[1])

    return Stage("read", inputs, ("features", "error"), function, vjp)
