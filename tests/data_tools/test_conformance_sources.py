"""Rules of other renderers name where they stand: each rule, its value, its version, and a text that says otherwise."""

import re

import pytest

from data_tools.conformance.fetching import repository_folder
from data_tools.conformance.habits import VIEWER, Habits
from data_tools.conformance.renderers import RENDERERS
from data_tools.conformance.report import NAMES
from data_tools.conformance.sources import SOURCES, Place, Stated, is_said
from data_tools.conformance.storing import LOG_SCALES, N_STEPS, N_STEPS_COMPACT
from data_tools.published.rows import has, says

RAN = [renderer for renderer in RENDERERS if renderer.habits is not None]
ROWS = [(name, rule) for name, rules in SOURCES.items() for rule in rules]
OF_QUADS = ("eps2d", "alpha_min", "deviations")


@pytest.mark.parametrize("renderer", RAN, ids=lambda renderer: renderer.name)
def test_every_rule_has_a_source(renderer):
    stated = SOURCES[renderer.name].keys()
    assert set(renderer.habits.rules) - stated == set()
    if renderer.driver:
        assert set(OF_QUADS) - stated == set()  # also where they are those of the profile


@pytest.mark.parametrize(("name", "rule"), ROWS)
def test_the_value_is_that_of_the_renderer(name, rule):
    habits, value = NAMES[name].habits, SOURCES[name][rule].said.value
    own = (habits.conventions._asdict() | habits._asdict())[rule]
    if isinstance(value, float):
        assert own == pytest.approx(value, rel=1e-12) and isinstance(own, int | float)
    else:
        assert own == value


@pytest.mark.parametrize(("name", "rule"), ROWS)
def test_the_version_is_that_of_the_renderer(name, rule):
    """Compiled parts alone are read in the repository of a package."""
    place, renderer = SOURCES[name][rule].place, NAMES[name]
    package, _, version = place.package.rpartition("@")
    if renderer.repository is not None:
        assert package == renderer.repository[0] and version.startswith(renderer.repository[1])
    elif place.package not in (*renderer.packages, *renderer.wheels):
        assert rule in ("is_last_first", "largest_scale", "is_in_file_order", "uses_principal_point")
        assert re.fullmatch(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}", place.package)
    assert place.path and place.symbol


def test_numbers_of_what_is_stored():
    assert SOURCES["spark"]["storage"].said.numbers == (*LOG_SCALES, N_STEPS)
    low, high = LOG_SCALES
    assert SOURCES["playcanvas"]["storage"].said.numbers[:3] == (low, N_STEPS_COMPACT, high - low)


def test_rules_in_words():
    """All that is not the profile's, and nothing else."""
    assert Habits(VIEWER).rules == {}
    other = Habits(VIEWER._replace(alpha_max=0.99, near_plane=0.2), box=(3.0, 2), beyond=1.2)
    assert other.rules == {
        "near_plane": "a near plane of 0.2",
        "alpha_max": "alpha clamped at 0.99",
        "box": "cut at 3 deviations in x and in y",
        "beyond": "hidden with a centre beyond 1.2 half images",
    }


@pytest.mark.parametrize(
    ("said", "text", "expected"),
    [
        (says(1.2, r"clip = ([\d.]+) \*"), "float clip = 1.2 * w;", True),
        (says(1.2, r"clip = ([\d.]+) \*"), "float clip = 1.3 * w;", False),
        (says(1.2, r"clip = ([\d.]+) \*"), "float bounds = 1.2 * w;", False),
        (says(2.0, "epsilon", numbers=(0.5,)), "epsilon = 0.5", True),
        (has(True, "a *= b", "c"), "a *= b; c", True),
        (has(True, "a *= b", "c"), "a *= b", False),
    ],
)
def test_a_text_says_a_rule_or_another(said, text, expected):
    assert is_said(Stated(Place("a@1", "b.js", "c"), said), text) is expected


def test_where_files_lie(tmp_path):
    commit = 40 * "a"
    assert Place("@b/c@1.0", "d/e.js", "f").file(tmp_path) == tmp_path / "node_modules" / "@b" / "c" / "d" / "e.js"
    assert Place(f"b/c@{commit}", "d.py", "f").file(tmp_path) == repository_folder("b/c", tmp_path) / "d.py"
    assert str(Place("a@1", "b_c.js", "d")) == r"d in a@1, b\_c.js"
