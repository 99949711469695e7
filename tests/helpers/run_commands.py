"""Trainings through the command line, for tests of run folders: options, refusals, an interruption."""

import contextlib
import io
import json
import signal

import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
ITERATIONS = 20
RECIPE = ("--recipe", "3dgs-accel")  # which has a schedule
OPTIONS = [*RECIPE, "--iterations", str(ITERATIONS), "--test-every", "4", "--seed", "3"]


def write_room(folder, name="room", **settings):
    """Write a synthetic scene into a folder, and return it."""
    write_scene(make_scene(name, supersampling=1, **settings), folder, settings)
    return folder


def in_process(words):
    """Carry out a command here; a stand-in for ``train_here``, which starts a process for each training."""
    return main([str(word) for word in words])


def in_process_silently(words):
    """The same without its lines, for tests of what the program around it prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        return in_process(words)


def read_json(path):
    return json.loads(path.read_text())


def contents(folder):
    """Every file of a folder with its bytes."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def refused(capfd):
    """Run a command line that must be refused in one line, which is returned."""

    def run_refused(*arguments):
        capfd.readouterr()
        assert main([str(argument) for argument in arguments]) == 2
        lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("minisplat-ref: error: ")]
        assert len(lines) == 1
        return lines[0]

    return run_refused


def photograph(scene, name):
    (path,) = (path for path in scene.rglob(f"{name}.png") if "images" in str(path))
    return path


def interrupt_at(step, monkeypatch, number=signal.SIGINT):
    """Press Ctrl-C, or send another signal, after an iteration."""
    report_step = Progress.__call__

    def press(progress, report):
        report_step(progress, report)
        if report.step == step:
            signal.raise_signal(number)

    monkeypatch.setattr(Progress, "__call__", press)
