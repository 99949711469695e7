"""What is built: a wheel of the package alone, since ``data_tools`` is somebody else's name on the package index."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

import minisplat_ref
from data_tools.package_readme import without_relative_links

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
    assert metadata["Description-Content-Type"] == "text/markdown"
    text = metadata.get_payload()
    assert text.lstrip().startswith("# minisplat_ref") and "## Installation" in text
    assert all(target.startswith(("https://", "#")) for target in re.findall(r"\]\(([^)]+)\)", text))


def test_the_readme_of_the_package_index():
    """Links lead to the released version; without a repository they become their texts."""
    text = (
        "![A film](docs/a.webp)\n\n[guide](docs/GUIDE.md#films), [paper](https://doi.org/1), [below](#there) [x](./y)"
    )
    assert without_relative_links(text, "https://github.com/me/it/", "1.2.3") == (
        "![A film](https://github.com/me/it/raw/v1.2.3/docs/a.webp)\n\n"
        "[guide](https://github.com/me/it/blob/v1.2.3/docs/GUIDE.md#films), [paper](https://doi.org/1),"
        " [below](#there) [x](https://github.com/me/it/blob/v1.2.3/y)"
    )
    assert without_relative_links(text, None, "1.2.3") == "guide, [paper](https://doi.org/1), [below](#there) x"


def test_the_index_can_show_it(dist):
    """``twine check`` as before an upload, which nothing here does."""
    pytest.importorskip("twine", reason="needs twine, of the extra [dev]")
    files = [str(path) for path in dist.iterdir()]
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *files], check=True, capture_output=True)


def test_source_distribution_has_tests_and_documentation_but_no_stored_notebooks(dist):
    with tarfile.open(dist / f"minisplat_ref-{minisplat_ref.__version__}.tar.gz") as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    needed = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "mkdocs.yml", "pyproject.toml"}
    needed |= {"tests/test_wheel.py", "docs/GUIDE.md", "docs/figures/readme.png", "data_tools/site.py"}
    assert needed <= names
    assert "notebooks/00_reading_guide.py" in names and not any(name.endswith(".ipynb") for name in names)
