"""Damaged files by the hundred: each is read or refused in one line, in bounded time and memory."""

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fuzzed
from data_tools import guided_fuzz
from data_tools.fuzz import run
from data_tools.fuzz.judging import judge
from data_tools.fuzz.readers import READERS, mutant
from data_tools.fuzz.run import chooser, fuzz, keep

ROOT = Path(__file__).parents[2]
IN_PROCESS = ("ply", "cameras", "config", "checkpoint", "golden")  # whatever Python raises can be caught
N_EXAMPLES = 100
N_FILES = 200


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The right files of each reader."""
    folders = {name: tmp_path_factory.mktemp(name) for name in IN_PROCESS}
    for name, folder in folders.items():
        READERS[name].write(folder)
    return folders


@pytest.mark.parametrize("name", IN_PROCESS)
@settings(
    max_examples=N_EXAMPLES,
    deadline=None,
    derandomize=True,  # the same files each time; data_tools.fuzz looks for others
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(data=st.data())
def test_damaged_file_is_read_or_refused(folders, name, data):
    folder, reader = folders[name], READERS[name]
    damaged = mutant(reader, folder, lambda n: data.draw(st.integers(0, n - 1)))
    assert judge(reader, folder, damaged).finding == ""


@pytest.mark.parametrize("name", sorted(READERS.keys() - set(IN_PROCESS)))
def test_libraries_in_c_survive_damaged_files(name):
    outcome = fuzz(READERS[name], n_files=N_FILES)
    assert outcome.findings == ()
    assert outcome.n_files == N_FILES and 0 < outcome.n_refused
    assert outcome.n_refused < N_FILES or name == "compact"  # whose checksums may notice every change


# the fuzzing itself


def verdict_of(read, folder):
    reader = fuzzed.reader(read)
    reader.write(folder)
    damaged = mutant(reader, folder, chooser(0, 1))
    verdict = judge(reader, folder, damaged)
    assert fuzzed.is_whole(damaged.path) and damaged.content != fuzzed.CONTENT
    return verdict


@pytest.mark.parametrize(
    ("read", "finding"),
    [
        (fuzzed.good, ""),
        (fuzzed.other_exception, "KeyError in fuzzed.py, other_exception"),
        (fuzzed.no_name, "refuses without the name of the file: 'damaged'"),
        (fuzzed.two_lines, "refuses, but not in one line: 'FOLDER/a.bin: damaged;\\ncopy it again'"),
        (fuzzed.raw_warning, "RuntimeWarning in fuzzed.py, raw_warning"),
        (fuzzed.much_memory, "takes 100 MB for files of 0.00 MB"),
        (fuzzed.hidden_memory, "asks for more memory than there is before it refuses"),
    ],
)
def test_what_is_a_finding(tmp_path, read, finding):
    assert verdict_of(read, tmp_path).finding == finding


@pytest.mark.parametrize(
    ("read", "finding"), [(fuzzed.dies, "ends the process with exit code 7"), (fuzzed.hangs, "hangs")]
)
def test_dead_and_hanging_processes_are_findings(monkeypatch, read, finding):
    monkeypatch.setattr(run, "SILENT_SECONDS", 1.0)
    outcome = fuzz(fuzzed.reader(read), n_files=3)
    assert outcome.n_files == 3  # each in a separate process
    assert [(found.what, found.n_files) for found in outcome.findings] == [(finding, 3)]


def test_a_finding_can_be_made_again(tmp_path):
    outcome = fuzz(fuzzed.reader(fuzzed.other_exception), seed=3, n_files=5)
    (finding,) = outcome.findings
    kept = keep(fuzzed.reader(fuzzed.other_exception), 3, finding.number, tmp_path / "kept")
    assert kept.path.name == f"{finding.number}-{finding.name}"
    with pytest.raises(KeyError):
        fuzzed.other_exception(kept.path.parent, kept.path)


def test_command():
    command = [sys.executable, "-m", "data_tools.fuzz", "cameras", "--seconds", "1"]
    shown = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert shown.stdout.startswith("| reader ") and "| cameras |" in shown.stdout


def test_guided_fuzzing_says_what_it_needs(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "atheris", None)
    monkeypatch.setattr(sys, "argv", ["guided_fuzz", "ply"])
    with pytest.raises(SystemExit) as exit_info:
        guided_fuzz.main()
    assert exit_info.value.code == 2
    assert "pip install 'minisplat_ref[fuzzing]'" in capsys.readouterr().err


@pytest.mark.slow
def test_guided_fuzzing_finds_nothing_in_ten_seconds():
    pytest.importorskip("atheris")
    command = [sys.executable, "-m", "data_tools.guided_fuzz", "ply", "--seconds", "10"]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
