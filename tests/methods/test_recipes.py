"""Recipes: events at exactly the right iterations, also when scaled."""

import inspect
import json
import re
from fractions import Fraction
from functools import partial

import numpy as np
import pytest

from minisplat_ref.app.cli import demo
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe, load_extensions
from minisplat_ref.methods import RECIPES, gaussian_splatting, get_recipe
from minisplat_ref.strategy.importance import outdoor
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import At, DatedEvent, During, Every, action_name, describe, scale_recipe


def nothing(state, iteration, **settings):
    pass


def firing(event, n=30_000):
    return [step for step in range(1, n + 1) if event.is_due(step)]


def firings(recipe):
    """Iterations of each event by the name of its action."""
    return {action_name(event): firing(event, recipe.iterations) for event in recipe.events}


def test_every_is_open_at_both_ends():
    assert firing(Every(3, nothing, start=3, stop=12), 20) == [6, 9]
    assert firing(Every(3, nothing), 10) == [3, 6, 9]
    assert firing(Every(3, nothing, skip=6), 20) == [3, 9, 15]
    assert firing(Every(3, nothing, stop=11), 20) == [3, 6, 9]


def test_at_and_during():
    assert firing(At(4, nothing), 10) == [4]
    assert firing(During(nothing, start=2, stop=6), 10) == [3, 4, 5]
    assert firing(During(nothing), 3) == [1, 2, 3]


@pytest.mark.parametrize("name", ["3dgs", "3dgs-accel"])
def test_3dgs_schedule(name):
    """As the released code: first densification at 600, last at 14,900; resets at 3000 to 12,000; sizes from 3100."""
    fired = firings(RECIPES[name])
    assert fired["collect_gradients"] == list(range(1, 15_000))
    assert fired["clone_and_split"] == fired["prune_faint"] == list(range(600, 15_000, 100))
    assert fired["prune_large"] == list(range(3_100, 15_000, 100))
    assert fired["reset_opacity"] == [3_000, 6_000, 9_000, 12_000]
    assert fired["reset_opacity_on_white"] == [500]


def test_mini_splatting_schedule():
    """As the released code: densification from 600 to 14,900 but not where depth reinitialises, at 5000 and 10,000."""
    recipe = RECIPES["mini-splatting"]
    fired = firings(recipe)
    assert fired["collect_gradients"] == fired["collect_blur"] == list(range(1, 15_000))
    densified = [step for step in range(600, 15_000, 100) if step % 5_000]
    assert fired["clone_and_split"] == fired["prune_faint"] == densified and len(densified) == 142
    assert fired["prune_large_by_distance"] == [step for step in densified if step > 3_000]
    assert fired["reinitialise_from_depth"] == [5_000, 10_000]
    assert fired["simplify"] == fired["store_sh"] == fired["restart_from_means"] == [15_000]
    assert fired["prune_tail"] == fired["restart_adam"] == [20_000]
    assert "reset_opacity" not in fired
    assert recipe.sh_degree == 0 and recipe.sh_milestones == (16_000, 17_000, 18_000)
    means = recipe.learning_rates.of["means"]
    assert means.at(14_999) == pytest.approx(1.6e-5, rel=1e-3) and means.at(15_000) == means.at(5_000)


def test_mini_splatting2_schedule():
    """As the released code: clones every 250 from 500 to 2750 but not at 2000, where depth reinitialises."""
    recipe = RECIPES["mini-splatting2"]
    fired = firings(recipe)
    assert recipe.iterations == 18_000 and fired["halve_large_views"] == list(range(1, 3_001))
    assert fired["aggressive_clone"] == [500, 750, 1_000, 1_250, 1_500, 1_750, 2_250, 2_500, 2_750]
    assert fired["clone_and_split"] == [step for step in range(600, 3_000, 100) if step != 2_000]
    assert fired["reinitialise_from_depth"] == [2_000]
    assert fired["simplify"] == fired["store_sh"] == [3_000]
    assert fired["stop_culling"] == [13_000]
    assert fired["prune_tail"] == [8_000]
    assert recipe.adam.is_visible_only and recipe.adam.has_bias_correction
    assert recipe.learning_rates.of["opacity_logits"] == 0.025
    assert recipe.learning_rates.of["means"] == RECIPES["3dgs"].learning_rates.of["means"]


