"""What fired in a training: the record in the run folder, what it says of each mechanism, and how it is told."""

import json
import re
import signal
from functools import partial
from itertools import pairwise

import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import checkpoints, events
from minisplat_ref.app.runs.events import count_published_times, describe, mechanisms, never_fired
from minisplat_ref.app.runs.progress import Progress, read_log
from minisplat_ref.errors import InputError
from minisplat_ref.methods import RECIPES
from minisplat_ref.methods.gaussian_splatting import clone_and_split, collect_gradients, prune_faint, reset_opacity
from minisplat_ref.training.schedule import At, During, Every, SmallerViews
from minisplat_ref.training.smaller_views import halve_large_views
from minisplat_ref.training.state import FiredEvent
from run_commands import write_room

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
ITERATIONS = 20


def noted(state, iteration):
    return "nothing to do"


RECIPE = RECIPES["3dgs"]._replace(
    iterations=ITERATIONS,
    events=(
        During(collect_gradients),
        Every(6, partial(clone_and_split, threshold=1e-4, size_fraction=0.01)),
        Every(6, partial(prune_faint, min_opacity=0.005)),
        At(9, noted),
        At(25, partial(reset_opacity, ceiling=0.01)),
    ),
)
FIRED = [
    (6, "clone_and_split"),
    (6, "prune_faint"),
    (9, "noted"),
    (12, "clone_and_split"),
    (12, "prune_faint"),
    (18, "clone_and_split"),
    (18, "prune_faint"),
]


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


def train(scene_folder, out):
    options = ["--recipe", "3dgs", "--iterations", str(ITERATIONS), "--test-every", "4"]
    return main(["train", str(scene_folder), *options, "--out", str(out)])


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(RECIPES, "3dgs", RECIPE)
        assert train(scene_folder, folder) == 0
    return folder


def without_times(folder):
    return [{**record, "seconds": None} for record in read_log(folder / "events.jsonl")]


def test_records(run_folder):
    records = read_log(run_folder / "events.jsonl")
    assert [(record["step"], record["action"]) for record in records] == FIRED
    counts = [(record["n_before"], record["n_after"]) for record in records]
    assert all(after == before for (_, after), (before, _) in pairwise(counts))
    assert counts[0][1] > counts[0][0] > 0  # it densifies
    assert counts[-1][1] == json.loads((run_folder / "metrics.json").read_text())["n_gaussians"]
    assert [record["note"] for record in records] == [None, None, "nothing to do", None, None, None, None]
    assert all(0 < record["seconds"] < 60 for record in records)


def test_interrupted_and_resumed(run_folder, scene_folder, tmp_path, monkeypatch, capsys):
    """Records after the checkpoint are of a part of the training that was lost."""
    report_step = Progress.__call__

    def press_ctrl_c(progress, report):
        report_step(progress, report)
        if report.step == 12:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setitem(RECIPES, "3dgs", RECIPE)
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", press_ctrl_c)
        assert train(scene_folder, tmp_path / "run") == 130
    assert main(["info", str(tmp_path / "run")]) == 0
    assert re.search("^not fired yet +reset_opacity$", capsys.readouterr().out, re.MULTILINE)
    path = tmp_path / "run" / "events.jsonl"
    assert without_times(tmp_path / "run") == without_times(run_folder)[:5]
    events.append(path, 13, [FiredEvent("lost", 1, 2, 0.5)])
    assert main(["train", "--resume", str(tmp_path / "run")]) == 0
    assert without_times(tmp_path / "run") == without_times(run_folder)


def test_stopped_before_anything_fired(run_folder, scene_folder, tmp_path, monkeypatch):
    """A worker was killed after the checkpoint of step 0, and the run that another continued had no record."""
    save = checkpoints.save

    def save_and_stop(*arguments):
        save(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setitem(RECIPES, "3dgs", RECIPE)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "save", save_and_stop)
        assert train(scene_folder, tmp_path / "run") == 130
    assert checkpoints.read_step(tmp_path / "run") == 0 and not (tmp_path / "run" / "events.jsonl").exists()
    assert main(["train", "--resume", str(tmp_path / "run")]) == 0
    assert without_times(tmp_path / "run") == without_times(run_folder)


