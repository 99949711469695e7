"""The time that is left: speeds by a clock that only the test moves, and how they are told."""

import pytest

from minisplat_ref.interface.remaining import SECONDS_MIN, Speed, describe_rest, format_interval


def test_a_speed_by_hand():
    now = [0.0]
    speed = Speed(lambda: now[0])
    assert speed.seconds_of(10) is None  # nothing is done
    now[0] = 50.0
    speed.count()  # which took 50 s to compile, and says nothing
    assert speed.seconds_of(10) is None
    now[0] += 0.5 * SECONDS_MIN
    speed.count()
    assert speed.seconds_of(10) is None  # too short to say anything
    now[0] = 60.0
    speed.count(3)
    assert speed.seconds_of(10) == 25.0  # 10 s for 4
    now[0] = 64.0
    speed.count(3)
    assert speed.seconds_of(7) == 14.0 and speed.seconds_of(0) == 0.0


@pytest.mark.parametrize(
    ("least", "most", "text"),
    [
        (40.2, 40.9, "about 00:40 to go"),
        (33, 222, "00:33 to 03:42 to go"),
        (61, None, "at least 01:01 to go"),
        (0, 3661, "00:00 to 1:01:01 to go"),
    ],
)
def test_a_rest_is_told(least, most, text):
    assert describe_rest(least, most) == text


def test_intervals():
    assert [format_interval(s) for s in (0.9, 59.9, 3599, 3600)] == ["00:00", "00:59", "59:59", "1:00:00"]
