"""The check of commit subjects, and the subjects of this release."""

import subprocess
from pathlib import Path

import pytest

from data_tools.commit_subject import LENGTH_MAX, find_fault, main, subject_of

ROOT = Path(__file__).parents[2]
LAST_UNCHECKED = "0e97647"


@pytest.mark.parametrize(
    "subject",
    [
        "fix: a",
        "fix(tiling): rows of the last tile",
        "feat!: another format",
        "feat(study)!: another table",
        f"docs: {'x' * (LENGTH_MAX - 6)}",
        f"docs: {'±' * (LENGTH_MAX - 6)}",  # characters, not bytes
        "Merge branch 'main' into house",
        f'Revert "docs: {"x" * (LENGTH_MAX - 6)}"',
        "fixup! fix: a",
    ],
)
def test_right_subject(subject):
    assert find_fault(subject) is None


@pytest.mark.parametrize(
    ("subject", "fault"),
    [
        ("", "is not 'TYPE: ...'"),
        ("a change", "is not 'TYPE: ...'"),
        ("fix:", "is not 'TYPE: ...'"),
        ("fix:no space", "is not 'TYPE: ...'"),
        ("fix(): no scope", "is not 'TYPE: ...'"),
        ("wip: a", "is not 'TYPE: ...'"),
        ("fixed: a", "is not 'TYPE: ...'"),
        (f"docs: {'x' * (LENGTH_MAX - 5)}", "has 73 characters, at most 72 fit"),
    ],
)
def test_wrong_subject(subject, fault):
    assert fault in find_fault(subject)


def test_subject_of_a_message():
    assert subject_of("\n# of git\n  fix: a \n\nbody\n") == "fix: a"
    assert subject_of("# nothing\n") == ""


def test_hook(tmp_path, capsys):
    message = tmp_path / "COMMIT_EDITMSG"
    message.write_text("fix: a\n\nThe body may be longer.\n", encoding="utf-8")
    assert main([str(message)]) == 0 and capsys.readouterr().err == ""
    message.write_text("a change\n", encoding="utf-8")
    assert main([str(message)]) == 1
    assert capsys.readouterr().err.startswith("a change\nthe subject is not")


def test_subjects_of_this_release():
    if not (ROOT / ".git").exists():
        pytest.skip("needs a git checkout")
    command = ["git", "log", "--no-merges", "--format=%H %s", f"{LAST_UNCHECKED}..HEAD"]
    history = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if history.returncode:
        pytest.skip(f"the history does not reach back to {LAST_UNCHECKED}")
    subjects = dict(line.split(" ", 1) for line in history.stdout.splitlines())
    assert not {commit for commit, subject in subjects.items() if find_fault(subject)}
