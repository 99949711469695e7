"""Numbers that go wrong: named by stage, view and row, written to a file, and the step dropped where asked for."""

import os
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.io.checkpoint import save_checkpoint
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.case import load_case
from minisplat_ref.training.guard import BadNumbers, Guard, examine
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import At
from tiny_training import RECIPE, all_arrays, assert_same_bytes, scene, uninterrupted  # noqa: F401  (fixtures)

ROW = 3


def with_bad(stage, field, at, value=np.nan, backend=CPU):
    """The backend with wrong numbers in row ROW of an output of a stage, in calls ``at``."""
    calls = []

    def broken(*args, **named):
        output = getattr(backend, stage)(*args, **named)
        calls.append(1)
        if len(calls) not in at:
            return output
        array = (output if field is None else getattr(output, field)).copy()
        array[ROW] = value
        return array if field is None else output._replace(**{field: array})

    return replace(backend, **{stage: broken})


STAGES = [
    ("project", "conics", "project: conics is nan in row 3 of 30"),
    ("sh_colors", None, "sh_colors: colors is nan in row 3 of 30"),
    ("photometric_loss_vjp", None, r"photometric_loss_vjp: v_image is nan at pixel \(0, 3\)"),
    ("composite_vjp", "means2d", "composite_vjp: v_means2d is nan in row 3 of 30"),
    ("sh_colors_vjp", "sh_dc", "sh_colors_vjp: v_sh_dc is nan in row 3 of 30"),
    ("project_vjp", "quats", "project_vjp: v_quats is nan in row 3 of 30"),
]


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda b: b.name)
@pytest.mark.parametrize(("stage", "field", "named"), STAGES, ids=lambda s: s if isinstance(s, str) else "")
def test_the_stage_in_which_it_arises_is_named(scene, stage, field, named, backend, tmp_path):
    """From the seventh view on one number is wrong, as often as it is drawn."""
    broken = with_bad(stage, field, range(7, 100), backend=backend)
    state = initial_state(scene, RECIPE, 3)
    with pytest.raises(BadNumbers, match=named) as caught:
        train(scene, RECIPE, seed=3, state=state, backend=broken, guard=Guard(every=1, folder=tmp_path))
    assert (state.step, state.is_whole) == (6, True)
    view = scene.train_views[state.view_order[-1]]
    path = tmp_path / "bad-numbers-7.npz"
    assert str(caught.value).startswith(f"iteration 7, view {view.name}, {stage}: ")
    assert str(caught.value).endswith(f"; minisplat-ref oracle replay {path} shows it with every backend")
    assert "\n" not in str(caught.value)


def test_the_file_holds_all_that_the_view_took(scene, tmp_path):
    masked = scene.train_views[0]._replace(mask=np.arange(24 * 16).reshape(16, 24) % 5 > 0, point_ids=np.arange(4))
    views = (masked, *scene.train_views[1:])
    broken = with_bad("project_vjp", "means", range(7, 100), np.inf)
    state = initial_state(scene, RECIPE, 3)
    recipe = RECIPE._replace(has_random_background=True)
    seen = {}

    def project(*args, **named):
        seen.update(means=args[0].copy(), camera=args[4])
        return CPU.project(*args, **named)

    with pytest.raises(BadNumbers, match="v_means is inf in row 3"):
        train(
            scene._replace(train_views=views),
            recipe,
            seed=3,
            state=state,
            backend=replace(broken, project=project),
            guard=Guard(every=1, folder=tmp_path, settings={"seed": 3}),
        )
    saved = load_case(tmp_path / "bad-numbers-7.npz")
    assert saved.wrong == "project_vjp: v_means is inf in row 3 of 30" and saved.metadata["settings"] == {"seed": 3}
    case = saved.of(recipe)
    np.testing.assert_array_equal(case.model.gaussians.means, seen["means"])
    view = views[state.view_order[-1]]
    for field in ("name", "time"):
        assert getattr(case.view, field) == getattr(view, field)
    np.testing.assert_equal(case.view.image, view.image)
    np.testing.assert_equal(case.view.mask, view.mask)
    np.testing.assert_equal(case.view.point_ids, view.point_ids)
    np.testing.assert_equal(tuple(case.view.camera), tuple(view.camera))
    assert type(case.view.camera.width) is int
    np.testing.assert_equal(case.scene.points, scene.points)
    assert (case.step, case.request.sh_degree, case.scene.extent) == (7, 0, scene.extent)
    examined = examine(case._replace(request=case.request._replace(backend=CPU)))
    assert examined.wrong is None and np.isfinite(examined.output.image).all()  # nothing is wrong without the error


