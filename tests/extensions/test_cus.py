"""CUS-GS: anchors by hand, gradients, the case that is 3DGS exactly, memory and maps, and a run with its files."""

import json
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cus.gradient_checks import N_CHANNELS, small, stages
from minisplat_ref.extensions.cus.memory import (
    _read_map,
    at_pixels,
    feature_error,
    feature_map,
    first_keys,
    read,
    remember,
)
from minisplat_ref.extensions.cus.model import ANCHORS, CAMERAS, Anchors, as_anchors, decode
from minisplat_ref.extensions.cus.recipe import (
    anchor_scale,
    blended_queries,
    blended_queries_vjp,
    contributions_of,
    draw_pixels,
    feature_loss,
    prune_insignificant,
    read_memory,
    significance,
)
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io import viewpoints
from minisplat_ref.io.images import read_image
from minisplat_ref.io.ply import load_ply, read_label
from minisplat_ref.mechanisms.features.blending import blend_channels
from minisplat_ref.mechanisms.features.filters import CONSTANT
from minisplat_ref.mechanisms.networks.mlp import Layer, to_shared
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.oracle.differences import Point, settled_derivative
from minisplat_ref.oracle.gradients import inner_product_case, jacobian_case
from minisplat_ref.oracle.loss_terms import loss_stage
from minisplat_ref.oracle.models import noisy_model, training_view
from minisplat_ref.oracle.pieces import SEED, tiny_setting
from minisplat_ref.oracle.relatives import Relative, check_relative_gradients
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.oracle.tolerances import GRADIENT_REL
from minisplat_ref.rendering import SPLATTING, RenderSettings, Request, activate
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.losses import LossTerm, Rendered
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.representation import GAUSSIANS
from minisplat_ref.training.state import Iteration
from minisplat_ref.types import Gaussians, Model, RenderOutput, View, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64

RENDERER = ANCHORS.renderer
WAYS = ("Jacobian", "inner products")  # of checking a gradient


def one_child(g):
    """Anchors of one Gaussian each, at their centres, without a latent that any network reads."""
    n, dtype = len(g.means), g.means.dtype
    return Anchors(*g, latents=np.zeros((n, 2), dtype), offsets=np.zeros((n, 3), dtype))


def table_networks(n, outputs):
    """Networks of n hidden units that read a latent of one 1 among zeros, and return a row of a table for it."""
    shared = {CAMERAS: np.zeros((1, 1))}
    for name, table in outputs.items():
        weights = np.zeros((n + 4, n))
        weights[:n] = np.eye(n)
        shared |= to_shared(name, (Layer(weights, np.zeros(n)), Layer(table, np.zeros(table.shape[1]))))
    return shared


# Anchors


def test_anchors_by_hand(rng):
    """The median scale is 0.5, so voxels of two scales have a side of 1."""
    means = np.array([[0.1, 0.2, -0.3], [0.4, -0.4, 0.2], [1.9, 0, 0], [-2.8, 0, 5.2]])
    dc = np.array([[1.0, 2, 3], [3, 4, 5], [0, 0, 1], [7, 0, 0]])
    g = make_gaussians(rng, 4, sh_degree=1)._replace(means=means, sh_dc=dc, log_scales=np.full((4, 3), np.log(0.5)))
    anchors = as_anchors(g, rng, voxel=2.0, children=4, latent=5)
    assert_allclose(anchors.means, [[-3, 0, 5], [0, 0, 0], [2, 0, 0]], atol=CLOSED_FORM)
    assert_allclose(anchors.sh_dc, [[7, 0, 0], [2, 3, 4], [0, 0, 1]], rtol=CLOSED_FORM)
    assert_allclose(anchors.log_scales, np.log(1 / 2), rtol=CLOSED_FORM)  # half a voxel: there are no three neighbours
    assert_allclose(1 / (1 + np.exp(-anchors.opacity_logits)), 0.1, rtol=CLOSED_FORM)
    assert anchors.latents.shape == (3, 5) and anchors.offsets.shape == (3, 12) and anchors.sh_rest.shape == (3, 0, 3)
    assert 0.2 < np.abs(anchors.offsets).max() <= 0.5 and anchors.n_children == 4
    with pytest.raises(InputError, match="voxel=0 is above 0"):
        as_anchors(g, rng, voxel=0.0, children=4, latent=5)


