"""Ctrl-C and failures at every place of an iteration: the state is whole, or it says that it is not."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training import interruption
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.interruption import Interruptions, terminated_like_interrupted
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.saved_state import save_state
from minisplat_ref.training.schedule import At
from tiny_training import RECIPE, assert_same_bytes, scene, uninterrupted  # noqa: F401  (fixtures)


class Unexpected(Exception):
    """What no code expects."""


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until a test puts it forward."""
    times = [0.0]
    monkeypatch.setattr(interruption.time, "monotonic", lambda: times[0])
    return times


def press():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("stage", ["project", "composite", "photometric_loss", "composite_vjp", "project_vjp"])
@pytest.mark.parametrize("call", [1, 7])
def test_ctrl_c_while_a_view_is_drawn_comes_at_once(scene, uninterrupted, stage, call):
    """Nothing has changed yet: no kernel is waited for, and the iteration is done again as if it had not begun."""
    calls = []

    def pressed(*args, **named):
        calls.append(1)
        if len(calls) == call:
            press()
            raise AssertionError("continued after Ctrl-C")
        return getattr(CPU, stage)(*args, **named)

    state = initial_state(scene, RECIPE, 3)
    with pytest.raises(KeyboardInterrupt):
        train(scene, RECIPE, seed=3, state=state, backend=replace(CPU, **{stage: pressed}))
    assert (state.step, state.is_whole) == (call - 1, True)
    train(scene, RECIPE, seed=3, state=state)
    assert_same_bytes(state, uninterrupted)


@pytest.mark.parametrize("stage", ["composite", "composite_vjp"])
def test_an_error_while_a_view_is_drawn_loses_nothing(scene, uninterrupted, stage):
    def failing(*args, **named):
        raise Unexpected

    state = initial_state(scene, RECIPE, 3)
    train(scene, RECIPE._replace(iterations=12), seed=3, state=state)
    with pytest.raises(Unexpected):
        train(scene, RECIPE, seed=3, state=state, backend=replace(CPU, **{stage: failing}))
    assert (state.step, state.is_whole) == (12, True)
    train(scene, RECIPE, seed=3, state=state)
    assert_same_bytes(state, uninterrupted)


def test_an_error_in_an_event_leaves_a_state_that_cannot_be_saved(scene, tmp_path):
    def failing(state, iteration):
        raise InputError("nothing to choose from")

    recipe = RECIPE._replace(events=(*RECIPE.events, At(12, failing)))
    state = initial_state(scene, recipe, 3)
    with pytest.raises(InputError, match="nothing to choose"):
        train(scene, recipe, seed=3, state=state)
    assert (state.step, state.is_whole) == (11, False)
    with pytest.raises(AssertionError, match="half an iteration"):
        save_state(tmp_path / "checkpoint.npz", state, recipe)
    assert not any(tmp_path.iterdir())


def test_a_loss_term_that_refuses_leaves_the_draws_alone(scene):
    def refuse(rendered):
        raise InputError("the scene lacks something")

    recipe = RECIPE._replace(losses=(*RECIPE.losses, LossTerm("refusing", refuse, 1.0)), has_random_background=True)
    state = initial_state(scene, recipe, 3)
    order, draws = list(state.view_order), state.rng.bit_generator.state
    with pytest.raises(InputError):
        train(scene, recipe, seed=3, state=state)
    assert (state.view_order, state.rng.bit_generator.state, state.is_whole) == (order, draws, True)


@pytest.mark.parametrize(("seconds", "step"), [(0.5, 12), (2.0, 11)])
def test_who_presses_again_does_not_wait_for_the_iteration(scene, clock, seconds, step):
    """But the same Ctrl-C twice, from the terminal and from a parent that sends it along, counts once."""
    after = []

    def press_twice(state, iteration):
        press()
        clock[0] += seconds
        press()
        after.append(True)

    recipe = RECIPE._replace(events=(At(12, press_twice), *RECIPE.events))
    state = initial_state(scene, recipe, 3)
    with pytest.raises(KeyboardInterrupt):
        train(scene, recipe, seed=3, state=state)
    assert (state.step, state.is_whole, after) == (step, step == 12, [True] if step == 12 else [])


def test_termination_counts_as_ctrl_c_where_the_program_says_so(scene, uninterrupted):
    def terminate(state, iteration):
        os.kill(os.getpid(), signal.SIGTERM)

    recipe = RECIPE._replace(events=(At(12, terminate), *RECIPE.events))
    state = initial_state(scene, recipe, 3)
    before = signal.getsignal(signal.SIGTERM)
    with terminated_like_interrupted(), pytest.raises(KeyboardInterrupt):
        train(scene, recipe, seed=3, state=state)
    assert signal.getsignal(signal.SIGTERM) is before
    assert (state.step, state.is_whole) == (12, True)
    train(scene, RECIPE, seed=3, state=state)
    assert_same_bytes(state, uninterrupted)


def test_what_was_held_back_to_the_end_is_raised_there():
    handler = signal.getsignal(signal.SIGINT)
    done = []
    with pytest.raises(KeyboardInterrupt), Interruptions() as interruptions:
        interruptions.defer()
        press()
        done.append(np.zeros(3))
    assert len(done) == 1 and signal.getsignal(signal.SIGINT) is handler
