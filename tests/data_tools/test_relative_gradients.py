"""The table of all relatives' gradients, from files of the command."""

import json

import pytest

from data_tools import relative_gradients
from data_tools.relative_gradients import NOTHING, to_row

CASES = [
    {"name": "cpu: render discs: Jacobian", "passed": True, "error": 2e-11, "entries": 1200, "note": ""},
    {"name": "reference: render discs: Jacobian", "passed": True, "error": 3e-12, "entries": 1200, "note": ""},
    {"name": "cpu: render discs: inner products", "passed": False, "error": 5e-3, "entries": 4e6, "note": "too large"},
    {"name": "cpu: render discs: as on reference", "passed": True, "error": 1e-15, "note": ""},
]


def test_a_row_has_the_largest_error_of_each_kind():
    assert to_row("surfels", CASES) == ["surfels", "4", "3", "2.0e-11", "5.0e-03", "1.0e-15", "2,400"]


def test_a_kind_without_cases_has_no_error():
    assert to_row("micro", CASES[1:2]) == ["micro", "1", "1", "3.0e-12", "", "", "1,200"]


def test_checks_that_were_made_are_not_repeated(monkeypatch, tmp_path, capsys):
    asked = []

    def check(arguments):
        asked.append(arguments[3])
        note = f"{NOTHING}: none"
        (tmp_path / f"{arguments[3]}.json").write_text(json.dumps({"cases": [{"name": "x", "note": note}]}))

    monkeypatch.setattr(relative_gradients, "run_command", check)
    (tmp_path / "surfels.json").write_text(json.dumps({"cases": CASES}))
    relative_gradients.main(["surfels", "segment", "--out", str(tmp_path)])
    assert asked == ["segment"]
    printed = capsys.readouterr().out
    assert "| surfels  | 4 " in printed and printed.endswith(f"{NOTHING} of segment\n")


def test_the_command_s_own_file_is_read(tmp_path, capsys):
    relative_gradients.main(["segment", "--out", str(tmp_path)])
    assert capsys.readouterr().out.endswith(f"{NOTHING} of segment\n")


def test_an_unknown_relative_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        relative_gradients.main(["nobody", "--out", str(tmp_path)])
    assert "nobody" in capsys.readouterr().err
