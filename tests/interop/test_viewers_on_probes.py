"""Viewers in a headless Chromium on the probes of data_tools.conformance: what each showed when its version was fixed.

A new version that mends an error, or makes one, fails here. Skipped without Chromium or the packages beside a
``node_modules/.bin`` of the PATH.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from browser import find_browser
from data_tools.conformance.judging import EMPTY, SQRT_8, VIEWER, Habits, judge
from data_tools.conformance.pages import browsing, picture, serving
from data_tools.conformance.probes import PROBES, write
from data_tools.conformance.report import NAMES

pytestmark = pytest.mark.interop

BY_NAME = {probe.name: probe for probe in PROBES}
NO_LOW_PASS = VIEWER._replace(eps2d=0.0)
CUT, SHARP = Habits(VIEWER, SQRT_8), Habits(NO_LOW_PASS, SQRT_8)
LOWERED = Habits(VIEWER, SQRT_8, True)
COMPENSATED = Habits(VIEWER._replace(is_antialiased=True), SQRT_8)
EXPECTED = {
    ("gsplatjs", "needle"): (SHARP, "agrees", ""),
    ("gsplatjs", "turned"): (SHARP, "agrees", ""),
    ("gsplatjs", "background"): (SHARP, "agrees", ""),
    ("gsplatjs", "disc"): (SHARP, "rule", EMPTY),
    ("playcanvas", "disc"): (LOWERED, "agrees", ""),
    ("playcanvas", "equal"): (LOWERED, "agrees", ""),
    ("playcanvas", "background"): (LOWERED, "agrees", ""),
    ("spark", "tiny"): (COMPENSATED, "agrees", ""),
    ("spark", "beside"): (COMPENSATED, "rule", EMPTY),
}


@pytest.fixture(scope="module")
def packages():
    folders = (Path(entry).resolve().parents[1] for entry in os.get_exec_path() if Path(entry).name == ".bin")
    return next(iter(folders), Path("nowhere"))


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if find_browser() is None:
        pytest.skip("no Chromium on the PATH")
    with browsing(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


def show(browser, packages, folder, viewer, probe, n_more=None, **changes):
    renderer = NAMES[viewer]
    if not (packages / "node_modules" / renderer.packages[0].rpartition("@")[0]).is_dir():
        pytest.skip(f"no {renderer.packages[0]} beside a node_modules/.bin of the PATH")
    request = write(BY_NAME[probe], folder, renderer.n_more if n_more is None else n_more) | changes
    with serving(folder, packages) as address:
        return picture(browser, address, folder, renderer.driver, dict(renderer.imports), request)


@pytest.mark.parametrize(("viewer", "probe"), EXPECTED, ids=str)
def test_a_viewer_shows_what_it_showed(browser, packages, tmp_path, viewer, probe):
    habits, result, rule = EXPECTED[viewer, probe]
    verdict = judge(BY_NAME[probe], show(browser, packages, tmp_path, viewer, probe), habits)
    assert verdict.result == result and (result == "agrees" or verdict.rule == rule), verdict


def test_a_single_gaussian_of_gaussian_splats_3d(browser, packages, tmp_path):
    """Its quad has six indices, of which as many are drawn as there are Gaussians."""
    alone = show(browser, packages, tmp_path, "mkkellogg", "disc", 0)
    assert judge(BY_NAME["disc"], alone, CUT).rule == EMPTY
    assert show(browser, packages, tmp_path, "mkkellogg", "disc", 6)[32, 48, 0] > 0.7


@pytest.mark.parametrize("viewer", ["gsplatjs", "playcanvas", "spark"])
def test_a_wrong_camera_turns_it_red(browser, packages, tmp_path, viewer):
    view = np.eye(4)
    view[0, 3] = 0.05  # one pixel
    right = show(browser, packages, tmp_path, viewer, "needle")
    moved = show(browser, packages, tmp_path, viewer, "needle", cam_from_world=view.tolist())
    assert np.abs(moved[:, 1:] - right[:, :-1]).max() < 8 / 255 < 0.1 < np.abs(moved - right).max()
    habits = {"gsplatjs": SHARP, "playcanvas": LOWERED, "spark": COMPENSATED}[viewer]
    assert judge(BY_NAME["needle"], moved, habits).result != "agrees"