def test_gaussians_are_spread_over_the_distance_of_anchors(rng):
    """Corners of a square of side 2, one of them 6 above: squared distances 4, 4, 8, and with it 36 more."""
    means = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 6]])
    g = make_gaussians(rng, 4, sh_degree=0)._replace(means=means, log_scales=np.full((4, 3), np.log(0.5)))
    anchors = as_anchors(g, rng, voxel=2.0, children=2, latent=2)
    assert_array_equal(anchors.means, means[[0, 2, 1, 3]])
    spreads = np.sqrt([(4 + 4 + 44) / 3, (4 + 8 + 40) / 3, (4 + 8 + 40) / 3, (40 + 40 + 44) / 3])
    assert_allclose(np.exp(anchors.log_scales), spreads[:, None] / 2 * np.ones(3), rtol=CLOSED_FORM)


def _steps_by_hand(g):
    """Offsets are in units of twice the scales."""
    return np.concatenate([u.reshape(-1, 3) * 2 * np.exp(s) for u, s in zip(g.offsets, g.log_scales, strict=True)])


def test_outputs_arrive_where_they_belong(rng):
    """Two anchors of two Gaussians; the second's outputs are 0.01, 0.02, and so on for each network."""
    g = as_anchors(make_gaussians(rng, 2, sh_degree=0), rng, voxel=1e-3, children=2, latent=2)
    g = g._replace(latents=np.eye(2))
    tables = {}
    for name, width in (("opacity", 2), ("shape", 14), ("color", 6)):
        tables[name] = np.stack([np.zeros(width), 0.01 * np.arange(1, 1 + width)])
    seen = decode(Model(g, table_networks(2, tables)), view_from(make_camera()), IN_NUMPY).gaussians
    assert_allclose(seen.means, np.repeat(g.means, 2, axis=0) + _steps_by_hand(g), rtol=CLOSED_FORM)
    assert_allclose(seen.opacity_logits - g.opacity_logits[[0, 0, 1, 1]], [0, 0, 0.01, 0.02], atol=CLOSED_FORM)
    of_scales = [[0.01, 0.02, 0.03], [0.08, 0.09, 0.1]]
    of_quats = [[1.04, 0.05, 0.06, 0.07], [1.11, 0.12, 0.13, 0.14]]
    assert_allclose(seen.log_scales[2:] - g.log_scales[1], of_scales, atol=CLOSED_FORM)
    assert_allclose(seen.quats[2:], of_quats, rtol=CLOSED_FORM)
    assert_allclose(seen.sh_dc[2:] - g.sh_dc[1], [[0.01, 0.02, 0.03], [0.04, 0.05, 0.06]], atol=CLOSED_FORM)
    assert_array_equal(seen.log_scales[:2], g.log_scales[[0, 0]])


