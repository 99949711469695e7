"""OMG's networks and codebooks: decoding by hand, the events that start them, and what must equal 3DGS exactly."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.omg import trained_file
from minisplat_ref.extensions.omg.codes import QUAT_MIN
from minisplat_ref.extensions.omg.model import (
    COMPACT,
    PLACE,
    OmgGaussians,
    add_features,
    decode,
    decode_vjp,
    encode_places,
    gather,
    gather_vjp,
    measure_place,
    run_networks,
    split_codes,
    without_features,
)
from minisplat_ref.extensions.omg.recipe import (
    fit_last_layer,
    prune_indistinct,
    round_centres,
    start_codes,
    start_networks,
    write_fields,
)
from minisplat_ref.mechanisms.networks.networks import COMPILED, IN_NUMPY
from minisplat_ref.methods.mini_splatting import MINI_SPLATTING, restart_from_means
from minisplat_ref.rendering import SPLATTING, RenderSettings, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.strategy.importance import indoor
from minisplat_ref.strategy.ops import keep
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import action_name, scale_recipe, without
from minisplat_ref.training.state import Iteration, apply_edit
from minisplat_ref.types import FILE_FRAME, Gaussians, Model, Scene, View
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, HALF_FLOAT, PARITY_FLOAT32_GRADIENT


def row(*numbers):
    return np.array([numbers], np.float64)


# Decoding


def tiny_networks():
    """Networks with one hidden number; F is always 2."""
    harmonics = np.zeros((1, 45))
    harmonics[0, 44] = 1
    return {
        **{"space_weights_0": np.zeros((6, 1)), "space_biases_0": np.ones(1)},
        **{"space_weights_1": row(2), "space_biases_1": np.zeros(1)},
        **{"color_weights_0": row(1, 0, 0, 1).T, "color_biases_0": np.zeros(1)},
        **{"color_weights_1": row(1, 2, 3), "color_biases_1": np.array([0, 0, 10.0])},
        **{"opacity_weights_0": row(0, -1, 0, 0).T, "opacity_biases_0": np.zeros(1)},
        **{"opacity_weights_1": row(100), "opacity_biases_1": np.array([1.0])},
        **{"harmonics_weights_0": row(0, 0, 1, 1).T, "harmonics_biases_0": np.zeros(1)},
        **{"harmonics_weights_1": harmonics, "harmonics_biases_1": np.zeros(45)},
    }


@pytest.mark.parametrize("networks", [IN_NUMPY, COMPILED], ids=["NumPy", "kernels"])
def test_decoding_by_hand(networks):
    """T = (5, 3, 0) and V = (0, 0, 7): hidden numbers are 5 + 2, -3 through a leak of 0.01, and 7 + 2."""
    decoded = run_networks(row(5, 3, 0, 0, 0, 7), np.zeros((1, 6)), tiny_networks(), networks)
    assert_allclose(decoded.color, [[7, 14, 31]], rtol=CLOSED_FORM)
    assert_allclose(decoded.logits, [1 - 3], rtol=CLOSED_FORM)
    assert_allclose(decoded.harmonics[0, [0, 43, 44]], [0, 0, 9], rtol=CLOSED_FORM)


def test_places_by_hand():
    """Two units from the centre at a radius of 2 is the edge of the ball; one at 5 radii comes to 1.8."""
    shared = {**tiny_networks(), PLACE: np.array([1.0, 0, 0, 0.5])}
    found = encode_places(np.array([[3.0, 0, 0], [1, 10, 0]]), shared, IN_NUMPY)
    root = np.sin(0.2 * np.pi)
    assert_allclose(found, [[0, -1, 0, 1, 0, 1], [0, 1, -root, np.cos(0.2 * np.pi), 0, 1]], atol=CLOSED_FORM)


def test_the_place_of_a_scene():
    points = np.array([[x, 1.0, 1] for x in range(-5, 6)])
    scene = Scene("a", (), (), points, np.zeros((11, 3), np.uint8), np.zeros(3), extent=4.0)
    assert_allclose(measure_place(scene), [0, 1, 1, 1 / 5], rtol=CLOSED_FORM)
    assert_allclose(measure_place(scene._replace(points=points[:0])), [0, 0, 0, 1 / 4])
    assert_allclose(measure_place(scene._replace(points=points[:1])), [-5, 1, 1, 1 / 4])


def test_codes_by_hand():
    books = np.array([[[1.0, 2], [3, 4]], [[5, 6], [7, 8]]])
    indices = np.array([[1, 0], [1, 1], [0, 0]])
    assert_array_equal(gather(books, indices), [[3, 4, 5, 6], [3, 4, 7, 8], [1, 2, 5, 6]])
    v = np.arange(12.0).reshape(3, 4)
    assert_array_equal(gather_vjp(books, indices, v), [[[8, 9], [4, 6]], [[12, 14], [6, 7]]])


def test_columns_of_codes_are_read_as_the_nearest_whole_numbers():
    shared = {"a": np.zeros((2, 3, 1)), "b": np.zeros((1, 3, 1))}
    found = split_codes(row(0.9999, 2.0001, 1), shared, ("a", "b"))
    assert {name: rows.tolist() for name, rows in found.items()} == {"a": [[1, 2]], "b": [[1]]}


# What must equal 3DGS


def drawn(renderer, model, backend):
    """Image and gradient of a rendering, in float32."""
    camera = make_camera(40, 30)
    view = View("a", camera, np.zeros((30, 40, 3), np.uint8), None)
    output, tape = renderer.render(model, view, Request(np.ones(3, np.float32), backend=backend))
    v = renderer.render_vjp(tape, np.ones_like(output.image), None)
    return output.image, v


@pytest.fixture
def gaussians(rng):
    return as_dtype(make_gaussians(rng, 30, sh_degree=3), np.float32)


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda b: b.name)
def test_without_features_and_codes_it_is_3dgs(gaussians, backend, rng):
    image, v = drawn(COMPACT.renderer, Model(without_features(gaussians, rng)), backend)
    expected, v_expected = drawn(SPLATTING, Model(gaussians), backend)
    assert image.tobytes() == expected.tobytes()
    assert [a.tobytes() for a in v.gaussians[:6]] == [a.tobytes() for a in v_expected.gaussians]
    assert drawn(COMPACT.renderer, Model(gaussians), backend)[0].tobytes() == expected.tobytes()


def test_codebooks_as_large_as_the_population_are_the_population(gaussians, rng):
    """Each row has its own codes, and the gradient of a code is that of its row."""
    n = len(gaussians.means)
    parts = {
        "scale_codes": gaussians.log_scales.T[..., None],
        "rotation_codes": [*np.split(gaussians.quats, 2, axis=1)],
    }
    shared = {name: np.ascontiguousarray(np.stack([*part])) for name, part in parts.items()}
    codes = np.repeat(np.arange(n, dtype=np.float32)[:, None], 5, axis=1)
    coded = without_features(gaussians, rng)._replace(codes=codes, quats=gaussians.quats * 0, log_scales=codes[:, :3])
    image, v = drawn(COMPACT.renderer, Model(coded, shared), CPU)
    expected, v_expected = drawn(SPLATTING, Model(gaussians), CPU)
    assert image.tobytes() == expected.tobytes()
    assert_array_equal(np.concatenate([*v.shared["scale_codes"]], axis=1), v_expected.gaussians.log_scales)
    assert_array_equal(np.concatenate([*v.shared["rotation_codes"]], axis=1), v_expected.gaussians.quats)
    assert np.abs(v_expected.gaussians.quats).max() > 0
    assert not v.gaussians.quats.any() and not v.gaussians.log_scales.any()


def test_kernels_and_numpy_decode_alike(gaussians, scene, rng):
    model = Model(add_features(gaussians, rng), COMPACT.shared(scene, rng))
    (ours, tape), (theirs, other) = decode(model, COMPILED), decode(model, IN_NUMPY)
    assert_allclose(ours.sh_rest, theirs.sh_rest, atol=PARITY_FLOAT32_GRADIENT * np.abs(theirs.sh_rest).max())
    v = theirs._replace(features=0 * theirs.features)
    found, expected = decode_vjp(tape, v)[1], decode_vjp(other, v)[1]
    assert len(expected) == 16
    for name, array in expected.items():
        assert_allclose(found[name], array, atol=PARITY_FLOAT32_GRADIENT * np.abs(array).max(), err_msg=name)


# The events


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", supersampling=1, n_views=6, width=32, height=24, n_points=120, test_every=4).scene


def state_and_iteration(scene):
    state = initial_state(scene, find_recipe("omg"), seed=0)
    degree = np.zeros((len(state.gaussians.means), 15, 3), np.float32)
    state.gaussians = state.gaussians._replace(sh_rest=degree)
    state.adam = state.adam._replace(
        first=state.adam.first._replace(sh_rest=degree.copy()), second=state.adam.second._replace(sh_rest=degree.copy())
    )
    nothing = dict.fromkeys(Iteration._fields)
    return state, Iteration(**nothing | {"scene": scene, "render_settings": RenderSettings(scene.background)})


def test_networks_begin_with_what_the_gaussians_had(scene):
    state, iteration = state_and_iteration(scene)
    before = state.gaussians
    state.shared_adam = state.shared_adam._replace(step=77)
    start_networks(state, iteration)
    assert_array_equal(state.gaussians.features, np.concatenate([before.sh_dc, np.zeros((120, 3))], axis=1))
    assert state.adam.first.features.shape == (120, 6)
    assert state.shared_adam.joined == {
        f"{n}_{kind}_{k}": 77
        for n in ("space", "color", "opacity", "harmonics")
        for kind in ("weights", "biases")
        for k in (0, 1)
    }
    nothing = {name: np.zeros_like(getattr(before, name)) for name in ("opacity_logits", "sh_dc")}
    decoded, _ = decode(state.model._replace(gaussians=state.gaussians._replace(**nothing)), IN_NUMPY)
    assert_allclose(decoded.opacity_logits, before.opacity_logits, atol=1e-3)
    assert not decoded.sh_rest.any()
    assert np.std(before.sh_dc) > 0.3
    assert np.sqrt(np.mean((decoded.sh_dc - before.sh_dc) ** 2)) < 0.02 * np.std(before.sh_dc)


def test_the_last_layer_is_that_of_least_squares(rng):
    hidden, truth = rng.normal(size=(50, 4)), rng.normal(size=(5, 2))
    layer = fit_last_layer(hidden, hidden @ truth[:4] + truth[4])
    assert_allclose(layer.weights, truth[:4], rtol=1e-10)
    assert_allclose(layer.biases, truth[4], rtol=1e-10)


def test_centres_are_rounded_to_half_floats_of_their_offset():
    """Around 1, half floats are 2^-10 apart, and around 1/4, 2^-12; the centre is not rounded."""
    state = SimpleNamespace(
        gaussians=SimpleNamespace(means=np.array([[101.0004, 0.0, 0.25], [101.0006, 0.0, 0.2501]])),
        shared={PLACE: np.array([100.0, 0.0, 0.0, 7.0])},
    )
    round_centres(state, None)
    expected = [[101.0, 0, 0.25], [101 + 2.0**-10, 0, 0.25]]
    assert_allclose(state.gaussians.means, expected, rtol=0, atol=1e-12)


LIMITS = {"scale_codes": 64, "rotation_codes": 512, "feature_codes": 1024}


def test_with_a_code_for_each_row_nothing_is_lost(scene):
    """Of 20 Gaussians, scales and features are exact, and rotations of length 1."""
    state, iteration = state_and_iteration(scene)
    apply_edit(state, keep(state.gaussians, np.arange(20)))
    start_networks(state, iteration)
    state.gaussians.features[:] = np.random.default_rng(0).normal(size=(20, 6))
    state.gaussians.quats[:] = np.random.default_rng(1).normal(size=(20, 4))
    state.gaussians.quats[3] = [0, 0, -3, 4]  # whose code (w, x) is kept above zero
    before = state.gaussians
    start_codes(state, iteration, **LIMITS, rows_per_code=1)
    assert state.gaussians.codes.shape == (20, 8)
    decoded, _ = decode(state.model, IN_NUMPY)
    assert_array_equal(decoded.log_scales, before.log_scales)
    assert_array_equal(decoded.features, before.features)
    unit = before.quats / np.linalg.norm(before.quats, axis=1, keepdims=True)
    unit *= np.where(unit[:, :1] < 0, -1, 1)
    unit[3, 0] = QUAT_MIN
    assert_allclose(decoded.quats, unit, rtol=1e-6)


def test_codebooks_are_limited(scene):
    """120 Gaussians have 15 codes at eight rows a code, and 4 where no more are asked for."""
    state, iteration = state_and_iteration(scene)
    rng = np.random.default_rng(0)
    state.gaussians.log_scales[:] = rng.normal(size=(120, 3))
    state.gaussians.quats[:] = rng.normal(size=(120, 4))
    start_codes(state, iteration, scale_codes=4, rotation_codes=512, feature_codes=1024, rows_per_code=8)
    n_codes = [len(np.unique(column)) for column in state.gaussians.codes.T]
    assert n_codes[:3] == [4, 4, 4] and max(n_codes[3:]) == 15 and len(n_codes) == 5  # without features


def test_codebooks_have_a_code_at_least(scene):
    state, iteration = state_and_iteration(scene)
    start_networks(state, iteration)
    start_codes(state, iteration, **LIMITS, rows_per_code=121)  # of 120 Gaussians
    assert not state.gaussians.codes.any()


def test_the_steps_of_codes_are_counted_from_their_start(scene):
    state, iteration = state_and_iteration(scene)
    start_networks(state, iteration)
    state.shared_adam = state.shared_adam._replace(step=55)
    start_codes(state, iteration, **LIMITS, rows_per_code=8)
    joined = {name: step for name, step in state.shared_adam.joined.items() if step == 55}
    assert joined == {"scale_codes": 55, "rotation_codes": 55, "feature_codes": 55}


def test_of_features_the_static_ones_are_compared(scene, rng):
    state, iteration = state_and_iteration(scene)
    start_networks(state, iteration)
    state.gaussians.features[:, :3] = 0.25
    state.gaussians.features[:, 3:] = rng.normal(size=(120, 3))  # of the view
    note = prune_indistinct(state, iteration, metric=indoor, distinct_mass=0.9, distinct_power=2.0)
    assert "all colours are alike" in note and len(state.gaussians.means) == 120


def test_in_the_end_the_fields_are_what_is_drawn(scene):
    """3DGS draws the six fields as the recipe's renderer draws features and codes, to the byte."""
    state, iteration = state_and_iteration(scene)
    start_networks(state, iteration)
    start_codes(state, iteration, **LIMITS, rows_per_code=8)
    settings, view = RenderSettings(scene.background, renderer=COMPACT.renderer), scene.test_views[0]
    image = settings.render_view(state.model, view)[0].image
    plain = Gaussians(*state.gaussians[:6])
    assert RenderSettings(scene.background).render_view(plain, view)[0].image.tobytes() != image.tobytes()
    write_fields(state, iteration)
    plain = Gaussians(*state.gaussians[:6])
    assert RenderSettings(scene.background).render_view(plain, view)[0].image.tobytes() == image.tobytes()
    assert settings.render_view(state.model, view)[0].image.tobytes() == image.tobytes()


