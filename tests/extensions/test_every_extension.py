"""What holds for every extension, by the reference: its gradients, and what its image does not depend on.

A new extension is checked, too, without a line here. Gradients are the quick part of ``oracle gradients --extension
NAME``: along random directions, without Jacobians, of half the Gaussians, with the wider limit; kernels are held
against the reference by the tests of each extension.
"""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.extension import load_extensions
from minisplat_ref.io.frames import place_camera, place_fields
from minisplat_ref.methods import RECIPES
from minisplat_ref.oracle.differences import careful_derivative, check_inner_products, settled_derivative
from minisplat_ref.oracle.loss_terms import LARGER, loss_stage, own_terms, stage_name
from minisplat_ref.oracle.models import model_settings, model_stages, noisy_model, training_view
from minisplat_ref.oracle.pieces import SEED
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.oracle.tolerances import GRADIENT_FLOOR, GRADIENT_REL_NEAR_THRESHOLD
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.representation import GAUSSIANS
from minisplat_ref.types import Frame, Model
from tolerances import PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

EXTENSIONS = {extension.name: extension for extension in load_extensions()}
FRAME = Frame((3.0, -2.0, 5.0), 0.25)
WITHOUT = {"compression", "proxies", "segment"}  # formats, edits and labels: nothing that has a gradient


# Gradients


def stages_of(extension):
    """The renderer and further stages on the oracle's larger scene, and loss terms on the first in which each acts."""
    representation = None if extension.representation == GAUSSIANS else extension.representation
    _, setting, rng = model_settings(GSPLAT_MAIN)
    stages = model_stages(REFERENCE, setting, representation, extension.stages, rng)
    core = [term for recipe in RECIPES.values() for term in recipe.losses]
    terms = own_terms([*extension.losses, *(t for recipe in extension.recipes for t in recipe.losses)], core)
    losses = [first_acting(term, extension, rng) for term in terms if stage_name(term) not in {s.name for s in stages}]
    return rng, [*((stage, careful_derivative) for stage in stages), *((stage, settled_derivative) for stage in losses)]


def first_acting(term, extension, rng):
    for size in LARGER:
        setting = make_setting(rng, *size, GSPLAT_MAIN, sh_degree=3)
        stage = loss_stage(term, REFERENCE, setting, extension.representation, rng)
        if stage is not None:
            return stage
    raise AssertionError(f"{term.name} is zero")


@pytest.mark.parametrize("name", sorted(EXTENSIONS.keys() - WITHOUT))
def test_gradients_along_random_directions(name, small_proof):
    rng, stages = stages_of(EXTENSIONS[name])
    assert stages
    for stage, differentiate in stages:
        products = check_inner_products(
            stage.function,
            stage.vjp,
            list(stage.inputs.values()),
            rng,
            names=list(stage.inputs),
            differentiate=differentiate,
        )
        assert {p.input for p in products} == set(stage.inputs), stage.name
        for p in products:
            assert p.step > 0 and p.size > GRADIENT_FLOOR, (stage.name, p)
            assert p.error <= GRADIENT_REL_NEAR_THRESHOLD, (stage.name, p)


@pytest.mark.parametrize("name", sorted(WITHOUT))
def test_what_has_no_gradient(name):
    extension = EXTENSIONS[name]
    assert extension.representation == GAUSSIANS and extension.stages is None
    assert not extension.losses and not extension.recipes


# Images


class Drawing:
    """A model of an extension with noise in what is its own, and its image."""

    def __init__(self, extension):
        self.representation, rng = extension.representation, np.random.default_rng(SEED)
        setting = make_setting(rng, 20, 20, 15, GSPLAT_MAIN, sh_degree=3)
        self.view = training_view(setting.camera)
        self.model, _ = noisy_model(setting, self.view, self.representation, rng)
        self.request = Request(setting.background, conventions=GSPLAT_MAIN, backend=REFERENCE)
        self.image = self.drawn(self.model).image
        assert self.image.std() > 0.05

    def drawn(self, model, **changes):
        return self.representation.renderer.render(model, self.view, self.request._replace(**changes))[0]

    def of_rows(self, rows):
        return self.model._replace(gaussians=take(self.model.gaussians, rows))