def test_with_a_table_for_networks_it_is_3dgs_to_the_byte(rng):
    """Latents of one 1 among zeros make of any networks tables, and of anchors any Gaussians whatever."""
    g = as_dtype(make_gaussians(rng, 12, sh_degree=0), np.float32)
    base = Gaussians(*(np.zeros_like(field) for field in g))._replace(means=g.means)
    anchors = one_child(base)._replace(latents=np.eye(12, dtype=np.float32))
    shape = np.concatenate([g.log_scales, g.quats], axis=1)
    tables = {"opacity": g.opacity_logits[:, None], "shape": shape, "color": g.sh_dc}
    model = Model(anchors, {k: v.astype(np.float32) for k, v in table_networks(12, tables).items()})
    view, request = view_from(make_camera()), Request(backend=CPU)
    (ours, tape), (theirs, plain) = RENDERER.render(model, view, request), SPLATTING.render(Model(g), view, request)
    assert ours.image.tobytes() == theirs.image.tobytes() and ours.image.max() > 0.1
    assert_array_equal(ours.visible_ids, theirs.visible_ids)
    v_image = np.ones_like(ours.image)
    v, v_plain = RENDERER.render_vjp(tape, v_image, None), SPLATTING.render_vjp(plain, v_image, None)
    assert v.shared["color_weights_1"].tobytes() == v_plain.gaussians.sh_dc.tobytes()
    assert v.gaussians.log_scales.tobytes() == v_plain.gaussians.log_scales.tobytes()
    assert v.means2d.tobytes() == v_plain.means2d.tobytes()


def test_a_file_alone_shows_what_anchors_begin_with(rng):
    g = as_dtype(make_gaussians(rng, 12, sh_degree=0), np.float32)
    view, request = view_from(make_camera()), Request(backend=CPU)
    ours, theirs = (r.render(Model(p), view, request)[0] for r, p in ((RENDERER, one_child(g)), (SPLATTING, g)))
    assert ours.image.tobytes() == theirs.image.tobytes()


@pytest.mark.parametrize(("name", "value"), [("similarity", 1.5), ("hidden", 0), ("query", -1), ("embedding", 0)])
def test_bad_settings(name, value, scene, rng):
    with pytest.raises(InputError, match=f"{name}={value}"):
        configure(find_recipe("cus"), **{name: value}).representation.shared(scene, rng)


def test_an_unseen_photograph_has_the_mean_embedding(rng):
    model, _ = noisy_model(tiny_setting(), training_view(make_camera()), small(rng), rng)
    shared = {**model.shared, CAMERAS: np.array([[1.0, -2.0, 0.5, 0.0], [3.0, 4.0, 0.5, 2.0]])}
    mean = {**shared, CAMERAS: np.array([[2.0, 1.0, 0.5, 1.0]])}
    camera = make_camera()
    unseen = decode(model._replace(shared=shared), view_from(camera), IN_NUMPY).gaussians
    known = decode(model._replace(shared=mean), view_from(camera)._replace(view_id=0), IN_NUMPY).gaussians
    assert_allclose(unseen.sh_dc, known.sh_dc, rtol=CLOSED_FORM)
    other = decode(model._replace(shared=shared), view_from(camera)._replace(view_id=1), IN_NUMPY).gaussians
    assert np.abs(other.sh_dc - known.sh_dc).max() > 0.01


def test_statistics_are_those_of_anchors(rng):
    g = as_anchors(make_gaussians(rng, 6, sh_degree=0), rng, voxel=1.0, children=2, latent=2)
    g = g._replace(log_scales=g.log_scales - np.log(4))  # so small that some pixels show none
    model, view = Model(g), view_from(make_camera())
    output, tape = RENDERER.render(model, view, Request(backend=CPU, wants=frozenset({"stats"})))
    inner, _ = SPLATTING.render(Model(tape.decoded.gaussians), view, Request(backend=CPU, wants=frozenset({"stats"})))
    n = len(model.gaussians.means)
    assert output.stats.blend_weight_sum.shape == (n,)
    assert_allclose(output.stats.blend_weight_sum.sum(), output.alpha.sum(), rtol=1e-9)
    assert_array_equal(output.stats.hit_count, inner.stats.hit_count[0::2] + inner.stats.hit_count[1::2])
    assert output.stats.dominant_ids.max() < n and output.stats.dominant_ids.min() == -1
    hidden = np.arange(n) != output.stats.dominant_ids.max()
    without, _ = RENDERER.render(model, view, Request(backend=CPU, is_visible=hidden))
    assert output.stats.dominant_ids.max() not in without.visible_ids