def test_continued_without_its_record(run_folder, scene_folder, tmp_path, monkeypatch):
    """Half a record would say of what fired before that it never did."""
    monkeypatch.setitem(RECIPES, "3dgs", RECIPE)
    assert train(scene_folder, tmp_path / "run") == 0
    (tmp_path / "run" / "events.jsonl").unlink()
    assert main(["train", "--resume", str(tmp_path / "run"), "--iterations", "26"]) == 0
    assert not (tmp_path / "run" / "events.jsonl").exists()


def test_info(run_folder, monkeypatch, capsys):
    monkeypatch.setitem(RECIPES, "3dgs", RECIPE._replace(events=(*RECIPE.events, At(5, prune_faint))))
    assert main(["info", str(run_folder)]) == 0
    lines = {line.partition("  ")[0]: line.partition("  ")[2].strip() for line in capsys.readouterr().out.splitlines()}
    records = read_log(run_folder / "events.jsonl")
    n_first, n_last = records[0]["n_before"], records[-1]["n_after"]
    assert lines["fired: clone_and_split"].startswith("3 times (published 3), from 6 to 18; +")
    assert lines["fired: prune_faint"].startswith("3 times (published 4), from 6 to 18; +0 -")
    added = int(lines["fired: clone_and_split"].split("+")[1].split(" ")[0].replace(",", ""))
    removed = int(lines["fired: prune_faint"].split("-")[1].split(" ")[0].replace(",", ""))
    assert n_first + added - removed == n_last
    assert lines["fired: noted"].startswith("once (published 1), at 9; ")
    assert lines["fired: noted"].endswith(" Gaussians; nothing to do")
    assert lines["never fired"] == "reset_opacity"


def test_damaged_record(tmp_path):
    path = tmp_path / "events.jsonl"
    with pytest.raises(InputError, match="is missing"):
        events.read_mechanisms(path, {})
    path.write_text('{"step": 1, "seconds": 0.5}\n')
    with pytest.raises(InputError, match="not the record of what fired"):
        events.read_mechanisms(path, {})


# By hand


def record(step, action, n_before, n_after, note=None):
    return {"step": step, "action": action, "n_before": n_before, "n_after": n_after, "seconds": 0.5, "note": note}


def test_mechanisms_by_hand():
    records = [
        record(10, "grow", 100, 150),
        record(10, "prune", 150, 140),
        record(20, "grow", 140, 140, "paused"),
        record(30, "grow", 140, 120),
        record(40, "grow", 120, 1130, "paused"),
    ]
    grow, prune = mechanisms(records, {"prune": 3, "reset": 2, "grow": 7})
    assert (grow.action, grow.times, grow.published, grow.first, grow.last) == ("grow", 4, 7, 10, 40)
    assert (grow.added, grow.removed, grow.n_before, grow.n_after) == (1060, 20, 100, 1130)
    assert (grow.seconds, grow.notes) == (2.0, {"paused": 2})
    assert (prune.times, prune.published, prune.added, prune.removed) == (1, 3, 0, 10)
    assert describe(grow) == "4 times (published 7), from 10 to 40; +1,060 -20 Gaussians; paused (2 times)"
    assert describe(prune) == "once (published 3), at 10; 150 -> 140 Gaussians"
    assert never_fired([grow, prune], {"prune": 3, "reset": 2, "grow": 7}) == ["reset"]
    assert mechanisms([record(1, "unknown", 1, 1)], {})[0].published == 0


def test_published_times_by_hand():
    """Several events of one action count together, those of every iteration not; half-size views are one mechanism."""
    assert count_published_times(RECIPE) == {"clone_and_split": 3, "prune_faint": 3, "noted": 1, "reset_opacity": 0}
    both = RECIPE._replace(events=(*RECIPE.events, At(2, prune_faint)))
    both = both._replace(
        events=(SmallerViews(partial(halve_large_views, min_side=16, max_halvings=1), until=3), *both.events)
    )
    assert count_published_times(both) == {"halve_large_views": 1, **count_published_times(RECIPE), "prune_faint": 4}
