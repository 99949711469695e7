"""The loop on a scene of five tiny images: it learns, it repeats, it resumes, it stops when told to."""

import os
import signal
import time
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.geometry import EXTENSION as GEOMETRY
from minisplat_ref.extensions.geometry import kernels
from minisplat_ref.extensions.geometry.weights import GeometricWeights
from minisplat_ref.methods import RECIPES, gaussian_splatting
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.rates import LogLinear
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import BLEND_STATS, At, During, SmallerViews
from minisplat_ref.training.smaller_views import halve_large_views
from minisplat_ref.training.state import FiredEvent
from minisplat_ref.types import Gaussians
from tiny_training import (  # noqa: F401  (fixtures)
    EVENTS,
    N_GAUSSIANS,
    N_VIEWS,
    PLAIN,
    RECIPE,
    all_arrays,
    assert_same_bytes,
    scene,
    uninterrupted,
)


def test_an_image_is_gone_before_the_next_is_made(scene):
    last, was_alive = [], []

    def project(*args, **kwargs):
        was_alive.extend(image() is not None for image in last)
        return CPU.project(*args, **kwargs)

    def on_step(report):
        last[:] = [weakref.ref(report.output.image)]

    train(scene, PLAIN._replace(iterations=4), seed=0, on_step=on_step, backend=replace(CPU, project=project))
    assert was_alive == [False] * 3


# It learns ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["3dgs", "3dgs-accel"])
@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda b: b.name)
def test_overfits_a_tiny_scene(scene, name, backend):
    recipe = PLAIN._replace(name=name, adam=RECIPES[name].adam, learning_rates=RECIPES[name].learning_rates)
    state, losses = initial_state(scene, recipe, 0), []
    before = evaluate(state.gaussians, scene.train_views, RenderSettings(scene.background, backend=backend))
    train(scene, recipe, seed=0, state=state, on_step=lambda report: losses.append(report.loss), backend=backend)
    after = evaluate(state.gaussians, scene.train_views, RenderSettings(scene.background, backend=backend))
    assert len(losses) == 60
    assert np.mean(losses[-N_VIEWS:]) < 0.75 * np.mean(losses[:N_VIEWS])
    assert after.psnr > before.psnr + 3.0
    assert after.ssim > before.ssim


def test_backends_train_alike(scene):
    """Twelve iterations of either backend: the same views, and renderings that agree."""
    reference, cpu = (
        train(scene, PLAIN._replace(iterations=12), seed=0, backend=backend) for backend in (REFERENCE, CPU)
    )
    assert reference.view_order == cpu.view_order
    images = [render(s.gaussians, scene.train_views[0].camera, backend=REFERENCE)[0].image for s in (reference, cpu)]
    assert np.abs(images[0] - images[1]).mean() < 1e-3


def test_every_event_happens(scene):
    counts = []
    state = train(
        scene, RECIPE, seed=0, on_step=lambda report: counts.append(len(report.state.gaussians.means)), backend=CPU
    )
    assert set(counts[:9]) == {N_GAUSSIANS}
    assert counts[9] > N_GAUSSIANS  # iteration 10 densifies
    assert len(counts) == 40 and counts[-1] == len(state.gaussians.means)
    assert all(len(array) == counts[-1] for array in all_arrays(state).values())
    assert state.gaussians.sh_rest.any()  # degree 1 from iteration 10 on


def test_the_loop_tells_what_fired(scene):
    """Each event but those of every iteration, with the counts that it found and left."""
    fired, counts = [], [N_GAUSSIANS]

    def slowly(state, iteration):
        time.sleep(0.05)
        return "slept"

    def on_step(report):
        fired.extend((report.step, event) for event in report.fired)
        counts.append(len(report.state.gaussians.means))

    train(scene, RECIPE._replace(events=(*EVENTS, At(33, slowly))), seed=0, on_step=on_step)
    of_ten = [(10, "clone_and_split"), (10, "prune_faint"), (20, "clone_and_split"), (20, "prune_faint")]
    expected = [*of_ten, (20, "prune_large"), (25, "reset_opacity"), (33, "slowly")]
    assert [(step, event.action) for step, event in fired] == expected
    for step in (10, 20, 25, 33):
        n = counts[step - 1]
        for event in (event for at, event in fired if at == step):
            assert event.n_before == n
            n = event.n_after
        assert n == counts[step]
    assert fired[0][1].n_after > fired[0][1].n_before
    assert [event.note for _, event in fired] == [None] * 6 + ["slept"]
    assert fired[-1][1].seconds >= 0.05


