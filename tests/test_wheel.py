"""What is installed: the package alone, since ``data_tools`` is somebody else's name on the package index."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_wheel_is_told_to_hold_the_package_alone():
    """Where hatchling is not installed, this is all that can be said; the next test builds the wheel."""
    hatch = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]
    assert hatch == {"build": {"targets": {"wheel": {"packages": ["minisplat_ref"]}}}}


def test_wheel_holds_the_package_alone(tmp_path):
    pytest.importorskip("hatchling", reason="needs hatchling, of the extra [test], to build the wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.iterdir()
    names = zipfile.ZipFile(wheel).namelist()
    version = wheel.name.split("-")[1]
    assert {name.split("/")[0] for name in names} == {"minisplat_ref", f"minisplat_ref-{version}.dist-info"}
    expected = {path.relative_to(ROOT).as_posix() for path in (ROOT / "minisplat_ref").rglob("*.py")}
    assert {name for name in names if name.endswith(".py")} == expected
    assert "minisplat_ref/py.typed" in names  # so that type checkers look into the package
