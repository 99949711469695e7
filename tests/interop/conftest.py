"""Fixtures for renderers of others: packages of npm, clones and a Chromium, skipped with a reason where one is missing.

``node_modules/.bin`` of the PATH names a folder with ``node_modules`` and ``repositories``, as the cache of
``python -m data_tools.conformance`` is one.
"""

import os
from pathlib import Path

import pytest

from browser import find_browser
from data_tools.conformance.fetching import repository_folder
from data_tools.conformance.pages import browsing, picture, serving
from data_tools.conformance.probes import write
from data_tools.conformance.report import NAMES


@pytest.fixture(scope="module")
def packages():
    folders = (Path(entry).resolve().parents[1] for entry in os.get_exec_path() if Path(entry).name == ".bin")
    return next(iter(folders), Path("nowhere"))


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    if find_browser() is None:
        pytest.skip("no Chromium on the PATH")
    with browsing(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


@pytest.fixture
def show(request, packages, tmp_path):
    """A function of a renderer's name, a probe, the number of unseen Gaussians, and changes of the request."""

    def shown(name, probe, n_more=None, **changes):
        renderer = NAMES[name]
        if renderer.packages and not _is_installed(renderer.packages[0], packages):
            pytest.skip(f"no {renderer.packages[0]} beside a node_modules/.bin of the PATH")
        if renderer.repository is not None and not repository_folder(renderer.repository[0], packages).is_dir():
            pytest.skip(f"no repositories/ with {renderer.repository[0]} beside a node_modules/.bin of the PATH")
        if renderer.render is not None:
            for wheel in renderer.wheels:
                pytest.importorskip(wheel.partition("==")[0], reason=f"needs {wheel}: pip install {wheel}")
            return renderer.render(probe, packages)
        asked = write(probe, tmp_path, renderer.n_more if n_more is None else n_more) | changes
        with serving(tmp_path, packages) as address:
            browser = request.getfixturevalue("opened")
            return picture(browser, address, tmp_path, renderer.driver, dict(renderer.imports), asked)

    return shown


def _is_installed(package, packages):
    return (packages / "node_modules" / package.rpartition("@")[0]).is_dir()
