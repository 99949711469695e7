"""The promise of ``simplify --max-drop``: through the command line, and its rows, made by hand."""

import json

import numpy as np
import pytest

from data_tools.claims import max_drop as max_drop_claim
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.claim import FIGURE, RESULT
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.simplified_run import RESULT as DECISION
from minisplat_ref.io.images import read_image

TINY = ("--views", "12", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("claim") / "room"
    assert main(["synthetic", "room", "--out", str(folder), *TINY]) == 0
    return folder


def test_claim_chooses_and_loses_what_the_command_does(scene_folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("minisplat_ref.app.cli.simplify.FINE_TUNE", 4)
    options = ("--recipe", "3dgs-accel", "--iterations", "60")
    words = ["max-drop", str(scene_folder), *options, "--fine-tune", "4", "--limits", "0,2", "--seeds", "3"]
    assert measure_claim([*words, "--out", str(tmp_path / "out")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    result = json.loads((tmp_path / "out" / RESULT).read_text())
    assert read_image(tmp_path / "out" / FIGURE).std() > 1
    nothing, much = result["runs"]
    assert (nothing["limit"], much["limit"]) == (0, 2) and len(lines) == 1 + 2

    run, small = tmp_path / "run", tmp_path / "small"
    assert main(["train", str(scene_folder), *options, "--seed", "3", "--out", str(run)]) == 0
    assert main(["simplify", str(run), "--out", str(small), "--max-drop", "2"]) == 0
    decision = json.loads((small / DECISION).read_text())
    assert much["n_after"] == decision["chosen"]["n_gaussians"] < much["n_before"]
    # The command reads what the training has rounded to a PLY, which has no exact order of equals.
    assert much["drop"] == pytest.approx(decision["chosen"]["drop"], abs=1e-3)
    assert much["lost"] == pytest.approx(decision["test"]["drop"], abs=1e-3)

    again = [*words, "--out", str(tmp_path / "out")]
    monkeypatch.setattr(max_drop_claim, "train_run", None)  # nothing is measured twice
    assert measure_claim(again) == 0


def test_a_row_for_each_limit_and_seed():
    record = {"n_before": 200, "n_after": 200, "drop": 0.0, "standard_error": 0.0, "test_before": 30.0, "lost": 0.0}
    records = [
        {**record, "seed": 0, "limit": 0.5, "n_after": 150, "drop": 0.25, "standard_error": 0.125, "lost": 0.375},
        {**record, "seed": 0, "limit": 0.1},
    ]
    records = [{**each, "lost_error": 0.0625} for each in records]
    heading, rows = max_drop_claim.to_table(records)
    assert rows == [
        ["0.1", "0", "200", "all", "", "0"],
        ["0.5", "0", "200", "150 (75%)", "0.250 ± 0.125", "0.375 ± 0.062"],
    ]
    assert len(heading) == len(rows[0])
    assert max_drop_claim.to_table([{**records[0], "lost_error": None}])[1][0][-1] == "0.375", "of one test view"
    (axes,) = max_drop_claim.draw(records).axes
    assert np.allclose(axes.lines[0].get_xydata(), [[0.1, 0], [0.5, 0.375]])