# Gradients and backends


@pytest.mark.parametrize(("number", "backend"), [(0, REFERENCE), (1, REFERENCE), (2, REFERENCE), (3, CPU)])
def test_gradients(number, backend, rng):
    """The renderer with every parameter, the blended queries, the reading of the memory, and the loss of features."""
    case = jacobian_case(stages(backend, tiny_setting(GSPLAT_MAIN), rng)[number])
    assert case.passed, case


@pytest.mark.parametrize("number", [0, 1, 3])
def test_gradients_are_checked_far_from_thresholds_and_rounding(number):
    """Along random directions, no step is so small that the wider limit counts, and a fifth of the limit is enough."""
    rng = np.random.default_rng(SEED)
    larger = make_setting(rng, 60, 40, 30, GSPLAT_MAIN, sh_degree=3)
    case = inner_product_case(stages(CPU, larger, rng)[number], rng)
    assert case.passed and case.figures["limit"] == GRADIENT_REL, case
    assert case.figures["error"] < GRADIENT_REL / 5 and case.figures["step"] >= 1e-6, case


def test_the_oracle_leaves_the_loss_of_features_to_the_stage(monkeypatch):
    """A stage with the name of a term replaces its check; the other term is checked as before."""
    stage = Stage("loss term feature_loss", {"x": np.ones(1)}, ("y",), lambda x: Point((3 * x,)), lambda v: (3 * v,))
    own = [stage.name for stage in stages(CPU, tiny_setting(GSPLAT_MAIN), np.random.default_rng(SEED))]
    assert own == ["render anchors", "blended_queries", "read", stage.name]
    plain = Relative("cus", GAUSSIANS, find_recipe("cus").losses, (), lambda *_: (stage,))
    names = [case.name for case in check_relative_gradients((CPU,), GSPLAT_MAIN, plain).cases]
    assert [name for name in names if "feature_loss" in name] == [f"{stage.name}: {kind}" for kind in WAYS]
    assert [name for name in names if "anchor_scale" in name] == [f"loss term anchor_scale: {kind}" for kind in WAYS]


def test_the_gradient_of_the_feature_loss(rng, tmp_path):
    """Along a random direction of everything on which it depends, with a given map and the mask of the check."""
    setting = tiny_setting(GSPLAT_MAIN)
    np.save(tmp_path / "a.npy", rng.normal(size=(7, 9, N_CHANNELS)))
    term = LossTerm("feature_loss", partial(feature_loss, features=str(tmp_path), samples=30), 1.0)
    stage = loss_stage(term, REFERENCE, setting, small(rng), rng)
    read = {"latents", "offsets", "opacity_weights_0", "shape_biases_1", "query_weights_1", "memory", "adapter"}
    assert read < stage.inputs.keys() and not any(name.startswith("color") for name in stage.inputs)
    case = inner_product_case(stage, rng, settled_derivative)
    assert case.passed, case


def test_backends_agree(rng):
    view = training_view(make_camera())
    model, _ = noisy_model(tiny_setting(), view, small(rng), rng)
    v_image, v_queries = rng.normal(size=(18, 24, 3)), rng.normal(size=(18, 24, 4))
    results = []
    for backend in (CPU, REFERENCE):
        request = Request(backend=backend)
        output, tape = RENDERER.render(model, view, request)
        v = RENDERER.render_vjp(tape, v_image, None)
        queries, of_queries = blended_queries(model, view, request)
        anchors, shared = blended_queries_vjp(of_queries, v_queries)
        both = [v.shared[name] for name in sorted(v.shared)] + [shared[name] for name in sorted(shared)]
        results.append([output.image, queries, *v.gaussians, *anchors, *both])
    assert np.abs(results[0][1]).max() > 0.01
    for ours, theirs in zip(*results, strict=True):
        assert_allclose(ours, theirs, atol=PARITY_FLOAT64 * np.abs(theirs).max(initial=1e-9))


