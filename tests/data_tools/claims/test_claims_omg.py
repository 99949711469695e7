"""OMG: files and distinctiveness, on a small run."""

import json

import numpy as np
import pytest

from compact import short_run
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.omg import networks as networks_claim
from measured_claims import measured
from minisplat_ref import load_ply, load_scene, save_ply
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.omg import file as omg
from minisplat_ref.extensions.omg import trained_file
from minisplat_ref.extensions.omg.trained_file import read_training
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import action_name
from minisplat_ref.types import Gaussians


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a scene, and a run of the recipe omg on it."""
    run = short_run(tmp_path_factory.mktemp("omg"), "omg", "--set", "distinct_mass=0.9")
    return run.parent / "nook", run


def test_claim_of_files(folders, tmp_path, capsys):
    """Sizes and losses in the table are those of the files."""
    nook, run = folders
    checkpoint = run / "checkpoint.npz"
    command = ["omg/files", str(nook), "--checkpoints", str(checkpoint), "--out", str(tmp_path / "out")]
    (record,) = measured(command)["runs"]
    rows = {row["file"]: row for row in record["rows"]}
    assert rows["as trained"]["lost"] == 0 and {".spz 0", ".msz 0", ".omg 4", ".omg of the training"} < set(rows)
    assert rows[".omg of the training"]["n_bytes"] == len(trained_file.encode(*read_training(checkpoint)))
    assert rows[".omg 2"]["n_bytes"] == len(omg.encode(load_ply(run / "point_cloud.ply"), 2))
    assert abs(rows[".msz 0"]["lost"]) < 1e-6 < abs(rows[".omg 4"]["lost"])
    assert ".omg of the training" in capsys.readouterr().out


def test_claim(folders, tmp_path, capsys):
    nook, run = folders
    command = ["omg/distinctiveness", str(nook), "--fine-tune", "3", "--seeds", "0", "--ply"]
    save_ply(tmp_path / "two.ply", take(load_ply(run / "point_cloud.ply"), np.arange(2)))
    few = [*command, str(tmp_path / "two.ply"), "--out", str(tmp_path / "few")]
    assert measure_claim(few) == 2  # two Gaussians differ from each other alike: both choices keep the same
    assert "'with distinctiveness' measured exactly what 'importance' did" in capsys.readouterr().err
    save_ply(tmp_path / "more.ply", initial_state(load_scene(nook), get_recipe("3dgs"), seed=0).gaussians)
    more = [*command, str(tmp_path / "more.ply"), "--out", str(tmp_path / "out")]
    result = measured(more)
    rows = result["runs"][0]
    assert [row["kept"] for row in rows] == ["all", *("50 %",) * 2, *("25 %",) * 2, *("12.5 %",) * 2]
    counts = [row["n_gaussians"] for row in rows]
    assert counts == sorted(counts, reverse=True) and counts[1] == counts[2] < counts[0]
    losses = {field: of_seeds[0] for field, of_seeds in result["losses"].items()}
    assert set(losses) == set(Gaussians._fields) and all(len(of_levels) == 5 for of_levels in losses.values())
    assert abs(losses["means"][0]) < 0.05  # half floats of a room of some metres, in images of 32 x 24
    assert (tmp_path / "out" / "figure.png").stat().st_size > 10_000
    assert "textured half" in capsys.readouterr().out
    assert measure_claim(more) == 0  # continues: there is nothing left to measure
    assert json.loads((tmp_path / "out" / "result.json").read_text()) == result


def test_arms_of_networks_leave_out_what_they_say():
    """Of the recipe's events alone; all prune by distinctiveness."""
    names = {arm: [action_name(event) for event in recipe.events] for arm, recipe in networks_claim.arms(3000).items()}
    whole = names["networks and codes"]
    assert whole == [action_name(event) for event in find_recipe("omg", 3000).events]
    assert [name for name in whole if name not in names["networks"]] == ["start_codes", "round_centres"]
    missing = [name for name in whole if name not in names["neither"]]
    assert missing == ["start_networks", "start_codes", "round_centres", "write_fields"]
    assert "prune_indistinct" in names["neither"]


def test_claim_of_networks(folders, tmp_path):
    """Without networks and codes it is the training whose events they are not; with both, the recipe."""
    nook, _ = folders
    command = ["omg/networks", str(nook), "--iterations", "60", "--seeds", "0", "--out", str(tmp_path / "out")]
    records = {record["arm"]: record for record in measured(command)["records"]}
    scene, recipe = load_scene(nook), find_recipe("omg", 60)
    model = train(scene, recipe, seed=0).model
    settings = RenderSettings(scene.background, renderer=recipe.renderer)
    expected = evaluate(model, scene.test_views, settings).psnr
    assert records["networks and codes"]["psnr"] == pytest.approx(expected, abs=1e-9)  # the same numbers
    assert len({record["psnr"] for record in records.values()}) == 3
