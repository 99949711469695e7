"""Viewers in a headless Chromium on the probes of data_tools.conformance: what each showed when its version was fixed.

A new version that differs fails here. Skipped without Chromium or the packages beside a ``node_modules/.bin`` of the
PATH. What is reported as an error has its own tests, test_reported_errors_of_programs.py.
"""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from data_tools.conformance.habits import SQRT_8, VIEWER, Habits
from data_tools.conformance.judging import EMPTY, judge
from data_tools.conformance.probes import PROBES
from data_tools.conformance.report import NAMES
from data_tools.conformance.sources import SOURCES, is_said

pytestmark = pytest.mark.interop

BY_NAME = {probe.name: probe for probe in PROBES}
EXPECTED = {
    ("gsplatjs", "needle"): "agrees",
    ("gsplatjs", "turned"): "agrees",
    ("gsplatjs", "background"): "agrees",
    ("playcanvas", "disc"): "agrees",
    ("playcanvas", "equal"): "agrees",
    ("playcanvas", "background"): "agrees",
    ("spark", "tiny"): "agrees",
    ("spark", "order"): "agrees",
    ("babylon", "needle"): "agrees",
    ("mkkellogg", "crowd"): "agrees",
    ("antimatter15", "needle"): "agrees",
    ("torch-splatting", "needle"): "agrees",
}


@pytest.mark.parametrize(("viewer", "probe"), EXPECTED, ids=str)
def test_a_viewer_shows_what_it_showed(show, viewer, probe):
    verdict = judge(BY_NAME[probe], show(viewer, BY_NAME[probe]), NAMES[viewer].habits)
    assert verdict.result == EXPECTED[viewer, probe], verdict


def test_what_spark_hides(show):
    """Where three deviations of the reference's Gaussian are in the image, but its centre is not."""
    assert judge(BY_NAME["beside"], show("spark", BY_NAME["beside"]), Habits(VIEWER, SQRT_8)).rule == EMPTY


@pytest.mark.parametrize("viewer", ["gsplatjs", "playcanvas", "spark", "mkkellogg", "babylon"])
def test_a_wrong_camera_turns_it_red(show, viewer):
    view = np.eye(4)
    view[0, 3] = 0.05  # one pixel
    right = show(viewer, BY_NAME["needle"])
    moved = show(viewer, BY_NAME["needle"], cam_from_world=view.tolist())
    assert np.abs(moved[:, 1:] - right[:, :-1]).max() < 8 / 255 < 0.1 < np.abs(moved - right).max()
    assert judge(BY_NAME["needle"], moved, NAMES[viewer].habits).result != "agrees"


@pytest.mark.parametrize("name", SOURCES)
def test_its_source_says_its_rules(packages, name):
    """In each file that is there: those of a version fetched, and of an installed wheel."""
    n_read = 0
    for rule, stated in SOURCES[name].items():
        file = stated.place.file(packages)
        if "==" in stated.place.package:
            package, _, path = stated.place.path.partition("/")
            spec = importlib.util.find_spec(package)
            file = Path(*spec.submodule_search_locations) / path if spec is not None else file
        if file.is_file():
            n_read += 1
            assert is_said(stated, file.read_text(encoding="utf-8")), (rule, str(stated.place))
    if n_read == 0:
        pytest.skip(f"no files of {name} beside a node_modules/.bin of the PATH")