def test_channels_are_blended_as_colors_are(rng):
    """Four channels in two passes, against the colours of 3DGS; those of one Gaussian are its weights."""
    g, view, request = make_gaussians(rng, 10, sh_degree=0), view_from(make_camera()), Request(backend=REFERENCE)
    channels = rng.uniform(size=(10, 4))
    blended, _ = blend_channels(activate(g), channels, view.camera, request)
    for columns in ((0, 1, 2), (3, 3, 3)):
        colored = g._replace(sh_dc=(channels[:, columns] - 0.5) / SH_C0)
        image = SPLATTING.render(Model(colored), view, request)[0].image
        assert_allclose(blended[..., columns], image, atol=PARITY_FLOAT64)


# The memory


def test_what_is_remembered_by_hand():
    """Of cosines 0.6, 0.8 and 1 with what is kept before, those below 0.7 are new; length does not matter."""
    rows = np.array([[2.0, 0], [0.6, 0.8], [5, 0], [0.8, 0.6], [-1, 0], [0, 0]])
    assert_allclose(remember([rows], 0.7), [[2, 0], [0.6, 0.8], [-1, 0], [0, 0]])
    assert_allclose(remember([rows[:1], rows[1:]], 0.5), [[2, 0], [-1, 0], [0, 0]])
    many = np.random.default_rng(0).normal(size=(3000, 3))
    kept = remember([many], 0.9)
    units = kept / np.linalg.norm(kept, axis=1, keepdims=True)
    assert (np.triu(units @ units.T, 1) < 0.9).all()
    assert ((many @ units.T).max(axis=1) >= 0.9 * np.linalg.norm(many, axis=1) - 1e-12).all()


def test_no_more_is_remembered_than_there_is_room_for(monkeypatch, rng):
    monkeypatch.setattr("minisplat_ref.extensions.cus.memory.ROWS_MAX", 7)
    assert remember([rng.normal(size=(100, 4))], 1.0).shape == (7, 4)


def test_keys_have_a_mean_square_of_one(rng):
    memory = rng.normal(size=(40, 3)) @ np.diag([5, 0.1, 1.0])
    keys = memory @ first_keys(memory, 5)
    assert_allclose(np.mean(keys**2, axis=0), [1, 1, 1, 0, 0], atol=1e-12)
    assert_allclose(np.abs(first_keys(np.ones((4, 2)), 2)), [[0.5, 0], [0.5, 0]], atol=1e-12)


def test_reading_by_hand():
    """A query of 2 ln 3 along one of two keys, of dimension 4: weights 3/4 and 1/4."""
    memory, keys = np.array([[1.0, 0], [0, 1]]), np.eye(2, 4)
    query = np.array([[2 * np.log(3), 0, 7, 0]])
    found, _ = read(query, memory, keys, np.array([[1.0, 0], [2, 1]]))
    assert_allclose(found, [[0.75 + 2 * 0.25, 0.25]], rtol=CLOSED_FORM)
    value, _ = feature_error(np.array([[0.0, 2]]), np.array([[3.0, 4]]))
    assert_allclose(value, (9 + 4) / 2 + 1 - 0.8, rtol=1e-6)  # the floor of lengths
    value, _ = feature_error(np.array([[0.0, 2], [5, 0]]), np.array([[3.0, 4], [1, 0]]))
    assert_allclose(value, (9 + 4 + 16) / 4 + 1 - (0.8 + 1) / 2, rtol=1e-6)


# Maps


def photograph(image):
    return View("a", make_camera(), image, None, view_id=0)


