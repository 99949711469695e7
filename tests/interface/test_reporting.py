"""What all reports have in common: the table in Markdown, and the machine."""

import platform

import numba
import pytest

from minisplat_ref.interface.reporting import describe_machine, machine, markdown_table
from minisplat_ref.oracle.cases import Case, Report, as_markdown


def test_aligned_table():
    assert markdown_table(["", "a"], [["PSNR (dB)", "1"]]) == (
        "|           | a |\n"
        "|-----------|---|\n"
        "| PSNR (dB) | 1 |"
    )  # fmt: skip


def test_table_of_long_cells():
    assert markdown_table(["name", "b"], [["x", "yes"]], is_aligned=False) == "| name | b |\n| --- | --- |\n| x | yes |"


def test_row_that_lacks_a_cell_is_refused():
    with pytest.raises(ValueError, match="zip"):
        markdown_table(["a", "b"], [["1", "2"], ["3"]])


def test_cases_as_a_table():
    """Columns of all cases; a figure that a case lacks stays empty."""
    cases = (Case("a", True, {"error": 0.12345}), Case("b", False, {"n": 7}, "why"))
    assert as_markdown(Report("", cases, {})) == (
        "| case | verdict | error | n | note |\n"
        "|------|---------|-------|---|------|\n"
        "| a    | passed  | 0.123 |   |      |\n"
        "| b    | FAILED  |       | 7 | why  |"
    )  # fmt: skip


def test_machine(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 3)
    found = machine()
    assert found["processor"] and found["threads"] == 3 and found["python"] == platform.python_version()
    assert describe_machine() == f"{found['processor']}, 3 threads, Python {found['python']}, Numba {numba.__version__}"
