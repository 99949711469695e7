"""The check of commit subjects: of a message, and of new commits."""

import subprocess

import pytest

from data_tools.commit_subject import LENGTH_MAX, find_fault, main, subject_of


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


def test_new_commits(tmp_path, capfd, monkeypatch):
    def git(*words):
        identity = ("-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
        subprocess.run(["git", *identity, *words], cwd=tmp_path, check=True, capture_output=True)

    git("init")
    for subject in ("an old one", "fix: a", f"docs: {'x' * LENGTH_MAX}", "a change"):
        git("commit", "--allow-empty", "--message", subject)
    monkeypatch.chdir(tmp_path)
    assert main(["--since", "HEAD~1"]) == 1
    assert capfd.readouterr().err.startswith("a change\nthe subject is not")
    assert main(["--since", "HEAD~3"]) == 1
    assert len(capfd.readouterr().err.splitlines()) == 4  # the long one and the last
    git("commit", "--allow-empty", "--message", "fix: b")
    assert main(["--since", "HEAD~1"]) == 0
