"""Jobs of a claim that are carried out elsewhere: records, an interruption, a failure."""

import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit import Report, records
from data_tools.claims.kit.claim import RESULT, RESUMED_OUT, SEEDS, declare
from data_tools.claims.kit.records import HAND_OUT, JOB, handing_out, job_file, one_job, resume
from minisplat_ref.app.runs import cluster
from minisplat_ref.interface.arguments import drop_workers

JOBS = [{"arm": arm, "seed": seed} for seed in (0, 1) for arm in ("a", "b")]
SETTINGS = {"iterations": 3}


def measure(arm, seed):
    return [{"value": f"{arm}{seed}"}, {"value": f"{arm}{seed} again"}]


@pytest.fixture
def in_turn(tmp_path):
    return resume(tmp_path / "turn", SETTINGS, JOBS, measure)


def elsewhere(folder, numbers):
    for number in reversed(numbers):  # as workers may end
        with one_job(number):
            resume(folder, {"of": "another machine"}, JOBS, measure)


def test_records_are_those_of_one_process(tmp_path, in_turn):
    folder = tmp_path / "out"
    with handing_out(elsewhere):
        assert resume(folder, SETTINGS, JOBS, measure) == in_turn
    assert (folder / records.RUNS).read_bytes() == (tmp_path / "turn" / records.RUNS).read_bytes()
    assert [path.name for path in folder.iterdir()] == [records.RUNS]
    assert (HAND_OUT.get(), JOB.get()) == (None, None)
    assert in_turn[3] == {"arm": "b", "seed": 0, "value": "b0 again"}


def test_what_an_interruption_leaves_is_taken_in(tmp_path, in_turn):
    folder, asked = tmp_path / "out", []

    def interrupted(folder, numbers):
        elsewhere(folder, [2, 0])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), handing_out(interrupted):
        resume(folder, SETTINGS, JOBS, measure)
    with handing_out(lambda folder, numbers: (asked.extend(numbers), elsewhere(folder, numbers))):
        continued = resume(folder, SETTINGS, JOBS, measure)
    assert asked == [1, 3]
    assert sorted(map(str, continued)) == sorted(map(str, in_turn))


def test_records_of_other_arguments_are_not_taken_in(tmp_path, in_turn):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / records.RUNS).write_text(json.dumps(SETTINGS) + "\n")
    job_file(folder, 1).write_text('{"arm": "c", "seed": 0, "value": "?"}\n')
    assert resume(folder, SETTINGS, JOBS, measure) == in_turn


def test_words_without_workers():
    words = ["claims", "x", "--workers", "2", "room", "--cluster=tcp://h:1", "--out", "o"]
    assert drop_workers(words) == ["claims", "x", "room", "--out", "o"]


def count_seeds(args):
    """The claim that the command runs below: a record for each seed."""
    found = resume(args.out, SETTINGS, [{"seed": seed} for seed in args.seeds], lambda seed: [{"value": 2 * seed}])
    return Report({"records": found}, Figure(), f"{found}")


CLAIM = declare("count", "counts", count_seeds, RESUMED_OUT, SEEDS)


@pytest.mark.parametrize("code", [0, 2])
def test_the_command_hands_out_itself(tmp_path, monkeypatch, capsys, code):
    """``--workers`` of a claim, with commands carried out here in place of workers' processes."""

    def carry_out_all(workers, jobs, folder, inputs=(), on_done=None):
        assert workers.n == 2
        for job in jobs:
            words = job.choose(*job.arguments)
            assert "--workers" not in words and Path(words[words.index("--out") + 1]) == folder
            assert measure_claim(words) == 0
            assert job.choose(*job.arguments) is None, "it has been done"
            on_done(job)
        return code

    monkeypatch.setattr("data_tools.claims.__main__.find_claim", {"count": CLAIM}.__getitem__)
    monkeypatch.setattr(cluster, "carry_out_all", carry_out_all)
    words = ["count", "--seeds", "3,4", "--out"]
    assert measure_claim([*words, str(tmp_path / "out"), "--workers", "2"]) == code
    printed = capsys.readouterr()
    assert "training 1: ended" in printed.out
    if code:
        assert "a training has failed; what others measured is in" in printed.err
        return
    assert measure_claim([*words, str(tmp_path / "turn")]) == 0
    for name in (records.RUNS, RESULT):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "turn" / name).read_bytes()
    assert json.loads((tmp_path / "out" / RESULT).read_text())["records"][1] == {"seed": 4, "value": 8}