def test_classical_maps_are_where_the_photograph_is():
    """Along a ramp of one level per pixel the mean colour is that of the pixel, at every scale but for the borders."""
    ramp = np.tile(np.arange(100, dtype=np.uint8)[None, :, None], (60, 1, 3))
    for image, turn in ((ramp, False), (ramp.transpose(1, 0, 2), True)):
        found = feature_map(photograph(np.ascontiguousarray(image)), "")
        assert found.shape == (*image.shape[:2], 22) and found.dtype == np.float32
        found = found.transpose(1, 0, 2) if turn else found
        inside = (slice(None), slice(30, 70))
        for first in (0, 7, 14):
            assert_allclose(found[(*inside, first)], 2 * ramp[(*inside, 0)] / 255 - 1, atol=1e-4)
    assert_array_equal(found[..., -1], CONSTANT)


def test_classical_maps_know_the_direction_of_stripes():
    """Energies are channels 3 to 6 of the finest scale: the first is of waves along a row."""
    x = np.tile(np.arange(64), (48, 1))
    image = (255 * (0.5 + 0.5 * np.cos(2 * np.pi * x / 4.5)))[..., None].repeat(3, axis=2).astype(np.uint8)
    row = feature_map(photograph(image), "")[24, 20:44, 3:7]
    assert (np.argmax(row, axis=1) == 0).all() and (row[:, 0] > 3 * row[:, 2]).all()
    assert np.ptp(row[:, 0]) < 0.2 * row[:, 0].mean()  # wherever in a stripe the pixel is


def test_cells_of_a_coarse_map():
    """Six columns of pixels over a map of two, and five rows over two: the middle is the second."""
    coarse = np.arange(4.0).reshape(2, 2, 1)
    pixels = np.array([[0, 0], [1, 2], [1, 3], [2, 2], [4, 5]])
    assert at_pixels(coarse, pixels, 5, 6)[:, 0].tolist() == [0, 0, 1, 2, 3]
    middle = np.array([[0, 0], [0, 1], [1, 1]])  # of three columns over two, the middle one is the second's, too
    assert at_pixels(coarse, middle, 3, 3)[:, 0].tolist() == [0, 1, 3]


def test_given_maps(tmp_path):
    array = np.arange(24.0).reshape(2, 3, 4)
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "b.npz", features=array + 1)
    assert_array_equal(feature_map(photograph(np.zeros((18, 24, 3), np.uint8)), str(tmp_path)), array)
    assert_array_equal(_read_map(tmp_path, "b"), array + 1)


def bad_maps(folder):
    np.save(folder / "flat.npy", np.zeros((3, 4)))
    np.save(folder / "nan.npy", np.full((2, 2, 2), np.nan))
    np.savez(folder / "two.npz", a=np.zeros((1, 1, 1)), b=np.zeros((1, 1, 1)))
    (folder / "text.npy").write_text("no array")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none", "none.npy cannot be read as an array: give every photograph NAME.npy or NAME.npz"),
        ("text", "text.npy cannot be read"),
        ("flat", r"flat.npy is float64 \(3, 4\)"),
        ("nan", "nan.npy has features that are not finite"),
        ("two", "two.npz holds 2 arrays"),
    ],
)
def test_bad_maps(name, message, tmp_path):
    bad_maps(tmp_path)
    with pytest.raises(InputError, match=message):
        _read_map(tmp_path, name)


def test_pixels_outside_a_mask_are_not_compared():
    view = photograph(np.zeros((18, 24, 3), np.uint8))
    mask = np.zeros((18, 24), bool)
    mask[3, 4:9] = True
    assert draw_pixels(view._replace(mask=mask), 100, 1).tolist() == [[3, x] for x in range(4, 9)]
    drawn = draw_pixels(view, 50, 1)
    assert len(np.unique(drawn, axis=0)) == 50 and (drawn != draw_pixels(view, 50, 2)).any()


# Losses and pruning


