"""A term of the loss as a stage under test: its value as a function of everything that it may depend on.

A term returns its value with its cotangents (:mod:`minisplat_ref.training.losses`). It is called with a rendered view
of the tiny scene, photographed at random and seen through a mask, with sparse points where the Gaussians are. Noise is
added to the rendered channels, because neighbours that show one Gaussian have one depth, at which an absolute
difference has no derivative. Its
inputs are the channels of the image, alpha, the fields of the population and the shared parameters: those that the
cotangents name, and those with which the value changes, so that a derivative that is left out is wrong, too. Values
that a term keeps constant (``Rendered.constant``) are not perturbed.

A term does not report its thresholds, such as the kink of an absolute value. So its differences have to settle
(:func:`minisplat_ref.oracle.differences.settled_derivative`).
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.cases import Case
from minisplat_ref.oracle.differences import Point, settled_derivative
from minisplat_ref.oracle.gradients import inner_product_case, jacobian_case
from minisplat_ref.oracle.models import NOISE, noisy_model, training_view
from minisplat_ref.oracle.pieces import SEED, tiny_setting
from minisplat_ref.oracle.setting import Setting, make_setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats

ALPHA = "alpha"
PROBE = 1e-3  # by which an input is moved, at random, to see whether the value depends on it
N_STEPS = 32  # iterations, from a term's first, in which it has to act: some act in every fourth only
MASKED = 0.1  # of the pixels
LARGER = ((30, 40, 30), (30, 80, 60))  # Gaussians, width, height: the second for terms that need more pixels


def loss_cases(
    term: LossTerm, backend: Backend, conventions: Conventions, representation: Representation
) -> list[Case]:
    """Check the derivatives of a term: entry by entry on the tiny scene, along random directions on a larger one.

    A scene in which the term is zero in each of its first iterations, because the images are too small for it, is left
    out; a term that is zero in all has a case that failed.

    Parameters
    ----------
    term : LossTerm
        Whatever its weight.
    backend : Backend
        The one that it has to use.
    conventions : Conventions
        Profile of the check.
    representation : Representation
        Of the model.
    """
    rng = np.random.default_rng(SEED)
    stage = loss_stage(term, backend, tiny_setting(conventions), representation, rng)
    cases = [] if stage is None else [jacobian_case(stage, settled_derivative)]
    for n, width, height in LARGER:
        larger = make_setting(rng, n, width, height, conventions, sh_degree=3)
        stage = loss_stage(term, backend, larger, representation, rng)
        if stage is not None:
            return [*cases, inner_product_case(stage, rng, settled_derivative)]
    note = f"it is zero in iterations {term.start + 1} to {term.start + N_STEPS}, so that nothing was checked"
    return cases or [Case(stage_name(term), False, {}, note)]


def loss_stage(
    term: LossTerm, backend: Backend, setting: Setting, representation: Representation, rng: np.random.Generator
) -> Stage | None:
    """Return a term as a function of its inputs; None if it is zero and depends on nothing.

    Parameters
    ----------
    term, backend, representation
        As for :func:`loss_cases`.
    setting : Setting
        Gaussians and camera.
    rng : Generator
        For the photograph, the mask, the noise of the model and of the rendered image.
    """
    camera = setting.camera
    photograph = rng.integers(0, 256, (camera.height, camera.width, 3)).astype(np.uint8)
    view = training_view(camera)._replace(image=photograph, mask=rng.uniform(size=photograph.shape[:2]) > MASKED)
    model, scene = noisy_model(setting, view, representation, rng)
    view = view._replace(point_ids=np.arange(len(scene.points)))
    request = Request(setting.background, conventions=setting.conventions, backend=backend, wants=term.wants)
    drawn, _ = representation.renderer.render(model, view, request)
    noise = NOISE * rng.uniform(-1, 0, size=(*drawn.alpha.shape, drawn.image.shape[2] + 1))
    output = drawn._replace(image=drawn.image * (1 + noise[..., 1:]), alpha=drawn.alpha * (1 + noise[..., 0]))
    channels = representation.renderer.channels(term.wants)
    kept = {name for name, rate in representation.rates.of.items() if rate == 0}
    fields = {name: field for name, field in model.gaussians._asdict().items() if name not in kept}
    everything: dict[str, Floats] = {name: output.image[..., where] for name, where in channels.items()}
    everything |= {ALPHA: output.alpha, **fields, **model.shared}

    def evaluate(moved: Mapping[str, Floats], step: int) -> tuple[float, Cotangents]:
        given = {**everything, **moved}
        image = output.image.copy()
        for name, where in channels.items():
            image[..., where] = given[name]
        moved_output = output._replace(image=image, alpha=given[ALPHA])
        population = model.gaussians._replace(**{name: given[name] for name in fields})
        moved_model = model._replace(gaussians=population, shared={name: given[name] for name in model.shared})
        at_rest = Rendered(output, channels, view, scene, model, step, request)
        return term.function(at_rest._replace(output=moved_output, model=moved_model, held=at_rest))

    step = _acting_step(term, lambda step: evaluate({}, step))
    if step is None:
        return None
    value, cotangents = evaluate({}, step)
    named = _name_cotangents(cotangents)
    probes = {name: PROBE * rng.normal(size=array.shape) for name, array in everything.items()}
    inputs = {
        name: array
        for name, array in everything.items()
        if name in named or evaluate({name: array + probes[name]}, step)[0] != value
    }

    def function(*args: Floats) -> Point:
        return Point((np.asarray(evaluate(dict(zip(inputs, args, strict=True)), step)[0]),))

    def vjp(v_loss: Floats) -> tuple[Floats, ...]:
        v = _name_cotangents(evaluate({}, step)[1])
        return tuple(float(v_loss) * v.get(name, np.zeros_like(array)) for name, array in inputs.items())

    return Stage(stage_name(term), inputs, ("loss",), function, vjp)


def stage_name(term: LossTerm) -> str:
    """Return the name of a term's stage; an extension's own stage of this name replaces it."""
    return f"loss term {term.name}"


def _acting_step(term: LossTerm, evaluate: Callable[[int], tuple[float, Cotangents]]) -> int | None:
    """Return the first iteration in which the term has a value or a derivative."""
    for step in range(term.start + 1, term.start + 1 + N_STEPS):
        value, cotangents = evaluate(step)
        if value != 0 or any(np.any(v) for v in _name_cotangents(cotangents).values()):
            return step
    return None


def _name_cotangents(v: Cotangents) -> dict[str, Floats]:
    alpha = {} if v.alpha is None else {ALPHA: v.alpha}
    return {**v.channels, **alpha, **v.gaussians, **v.shared}


def own_terms(own: Sequence[LossTerm], of_core: Sequence[LossTerm]) -> tuple[LossTerm, ...]:
    """Return the terms with a function from outside the core, each once."""
    functions = [_unbound(term) for term in of_core]
    found = {(term.name, _unbound(term)): term for term in own if _unbound(term) not in functions}
    return tuple(found.values())


def _unbound(term: LossTerm) -> object:
    return getattr(term.function, "func", term.function)
