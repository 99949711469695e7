"""A plugin of pytest, ``-p data_tools.deadline --seconds T``: begins no further test when the time is over.

What has been run until then counts: the exit code is 0 if none of it failed.
"""

import time

import pytest

_START = time.monotonic()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the option."""
    parser.addoption("--seconds", type=float, required=True, help="after which no further test begins")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """End the run before a test that begins too late."""
    if time.monotonic() - _START > item.config.getoption("seconds") and not item.session.testsfailed:
        pytest.exit("the time is over", returncode=0)
