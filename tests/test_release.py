"""What a release states about itself: version, changelog, citation, workflow and hooks."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import minisplat_ref

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
HEADINGS = ["Added", "Changed", "Deprecated", "Removed", "Fixed", "Security", "Numerics", "Performance"]


def read_citation(key):
    """Return the values of a key at the start of a line of CITATION.cff."""
    return re.findall(rf"^{key}: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)


def split_releases():
    """Return the title and the text of each section of the changelog, in its order."""
    parts = re.split(r"^## (.*)$", CHANGELOG, flags=re.MULTILINE)[1:]
    return list(zip(parts[::2], parts[1::2], strict=True))


# Version and metadata


def test_version_is_stated_once():
    assert PROJECT["dynamic"] == ["version", "readme"] and "version" not in PROJECT
    assert re.fullmatch(r"\d+\.\d+\.\d+", minisplat_ref.__version__)


def test_version_needs_no_other_module():
    code = "import sys, minisplat_ref; minisplat_ref.__version__; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_citation_agrees():
    assert read_citation("version") == [minisplat_ref.__version__]
    assert read_citation("license") == [PROJECT["license"]]
    assert read_citation("  - name") == [author["name"] for author in PROJECT["authors"]]


# Changelog


def test_latest_release_is_this_version():
    (unreleased, _), (title, text), *_ = split_releases()
    assert unreleased == "[Unreleased]" and text.strip()
    assert title == f"[{minisplat_ref.__version__}] - {read_citation('date-released')[0]}"


def test_headings_of_the_changelog():
    for title, text in split_releases():
        found = re.findall(r"^### (.*)$", text, re.MULTILINE)
        assert found == [heading for heading in HEADINGS if heading in found], title  # each once, in this order


def test_no_paragraph_of_the_changelog_stands_twice():
    for _, text in split_releases():
        paragraphs = [" ".join(part.split()) for part in re.split(r"\n\n|\n- ", text) if part.strip()]
        openings = [paragraph[:60] for paragraph in paragraphs if not paragraph.startswith("#")]
        assert len(openings) == len(set(openings))


# Workflow and hooks


def test_workflow_calls_ci_run_and_nothing_else():
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    assert re.findall(r"^\s+(?:- )?run: (.*)$", text, re.MULTILINE) == [".ci/run"]
    assert {used.partition("@")[0] for used in re.findall(r"uses: (.*)", text)} == {
        "actions/checkout",
        "actions/setup-python",
    }
    versions = re.findall(r'"(3\.\d+)"', text)
    known = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert [versions[0], versions[-1]] == [known[0], known[-1]]  # the oldest and the newest that are promised
    assert PROJECT["requires-python"] == f">={versions[0]}"


def test_hooks_are_steps_of_ci_run():
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    entries = re.findall(r"entry: (.*)", hooks)
    assert entries.count("python -m data_tools.commit_subject") == 1
    steps = (ROOT / ".ci" / "run").read_text(encoding="utf-8").replace('"$bin/', "").replace('"', "")
    for entry in entries:
        if not entry.startswith("python"):
            assert entry.removesuffix(" --force-exclude") in steps


@pytest.mark.parametrize("path", ["LICENSE", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff"])
def test_what_a_release_needs_is_here(path):
    assert (ROOT / path).stat().st_size > 0