def once(scene):
    return 1


def test_the_loop_tells_whether_views_were_halved(scene):
    def recipe_with(action):
        return PLAIN._replace(iterations=4, events=(SmallerViews(action, until=3),))

    told, recipe = [], recipe_with(partial(halve_large_views, min_side=16, max_halvings=1))
    train(scene, recipe, seed=0, on_step=lambda report: told.extend((report.step, event) for event in report.fired))
    assert told == []  # the views are too small for it
    train(
        scene,
        recipe_with(once),
        seed=0,
        on_step=lambda report: told.extend((report.step, event) for event in report.fired),
    )
    n = N_GAUSSIANS
    assert told == [(1, FiredEvent("once", n, n, 0.0, "to 1/2 of their size until iteration 3"))]


def test_rates_are_those_of_the_iteration_that_is_done(scene):
    """Counted from 1. Adam without bias corrections hands the rate on as it is; means are the first field."""
    schedule, taken = LogLinear(1e-3, 1e-5, 3), []

    def adam_update(*arrays_and_step):
        taken.append(arrays_and_step[-1].rate)
        return CPU.adam_update(*arrays_and_step)

    recipe = PLAIN._replace(iterations=3, learning_rates=PLAIN.learning_rates.change(means=schedule))
    train(scene._replace(extent=2.0), recipe, seed=0, backend=replace(CPU, adam_update=adam_update))
    assert taken[:: len(Gaussians._fields)] == [2.0 * schedule.at(step) for step in (1, 2, 3)]


def test_mask_and_random_background(scene):
    masked = tuple(view._replace(mask=np.zeros((16, 24), bool)) for view in scene.train_views)
    state = initial_state(scene, PLAIN, 0)
    before = state.gaussians.means.copy()
    train(scene._replace(train_views=masked), PLAIN._replace(iterations=3), seed=0, state=state)
    assert_array_equal(state.gaussians.means, before)  # nothing counts, nothing moves

    corners = []
    random = PLAIN._replace(iterations=4, has_random_background=True)
    train(scene, random, seed=0, on_step=lambda report: corners.append(report.output.image[0, 0]))
    assert np.ptp(corners, axis=0).max() > 0.1


def test_blend_statistics_only_where_asked_for(scene):
    seen = {}
    note = lambda state, iteration: seen.update({state.step + 1: iteration.output.stats})  # noqa: E731
    recipe = PLAIN._replace(
        iterations=4, events=(During(note, stop=4), During(lambda *_: None, 1, 3, wants=BLEND_STATS))
    )
    train(scene, recipe, seed=0)
    assert {step: stats is not None for step, stats in seen.items()} == {1: False, 2: True, 3: False}


def with_geometry(**weights):
    return configure(PLAIN._replace(losses=(*PLAIN.losses, *GEOMETRY.losses)), **weights)


def test_geometric_terms_join_the_loss(scene):
    """Smooth depth is paid for, and trained: the same run with the term ends with less of it."""

    def roughness(state):
        camera = scene.train_views[0].camera
        output, _ = render(state.gaussians, camera, with_depth=True)
        target = np.zeros((camera.height, camera.width, 3), np.float32)
        weights = GeometricWeights(depth_smoothness=1.0)
        return kernels.geometric_loss(output.image[..., 3], output.alpha, target, camera, scene.points[:0], weights)[0]

    plain, smooth = [], []
    recipe = with_geometry(depth_smoothness=2.0)
    rough = train(scene, PLAIN, seed=0, on_step=lambda report: plain.append(report.loss))
    smoothed = train(scene, recipe, seed=0, on_step=lambda report: smooth.append(report.loss))
    assert smooth[0] > plain[0]
    assert roughness(smoothed) < 0.8 * roughness(rough)


def test_depth_of_points_needs_to_know_who_sees_them(scene):
    recipe = with_geometry(sfm_depth=0.1)
    with pytest.raises(InputError, match="tiny does not say which view sees which point"):
        train(scene, recipe, seed=0)


def test_action_may_raise_the_stored_degree(scene):
    """Mini-Splatting starts without view-dependent colour and makes room for it later."""

    def widen(population):
        return population._replace(sh_rest=np.zeros((len(population.means), 3, 3), np.float32))

    def store_degree_one(state, iteration):
        state.gaussians = widen(state.gaussians)
        state.adam = state.adam._replace(first=widen(state.adam.first), second=widen(state.adam.second))

    recipe = PLAIN._replace(iterations=6, sh_degree=0, sh_milestones=(2,), events=(At(4, store_degree_one),))
    assert train(scene, recipe, seed=0).gaussians.sh_rest.any()


