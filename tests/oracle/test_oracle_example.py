"""What docs/ORACLE.md gives to copy: a valid, short workflow, and a test that runs in somebody else's repository."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from minisplat_ref.app.cli.oracle.compare import SCENES

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"
TEXT = (ROOT / "docs" / "ORACLE.md").read_text(encoding="utf-8")
RENDERER = """
import minisplat_ref as ms

def rasterization(**arguments):
    image, alpha, meta = ms.rasterization(**arguments, backend="reference")
    return {scale} * image, alpha, meta

def rasterization_vjp(**arguments):
    return ms.rasterization_vjp(**arguments, backend="reference")
"""


@pytest.mark.parametrize(("file", "language"), [("oracle.yml", "yaml"), ("test_oracle.py", "python")])
def test_the_page_shows_the_files(file, language):
    blocks = re.findall(rf"\(examples/{re.escape(file)}\):\n\n```{language}\n(.*?)```", TEXT, re.DOTALL)
    assert blocks == [(EXAMPLES / file).read_text(encoding="utf-8")]


def test_the_workflow_is_ten_lines_that_run_the_test():
    yaml = pytest.importorskip("yaml")
    text = (EXAMPLES / "oracle.yml").read_text(encoding="utf-8")
    assert len(text.splitlines()) == 10
    workflow = yaml.safe_load(text)
    assert workflow[True] == ["push", "pull_request"]  # YAML 1.1 reads "on" as true
    *_, last = workflow["jobs"]["oracle"]["steps"]
    assert last["run"].endswith("pytest tests/test_oracle.py") and "minisplat_ref" in last["run"]
    assert "[`tests/test_oracle.py`](examples/test_oracle.py)" in TEXT  # where the page puts it


@pytest.fixture
def repository(tmp_path):
    """Return a function that makes the repository of a renderer whose image is off by a factor, and runs its test."""
    (tmp_path / "tests").mkdir()
    shutil.copy(EXAMPLES / "test_oracle.py", tmp_path / "tests")

    def run(scale, *arguments):
        (tmp_path / "my_renderer.py").write_text(RENDERER.replace("{scale}", str(scale)))
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "--import-mode=importlib",
            *arguments,
        ]
        path = {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
        return subprocess.run(command, cwd=tmp_path, env={**os.environ, **path}, capture_output=True, text=True)

    return run


def test_a_right_renderer_passes_in_every_scene(repository):
    done = repository(1.0)
    scenes = re.findall(r'"([\w-]+)"', (EXAMPLES / "test_oracle.py").read_text().partition("[")[2].partition("]")[0])
    assert set(scenes) < set(SCENES) and len(scenes) == 6
    assert done.returncode == 0 and "6 passed" in done.stdout, done.stdout


def test_a_wrong_one_fails_with_the_stage_and_what_it_looks_like(repository):
    done = repository(1.01, "-k", "sh3")
    assert done.returncode == 1 and "1 failed" in done.stdout
    assert "the first stage that diverges is image, in scene sh3" in done.stdout
    assert re.search(r"image, .* wrong and .* right: ", done.stdout) and "  1. colours times 1.01" in done.stdout