@pytest.fixture(scope="module", params=sorted(EXTENSIONS))
def drawing(request):
    return Drawing(EXTENSIONS[request.param])


def test_the_order_of_rows_has_no_meaning(drawing, rng):
    rows = rng.permutation(len(drawing.model.gaussians.means))
    assert_allclose(drawing.drawn(drawing.of_rows(rows)).image, drawing.image, atol=PARITY_FLOAT64)


def test_a_hidden_row_is_as_one_that_is_not_there(drawing):
    is_visible = np.arange(len(drawing.model.gaussians.means)) % 3 > 0
    hidden = drawing.drawn(drawing.model, is_visible=is_visible).image
    assert_allclose(hidden, drawing.drawn(drawing.of_rows(np.flatnonzero(is_visible))).image, atol=PARITY_FLOAT64)
    assert np.abs(hidden - drawing.image).max() > 0.01


def test_nothing_is_drawn_of_no_rows(drawing):
    output = drawing.drawn(drawing.of_rows(np.zeros(0, int)))
    assert not output.alpha.any() and np.isfinite(output.image).all() and len(output.visible_ids) == 0


def test_float32_stays_float32(drawing):
    population, shared = drawing.model.gaussians, drawing.model.shared
    fields = type(population)(*(field.astype(np.float32) for field in population))
    model = Model(fields, {name: array.astype(np.float32) for name, array in shared.items()})
    request = drawing.request._replace(background=drawing.request.background.astype(np.float32))
    renderer = drawing.representation.renderer
    output, tape = renderer.render(model, drawing.view, request)
    assert output.image.dtype == output.alpha.dtype == np.float32
    assert_allclose(output.image, drawing.image, atol=PARITY_FLOAT32_IMAGE)
    v = renderer.render_vjp(tape, np.ones_like(output.image), np.ones_like(output.alpha))
    wide = {name for name, array in {**v.gaussians._asdict(), **v.shared}.items() if array.dtype != np.float32}
    assert wide == set()


@pytest.mark.parametrize("name", sorted(EXTENSIONS.keys() - {"satellite"}))
def test_a_scene_is_drawn_alike_wherever_it_lies(name):
    """In other units about another origin, fields and shared parameters as their units say, the image is the same.

    The cameras of ``satellite`` have a number of pixels for a unit of length, whatever their place; its scenes come in
    a frame of their own.
    """
    drawing = Drawing(EXTENSIONS[name])
    model, view, representation = drawing.model, drawing.view, drawing.representation
    fields = place_fields(model.gaussians._asdict(), representation.units, FRAME)
    moved = Model(type(model.gaussians)(**fields), place_fields(model.shared, representation.units, FRAME))
    seen_from = view._replace(camera=place_camera(view.camera, FRAME))
    image = representation.renderer.render(moved, seen_from, drawing.request)[0].image
    assert_allclose(image, drawing.image, atol=PARITY_FLOAT64)


# Threads


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
@pytest.mark.parametrize("name", sorted(EXTENSIONS.keys() - WITHOUT))
def test_bytes_do_not_depend_on_threads(name):
    """The kernels' renderer and stages with their gradients, over 30 tiles; in float32 rounding would hide an order."""
    extension, rng = EXTENSIONS[name], np.random.default_rng(SEED)
    representation = None if extension.representation is GAUSSIANS else extension.representation
    setting = make_setting(rng, 300, 90, 70, GSPLAT_MAIN, sh_degree=3)
    for stage in model_stages(CPU, setting, representation, extension.stages, rng):
        arrays = list(stage.inputs.values())
        v = [rng.normal(size=np.shape(value)) for value in stage.function(*arrays).outputs]
        results, n_threads = [], numba.get_num_threads()
        try:
            for n in (1, 2, 2):
                numba.set_num_threads(n)
                results.append([*stage.function(*arrays).outputs, *stage.vjp(*v)])
        finally:
            numba.set_num_threads(n_threads)
        assert sum(np.any(array) for array in results[0]) > 1, stage.name
        for one, *two in zip(*results, strict=True):
            assert all(np.asarray(one).tobytes() == np.asarray(other).tobytes() for other in two), stage.name
