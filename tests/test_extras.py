"""The library and the oracle without the packages of the extra ``photos``; commands that need one say so first."""

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from minisplat_ref import save_ply
from minisplat_ref.app.cli.guard import EXTRAS
from minisplat_ref.app.reports.images import colorize
from photo_scenes import write_transforms
from scenes import as_dtype, make_gaussians

ROOT = Path(__file__).parents[1]
CODE = """
import sys
sys.modules |= {"matplotlib": None, "pycolmap": None}
from minisplat_ref.app.cli import main
sys.exit(main(sys.argv[1:]))
"""


def run(folder, *arguments):
    """Run a command where neither package is installed; return its exit code, what it printed, and its errors."""
    command = [sys.executable, "-c", CODE, *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr.splitlines()


@pytest.mark.parametrize("options", [(), ("--extension", "velocity")])
def test_the_oracle_needs_neither(tmp_path, options):
    code, said, errors = run(tmp_path, "oracle", "gradients", "--backend", "reference", *options)
    assert (code, errors) == (0, []) and "cases passed" in said


def test_a_file_is_described_and_converted_without(tmp_path):
    save_ply(tmp_path / "a.ply", as_dtype(make_gaussians(np.random.default_rng(0), 5), np.float32))
    assert run(tmp_path, "info", "a.ply")[0] == 0
    assert run(tmp_path, "convert", "a.ply", "b.spz")[0] == 0 and (tmp_path / "b.spz").exists()


def test_a_training_needs_neither(tmp_path):
    """Its report has everything but the curves, and says what draws them."""
    write_transforms(tmp_path / "scene", n=6, camera_angle_x=0.7)
    options = ("--recipe", "3dgs-accel", "--iterations", "5", "--test-every", "4")
    code, said, _ = run(tmp_path, "train", "scene", *options, "--out", "out")
    assert code == 0 and "PSNR" in said
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<svg" not in page and "pip install &#x27;minisplat_ref[photos]&#x27;" in page
    assert page.count("data:image/png") >= 3


def test_colours_of_errors_are_those_of_matplotlib():
    """Within two levels, everywhere between the ends."""
    values = np.linspace(0, 1, 256, dtype=np.float32)[None]
    for name in ("viridis", "magma", "inferno", "gray"):
        theirs = pytest.importorskip("matplotlib").colormaps[name](values, bytes=True)[..., :3]
        assert np.abs(colorize(values, 0.0, 1.0, name).astype(int) - theirs).max() <= 2
    assert colorize(np.array([[-1.0, 2.0]]), 0.0, 1.0, "gray").tolist() == [[[0, 0, 0], [255, 255, 255]]]
    assert colorize(np.array([[1.0, 2.0]]), 2.0, 1.0, "gray").tolist() == [[[255, 255, 255], [0, 0, 0]]], "reversed"


def test_a_command_that_ends_with_a_page_says_so_before_it_begins(tmp_path):
    write_transforms(tmp_path / "scene", n=4)
    code, said, (line,) = run(tmp_path, "compare", "scene", "--recipes", "3dgs", "--out", "out")
    assert (code, said) == (2, "") and not (tmp_path / "out").exists()
    assert line == (
        "minisplat-ref: error: this needs matplotlib, which is not installed: pip install 'minisplat_ref[photos]'"
    )


def test_extras_are_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for package, extra in EXTRAS.items():
        assert any(line.startswith(package) for line in project["optional-dependencies"][extra])
        assert not any(line.startswith(package) for line in project["dependencies"])
