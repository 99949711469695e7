"""CUS-GS in its parts: statistics, embeddings, maps at their borders, the recipe's numbers, by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cus.gradient_checks import small
from minisplat_ref.extensions.cus.memory import _read_map, feature_map, sample_rows
from minisplat_ref.extensions.cus.model import ANCHORS, CAMERAS, MEMORY, as_anchors, decode, decode_vjp
from minisplat_ref.extensions.cus.recipe import (
    blended_queries,
    feature_loss,
    grow_anchors,
    prune_insignificant,
)
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.oracle.models import noisy_model, training_view
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.recipe_settings import configure, settings_of
from minisplat_ref.training.schedule import firing_steps
from minisplat_ref.types import Gaussians, Model, RenderOutput, View, view_from
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM

RENDERER = ANCHORS.renderer
SMALL = {"children": 2, "latent": 3, "hidden": 4, "embedding": 2, "query": 3}


@pytest.fixture(scope="module")
def made():
    return make_scene("room", n_views=6, width=48, height=40, supersampling=1, n_points=60)


def small_model(rng):
    return noisy_model(tiny_setting(), training_view(make_camera()), small(rng), rng)[0]


# Decoding and rendering


def test_the_gradient_of_an_unseen_photograph_is_shared_by_all_embeddings(rng):
    """The mean of two embeddings moves by half of what either does."""
    model = small_model(rng)
    embeddings = rng.normal(size=(2, 4))
    two, one = ({**model.shared, CAMERAS: a} for a in (embeddings, embeddings.mean(axis=0, keepdims=True)))
    unseen, known = view_from(make_camera()), training_view(make_camera())
    decoded = decode(model._replace(shared=two), unseen, IN_NUMPY)
    v = Gaussians(*(rng.normal(size=field.shape) for field in decoded.gaussians))
    found = decode_vjp(decoded, v).shared[CAMERAS]
    expected = decode_vjp(decode(model._replace(shared=one), known, IN_NUMPY), v).shared[CAMERAS]
    assert_allclose(found, np.repeat(expected / 2, 2, axis=0), rtol=1e-9)
    assert np.abs(expected).min() > 1e-3


def test_anchors_that_are_not_rendered_blend_no_queries(rng):
    model, view = small_model(rng), training_view(make_camera())
    is_visible = np.arange(len(model.gaussians.means)) != 1
    hidden, _ = blended_queries(model, view, Request(backend=CPU, is_visible=is_visible))
    fewer = model._replace(gaussians=take(model.gaussians, is_visible))
    without, _ = blended_queries(fewer, view, Request(backend=CPU))
    assert_allclose(hidden, without, atol=CLOSED_FORM)
    assert np.abs(hidden - blended_queries(model, view, Request(backend=CPU))[0]).max() > 0.01


def test_statistics_of_anchors_are_sums_or_the_largest(rng):
    g = as_anchors(make_gaussians(rng, 6, sh_degree=0), rng, voxel=1.0, children=2, latent=2)
    request = Request(backend=CPU, wants=frozenset({"stats", "removal_changes"}))
    output, tape = RENDERER.render(Model(g), view_from(make_camera()), request)
    inner, _ = SPLATTING.render(Model(tape.decoded.gaussians), view_from(make_camera()), request)
    ours, theirs = output.stats, inner.stats
    pairs = theirs.blend_weight_max.reshape(-1, 2)
    assert_array_equal(ours.blend_weight_max, np.maximum(pairs[:, 0], pairs[:, 1]))
    assert (pairs[:, 0] != pairs[:, 1]).any()
    for found, of_children in (
        (ours.dominant_count, theirs.dominant_count),
        (output.extras["removal_changes"], inner.extras["removal_changes"]),
    ):
        assert_allclose(found, of_children[0::2] + of_children[1::2], rtol=CLOSED_FORM)
        assert found.max() > 0


# The recipe and what it begins with


def test_the_recipe_by_its_numbers():
    recipe = find_recipe("cus", 30_000)
    weights = {term.name: term.weight for term in recipe.losses}
    assert weights == {"photometric": 1.0, "feature_loss": 0.1, "anchor_scale": 0.01}
    assert firing_steps(recipe, prune_insignificant) == list(range(2_000, 15_000, 1_000))
    settings = settings_of(recipe)
    expected = {"children": 10, "latent": 32, "hidden": 32, "embedding": 32, "query": 15, "similarity": 0.9}
    expected |= {"voxel": 1.0, "share": 0.001, "samples": 2_048, "growth_threshold": 2e-4}
    assert {name: settings[name] for name in expected} == expected
    assert len(firing_steps(recipe, grow_anchors)) == 134 and recipe.sh_degree == 0
    first, last = recipe.rates.at(1, 2.0), recipe.rates.at(30_000, 2.0)
    still = ("means", "quats", "opacity_logits", "sh_dc", "sh_rest", "memory")
    assert all(first[name] == 0 for name in still)
    assert first["latents"] == last["latents"] == 7.5e-3 and first["log_scales"] == 7e-3
    assert_allclose([first["offsets"], last["offsets"]], [2 * 1e-2, 2 * 1e-4], rtol=1e-3)
    by_name = {"color_weights_0": 8e-3, "shape_biases_1": 4e-3, "query_weights_1": 5e-3, "memory_keys": 1e-2}
    assert_allclose([first[name] for name in by_name], list(by_name.values()), rtol=1e-3)
    assert "offsets" not in ANCHORS.units and ANCHORS.units["means"] == Unit.PLACE  # they are in units of scales


def test_what_training_begins_with(made, rng):
    """Networks whose outputs are 0 but for the query, of which the mixture takes all and no offsets."""
    shared = configure(find_recipe("cus"), **SMALL).representation.shared(made.scene, rng)
    assert_array_equal(shared["query_mix_weights_0"], np.eye(6, 3))
    for name in ("opacity", "shape", "color"):
        assert not shared[f"{name}_weights_1"].any() and shared[f"{name}_weights_0"].any()
    assert shared["query_weights_1"].any() and not shared[CAMERAS].any()
    assert shared[CAMERAS].shape == (len(made.scene.train_views), 2) and shared["shape_weights_1"].shape == (4, 14)
    many = make_gaussians(rng, 400, sh_degree=0)
    anchors = as_anchors(many, rng, voxel=1e-3, children=2, latent=50)
    assert abs(np.std(anchors.latents) - 0.1) < 0.005
    with pytest.raises(InputError, match=r"similarity=-1\.5"):
        configure(find_recipe("cus"), **SMALL, similarity=-1.5).representation.shared(made.scene, rng)


def test_photographs_that_are_smaller_than_the_filters_have_no_error(rng):
    """At the filters' size there is a map, here of another depth than the memory, which is refused."""
    model = small_model(rng)
    for side, is_compared in ((CLASSICAL.min_side - 1, False), (CLASSICAL.min_side, True)):
        camera = make_camera()._replace(width=60, height=side)
        view = View("a", camera, np.zeros((side, 60, 3), np.uint8), None, view_id=0)
        output = RenderOutput(np.zeros((side, 60, 3)), np.zeros((side, 60)), None, None)
        rendered = Rendered(output, {"rgb": slice(0, 3)}, view, None, model, 1, Request())
        if is_compared:
            with pytest.raises(InputError, match="has 22 channels"):
                feature_loss(rendered, features="", samples=9)
        else:
            assert feature_loss(rendered, features="", samples=9)[0] == 0
    assert model.shared[MEMORY].shape[1] != 22


