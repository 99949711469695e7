"""The progress of long steps: a bar that goes in a terminal, lines that stay in a log, nothing for what is quick."""

import io
import re

import pytest

from minisplat_ref.interface import progress
from minisplat_ref.interface.progress import Lines, progress_bar, say, with_progress


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """The time in seconds, which only the test moves."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_log_has_a_line_every_thirty_seconds_with_the_rest_by_the_rate(clock, capsys):
    for k in with_progress(range(10), "fusing depths", "views"):
        clock[0] += 14.0 if k < 5 else 700.0
    assert capsys.readouterr().err.splitlines() == [
        "minisplat-ref: fusing depths: 2 of 10 views, 00:28 gone, about 01:52 to go",  # before it is spent
        "minisplat-ref: fusing depths: 5 of 10 views, 01:10 gone, about 01:10 to go",  # 70 s (10/5 - 1)
        "minisplat-ref: fusing depths: 6 of 10 views, 12:50 gone, about 08:33 to go",  # 770 s (10/6 - 1)
        "minisplat-ref: fusing depths: 7 of 10 views, 24:30 gone, about 10:30 to go",
        "minisplat-ref: fusing depths: 8 of 10 views, 36:10 gone, about 09:02 to go",
        "minisplat-ref: fusing depths: 9 of 10 views, 47:50 gone, about 05:18 to go",
        "minisplat-ref: fusing depths: 10 of 10 views, 59:30 gone",
    ]


def test_the_time_is_told_as_soon_as_two_seconds_are_measured_if_it_is_long(clock, capsys):
    with progress_bar("matching", "pairs", 40) as bar:
        for _ in range(5):
            clock[0] += 1.0
            bar.update()
    assert capsys.readouterr().err == "minisplat-ref: matching: 3 of 40 pairs, 00:03 gone, about 00:37 to go\n"
    with progress_bar("matching", "pairs", 30) as bar:
        for _ in range(5):
            clock[0] += 1.0
            bar.update()
    assert capsys.readouterr().err == ""  # 27 s and less


def test_a_slow_beginning_is_no_long_step(clock, capsys):
    with progress_bar("rendering", "views", 100) as bar:
        clock[0] += 20.0
        for _ in range(5):
            bar.update()
            clock[0] += 0.25
    assert capsys.readouterr().err == ""


def test_a_quick_step_leaves_nothing_in_a_log(clock, capsys):
    for _ in with_progress(range(1000), "quick"):
        clock[0] += 0.029
    assert capsys.readouterr().err == ""


def test_a_total_that_is_not_known_and_hours(clock, capsys):
    with progress_bar("waiting") as bar:
        clock[0] += 3 * 3600 + 61
        bar.update(1234)
        bar.set_description("still waiting")
        clock[0] += 31
        bar.update()
    assert capsys.readouterr().err.splitlines() == [
        "minisplat-ref: waiting: 1,234, 3:01:01 gone",
        "minisplat-ref: still waiting: 1,235, 3:01:32 gone",
    ]


def test_bytes_are_shown_as_megabytes(clock, capsys):
    with progress_bar("fox", "MB", 18_338_147) as bar:
        clock[0] += 30
        bar.update(9_169_073)
    assert capsys.readouterr().err == "minisplat-ref: fox: 9.2 of 18.3 MB, 00:30 gone, about 00:30 to go\n"


def test_a_terminal_has_a_bar_that_is_removed(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "100")
    assert list(with_progress([3, 4], "rendering", "views", delay=0.0)) == [3, 4]
    shown = terminal.getvalue()
    assert "rendering:   0%|" in shown and "0/2 [00:00<?, ? views/s]" in shown
    assert shown.split("\r")[-1] == "" and shown.split("\r")[-2].strip() == ""


def test_a_terminal_shows_nothing_of_a_quick_step(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    assert len(list(with_progress(range(3), "quick"))) == 3
    assert terminal.getvalue() == ""


def test_a_line_for_a_person_is_above_the_bar(monkeypatch, capsys):
    say("in a log")
    assert capsys.readouterr().err == "minisplat-ref: in a log\n"
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with progress_bar("matching", "pairs", 40, delay=0.0) as bar:
        bar.update()
        say("in a terminal")
    assert "minisplat-ref: in a terminal\n" in re.split("\r", terminal.getvalue())  # from the left edge


def test_items_are_counted_when_their_work_is_done(clock, capsys):
    items = with_progress(iter("ab"), "working", "letters", total=2)
    next(items)
    clock[0] += 40
    assert capsys.readouterr().err == ""
    next(items)
    assert capsys.readouterr().err == "minisplat-ref: working: 1 of 2 letters, 00:40 gone, about 00:40 to go\n"


def test_lines_for_a_bar_have_no_carriage_returns(capsys):
    lines = Lines()
    for text in ("\rtraining: 0it", "", "\r  ", "\rtraining: 5it   ", "\n"):
        lines.write(text)
    lines.flush()
    assert capsys.readouterr().err == "minisplat-ref: training: 0it\nminisplat-ref: training: 5it\n"


def test_every_bar_of_the_package_is_this_one():
    from pathlib import Path

    package = Path(progress.__file__).parents[1]
    users = {
        str(path.relative_to(package)) for path in package.rglob("*.py") if re.search(r"\btqdm\b", path.read_text())
    }
    assert {name.replace("\\", "/") for name in users} == {"interface/progress.py", "app/runs/progress.py"}
