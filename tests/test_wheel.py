"""What is built: a wheel of the package alone, since ``data_tools`` is somebody else's name on the package index."""

import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

import minisplat_ref

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """A folder with the wheel and the source distribution."""
    pytest.importorskip("hatchling", reason="needs hatchling, of the extra [test], to build")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return folder


def test_wheel_is_told_to_hold_the_package_alone():
    """Where hatchling is not installed, this is all that can be said; the next tests build the wheel."""
    hatch = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]
    assert hatch["build"]["targets"]["wheel"] == {"packages": ["minisplat_ref"]}


def test_wheel_holds_the_package_alone(dist):
    (wheel,) = dist.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    information = f"minisplat_ref-{minisplat_ref.__version__}.dist-info"
    assert {name.split("/")[0] for name in names} == {"minisplat_ref", information}
    expected = {path.relative_to(ROOT).as_posix() for path in (ROOT / "minisplat_ref").rglob("*.py")}
    assert {name for name in names if name.endswith(".py")} == expected
    assert "minisplat_ref/py.typed" in names  # so that type checkers look into the package


def test_metadata_of_the_wheel(dist):
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        metadata = message_from_bytes(file.read(f"minisplat_ref-{minisplat_ref.__version__}.dist-info/METADATA"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert metadata["Version"] == minisplat_ref.__version__
    urls = dict(line.split(", ") for line in metadata.get_all("Project-URL"))
    assert urls == project["urls"] and all(url.startswith("https://") for url in urls.values())
    assert set(metadata.get_all("Classifier")) == set(project["classifiers"])


def test_source_distribution_has_tests_and_documentation_but_no_stored_notebooks(dist):
    with tarfile.open(dist / f"minisplat_ref-{minisplat_ref.__version__}.tar.gz") as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    needed = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "mkdocs.yml", "pyproject.toml"}
    needed |= {"tests/test_wheel.py", "docs/GUIDE.md", "docs/figures/readme.png", "data_tools/site.py"}
    assert needed <= names
    assert "notebooks/00_reading_guide.py" in names and not any(name.endswith(".ipynb") for name in names)
