"""Other people's renderers, right and wrong, in NumPy, torch and JAX: no alarm where nothing is wrong, the right hint.

Each error is a line of source that is replaced (``tests/helpers/foreign_faults.py``). The package's own faults had no
part in them, though the two that were missed at first have been planted since: now all twenty first hints have to be
right. Of ten other spellings none may be an alarm.
"""

import re
from pathlib import Path

import pytest

from foreign_faults import FAULTS, SOUND, load
from minisplat_ref.testing import assert_matches_oracle

MODULES = ("numpy", "torch", "jax")
MISSED = ()
"""Faults whose first hint is known not to be right."""


def check(change):
    kind = change.module.partition("_")[0]
    if kind != "numpy":
        pytest.importorskip(kind)
    assert_matches_oracle(load(change), arrays=kind, has_gradients=kind != "numpy")


def test_twenty_faults_ten_spellings_three_libraries():
    assert len(FAULTS) == len({fault.name for fault in FAULTS}) == 20 and len(SOUND) == 10
    assert {change.module.partition("_")[0] for change in (*FAULTS, *SOUND)} == set(MODULES)
    assert len(MISSED) <= 3


@pytest.mark.parametrize("change", SOUND, ids=lambda change: change.name)
def test_another_spelling_is_no_alarm(change):
    check(change)


@pytest.mark.parametrize("change", FAULTS, ids=lambda change: change.name)
def test_the_first_hint_is_right(change):
    with pytest.raises(AssertionError) as error:
        check(change)
    first = re.search(r"^  1\. (.*)$", str(error.value), re.MULTILINE)
    is_right = first is not None and re.search(change.hint, first[1]) is not None
    assert is_right == (change.name not in MISSED), str(error.value)
    if change.name == "pixel centres at 0":  # the example of docs/ORACLE.md, as it is printed
        shown = re.search(r"^image.* wrong: as with\n  1\. .*\nto tell these apart.*$", str(error.value), re.MULTILINE)
        assert shown is not None and shown[0] in (Path(__file__).parents[2] / "docs" / "ORACLE.md").read_text()
