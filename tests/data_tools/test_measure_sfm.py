"""The table of the parts of structure from motion."""

from data_tools.measure_sfm import PARTS_HEADING, describe_parts
from minisplat_ref.datasets.sfm.attempts import Part


def test_parts_with_their_times():
    parts = [Part("standard features", 13, 20.8), Part("standard matches", 1078, 107.8)]
    rows = describe_parts("buddha", parts)
    assert rows == [
        ["**buddha**", "standard features", "13", "20.8", "1.60"],
        ["", "standard matches", "1,078", "107.8", "0.10"],
    ]
    assert {len(row) for row in rows} == {len(PARTS_HEADING)}
