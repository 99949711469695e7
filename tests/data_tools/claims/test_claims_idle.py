"""A mechanism that did not act is refused, not reported: two arms of a claim that agree in every digit."""

import argparse

import numpy as np
import pytest
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.__main__ import main as measure_claim
from minisplat_ref.errors import InputError

RECORDS = [
    {"recipe": "full", "seed": 0, "psnr": 20.5, "n": 10, "seconds": 3.0},
    {"recipe": "without a", "seed": 0, "psnr": 20.5, "n": 10, "seconds": 4.0},
    {"recipe": "without b", "seed": 0, "psnr": 20.4, "n": 10, "seconds": 3.0},
    {"recipe": "full", "seed": 1, "psnr": 21.5, "n": 11, "seconds": 3.0},
    {"recipe": "without a", "seed": 1, "psnr": 21.5, "n": 11, "seconds": 2.0},
    {"recipe": "without b", "seed": 1, "psnr": 21.5, "n": 11, "seconds": 3.0},
]


def test_arms_by_hand():
    arms = kit.arms_of(RECORDS, "recipe", ("psnr", "n"))
    assert arms["without b"] == [[20.4, 10], [21.5, 11]]
    assert kit.find_idle(arms) == {"without a": "full"}
    names, text = kit.leave_out_idle(arms)
    assert names == ["full", "without b"]
    assert text.startswith("\n\n'without a' measured exactly what 'full' did: what distinguishes them did not act")
    assert kit.leave_out_idle({"full": 1.0, "other": 2.0}) == (["full", "other"], "")


def test_one_digit_of_one_seed_is_a_difference():
    arms = {"full": [20.5, 21.5], "other": [20.5, np.nextafter(21.5, 22)]}
    assert kit.find_idle(arms) == {}
    assert kit.find_idle({**arms, "third": list(arms["other"])}) == {"third": "other"}


def test_seconds_are_no_difference():
    arms = {"full": {"curve": [{"psnr": 20.0, "seconds": 1.0}], "seconds": 2.0}}
    assert kit.find_idle({**arms, "other": {"curve": [{"psnr": 20.0, "seconds": 3.0}], "seconds": 1.0}})
    assert not kit.find_idle({**arms, "other": {"curve": [{"psnr": 20.1, "seconds": 1.0}], "seconds": 2.0}})


def test_arrays_and_numbers_that_are_none():
    full = {"psnr": np.float32(20.5), "image": np.zeros((2, 2)), "left": None, "error": np.nan}
    assert kit.find_idle({"full": full, "other": {**full, "image": np.zeros((2, 2))}})
    assert not kit.find_idle({"full": full, "other": {**full, "image": np.eye(2)}})
    assert kit.find_idle({}) == {} == kit.find_idle({"alone": 1})


def test_all_idle_is_refused():
    with pytest.raises(InputError, match="'a' measured exactly what 'full' did, 'b' measured exactly what 'full' did"):
        kit.leave_out_idle({"full": 1, "a": 1, "b": 1})


def report(arms):
    return kit.Report({"rows": 1}, Figure(), "a table", arms)


def test_a_report_of_idle_arms_is_not_written(tmp_path, capsys):
    args = argparse.Namespace(out=tmp_path / "out")
    with pytest.raises(InputError, match="give more iterations"):
        kit.carry_out(lambda _: report({"full": 1.0, "without": 1.0}), args, is_resumed=False)
    assert not args.out.exists() and capsys.readouterr().out == ""
    kit.carry_out(lambda _: report({"full": 1.0, "without": 1.1}), args, is_resumed=False)
    assert capsys.readouterr().out == "a table\n"


def test_a_disturbance_that_is_none_is_refused(tmp_path, capsys):
    small = ["--views", "6", "--width", "32", "--iterations", "5"]
    out = ["--out", str(tmp_path / "out")]
    assert measure_claim(["pose", "room", *small, *out, "--degrees", "0", "--shift", "0"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and "'disturbed' measured exactly what 'undisturbed' did" in said.err
    assert not (tmp_path / "out").exists()
    assert measure_claim(["pose", "room", *small, *out]) == 0


def test_a_weight_of_zero_is_refused(tmp_path, capsys):
    command = ["micro/checker", "--out", str(tmp_path / "out"), "--iterations", "100", "--seeds", "1"]
    assert measure_claim([*command, "--trace", "0"]) == 2
    said = capsys.readouterr()
    assert "'trace' measured exactly what '3dgs' did, 'both' measured exactly what 'detail' did" in said.err
