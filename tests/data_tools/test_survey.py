"""Planted errors: each line is where the list says, a planted function is restored, a command's verdict is told."""

import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_tools import survey as module
from data_tools.survey import as_markdown, main, plant_in_copy, plant_in_function, survey
from data_tools.survey_errors import ERRORS
from minisplat_ref.app.runs import cluster
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.reference import adam, hits
from minisplat_ref.reference.adam import adam_update

BY_NAME = {error.what: error for error in ERRORS}


def test_every_line_is_where_the_list_says(tmp_path):
    assert len(BY_NAME) == len(ERRORS) >= 25
    for k, error in enumerate(ERRORS):
        if error.is_compiled:
            plant_in_copy(error, tmp_path / str(k))
        else:
            with plant_in_function(error):
                pass
    with pytest.raises(InputError, match=r"stands 0 times in reference\.adam:adam_update"):
        with plant_in_function(BY_NAME["eps inside the root"]._replace(right="no such line")):
            pass


def test_a_function_is_wrong_for_whoever_holds_it_and_right_again():
    right = adam_update.__code__
    with plant_in_function(BY_NAME["eps inside the root"]):
        assert adam.adam_update is adam_update and adam_update.__code__ is not right
    assert adam_update.__code__ is right


def test_a_copy_differs_in_one_line(tmp_path):
    error = BY_NAME["kernels: eps inside the root"]
    plant_in_copy(error, tmp_path)
    lines = [
        (folder / "scalar" / "adam.py").read_text().splitlines()
        for folder in (module.PACKAGE, tmp_path / "minisplat_ref")
    ]
    changed = [pair for pair in zip(*lines, strict=True) if pair[0] != pair[1]]
    assert len(changed) == 1 and error.right in changed[0][0] and error.wrong in changed[0][1]


def test_a_command_notices_or_not(monkeypatch, capsys):
    commands = {"Adam": ("compare", "reference", "--scene", "equality"), "truth": ("export", "/dev/null/nowhere")}
    monkeypatch.setattr(module, "COMMANDS", commands)
    outcome = survey(BY_NAME["eps inside the root"], ["Adam"])
    assert outcome.notices == {"Adam": True}
    harmless = BY_NAME["eps inside the root"]._replace(what="none", wrong="(np.sqrt(v) + 1.0 * step.eps)")
    passed = survey(harmless, ["Adam"])
    assert passed.notices == {"Adam": False} and capsys.readouterr().out == ""
    table = as_markdown([outcome, passed]).splitlines()
    assert "noticed" in table[2] and "noticed" not in table[3] and table[-1].startswith("| 1 of 2 are noticed")


def test_an_exception_is_noticed():
    broken = BY_NAME["continues where T equals the stop"]._replace(wrong="1 / 0 + conventions")
    assert survey(broken, ["compare reference"]).notices == {"compare reference": True}
    assert "/ 0" not in inspect.getsource(hits.is_accepted) and hits.is_accepted(np.ones(1), GSPLAT_MAIN)


ADAM = ["--only", "*mean", "--commands", "Adam"]  # of three errors


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(module, "COMMANDS", {"Adam": ("compare", "reference", "--scene", "equality")})


def test_workers_give_the_same_table(quick, tmp_path, monkeypatch, capsys):
    """Jobs are carried out here, the last one first, in place of workers' processes."""
    assert main(ADAM) == 1
    in_turn = capsys.readouterr()
    assert "beta2 for the mean: Adam\n" in in_turn.err and "PASSES EVERY COMMAND" in in_turn.err

    def carry_out_all(workers, jobs, folder, inputs=(), on_done=None):
        assert workers.n == 2 and len(jobs) == 3
        for job in reversed(jobs):
            words = job.choose(*job.arguments)
            assert job.program == "data_tools.survey" and main(words) == 0
            assert job.choose(*job.arguments) is None, "it has been done"
        return 0

    out = str(tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(cluster, "carry_out_all", carry_out_all)
        assert main([*ADAM, "--out", out, "--workers", "2"]) == 1
    assert capsys.readouterr().out == in_turn.out
    monkeypatch.setattr(module, "survey", None)  # nothing is surveyed twice
    assert main([*ADAM, "--out", out]) == 1
    assert capsys.readouterr().out == in_turn.out
    monkeypatch.setattr(module, "ERRORS", ERRORS[:-1])
    with pytest.raises(InputError, match=r"holds errors of .* give another --out"):
        main([*ADAM, "--out", out])


def test_workers_need_a_folder(capsys):
    with pytest.raises(SystemExit):
        main(["--workers", "2"])
    assert "give --out DIR" in capsys.readouterr().err


@pytest.mark.slow
def test_two_workers_give_the_same_bytes(tmp_path):
    pytest.importorskip("distributed")
    call = [sys.executable, "-m", "data_tools.survey", "--only", "*mean", "--commands", "compare reference"]
    tables = [
        subprocess.run([*call, *options], cwd=Path(__file__).parents[2], capture_output=True, check=False)
        for options in ([], ["--out", str(tmp_path / "out"), "--workers", "2"])
    ]
    assert [table.returncode for table in tables] == [1, 1], tables[1].stderr
    assert tables[0].stdout in tables[1].stdout and tables[0].stdout.startswith(b"| planted error")


def test_the_script_names_its_commands():
    call = [sys.executable, "-m", "data_tools.survey", "--help"]
    done = subprocess.run(call, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    assert all(heading in done.stdout for heading in module.COMMANDS)