# It repeats -----------------------------------------------------------------------------------------------------------


def test_views_come_once_per_round_in_changing_order(scene):
    names = []
    train(scene, PLAIN._replace(iterations=24), seed=1, on_step=lambda report: names.append(report.view.name))
    rounds = [names[i : i + N_VIEWS] for i in range(0, 24, N_VIEWS)]
    assert all(sorted(one) == ["view0", "view1", "view2", "view3"] for one in rounds)
    assert len({tuple(one) for one in rounds}) > 1


def test_same_seed_same_bytes(scene, uninterrupted):
    assert_same_bytes(train(scene, RECIPE, seed=3), uninterrupted)
    briefly = RECIPE._replace(iterations=3)
    first, other = (train(scene, briefly, seed=seed) for seed in (3, 4))
    assert first.gaussians.means.tobytes() != other.gaussians.means.tobytes()


@pytest.mark.parametrize("stop", [14, 20])
def test_resumed_is_bit_equal_to_uninterrupted(scene, uninterrupted, stop, tmp_path):
    """In the middle of a round of views, when statistics are half collected, and right after an event."""
    path = tmp_path / "checkpoint.npz"
    save_state(path, train(scene, RECIPE._replace(iterations=stop), seed=3), RECIPE)
    resumed = load_state(path, RECIPE)
    assert resumed.step == stop
    train(scene, RECIPE, seed=999, state=resumed)
    assert_same_bytes(resumed, uninterrupted)


def test_finished_training_stays_as_it_is(scene):
    state = train(scene, RECIPE, seed=0)
    before = state.gaussians.means.tobytes()
    train(scene, RECIPE, seed=0, state=state)
    assert state.step == 40 and state.gaussians.means.tobytes() == before


# It stops when told to ------------------------------------------------------------------------------------------------


def test_ctrl_c_waits_for_the_end_of_the_iteration(scene, uninterrupted):
    """The signal arrives inside an iteration; the state that remains continues as if nothing had been."""

    def press(state, iteration):
        os.kill(os.getpid(), signal.SIGINT)
        pressed.append(state.step)

    pressed = []
    handler = signal.getsignal(signal.SIGINT)
    recipe = RECIPE._replace(events=(At(12, press), *EVENTS))
    state = initial_state(scene, recipe, 3)
    with pytest.raises(KeyboardInterrupt):
        train(scene, recipe, seed=3, state=state)
    assert pressed == [11] and state.step == 12
    assert signal.getsignal(signal.SIGINT) is handler
    train(scene, RECIPE, seed=3, state=state)
    assert_same_bytes(state, uninterrupted)


# Bad input ------------------------------------------------------------------------------------------------------------


def test_scene_without_views(scene):
    with pytest.raises(InputError, match="tiny has no training views"):
        train(scene._replace(train_views=()), RECIPE, seed=0)


@pytest.mark.parametrize("name", ["3dgs", "3dgs-accel"])
def test_one_view_is_enough(scene, name):
    """3DGS compares nothing between views."""
    state = initial_state(scene._replace(train_views=scene.train_views[:1]), RECIPES[name], 0)
    assert len(state.gaussians.means) == N_GAUSSIANS


def test_resuming_another_scene(scene):
    state = initial_state(scene, RECIPE, 0)
    state.view_order = [3, 0]
    with pytest.raises(InputError, match="fewer training views"):
        train(scene._replace(train_views=scene.train_views[:2]), RECIPE, seed=0, state=state)


def test_resuming_with_another_recipe(scene, tmp_path):
    path = tmp_path / "checkpoint.npz"
    save_state(path, initial_state(scene, RECIPE, 0), RECIPE)
    load_state(path, RECIPE)
    with pytest.raises(InputError, match=r"written by recipe 3dgs-accel of 40 iterations.*continue with the recipe"):
        load_state(path, RECIPE._replace(iterations=50))


def test_no_gaussians_left(scene):
    """A recipe that prunes everybody continues rendering the background."""
    recipe = RECIPE._replace(events=(*EVENTS, At(5, partial(gaussian_splatting.prune_large, size_fraction=1e-9))))
    state = train(scene, recipe, seed=0)
    assert len(state.gaussians.means) == 0 and state.step == 40