# Maps


def photograph(image):
    return View("a", make_camera(), np.ascontiguousarray(image), None, view_id=0)


@pytest.mark.parametrize("width", range(60, 64))
def test_maps_reach_both_borders(width):
    """A ramp and its mirror image have mirrored maps of colours, whatever the place of the last response."""
    ramp = np.tile((4 * np.arange(width)).astype(np.uint8)[None, :, None], (40, 1, 3))
    found, mirrored = (feature_map(photograph(image), "")[20] for image in (ramp, ramp[:, ::-1]))
    for first in (0, 7, 14):
        assert_allclose(found[[0, -1], first], mirrored[[-1, 0], first], atol=0.01)


def test_photographs_with_the_same_bytes_but_another_shape_have_other_maps():
    image = (np.arange(40 * 60 * 3) % 251).astype(np.uint8).reshape(40, 60, 3)
    assert feature_map(photograph(image), "").shape == (40, 60, 22)
    assert feature_map(photograph(image.reshape(60, 40, 3)), "").shape == (60, 40, 22)


def test_an_npy_comes_before_an_npz(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((1, 2, 3)))
    np.savez(tmp_path / "a.npz", features=np.zeros((1, 2, 3)))
    assert _read_map(tmp_path, "a").sum() == 6


def test_features_are_sampled_without_replacement(rng):
    few = np.arange(24.0).reshape(3, 4, 2)
    assert_array_equal(np.sort(sample_rows(few, rng), axis=0), few.reshape(12, 2))
    many = np.arange(50.0 * 50).reshape(50, 50, 1)
    drawn = sample_rows(many, rng)
    assert drawn.shape == (2_048, 1) and len(np.unique(drawn)) == 2_048 and drawn.max() > 2_048


# The study
