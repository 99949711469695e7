"""The gradient proof for a whole model: any representation with its own renderer, without further code.

The Gaussians of the tiny scene become the representation's population. Its further fields, and shared parameters, have
the initial values of training, often zero or the identity, where much of a gradient vanishes: here random noise is
added. A parameter of learning rate 0, which an event sets instead of a gradient, gets noise too but is not
differentiated: a bound or a number of samples has no derivative. The view is at time 0.7, so that time has an effect.

The calls of the backend's stages record which hits are blended and which of them are clamped. They do not see a
threshold of the renderer's own, a gate or a ReLU: its stage belongs in the extension's ``stages``. A stage there with
the name that the whole renderer has here replaces it.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.oracle.cases import Case, Report
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.gradients import inner_product_case, jacobian_case
from minisplat_ref.oracle.pieces import SEED, tiny_setting
from minisplat_ref.oracle.setting import POSE, Setting, make_setting
from minisplat_ref.oracle.stages import Stage, watch
from minisplat_ref.reference.hits import TileHits
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Camera, Floats, Gaussians, Model, RenderOutput, Scene, View

TIME = 0.7
NOISE = 0.1  # standard deviation: the Gaussians lie at depth 3 and are 0.1 to 0.5 large
N_POINTS = 6

Stages = Callable[[Backend, Setting, np.random.Generator], Sequence[Stage]]


class Drawn(NamedTuple):
    """A rendered model, for which a relative returns the sides of its kinks."""

    model: Model
    view: View
    request: Request
    tape: Any
    """Of the renderer."""


def check_model_gradients(
    backend: Backend, conventions: Conventions, representation: Representation, stages: Stages | None = None
) -> Report:
    """Check the renderer of a representation, and further stages.

    :func:`minisplat_ref.oracle.relatives.check_relative_gradients` checks everything that an extension adds.

    Parameters
    ----------
    backend : Backend
        Backend for the renderer to use; in float64.
    conventions : Conventions
        Profile of the check.
    representation : Representation
        What is rendered.
    stages : callable, optional
        ``stages(backend, setting, rng)``: an extension's stages besides its renderer.

    Returns
    -------
    Report
        A case for each stage and way of checking.
    """
    cases = model_cases(backend, conventions, representation, stages)
    settings = {"backend": backend.name, "profile": conventions.name, "dtype": "float64", "seed": SEED, "time": TIME}
    title = f"gradients of {representation.name} on {backend.name}, profile {conventions.name}, float64"
    return Report(title, tuple(cases), settings)


def model_cases(
    backend: Backend, conventions: Conventions, representation: Representation | None, stages: Stages | None
) -> list[Case]:
    """Return the cases of a renderer, where there is one, and of further stages; see :func:`check_model_gradients`."""
    tiny, larger, rng = model_settings(conventions)
    tiny_stages = model_stages(backend, tiny, representation, stages, rng)
    checked = with_progress(tiny_stages, f"{backend.name}, Jacobians", "stages")
    cases: list[Case] = [jacobian_case(stage) for stage in checked]
    larger_stages = model_stages(backend, larger, representation, stages, rng)
    checked = with_progress(larger_stages, f"{backend.name}, inner products", "stages")
    return cases + [inner_product_case(stage, rng) for stage in checked]


def model_settings(conventions: Conventions) -> tuple[Setting, Setting, np.random.Generator]:
    """Return the scene of the Jacobians, that of the inner products, and the generator for the rest."""
    rng = np.random.default_rng(SEED)
    return tiny_setting(conventions), make_setting(rng, 60, 40, 30, conventions, sh_degree=3), rng


def model_stages(
    backend: Backend,
    setting: Setting,
    representation: Representation | None,
    stages: Stages | None,
    rng: np.random.Generator,
) -> tuple[Stage, ...]:
    """Return the whole renderer, where there is one, and the further stages; one with its name replaces it."""
    whole = () if representation is None else (model_stage(backend, setting, representation, rng),)
    further = () if stages is None else tuple(stages(backend, setting, rng))
    names = {stage.name for stage in further}
    return (*(stage for stage in whole if stage.name not in names), *further)


def model_stage(
    backend: Backend,
    setting: Setting,
    representation: Representation,
    rng: np.random.Generator,
    *,
    wants: frozenset[str] | None = None,
    sides_of: Callable[[Drawn], Sequence[np.ndarray]] = lambda drawn: (),
    fixed: Sequence[str] = (),
) -> Stage:
    """Return a renderer as a function of every field, every shared parameter, the background and the pose.

    The background is left out where the image does not depend on it, as behind a sky of the renderer's own, and so are
    parameters of learning rate 0.

    Parameters
    ----------
    backend : Backend
        The one that the renderer has to use.
    setting : Setting
        Gaussians and camera.
    representation : Representation
        Makes the population and the shared parameters, and renders them.
    rng : Generator
        For the noise.
    wants : frozenset of str, optional
        Channels that are rendered besides RGB; by default depth, where the renderer has it.
    sides_of : callable, optional
        Returns on which sides of the renderer's own kinks a rendered model is: which hits are blended, which ReLUs are
        on, which cells are read. Differences across one of them are refused. The calls of the backend's stages record
        theirs without it.
    fixed : sequence of str, optional
        Further fields and shared parameters that are not differentiated.
    """
    renderer, view = representation.renderer, training_view(setting.camera)
    (population, shared), _ = noisy_model(setting, view, representation, rng)
    fields = population._asdict()
    wants = frozenset({"depth"} & renderer.channels(frozenset({"depth"})).keys()) if wants is None else wants
    all_parameters = {**fields, **shared}
    still = {*fixed, *(name for name, rate in representation.rates.of.items() if rate == 0)}
    held = {name: array for name, array in all_parameters.items() if name in still}
    free = {name: array for name, array in all_parameters.items() if name not in still}
    inputs = {**free, "background": setting.background, **setting.pose}

    def draw(arrays: dict[str, Floats], used: Backend) -> tuple[RenderOutput, Drawn]:
        model = Model(population._make(arrays[name] for name in fields), {name: arrays[name] for name in shared})
        R, t = (arrays[name] for name in POSE)
        moved = view._replace(camera=view.camera._replace(cam_from_world_R=R, cam_from_world_t=t))
        request = Request(arrays["background"], conventions=setting.conventions, backend=used, wants=wants)
        output, tape = renderer.render(model, moved, request)
        return output, Drawn(model, moved, request, tape)

    over_black = draw({**held, **inputs, "background": np.zeros(3)}, backend)[0].image
    if np.array_equal(draw({**held, **inputs}, backend)[0].image, over_black):
        del inputs["background"]

    def arrays_of(args: Sequence[Floats]) -> dict[str, Floats]:
        return {"background": setting.background, **held, **dict(zip(inputs, args, strict=True))}

    def function(*args: Floats) -> Point:
        on_watch, sides = watch(backend)
        output, drawn = draw(arrays_of(args), on_watch)
        return Point((output.image, output.alpha), (*sides, *sides_of(drawn)))

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        _, drawn = draw(arrays_of(tuple(inputs.values())), backend)
        v = renderer.render_vjp(drawn.tape, v_image, v_alpha)
        by_name = {
            **v.gaussians._asdict(),
            **{name: v.shared.get(name, np.zeros_like(array)) for name, array in shared.items()},
            **{name: getattr(v, name) for name in ("background", *POSE)},
        }
        return tuple(by_name[name] for name in inputs)

    return Stage(f"render {representation.name}", inputs, ("image", "alpha"), function, vjp)


def hit_sides(tiles: Iterable[TileHits]) -> list[np.ndarray]:
    """Return which hits of the tiles of an image are blended, and which of them are clamped."""
    pairs = [(np.ravel(tile.alphas > 0), np.ravel(tile.is_clamped)) for tile in tiles]
    return [np.concatenate(sides) for sides in zip(*pairs, strict=True)]


def noisy_model(
    setting: Setting, view: View, representation: Representation, rng: np.random.Generator
) -> tuple[Model, Scene]:
    """Return the Gaussians as a model, with noise in the representation's additional fields, and the scene of the view.

    Parameters
    ----------
    setting : Setting
        Its Gaussians become the population; those of 3DGS stay where they are.
    view : View
        The scene's only one.
    representation : Representation
        Makes the population and the shared parameters.
    rng : Generator
        For both, and for the noise.
    """
    points = setting.gaussians.means[:N_POINTS]
    colors = np.full(points.shape, 128, np.uint8)
    scene = Scene("tiny", (view,), (), points, colors, setting.background, extent=1.0)
    population = _noisy_population(setting.gaussians, representation, rng)
    shared = {name: _noisy(array, rng) for name, array in representation.shared(scene, rng).items()}
    return Model(population, shared), scene


def _noisy_population(gaussians: Gaussians, representation: Representation, rng: np.random.Generator) -> Any:
    """Turn the Gaussians into a population, and add noise to its further fields."""
    population = representation.extend(gaussians, rng)
    known = gaussians._asdict()
    return population._make(
        field if field is known.get(name) else _noisy(field, rng) for name, field in population._asdict().items()
    )


def _noisy(array: Floats, rng: np.random.Generator) -> Floats:
    """Return the array in float64, each entry moved by NOISE."""
    return array + NOISE * rng.normal(size=array.shape)


def training_view(camera: Camera) -> View:
    """Return a training view at TIME, of a black photograph."""
    return View("a", camera, np.zeros((camera.height, camera.width, 3), np.uint8), None, view_id=0, time=TIME)