def poison(state, iteration, *, field="opacity_logits"):
    getattr(state.gaussians, field)[ROW] = np.nan


def test_an_event_that_makes_it_is_named(scene, tmp_path):
    recipe = RECIPE._replace(events=(*RECIPE.events, At(13, partial(poison, field="log_scales"))))
    state = initial_state(scene, recipe, 3)
    with pytest.raises(BadNumbers, match=r"iteration 13, view view\d, event poison: log_scales is nan in row 3 of"):
        train(scene, recipe, seed=3, state=state, guard=Guard(folder=tmp_path))
    assert (state.step, state.is_whole) == (12, False)
    assert (tmp_path / "bad-numbers-13.npz").exists()


@pytest.mark.parametrize("step", [10, 13])  # 10 is looked at closely; 13 would be, were it not dropped from view
def test_a_step_that_makes_it_is_named(scene, step):
    n_fields, calls = 6, []

    def adam_update(values, *rest):
        CPU.adam_update(values, *rest)
        calls.append(1)
        if len(calls) == n_fields * (step - 1) + 1:  # the means
            values[ROW] = np.nan

    state = initial_state(scene, RECIPE._replace(events=()), 3)
    with pytest.raises(BadNumbers) as caught:
        train(
            scene,
            RECIPE._replace(events=()),
            seed=3,
            state=state,
            backend=replace(CPU, adam_update=adam_update),
            guard=Guard(every=10),
        )
    if step == 10:
        assert ", Adam: means is nan in row 3 of 30" in str(caught.value) and state.step == 9
    else:
        expected = "parameters: means is nan in row 3 of 30, since one of the last 10 iterations; --check-every 1 finds"
        assert str(caught.value).startswith("iteration 20") and expected in str(caught.value)


def test_a_loss_that_is_not_finite_is_seen_at_once(scene):
    with pytest.raises(BadNumbers, match=r"iteration 7, view view\d, sh_colors: colors is inf"):
        train(scene, RECIPE, seed=3, backend=with_bad("sh_colors", None, range(7, 100), np.inf), guard=Guard(every=50))


def test_a_step_is_dropped_where_that_is_asked_for(scene, tmp_path):
    """Each view is drawn twice, the second time under watch: both calls are wrong, and the next views are right."""
    notes = []
    backend = with_bad("project_vjp", "means", (7, 8, 20, 21))
    state = train(
        scene,
        RECIPE,
        seed=3,
        backend=backend,
        on_step=lambda report: notes.extend(report.notes),
        guard=Guard(drops_steps=True, folder=tmp_path),
    )
    assert len(notes) == 2
    assert notes[0].startswith("iteration 7, view view") and "project_vjp: v_means is nan in row 3 of 30" in notes[0]
    assert notes[1].startswith("iteration 19, view view") and notes[1].endswith("; step left out")
    assert os.listdir(tmp_path) == ["bad-numbers-7.npz"]  # of the first
    assert state.step == 40 and all(np.isfinite(array).all() for array in all_arrays(state).values())


def test_no_dropping_mends_a_parameter(scene):
    recipe = RECIPE._replace(events=(*RECIPE.events, At(13, poison)))
    with pytest.raises(BadNumbers, match="event poison: opacity_logits is nan in row 3"):
        train(scene, recipe, seed=3, guard=Guard(drops_steps=True))


def test_watching_changes_nothing(scene, uninterrupted):
    assert_same_bytes(train(scene, RECIPE, seed=3, guard=Guard(every=1)), uninterrupted)


def test_a_checkpoint_is_no_case(tmp_path):
    save_checkpoint(tmp_path / "a.npz", {}, {"step": 1})
    with pytest.raises(InputError, match=r"a\.npz is no case of bad numbers"):
        load_case(tmp_path / "a.npz")
    assert os.listdir(tmp_path) == ["a.npz"]
