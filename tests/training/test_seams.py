"""The seams: populations, shared parameters, renderers, loss terms and settings as data, also through the commands."""

import json
import shutil
from fractions import Fraction
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io import load_scene
from minisplat_ref.io.checkpoint import load_checkpoint
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.methods import RECIPES, gaussian_splatting, get_recipe
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.strategy.clone_split import clone_and_split
from minisplat_ref.strategy.importance import indoor, outdoor
from minisplat_ref.strategy.ops import take
from minisplat_ref.strategy.simplify import by_rank, merge_neighbours
from minisplat_ref.training.adam import AdamRule, AdamState, adam_step, zero_moments
from minisplat_ref.training.calibration import EXPOSURES, POSE, ROTATIONS, SHIFTS
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered, photometric, total_loss
from minisplat_ref.training.rates import LogLinear, Rates, Rewind
from minisplat_ref.training.recipe_settings import configure, parse_settings, settings_of
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import Every, describe, scale_recipe
from minisplat_ref.training.state import Iteration, TrainState, start_again
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM, GRADIENT_REL, ROUNDED_TO_FLOAT32

SCHEDULED = ("--recipe", "3dgs-accel")
CALIBRATED = {"exposure": "learned", "pose": True}


class Labelled(NamedTuple):
    """A population with further fields: one number a row, and two."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    weights: Floats
    """[N]."""
    labels: Floats
    """[N, 2]."""


def labelled(gaussians, rng=None):
    n = len(gaussians.means)
    dtype = gaussians.means.dtype
    return Labelled(
        **gaussians._asdict(),
        weights=np.arange(n).astype(dtype),
        labels=np.arange(2 * n).reshape(n, 2).astype(dtype),
    )


LABELLED = Representation(
    "labelled Gaussians",
    population=Labelled,
    extend=labelled,
    rates=Rates({"weights": 0.1, "labels": 0.2, "table": 0.3}, frozenset()),
)


@pytest.fixture(scope="module")
def scene():
    """Noise in four photographs: enough to train on, and every parameter has a gradient."""
    rng = np.random.default_rng(5)
    views = [
        View(f"view{i}", make_camera(24, 16, rng=rng), rng.integers(0, 256, (16, 24, 3), np.uint8), None)
        for i in range(4)
    ]
    points = make_gaussians(rng, 30).means
    return Scene("tiny", tuple(views), (), points, rng.integers(0, 256, (30, 3), np.uint8), np.zeros(3), 2.0)


def brief(**changes):
    recipe = get_recipe("3dgs-accel", 24)._replace(events=(), sh_degree=1, sh_milestones=(10,))
    return recipe._replace(**changes)


# Rates ----------------------------------------------------------------------------------------------------------------


def test_rates_per_extent_are_multiplied_by_it():
    rates = Rates({"means": 2.0, "quats": 3.0, "shifts": LogLinear(1.0, 0.01, 10)}, frozenset({"means", "shifts"}))
    assert rates.at(5, 10.0) == pytest.approx({"means": 20.0, "quats": 3.0, "shifts": 10 * 0.1})
    assert rates.at(99, 1.0)["shifts"] == pytest.approx(0.01)  # after the schedule's end


def test_changed_rates_replace_and_add():
    rates = Rates({"means": 1.0, "quats": 2.0}).change(quats=3.0, labels=4.0)
    assert dict(rates.of) == {"means": 1.0, "quats": 3.0, "labels": 4.0}
    assert rates.per_extent == {"means"}


def test_of_one_name_the_first_of_joined_rates_counts():
    """With its own unit: what is per extent in the other is not so in the first."""
    first = Rates({"means": 1.0, "quats": 2.0}, frozenset())
    joined = first.join(Rates({"quats": 5.0, "shifts": 6.0, "means": 7.0}, frozenset({"means", "shifts"})))
    assert joined.at(1, 10.0) == {"means": 1.0, "quats": 2.0, "shifts": 60.0}
    assert Rates({"shifts": 6.0}, frozenset({"shifts"})).join(first).at(1, 10.0)["means"] == 1.0


def test_scaled_rates():
    rates = Rates({"means": LogLinear(1.0, 0.1, 100, Rewind(50, 20)), "quats": 2.0})
    halved = rates.scale(Fraction(1, 2), 3.0, 9.0)
    assert halved.of["means"] == LogLinear(9.0, pytest.approx(0.9), 50, Rewind(25, 10))
    assert halved.of["quats"] == 6.0
    assert json.loads(json.dumps(halved.describe()))["per_extent"] == ["means"]


def test_short_runs_keep_the_path_of_poses_and_the_rate_of_exposures():
    published, short = (configure(get_recipe("3dgs", n), **CALIBRATED).rates.of for n in (30_000, 300))
    for name in (ROTATIONS, SHIFTS):
        assert short[name].first == pytest.approx(100 * published[name].first)
        assert short[name].last == pytest.approx(100 * published[name].last)
        assert short[name].steps == 300
    assert short[EXPOSURES] == published[EXPOSURES]._replace(steps=300)
    longer = configure(get_recipe("3dgs", 60_000), pose=True).rates.of
    assert longer[ROTATIONS] == POSE.rates.of[ROTATIONS]._replace(steps=60_000)


def test_a_field_without_a_rate_is_named(scene):
    recipe = brief(representation=LABELLED._replace(rates=Rates({"weights": 0.1}, frozenset())))
    with pytest.raises(InputError, match="no learning rate for labels of labelled Gaussians"):
        initial_state(scene, recipe, 0)


# Loss terms -----------------------------------------------------------------------------------------------------------


def mean_depth(rendered):
    """A term of another channel and of alpha: sum z^2 / 2 + sum a^2."""
    depth, alpha = rendered.channel("depth"), rendered.output.alpha
    return float(np.sum(depth**2) / 2 + np.sum(alpha**2)), Cotangents({"depth": depth}, 2 * alpha)


def brightness(rendered):
    """A term of the channel that another has, too: sum of the colours, and of alpha."""
    rgb = rendered.channel("rgb")
    return float(rgb.sum() + rendered.output.alpha.sum()), Cotangents(
        {"rgb": np.ones_like(rgb)}, np.ones_like(rendered.output.alpha)
    )


def opacity_penalty(rendered):
    """A term of the parameters themselves: sum of logits^2 / 2."""
    logits = rendered.model.gaussians.opacity_logits
    return float(np.sum(logits**2) / 2), Cotangents(gaussians={"opacity_logits": logits})


def table_penalty(rendered):
    """A term of a shared parameter: sum of its sines."""
    table = rendered.model.shared["table"]
    return float(np.sin(table).sum()), Cotangents(shared={"table": np.cos(table)})


TERMS = (
    LossTerm("photometric", partial(photometric, dssim_weight=0.2), 1.0),
    LossTerm("depth", mean_depth, 0.7, wants=frozenset({"depth"})),
    LossTerm("brightness", brightness, -0.3),
    LossTerm("penalty", opacity_penalty, 0.5),
    LossTerm("table", table_penalty, 2.0),
)
WANTS = frozenset({"depth"})


@pytest.fixture
def drawn(rng):
    """A view drawn in float64, with shared parameters that no renderer looks at."""
    model = Model(make_gaussians(rng, 8), {"table": rng.normal(size=(2, 3))})
    camera = make_camera(12, 10)
    view = View("one", camera, rng.integers(0, 256, (10, 12, 3), np.uint8), None)
    request = Request(np.zeros(3), backend=REFERENCE, wants=WANTS)
    output, tape = SPLATTING.render(model, view, request)
    return Rendered(output, SPLATTING.channels(WANTS), view, None, model, 1, request), tape


def test_total_is_the_weighted_sum_of_the_terms(drawn):
    rendered, _ = drawn
    loss = total_loss(TERMS, rendered)
    assert loss.value == pytest.approx(sum(t.weight * t.function(rendered)[0] for t in TERMS), rel=CLOSED_FORM)
    parts = [term.function(rendered)[1] for term in TERMS]
    assert_allclose(loss.v_image[..., :3], parts[0].channels["rgb"] - 0.3, rtol=CLOSED_FORM)
    assert_allclose(loss.v_image[..., 3:], 0.7 * parts[1].channels["depth"], rtol=CLOSED_FORM)
    assert_allclose(loss.v_alpha, 0.7 * parts[1].alpha - 0.3, rtol=CLOSED_FORM)
    assert_allclose(loss.v_gaussians["opacity_logits"], 0.5 * rendered.model.gaussians.opacity_logits)
    assert_allclose(loss.v_shared["table"], 2 * np.cos(rendered.model.shared["table"]), rtol=CLOSED_FORM)


def test_two_terms_of_one_field_add_up(drawn):
    rendered, _ = drawn
    twice = total_loss((TERMS[3], TERMS[3]._replace(weight=1.5), TERMS[4], TERMS[4]), rendered)
    assert_allclose(twice.v_gaussians["opacity_logits"], 2 * rendered.model.gaussians.opacity_logits)
    assert_allclose(twice.v_shared["table"], 4 * np.cos(rendered.model.shared["table"]))
    assert not twice.v_image.any() and twice.v_image.shape == (10, 12, 4) and twice.v_alpha is None


def test_one_photometric_term_is_passed_on_as_it_is(drawn):
    """The loss of 3DGS costs nothing on top of its one term."""
    rendered, _ = drawn
    rgb = rendered._replace(
        output=rendered.output._replace(image=rendered.output.image[..., :3]), channels=SPLATTING.channels(frozenset())
    )
    made = []

    def term(rendered):
        loss, v = photometric(rendered, dssim_weight=0.2)
        made.append(v.channels["rgb"])
        return loss, v

    assert total_loss((LossTerm("photometric", term, 1.0),), rgb).v_image is made[0]


def test_gradient_of_the_total_by_differences(drawn, rng):
    """Through image, depth and alpha, and directly: what a step of the population or of the table changes."""
    rendered, tape = drawn
    loss = total_loss(TERMS, rendered)
    v = SPLATTING.render_vjp(tape, loss.v_image, loss.v_alpha)
    model, step = rendered.model, 1e-6

    def value(gaussians, shared):
        moved = Model(gaussians, shared)
        output, _ = SPLATTING.render(moved, rendered.view, rendered.request)
        return total_loss(TERMS, rendered._replace(output=output, model=moved)).value

    for name in ("opacity_logits", "sh_dc"):
        field = getattr(model.gaussians, name)
        direction = rng.normal(size=field.shape)
        up, down = (
            value(model.gaussians._replace(**{name: field + s * step * direction}), model.shared) for s in (1, -1)
        )
        gradient = getattr(v.gaussians, name) + loss.v_gaussians.get(name, 0)
        size = np.abs(gradient * direction).sum()
        assert size > 1e-3
        assert abs((up - down) / (2 * step) - np.vdot(gradient, direction)) < 10 * GRADIENT_REL * size, name
    direction = rng.normal(size=(2, 3))
    up, down = (value(model.gaussians, {"table": model.shared["table"] + s * step * direction}) for s in (1, -1))
    assert (up - down) / (2 * step) == pytest.approx(np.vdot(loss.v_shared["table"], direction), rel=1e-6)


def test_term_is_due_between_start_and_stop():
    term = LossTerm("depth", mean_depth, 1.0, start=3, stop=6)
    assert [step for step in range(10) if term.is_due(step)] == [4, 5]
    assert not any(term._replace(weight=0.0).is_due(step) for step in range(10))
    assert [step for step in range(9) if term._replace(stop=None).is_due(step)] == [4, 5, 6, 7, 8]
    assert term._replace(start=30, stop=60).scale(Fraction(1, 10)) == term
    assert term._replace(stop=None).scale(Fraction(2)) == term._replace(start=6, stop=None)


def test_terms_act_in_training_when_they_are_due_alone(scene):
    """A direct term moves what has no other gradient: the table of the representation, from iteration 6 to 9."""
    values = []
    representation = LABELLED._replace(shared=lambda scene, rng: {"table": np.zeros((2, 3), np.float32)})
    term = LossTerm("table", table_penalty, 1.0, start=5, stop=10)
    recipe = brief(iterations=7, representation=representation)
    recipe = recipe._replace(losses=(*recipe.losses, term))
    train(scene, recipe, seed=0, on_step=lambda report: values.append(report.state.shared["table"].copy()))
    assert not any(value.any() for value in values[:5])
    # From zero moments Adam's first step, if its counter is at 6, is 0.1 / (1 - 0.9^6) sqrt((1 - 0.999^6) / 0.001).
    expected = -0.3 * 0.1 / (1 - 0.9**6) * np.sqrt((1 - 0.999**6) / 0.001)
    assert_allclose(values[5], expected, rtol=1e-6)
    assert np.all(values[6] < values[5])


# Settings -------------------------------------------------------------------------------------------------------------

MINI = RECIPES["mini-splatting"]


def test_settings_are_of_events_terms_and_calibrations():
    settings = settings_of(MINI)
    assert settings["exposure"] == "none" and settings["pose"] is False
    assert settings["photometric"] == 1.0 and settings["dssim_weight"] == 0.2
    assert settings["metric"] is indoor and settings["budget"] is None and settings["threshold"] == 2e-4


def test_what_is_set_is_set_and_nothing_else():
    for name, value in {"exposure": "learned", "photometric": 0.5, "dssim_weight": 0.3, "threshold": 1e-3}.items():
        changed = configure(MINI, **{name: value})
        assert settings_of(changed) == {**settings_of(MINI), name: value}
        assert describe(changed) != describe(MINI)
    assert configure(MINI) == MINI
    assert [c.name for c in configure(MINI, **CALIBRATED).active_calibrations] == ["exposure", "pose"]


TEXTS = [
    ("exposure", "learned", "learned"),
    ("pose", "False", False),
    ("photometric", "0.5", 0.5),
    ("photometric", "2", 2.0),
    ("sh_degree", "2", 2),
    ("budget", "1000", 1000),
    ("budget", "none", None),
    ("depth_tolerance", "None", None),
    ("points_per_gaussian", "inf", np.inf),
    ("threshold", "1e-3", 1e-3),
    ("metric", "outdoor", outdoor),
    ("choose", "by_rank", by_rank),
]


@pytest.mark.parametrize(("name", "text", "value"), TEXTS)
def test_text_becomes_a_value_of_the_present_type(name, text, value):
    (parsed,) = parse_settings(MINI, {name: text}).values()
    assert parsed == value and type(parsed) is type(value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("pose", "1", "pose=1 is neither true nor false"),
        ("exposure", "true", "exposure=true: choose from none, tracks, refined, learned"),
        ("photometric", "much", "photometric=much is not a number, as photometric=1.0 is"),
        ("photometric", "none", "photometric=none is not a number"),
        ("photometric", "nan", "photometric=nan is not a number"),
        ("photometric", "-1", "photometric=-1: a weight of the loss is at least 0; 0 leaves the term out"),
        ("photometric", "inf", "photometric=inf: a weight of the loss is at least 0"),
        ("dssim_weight", "-0.1", "dssim_weight=-0.1: the shares of L1 and D-SSIM are at least 0; give 0 to 1"),
        ("dssim_weight", "1.5", "dssim_weight=1.5: the shares of L1 and D-SSIM"),
        ("sh_degree", "2.5", "sh_degree=2.5 is not a whole number, as sh_degree=3 is"),
        ("sh_degree", "inf", "sh_degree=inf is not a whole number"),
        ("budget", "few", "budget=few is not a number"),
        ("budget", "nan", "budget=nan is not a number"),
        ("metric", "underwater", "metric=underwater names no function: choose from indoor, outdoor"),
        ("metric", "none", "metric=none names no function"),
        ("choose", "merge_neighbours", "names no function: choose from by_merging, by_rank, by_sampling"),
        ("nonsense", "1", "recipe mini-splatting has no nonsense to set: choose from antialiasing, .*threshold"),
    ],
)
def test_text_that_is_no_such_value_is_refused(name, text, message):
    with pytest.raises(InputError, match=message):
        parse_settings(MINI, {name: text})


def test_unknown_setting_lists_those_that_exist():
    with pytest.raises(InputError, match="has no nonsense to set") as caught:
        configure(MINI, nonsense=1)
    assert all(name in str(caught.value) for name in settings_of(MINI))
    with pytest.raises(InputError, match="has no a, b to set"):
        parse_settings(MINI, {"a": "1", "b": "2"})


def coloured(scene, rng, *, color, folder):
    return {"table": color(3)}


def grey(n_channels):
    return np.full(n_channels, 0.5)


def white(n_channels):
    return np.full(n_channels, 1.0)


def test_settings_of_shared_parameters_are_functions_and_text():
    """A function by its name, which ``describe`` gives back, and text as it is."""
    start = partial(coloured, color=grey, folder="")
    recipe = brief()._replace(representation=LABELLED._replace(shared=start))
    chosen = configure(recipe, **parse_settings(recipe, {"color": "white", "folder": "a b/c"}))
    assert chosen.representation.shared(None, None)["table"].tolist() == [1, 1, 1]
    assert chosen.representation.shared.keywords["folder"] == "a b/c"
    with pytest.raises(InputError, match="color=black names no function: choose from grey, white"):
        parse_settings(recipe, {"color": "black"})
    drawn = SPLATTING._replace(render=partial(SPLATTING.render, color=white))
    described = json.loads(json.dumps(describe(recipe._replace(representation=LABELLED._replace(renderer=drawn)))))
    assert described["representation"]["renderer"] == {"color": "white"}


def test_infinite_number_where_none_stands():
    """The present value says nothing of the type, and infinity is no whole number."""
    assert parse_settings(MINI, {"budget": "inf"}) == {"budget": np.inf}


# Shared parameters ----------------------------------------------------------------------------------------------------


def all_bytes(state):
    bundles = {"p": state.gaussians, "m": state.adam.first, "v": state.adam.second}
    shared = {"p": state.shared, "m": state.shared_adam.first, "v": state.shared_adam.second}
    return {
        **{(kind, name): field.tobytes() for kind, b in bundles.items() for name, field in b._asdict().items()},
        **{(kind, name, "shared"): field.tobytes() for kind, b in shared.items() for name, field in b.items()},
        "steps": (state.step, state.adam.step, state.shared_adam.step),
    }


@pytest.mark.parametrize("stop", [5, 12])
def test_resumed_run_with_calibrations_has_the_same_bytes(scene, stop, tmp_path):
    recipe = configure(brief(), **CALIBRATED)
    whole = train(scene, recipe, seed=3)
    path = tmp_path / "checkpoint.npz"
    save_state(path, train(scene, recipe._replace(iterations=stop), seed=3), recipe)
    resumed = load_state(path, recipe)
    assert resumed.shared.keys() == {EXPOSURES, ROTATIONS, SHIFTS}
    train(scene, recipe, seed=99, state=resumed)
    assert all_bytes(resumed) == all_bytes(whole)
    assert resumed.shared_adam.step == 24 and resumed.shared[ROTATIONS].any()
    assert not np.array_equal(resumed.shared[EXPOSURES][0], np.eye(3, 4))


def test_calibrations_that_are_off_change_nothing(scene):
    plain, off = (train(scene, r, seed=0) for r in (brief(calibrations=()), brief()))
    assert all_bytes(plain) == all_bytes(off) and off.shared == {}


def test_resuming_with_other_calibrations_is_refused(scene, tmp_path):
    path = tmp_path / "checkpoint.npz"
    save_state(path, initial_state(scene, brief(), 0), brief())
    with pytest.raises(InputError, match="other settings"):
        load_state(path, configure(brief(), pose=True))


def test_adam_updates_a_mapping_as_it_does_a_population(backend, rng):
    class Bundle(NamedTuple):
        a: Floats
        b: Floats

    rates, rule = {"a": 0.1, "b": 0.2}, AdamRule(is_visible_only=False, has_bias_correction=True)
    start, gradient = (Bundle(rng.normal(size=5), rng.normal(size=(3, 2, 4))) for _ in range(2))
    population = Bundle(*(field.copy() for field in start))
    mapping = {name: field.copy() for name, field in start._asdict().items()}
    state, mapped_state = zero_moments(population), zero_moments(mapping)
    for _ in range(3):
        state = adam_step(population, gradient, state, rates, rule, np.arange(0), backend)
        mapped_state = adam_step(mapping, gradient._asdict(), mapped_state, rates, rule, np.arange(0), backend)
    assert mapped_state.step == 3
    for name, field in population._asdict().items():
        assert np.all(field != getattr(start, name))
        assert_array_equal(mapping[name], field)
        assert_array_equal(mapped_state.second[name], getattr(state.second, name))


def test_shared_parameters_and_fields_in_any_order_of_memory_are_trained(scene):
    """Adam writes through flat views; a transposed array would be copied instead, and stay as it was."""

    def transposed(gaussians, rng):
        population = labelled(gaussians)
        return population._replace(means=np.asfortranarray(population.means))

    representation = LABELLED._replace(
        extend=transposed, shared=lambda scene, rng: {"table": np.zeros((3, 2), np.float32).T}
    )
    recipe = brief(iterations=2, representation=representation)
    recipe = recipe._replace(losses=(*recipe.losses, LossTerm("table", table_penalty, 1.0)))
    before = initial_state(scene, recipe, 0)
    after = train(scene, recipe, seed=0)
    assert after.shared["table"].shape == (2, 3) and np.all(after.shared["table"] < 0)
    assert np.any(after.gaussians.means != before.gaussians.means)


# Further fields -------------------------------------------------------------------------------------------------------


@pytest.fixture
def population(rng):
    return labelled(make_gaussians(rng, 12, sh_degree=1))


def test_further_fields_go_through_ply(population, tmp_path):
    path = tmp_path / "labelled.ply"
    save_ply(path, population)
    loaded = load_ply(path, Labelled)
    assert type(loaded) is Labelled
    for field, expected in zip(loaded, population, strict=True):
        assert field.shape == expected.shape
        assert_allclose(field, expected, rtol=0, atol=ROUNDED_TO_FLOAT32)
    with pytest.warns(InputWarning, match="not drawn are weights, labels_0, labels_1"):
        assert type(load_ply(path)) is Gaussians  # other readers skip them
    save_ply(path, Gaussians(*population[:6]))
    with pytest.raises(InputError, match="no property weights, labels"):
        load_ply(path, Labelled)


def test_further_fields_follow_clones_and_children(population, rng):
    norms = np.array([1.0, 0.0] * 6)
    population.log_scales[:6] = np.log(0.5)
    edit = clone_and_split(population, norms, threshold=0.5, size_limit=0.4, rng=rng)
    assert type(edit.gaussians) is Labelled and len(edit.parent_ids) == 12 + 3 + 3
    assert_array_equal(edit.gaussians.weights, population.weights[edit.parent_ids])
    assert_array_equal(edit.gaussians.labels, population.labels[edit.parent_ids])


def test_further_fields_of_merged_gaussians_are_weighted_means(population):
    """Two that lie together, and far from the others, become one: 0.75 of the first, 0.25 of the second."""
    population.means[1], population.sh_dc[1] = population.means[0] + 1e-3, population.sh_dc[0]
    importance = np.ones(12)
    importance[0] = 3.0
    edit = merge_neighbours(population, importance, 11)
    (row,) = np.flatnonzero(edit.is_new)
    assert edit.parent_ids[row] == 0
    assert_allclose(edit.gaussians.weights[row], 0.25, rtol=CLOSED_FORM)
    assert_allclose(edit.gaussians.labels[row], [0.5, 1.5], rtol=CLOSED_FORM)
    kept = np.flatnonzero(~edit.is_new)
    assert_array_equal(edit.gaussians.labels[kept], population.labels[edit.parent_ids[kept]])


def test_beginning_anew_keeps_what_is_shared(population, rng):
    """Rows, moments and statistics go; the table, its moments and its step stay; further fields start again."""
    shared = {"table": rng.normal(size=(2, 3))}
    moments = AdamState({"table": np.ones((2, 3))}, {"table": np.full((2, 3), 2.0)}, 7)
    state = TrainState(population, zero_moments(population), 9, [1], rng, {"x": np.ones(12)}, shared, moments)
    iteration = Iteration(*[None] * 5, representation=LABELLED)
    start_again(state, iteration, Gaussians(*take(population, np.arange(4))[:6])._replace())
    assert type(state.gaussians) is Labelled
    assert_array_equal(state.gaussians.weights, np.arange(4))
    assert not state.adam.first.labels.any() and state.adam.step == 0
    assert state.stats == {} and state.view_order == []
    assert state.shared is shared and state.shared_adam is moments


def test_population_with_further_fields_is_trained_densified_and_resumed(scene, tmp_path):
    """A gradient of their own for the labels; density control and checkpoints take any field along."""

    def pull(rendered):
        labels = rendered.model.gaussians.labels
        return float(np.sum(labels**2) / 2), Cotangents(gaussians={"labels": labels})

    events = (
        Every(1, gaussian_splatting.collect_gradients),
        Every(6, partial(gaussian_splatting.clone_and_split, threshold=1e-6, size_fraction=0.01)),
    )
    recipe = brief(representation=LABELLED, events=events)
    recipe = recipe._replace(losses=(*recipe.losses, LossTerm("pull", pull, 1.0)), iterations=10)
    whole = train(scene, recipe, seed=0)
    n = len(whole.gaussians.means)
    assert n > 30 and whole.gaussians.labels.shape == (n, 2) and whole.gaussians.weights.shape == (n,)
    assert whole.gaussians.labels.max() < 2 * 30 - 1  # pulled towards zero
    save_state(tmp_path / "c.npz", train(scene, recipe._replace(iterations=7), seed=0), recipe)
    resumed = load_state(tmp_path / "c.npz", recipe)
    assert type(resumed.gaussians) is Labelled
    train(scene, recipe, seed=1, state=resumed)
    assert all_bytes(resumed) == all_bytes(whole)


# Through the commands -------------------------------------------------------------------------------------------------

SETTINGS = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SETTINGS), folder, SETTINGS)
    return folder


def test_calibrated_training_from_end_to_end(scene_folder, tmp_path, capsys):
    """Twelve iterations at once, and eight and then four: the same bytes; and every command takes the run."""
    options = [*SCHEDULED, "--set", "exposure=learned", "--set", "pose=true", "--test-every", "4", "--seed", "5"]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main(["train", str(scene_folder), "--out", str(whole), "--iterations", "12", *options]) == 0
    assert json.loads((whole / "config.json").read_text())["recipe"]["calibrations"] == ["exposure", "pose"]
    recipe = configure(get_recipe("3dgs-accel", 12), **CALIBRATED)
    state = load_state(whole / "checkpoint.npz", recipe)
    assert state.step == state.shared_adam.step == 12
    shapes = {name: array.shape for name, array in state.shared.items()}
    assert shapes == {EXPOSURES: (6, 3, 4), ROTATIONS: (6, 3), SHIFTS: (6, 3)}
    with np.load(whole / "shared.npz") as archive:
        for name, array in state.shared.items():
            assert array.any() and archive[name].tobytes() == array.tobytes()

    shutil.copytree(whole, parts)  # as if the run had been stopped after eight
    stopped = train(load_scene(scene_folder, test_every=4), recipe._replace(iterations=8), seed=5)
    save_state(parts / "checkpoint.npz", stopped, recipe)
    assert main(["train", "--resume", str(parts)]) == 0
    assert all_bytes(load_state(parts / "checkpoint.npz", recipe)) == all_bytes(state)
    assert (parts / "point_cloud.ply").read_bytes() == (whole / "point_cloud.ply").read_bytes()

    capsys.readouterr()
    assert main(["info", str(whole)]) == 0
    assert "exposures [6, 3, 4], pose_rotations [6, 3], pose_shifts [6, 3]" in capsys.readouterr().out
    metrics = json.loads((whole / "metrics.json").read_text())
    assert main(["eval", str(whole)]) == 0
    assert json.loads((whole / "metrics.json").read_text())["psnr"] == metrics["psnr"]
    assert main(["render", str(whole), "--out", str(tmp_path / "images"), "--cameras", "train"]) == 0
    assert len(list((tmp_path / "images").glob("*.png"))) == 6


def test_unknown_setting_on_the_command_line(scene_folder, tmp_path, capsys):
    out = tmp_path / "out"
    options = [*SCHEDULED, "--iterations", "2", "--set", "nonsense=1"]
    assert main(["train", str(scene_folder), "--out", str(out), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "has no nonsense to set: choose from" in line
    assert all(name in line for name in settings_of(RECIPES["3dgs-accel"]))
    assert not out.exists()


def test_checkpoint_of_an_older_version_is_one_line(scene_folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["train", str(scene_folder), "--out", str(out), "--iterations", "2"]) == 0
    path = out / "checkpoint.npz"
    arrays, metadata = load_checkpoint(path)
    header = json.dumps({"format": "minisplat_ref checkpoint 1", "metadata": metadata}).encode()
    np.savez(path, header=np.frombuffer(header, np.uint8), **arrays)
    for command in (["train", "--resume", str(out), "--iterations", "4"], ["info", str(path)]):
        capsys.readouterr()
        assert main(command) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "checkpoint.npz is 'minisplat_ref checkpoint 1', this version reads" in line and "train again" in line


def test_scaled_recipe_keeps_its_calibrations_switched_on():
    assert scale_recipe(configure(RECIPES["3dgs"], pose=True), 3_000).active_calibrations[0].name == "pose"


def test_damaged_shared_parameters_are_named(scene_folder, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--iterations", "2", "--set", "pose=true", "--test-every", "4"]
    assert main(["train", str(scene_folder), "--out", str(out), *options]) == 0
    (out / "shared.npz").write_bytes(b"PK half a file")
    capsys.readouterr()
    assert main(["eval", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "shared.npz is not an .npz of plain arrays, or is damaged" in line
