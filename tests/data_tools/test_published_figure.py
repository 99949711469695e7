"""Curves of published scenes: means by hand, what is drawn, and what is refused."""

import json

import pytest

from data_tools import published_figure
from data_tools.published_figure import main, read_course
from minisplat_ref.errors import InputError
from minisplat_ref.io import read_image


def write_run(folder, n, every=5):
    """A run that has logged every fifth of ``n`` iterations: PSNR is the iteration, the number twice it."""
    folder.mkdir()
    steps = range(every, n + 1, every)
    log = [json.dumps({"step": i, "seconds": 0.1 * i, "psnr": float(i), "n_gaussians": 2 * i}) for i in steps]
    (folder / "log.jsonl").write_text("".join(f"{line}\n" for line in log))
    (folder / "curve.jsonl").write_text(json.dumps({"step": n, "seconds": 9.0, "psnr": 30.5}) + "\n")
    return folder


def test_means_by_hand(tmp_path):
    """Of 5, 10, ..., 100 the mean is 52.5; the last window ends where the run does."""
    course = read_course(write_run(tmp_path / "run", 250))
    assert course.steps.tolist() == [100, 200, 250]
    assert course.psnr.tolist() == [52.5, 152.5, 227.5] and course.n_gaussians.tolist() == [105.0, 305.0, 455.0]
    assert (course.test_steps.tolist(), course.test_psnr.tolist(), course.name) == ([250], [30.5], "run")
    with pytest.raises(InputError, match="fewer than 100 iterations"):
        read_course(write_run(tmp_path / "short", 95))


def test_a_long_run_has_as_many_points_as_a_line_shows(tmp_path, monkeypatch):
    monkeypatch.setattr(published_figure, "POINTS_MAX", 2)
    assert read_course(write_run(tmp_path / "run", 1000)).steps.tolist() == [500, 1000]


def test_from_the_command_line(tmp_path, capsys):
    runs, out = [str(write_run(tmp_path / name, 200)) for name in "ab"], tmp_path / "curves.png"
    assert main([*runs, "--published", "35.78", "--out", str(out)]) == 0
    assert read_image(out).shape[:2] == (600, 1500)
    without = tmp_path / "without.png"
    assert main([*runs, "--out", str(without)]) == 0 and out.read_bytes() != without.read_bytes()
    assert main([str(tmp_path), "--out", str(tmp_path / "no.png")]) == 2 and not (tmp_path / "no.png").exists()
    assert "published_figure: error: " in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*runs * 5, "--out", str(out)])