def test_the_size_of_anchors_by_hand(rng):
    """Scales are twice and a half of a hundredth of the extent."""
    g = as_anchors(make_gaussians(rng, 2, sh_degree=0), rng, voxel=1e-3, children=2, latent=2)
    g = g._replace(log_scales=np.log([[0.08, 0.08, 0.08], [0.02, 0.02, 0.04]]))
    scene = make_scene("room", n_views=2, width=8, height=8, supersampling=1, n_points=4, test_every=0).scene
    view = photograph(np.zeros((18, 24, 3), np.uint8))
    output = RenderOutput(np.zeros((18, 24, 3)), np.zeros((18, 24)), None, None)
    rendered = Rendered(output, {"rgb": slice(0, 3)}, view, scene._replace(extent=4.0), Model(g), 1, Request())
    value, v = anchor_scale(rendered)
    assert_allclose(value, (8 + 0.25) / 2, rtol=1e-9)
    assert_allclose(v.gaussians["log_scales"], [[4] * 3, [0.125] * 3], rtol=1e-9)


def test_significance_by_hand():
    """Norms 5, 0, 10 and 1, 2, 0 of means 5 and 1, contributions of mean 2."""
    latents, v = np.array([[3.0, 4], [0, 0], [6, 8]]), np.array([[1.0, 0], [0, 2], [0, 0]])
    expected = [2 * 1 + 8 * 1 + 0, 0 + 8 * 2 + 0.5, 2 * 2 + 0 + 2.5]
    assert_allclose(significance(latents, v, np.array([0.0, 1, 5])), expected, rtol=CLOSED_FORM)


def test_contributions_by_hand(rng):
    """The quantile of volumes of eleven Gaussians, the last as large as ten others, is 1; opacities are a half."""
    g = make_gaussians(rng, 12, sh_degree=0)._replace(opacity_logits=np.zeros(12))
    log_scales = np.zeros((12, 3))
    log_scales[0] = -np.log(2)
    log_scales[11] = np.log(9)
    found = contributions_of(g._replace(log_scales=log_scales), np.arange(12), 3)
    assert_allclose(found, [0.5 * (0 / 8 + 1 + 2), 6, 10.5, 15], rtol=CLOSED_FORM)


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=6, width=48, height=40, supersampling=1, n_points=60).scene


SMALL = {"children": 2, "latent": 3, "hidden": 4, "embedding": 2, "query": 3}


def test_the_least_significant_anchors_go(scene):
    recipe = configure(find_recipe("cus"), **SMALL)
    state = initial_state(scene, recipe, seed=0)
    n = len(state.gaussians.means)
    state.adam.first.latents[:] = 1.0
    state.gaussians.latents[:] = 1.0
    weak = [3, n - 2]
    state.adam.first.latents[weak] = state.gaussians.latents[weak] = 0
    rest = np.delete(state.gaussians.means, weak, axis=0)
    settings = RenderSettings(scene.background, renderer=recipe.renderer)
    nothing = np.zeros(0, np.int64)
    output = RenderOutput(np.zeros((1, 1, 3)), np.zeros((1, 1)), None, None)
    iteration = Iteration(scene, scene.train_views[0], output, nothing, np.zeros((n, 2)), settings)
    prune_insignificant(state, iteration, share=1.5 / n)
    assert_array_equal(state.gaussians.means, rest)
    assert len(state.adam.first.latents) == n - 2
    strong = len(rest) // 2  # the only one that photographs show well
    state.gaussians.opacity_logits[:] = -4.0
    state.gaussians.opacity_logits[strong] = 4.0
    state.gaussians.log_scales[strong] += 1.0
    prune_insignificant(state, iteration, share=(n - 3) / (n - 2))
    assert_array_equal(state.gaussians.means, rest[[strong]])
    assert prune_insignificant(state, iteration, share=0.5).startswith("nothing done")


