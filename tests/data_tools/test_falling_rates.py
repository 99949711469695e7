"""Moments of a cool-down by hand, and runs that have none."""

import json

import numpy as np

from data_tools.falling_rates import main
from minisplat_ref.training.pace import COOLED, Decision, Measurement, Pace, pace_to_json


def write_run(folder, factors, n=7):
    """A run whose rate falls from 1 to 0.01 in 100 iterations; its error is 0.01 + 0.01 r, times ``factors``."""
    measured = []
    for k in range(n):
        step = 1000 + 10 * k
        error = (0.01 + 0.01 * 0.01 ** (k / 10)) * factors.get(k, 1.0)
        measured.append(Measurement(step, (-10 * np.log10(error),) * 2, 500 - k, 0, (0.9, 0.9)))
    decisions = (Decision(1000, COOLED, "why", 0.1, 0.1),)
    pace = Pace(decisions=decisions, cooling_from=1000, last_step=1100, while_cooling=tuple(measured))
    folder.mkdir()
    (folder / "decisions.json").write_text(json.dumps(pace_to_json(pace)))
    return str(folder)


def test_moments_by_hand(tmp_path, capsys):
    """The last error is a tenth larger than predicted: 0.41 dB. At the first r is 1 and the error 0.02, 16.99 dB."""
    assert main([write_run(tmp_path / "run", {6: 1.1})]) == 0
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()[2:]]
    assert rows[0] == ["run", "1.000", "500", "16.99", "16.99", "+0.00", "+0.0000"]
    assert rows[5][1:] == ["0.100", "495", "19.59", "19.59", "+0.00", "+0.0000"]
    assert rows[6][2:] == ["494", "19.32", "19.73", "-0.41", "+0.0000"]


def test_runs_that_have_none(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "decisions.json is missing" in capsys.readouterr().err
    assert main([write_run(tmp_path / "early", {}, n=6)]) == 2
    assert "was measured 6 times while its rates fell: 7 are needed" in capsys.readouterr().err
