"""Files as other programs and people leave them: each case of ``python -m data_tools.foreign_files``."""

import pytest

from data_tools.foreign_files.kinds import KINDS, failures_of

SLOW = {  # seconds each; a quicker case of the same kind is run every time
    *("compare", "simplify", "SPZ of a small scene", "recipe velocity", "commands in ascii", "spawn, cpu", "ECEF"),
    *("scaled by 1e-06", "scaled by 1e+06", "UTM in kilometres", "no points, binary", "scaled by 10, ordinary"),
}


PIPES = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio-ffmpeg leaves them open


def marks_of(name):
    return [*([pytest.mark.slow] if name in SLOW else []), *([PIPES] if name.startswith("video ") else [])]


CASES = [
    pytest.param(case, id=f"{kind}-{name}", marks=marks_of(name))
    for kind, cases in KINDS.items()
    for name, case in cases.items()
]


@pytest.mark.parametrize("case", CASES)
def test_foreign_file(case, tmp_path):
    case(tmp_path)


def test_slow_cases_exist():
    assert {name for cases in KINDS.values() for name in cases} >= SLOW


def test_what_is_wrong_is_counted(tmp_path):
    """A case that fails, or ends in an error of the program, is reported with its traceback; others are still run."""

    def fails(folder):
        assert folder.is_dir() and not any(folder.iterdir())
        assert 1 == 2, "one is not two"

    def breaks(folder):
        raise KeyError("absent")

    failures = failures_of({"a": fails, "b": lambda folder: None, "c": breaks})
    assert failures.keys() == {"a", "c"}
    assert "one is not two" in failures["a"] and "KeyError" in failures["c"]
