"""The time of ``simplify``, told before it is spent; the clock is the test's own."""

import pytest

from minisplat_ref.app.runs.simplification_time import SimplificationTime, Sizes


@pytest.fixture
def clock():
    return [0.0]


def iterate(expected, clock, n, seconds):
    for _ in range(n):
        clock[0] += seconds
        expected.count_iteration()


def test_the_first_seconds_tell_what_is_left(clock, capsys):
    """100 iterations for each size and 30 at the end: 9 of 0.25 s leave 191, that is 47 s."""
    expected = SimplificationTime(100, 30, lambda: clock[0])
    expected.plan(Sizes(2, None))
    iterate(expected, clock, 8, 0.25)
    assert capsys.readouterr().err == ""
    iterate(expected, clock, 92, 0.25)
    assert capsys.readouterr().err == "minisplat-ref: 2 or more sizes to measure, at least 00:47 to go\n"


def test_each_new_plan_is_told_once_and_the_estimate_falls(clock, capsys):
    expected = SimplificationTime(100, 30, lambda: clock[0])
    for sizes in (Sizes(2, None), Sizes(1, 3), Sizes(1, 1), Sizes(0, 0)):
        expected.plan(sizes)
        iterate(expected, clock, 100, 0.25)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "minisplat-ref: 2 or more sizes to measure, at least 00:47 to go",  # (200 - 9) / 4
        "minisplat-ref: 1 to 3 sizes to measure, 00:25 to 01:22 to go",  # 330 / 4
        "minisplat-ref: 1 size to measure, 00:25 to 00:32 to go",  # the last model may be the run's own
    ]


def test_without_fine_tuning_nothing_is_told(clock, capsys):
    expected = SimplificationTime(0, 0, lambda: clock[0])
    expected.plan(Sizes(2, 2))
    clock[0] += 60.0
    expected.plan(Sizes(1, 1))
    assert capsys.readouterr().err == ""