@pytest.mark.parametrize("name", ["mini-splatting-d", "mini-splatting2-d"])
def test_dense_recipes_do_not_sample(name):
    """Their densification is that of the recipe that is named after."""
    fired, other = firings(RECIPES[name]), firings(RECIPES[name.removesuffix("-d")])
    assert fired.keys() == other.keys() - {"simplify", *(["prune_tail", "restart_adam"] if "2" not in name else [])}
    assert all(fired[action] == other[action] for action in fired.keys() - {"prune_tail"})
    prunings = [event.step for event in RECIPES[name].events if action_name(event) == "prune_tail"]
    assert prunings == ([3_000, 8_000] if "2" in name else [])


# Published values: those of the released code of 3DGS (2023), of its later optimiser (``-accel``), of Mini-Splatting
# and of Mini-Splatting2. What is our own (``max_per_pixel``, ``min_area``, the vote on depths) is not among them.
PUBLISHED = [name for name, recipe in RECIPES.items() if recipe.cooling is None]  # the others have no schedule
OPACITY_RATES = {"3dgs": 0.05, "mini-splatting": 0.05, "mini-splatting-d": 0.05}  # the others: half of it
SH_MILESTONES = {"3dgs": (1_000, 2_000, 3_000), "mini-splatting": (16_000, 17_000, 18_000)}
SH_MILESTONES |= {"3dgs-accel": SH_MILESTONES["3dgs"], "mini-splatting-d": SH_MILESTONES["mini-splatting"]}
ADAMS = {"3dgs": (False, True), "3dgs-accel": (True, False)}  # is_visible_only, has_bias_correction
ADAMS |= {"mini-splatting": (False, True), "mini-splatting-d": (False, True)}
OF_3DGS = {
    "clone_and_split": {"threshold": 2e-4, "size_fraction": 0.01},
    "prune_faint": {"min_opacity": 0.005},
    "prune_large": {"size_fraction": 0.1},
    "reset_opacity": {"ceiling": 0.01},
    "reset_opacity_on_white": {"ceiling": 0.01},
}
OF_MINI_SPLATTING = {
    "clone_and_split": OF_3DGS["clone_and_split"] | {"draw_children": "random_children"},
    "prune_faint": OF_3DGS["prune_faint"],
    "prune_large_by_distance": {"size_fraction": 0.1},
    "collect_blur": {"area_fraction": 2e-4},
    "reinitialise_from_depth": {"points_of": "midpoint_points", "min_alpha": 0.0},
    "simplify": {"choose": "by_sampling", "keep_fraction": 0.5, "min_views": 0, "is_intersecting": True},
    "store_sh": {"sh_degree": 3},
    "restart_from_means": {"sh_degree": 3},
    "prune_tail": {"mass": 0.99, "min_views": 0, "is_intersecting": True},
}
_FEW_SEE = {"min_views": 2, "visibility_mass": 0.99}
OF_MINI_SPLATTING2 = {
    "halve_large_views": {"max_halvings": 1},
    **{action: OF_MINI_SPLATTING[action] for action in ("clone_and_split", "prune_faint", "collect_blur", "store_sh")},
    "reinitialise_from_depth": {
        **OF_MINI_SPLATTING["reinitialise_from_depth"],
        **{"points_per_gaussian": 1.0, "drawn_mass": 0.99},
    },
    "aggressive_clone": {"critical": "critical_by_mass", "factor": 2, "tail_mass": 0.999, **_FEW_SEE},
    "simplify": {"choose": "by_sampling", "keep_fraction": 0.6, "is_intersecting": True, **_FEW_SEE},
    "prune_tail": {"mass": 0.99, "is_intersecting": True, **_FEW_SEE},
}
DENSE = {action: settings for action, settings in OF_MINI_SPLATTING.items() if action not in ("simplify", "prune_tail")}
DENSE2 = {action: settings for action, settings in OF_MINI_SPLATTING2.items() if action != "simplify"}
SETTINGS = {
    "3dgs": OF_3DGS,
    "3dgs-accel": OF_3DGS,
    "mini-splatting": OF_MINI_SPLATTING,
    "mini-splatting-d": DENSE,
    "mini-splatting2": OF_MINI_SPLATTING2,
    "mini-splatting2-d": DENSE2 | {"prune_tail": {"mass": 0.99, "is_intersecting": False, **_FEW_SEE}},
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_rates_and_losses_are_the_published_ones(name):
    recipe = describe(RECIPES[name])
    rates = dict(recipe["learning_rates"]["of"])
    rewind = {"at": 15_000, "to": 5_000} if name in ("mini-splatting", "mini-splatting-d") else None
    assert rates.pop("means") == {"first": 1.6e-4, "last": 1.6e-6, "steps": 30_000, "rewind": rewind}
    assert rates == {
        "quats": 1e-3,
        "log_scales": 5e-3,
        "opacity_logits": OPACITY_RATES.get(name, 0.025),
        "sh_dc": 2.5e-3,
        "sh_rest": 1.25e-4,
    }
    assert recipe["learning_rates"]["per_extent"] == ["means"]
    assert recipe["adam"] == {
        **dict(zip(("is_visible_only", "has_bias_correction"), ADAMS.get(name, (True, True)), strict=True)),
        **{"beta1": 0.9, "beta2": 0.999, "eps": 1e-15},
    }
    assert tuple(recipe["sh_milestones"]) == SH_MILESTONES.get(name, (4_000, 5_000, 6_000))
    assert recipe["sh_degree"] == (3 if name.startswith("3dgs") else 0) and not recipe["has_random_background"]
    assert recipe["iterations"] == (18_000 if "2" in name else 30_000)
    assert [(loss["name"], loss["weight"], loss["settings"]) for loss in recipe["losses"]] == [
        ("photometric", 1.0, {"dssim_weight": 0.2})
    ]


@pytest.mark.parametrize("name", PUBLISHED)
def test_settings_are_the_published_ones(name):
    """Every action of the table is in the recipe, every one with settings in the table."""
    actions = [event.action for event in RECIPES[name].events if isinstance(event.action, partial)]
    assert {action.func.__name__ for action in actions} == SETTINGS[name].keys()
    for action in actions:
        parameters = inspect.signature(action).parameters  # with the recipe's settings as the defaults
        for key, value in SETTINGS[name][action.func.__name__].items():
            actual = parameters[key].default
            assert getattr(actual, "__name__", actual) == value, (action, key)


def test_settings_are_replaced_in_every_event_that_has_them():
    recipe = configure(RECIPES["mini-splatting"], metric=outdoor, budget=1_000)
    settings = [event["settings"] for event in describe(recipe)["events"]]
    assert [s["metric"] for s in settings if "metric" in s] == ["outdoor", "outdoor"]
    assert [s["budget"] for s in settings if "budget" in s] == [1_000]
    assert firings(recipe) == firings(RECIPES["mini-splatting"])
    with pytest.raises(InputError, match="recipe 3dgs has no budget to set"):
        configure(RECIPES["3dgs"], budget=1_000)


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_can_be_described_and_scaled(name):
    for recipe in (RECIPES[name], get_recipe(name, 3_000), get_recipe(name, 1)):
        assert json.loads(json.dumps(describe(recipe)))["name"] == name


def published_firings(event):
    """Iterations at which an event of a published recipe acts, without those at every iteration."""
    return [event.step] if isinstance(event, At) else firing(event, event.stop)


LENGTHS = [
    pytest.param((*range(100, 600), *range(600, 60_001, 487)), id="densest where rounding bites"),
    pytest.param(range(100, 60_001), id="all", marks=pytest.mark.slow),
]
"""Of compressed and stretched runs."""


@pytest.mark.parametrize("lengths", LENGTHS)
@pytest.mark.parametrize("name", ["mini-splatting", "mini-splatting2"])
def test_events_keep_their_order_and_gaps_at_every_length(name, lengths):
    """Of any two published iterations, the earlier stays the earlier, and their gap is in proportion.

    Rounding moves each by half an iteration at most. What `min_gap` thins is in the next test.
    """
    recipe = RECIPES[name]
    events = [
        event for event in recipe.events if getattr(event, "period", 250) >= 250 and isinstance(event, DatedEvent)
    ]
    published = sorted((step, number) for number, event in enumerate(events) for step in published_firings(event))
    assert len(published) == {"mini-splatting": 7, "mini-splatting2": 14}[name]
    for n in lengths:
        factor = Fraction(n, recipe.iterations)
        steps = [round(step * factor) for step, _ in published]
        for (_, number), step in zip(published, steps, strict=True):
            event = events[number].scale(factor)
            assert event.is_due(step), (n, step)
        assert steps == sorted(steps), n
        gaps = np.diff(steps) - np.diff([step for step, _ in published]) * (n / recipe.iterations)
        assert np.abs(gaps).max() <= 1 + 1e-9, n


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("n", [100, 999, 1_000, 3_001, 5_000, 6_000, 18_000, 30_000, 60_000])
def test_a_compressed_schedule_is_part_of_the_published_one(name, n):
    """Nothing happens that was not published, in the published order, and no two density events come too close."""
    recipe = RECIPES[name]
    factor = Fraction(n, recipe.iterations)
    for event in recipe.events:
        if isinstance(event, Every):
            published = {round(step * factor) for step in firing(event, event.stop)}
            steps = firing(event.scale(factor), n)
            assert set(steps) <= published
            gaps = np.diff([*steps, round(event.stop * factor)])
            assert all(gaps >= event.min_gap - 1), gaps  # each end is rounded by up to a half
            if event.period * factor >= event.min_gap:
                assert set(steps) == published


def test_the_last_density_event_is_as_far_from_simplification_as_published():
    """Published 250 iterations. It was 4 of 1,000, where coincident copies never both lead and half of them go."""
    for n in (3_000, 6_000, 12_000):
        recipe = get_recipe("mini-splatting2", n)
        fired = firings(recipe)
        gap = fired["simplify"][0] - fired["aggressive_clone"][-1]
        assert gap == pytest.approx(250 * n / 18_000, abs=1)


def test_rates_of_short_runs_are_raised_where_the_recipe_says_so():
    recipe = RECIPES["3dgs"]._replace(short_run_exponent=0.5)
    short, rates = (dict(r.learning_rates.of) for r in (scale_recipe(recipe, 7_500), recipe))
    short_means, means = short.pop("means"), rates.pop("means")
    assert len(short) == 5 and short == pytest.approx({name: 2 * rate for name, rate in rates.items()})
    assert (short_means.first, short_means.last) == pytest.approx((4 * means.first, 4 * means.last))
    assert rates.items() <= scale_recipe(recipe, 60_000).learning_rates.of.items()  # longer runs keep them


def test_rewind_and_warm_up_are_scaled():
    assert get_recipe("mini-splatting", 3_000).learning_rates.of["means"].rewind == (1_500, 500)
    assert firings(get_recipe("mini-splatting2", 1_800))["halve_large_views"] == list(range(1, 301))


def test_scaled_to_a_tenth():
    recipe = get_recipe("3dgs", 3_000)
    fired = firings(recipe)
    assert fired["collect_gradients"] == list(range(1, 1_500))
    assert fired["clone_and_split"] == fired["prune_faint"] == list(range(100, 1_500, 100))  # not every 10
    assert fired["prune_large"] == list(range(400, 1_500, 100))
    assert fired["reset_opacity"] == [300, 600, 900, 1_200]
    assert fired["reset_opacity_on_white"] == [50]
    assert recipe.sh_milestones == (100, 200, 300)
    assert recipe.learning_rates.of["means"].at(1_500) == RECIPES["3dgs"].learning_rates.of["means"].at(15_000)
    assert {name: r for name, r in recipe.learning_rates.of.items() if name != "means"} == {
        name: r for name, r in RECIPES["3dgs"].learning_rates.of.items() if name != "means"
    }


def test_a_published_iteration_is_rounded_by_itself():
    event = Every(100, nothing, start=500, stop=15_000).scale(Fraction(7, 30))  # 140, 163.33, 186.67, 210
    assert firing(event)[:4] == [140, 163, 187, 210] and len(firing(event)) == 144
    assert firing(Every(100, nothing, stop=1_000, min_gap=50).scale(Fraction(1, 5)), 200) == [20, 80, 140]
    assert firing(Every(100, nothing, min_gap=50).scale(Fraction(1, 5)), 200) == [60, 120, 180]  # without an end
    longer = firings(scale_recipe(RECIPES["3dgs"], 60_000))
    assert longer["collect_gradients"] == list(range(1, 30_000))  # every iteration, not every second one
    assert longer["clone_and_split"] == list(range(1_200, 30_000, 200))


def test_scaled_to_next_to_nothing():
    assert firings(get_recipe("3dgs", 1)).keys() == firings(RECIPES["3dgs"]).keys()
    assert firing(Every(100, nothing).scale(Fraction(1, 1_000)), 5) == [1, 2, 3, 4, 5]
    assert At(100, nothing).scale(Fraction(1, 1_000)) == At(1, nothing)


def test_scaled_by_one_changes_nothing():
    assert scale_recipe(RECIPES["3dgs"], 30_000) == RECIPES["3dgs"]


def test_what_tells_the_two_recipes_apart():
    dense, accelerated = RECIPES["3dgs"], RECIPES["3dgs-accel"]
    assert (dense.learning_rates.of["opacity_logits"], accelerated.learning_rates.of["opacity_logits"]) == (0.05, 0.025)
    assert not dense.adam.is_visible_only and dense.adam.has_bias_correction
    assert accelerated.adam.is_visible_only and not accelerated.adam.has_bias_correction
    assert dense.adam.eps == accelerated.adam.eps == 1e-15
    assert dense.events == accelerated.events


def test_bad_input():
    with pytest.raises(InputError, match="recipe '4dgs' does not exist; did you mean 3dgs"):
        get_recipe("4dgs")
    with pytest.raises(InputError, match="iterations is 0"):
        get_recipe("3dgs", 0)


def test_every_term_that_counts_is_described():
    losses = tuple(LossTerm(str(weight), nothing, weight) for weight in (-0.5, 0.0, 2.0))
    assert [loss["name"] for loss in describe(RECIPES["3dgs"]._replace(losses=losses))["losses"]] == ["-0.5", "2.0"]


def test_description_is_json_and_tells_settings_apart():
    recipe = RECIPES["3dgs"]
    description = json.loads(json.dumps(describe(recipe)))
    assert description["iterations"] == 30_000
    assert description["learning_rates"]["of"]["means"] == {
        **{"first": 1.6e-4, "last": 1.6e-6, "steps": 30_000, "rewind": None}
    }
    densify = description["events"][1]
    assert densify["event"] == "Every" and densify["action"] == "clone_and_split"
    assert densify["settings"] == {"threshold": 2e-4, "size_fraction": 0.01}
    other = recipe._replace(events=(Every(100, partial(gaussian_splatting.prune_faint, min_opacity=0.1)),))
    assert json.loads(json.dumps(describe(other))) != description


ADDS_ROWS = re.compile("clone|split|densif|reinit|grow|insert|promote|control|halve_large$")


@pytest.mark.parametrize("iterations", [30, 100, 300, 590, 750, 1500, 3000, 18_000])
@pytest.mark.parametrize("name", [*RECIPES, *(recipe.name for e in load_extensions() for recipe in e.recipes)])
def test_no_schedule_ends_right_after_a_densification(name, iterations):
    """What was added has two fifths of the iterations to be trained, or as large a part as in the published length."""
    recipe = find_recipe(name)
    if recipe.cooling is not None:
        return  # it decides when its growth ends, and cools down for half as long

    def last_share(recipe):
        adding = [e for e in recipe.events if isinstance(e, DatedEvent) and ADDS_ROWS.search(action_name(e))]
        due = (step for step in range(recipe.iterations, 0, -1) if any(event.is_due(step) for event in adding))
        return next(due, 0) / recipe.iterations

    assert last_share(find_recipe(name, iterations)) <= max(0.6, last_share(recipe) + 0.5 / iterations)


def test_the_demo_ends_with_its_schedule():
    """It trains its recipe whole: the first part of a longer schedule would end while Gaussians are added."""
    assert demo.RECIPE == "mini-splatting2" and not hasattr(demo, "SCHEDULE_ITERATIONS")