# Runs


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A run with given features: one channel is the lightness, two are constant."""
    folder = tmp_path_factory.mktemp("cus")
    sizes = ["--views", "6", "--width", "48", "--height", "40", "--points", "60", "--supersampling", "1"]
    assert main(["synthetic", "room", "--out", str(folder / "room"), *sizes]) == 0
    (folder / "maps").mkdir()
    for path in sorted((folder / "room" / "images").iterdir()):
        lightness = read_image(path).mean(axis=2, keepdims=True)[::2, ::2] / 255
        np.save(
            folder / "maps" / f"{path.stem}.npy", np.concatenate([lightness, 0 * lightness + 0.5, 1 - lightness], 2)
        )
    sets = [word for name, value in SMALL.items() for word in ("--set", f"{name}={value}")]
    options = ["--iterations", "60", "--set", f"features={folder / 'maps'}", *sets, "--out", str(folder / "run")]
    assert main(["train", str(folder / "room"), "--recipe", "cus", "--test-every", "3", *options]) == 0
    return folder / "run"


def test_a_file_says_that_it_lacks_the_network(run_folder, capfd):
    label = read_label(run_folder / "point_cloud.ply")
    assert label.extension == "cus" and label.lacks == ("network",)
    anchors = load_ply(run_folder / "point_cloud.ply", Anchors)
    assert anchors.offsets.shape[1] == 6 and anchors.latents.shape[1] == 3
    with np.load(run_folder / "shared.npz") as stored:
        assert stored["memory"].shape[1] == 3 and np.abs(stored["color_weights_1"]).max() > 0
    before = json.loads((run_folder / "metrics.json").read_text())["psnr"]
    assert main(["eval", str(run_folder)]) == 0
    assert json.loads((run_folder / "metrics.json").read_text())["psnr"] == before


def test_features_of_a_run_are_what_its_views_read(run_folder, tmp_path, capfd):
    assert main(["cus", "features", str(run_folder), "--out", str(tmp_path / "found")]) == 0
    names = sorted(path.stem for path in (tmp_path / "found").iterdir())
    assert f"features of {len(names)} views, 3 channels, in" in capfd.readouterr().out
    assert names == sorted(path.stem for path in (run_folder.parent / "maps").iterdir())
    with np.load(run_folder / "shared.npz") as stored:
        model = Model(load_ply(run_folder / "point_cloud.ply", Anchors), dict(stored))
    viewpoint = viewpoints.read(run_folder / "cameras.json")[1]
    queries, _ = blended_queries(model, view_from(viewpoint.camera), Request())
    found = np.load(tmp_path / "found" / f"{viewpoint.name}.npy")
    expected, _ = read_memory(queries.reshape(-1, 3), model.shared)
    assert_allclose(found, expected.reshape(40, 48, 3), atol=1e-6)
    assert found[..., 0].std() > 1e-4
    for arguments, expected in (
        ([str(run_folder / "point_cloud.ply")], "a PLY alone has no memory"),
        ([str(run_folder)], "already there"),
    ):
        assert main(["cus", "features", *arguments, "--out", str(tmp_path / "found")]) == 2
        assert expected in capfd.readouterr().err


def test_maps_of_different_depth_are_refused(run_folder, tmp_path, capfd):
    names = sorted(path.stem for path in (run_folder.parent / "maps").iterdir())
    for k, name in enumerate(names):
        np.save(tmp_path / f"{name}.npy", np.ones((2, 2, 3 + (k == len(names) - 1))))
    words = ["--set", f"features={tmp_path}", "--iterations", "2", "--test-every", "0", "--out", str(tmp_path / "no")]
    assert main(["train", str(run_folder.parent / "room"), "--recipe", "cus", *words]) == 2
    assert f"the map of photograph {names[-1]} has 4 channels, that of {names[0]} 3" in capfd.readouterr().err
    assert not (tmp_path / "no").exists()


def test_features_of_another_recipe_are_refused(run_folder, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr("minisplat_ref.extensions.cus.recipe.CUS", find_recipe("cus")._replace(name="other"))
    assert main(["cus", "features", str(run_folder), "--out", str(tmp_path / "no")]) == 2
    assert "was trained by recipe cus, without features" in capfd.readouterr().err and not (tmp_path / "no").exists()