def test_a_file_keeps_each_row_together(scene):
    """Of 120 Gaussians in Morton order, each has its own centre, codes and colour."""
    state, iteration = state_and_iteration(scene)
    state.gaussians.log_scales[:] = np.random.default_rng(0).normal(size=(120, 3))
    start_networks(state, iteration)
    start_codes(state, iteration, **LIMITS, rows_per_code=2)
    write_fields(state, iteration)
    back = trained_file.decode(trained_file.encode(state.model, FILE_FRAME), "a")
    found, expected = np.lexsort(back.means.T), np.lexsort(state.gaussians.means.T)
    assert (np.diff(expected) != 1).any()
    for name in ("means", "log_scales", "sh_dc"):
        a, b = getattr(back, name)[found], getattr(state.gaussians, name)[expected]
        assert_allclose(a, b, atol=20 * HALF_FLOAT * np.abs(b).max(), err_msg=name)


def test_without_its_events_it_trains_as_mini_splatting(scene):
    """Networks, codes and distinctiveness off: the same bytes after a whole short training."""
    recipe = find_recipe("omg", 60)
    for action in (start_networks, start_codes, round_centres, write_fields):
        recipe = without(recipe, action)
    ours = train(scene, configure(recipe, distinct_power=0.0), seed=0).gaussians
    theirs = train(scene, scale_recipe(MINI_SPLATTING, 60), seed=0).gaussians
    assert isinstance(ours, OmgGaussians)
    for name in Gaussians._fields:
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()


def test_networks_start_right_after_the_restart():
    names = [action_name(event) for event in find_recipe("omg").events]
    assert names.index("start_networks") == names.index(restart_from_means.__name__) + 1
    assert names[-3:] == ["start_codes", "round_centres", "write_fields"]
