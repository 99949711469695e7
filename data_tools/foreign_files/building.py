"""Parts of the cases: a small scene on disk, a command run as a user would, and what it said."""

import contextlib
import io
import json
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene

SCENE: dict[str, Any] = {"n_views": 6, "width": 48, "height": 36, "n_points": 200, "test_every": 4}
OPTIONS = ("--recipe", "3dgs-accel", "--iterations", "15", "--test-every", "4")
NAMES = tuple(f"view_{i:04d}" for i in range(8))  # six training and two test views
TEST_NAMES = (NAMES[0], NAMES[4])


class Said(NamedTuple):
    """What came of a command."""

    code: int
    out: str
    err: str

    @property
    def warnings(self) -> list[str]:
        """The warnings, a line each."""
        return [line for line in self.err.splitlines() if line.startswith("minisplat-ref: warning: ")]


def room(folder: Path) -> Path:
    """Copy a ray-traced room of eight photographs, a COLMAP text model, into a folder; return the scene's folder."""
    scene = folder / "room"
    shutil.copytree(_room(), scene)
    return scene


@cache
def _room() -> Path:
    made = Path(tempfile.mkdtemp(prefix="foreign-room-"))
    write_scene(make_scene("room", supersampling=1, **SCENE), made / "room", SCENE)
    for truth in ("depths", "normals", "scene_info.json"):
        path = made / "room" / truth
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return made / "room"


def command(*arguments: object) -> Said:
    """Run a command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(argument) for argument in arguments])
    return Said(code, out.getvalue(), err.getvalue())


def done(*arguments: object) -> Said:
    """Run a command line that must succeed."""
    said = command(*arguments)
    assert said.code == 0, said.err
    return said


def refused(*arguments: object, names: object) -> str:
    """Run a command line that must be refused in one line, which names something; return the line."""
    said = command(*arguments)
    lines = [line for line in said.err.splitlines() if line.startswith("minisplat-ref: error: ")]
    assert said.code == 2 and len(lines) == 1, (said.code, said.err[-2000:])
    assert "Traceback" not in said.err, said.err
    assert str(names) in lines[0], lines[0]
    return lines[0]


def metrics_of(run: Path) -> dict[str, Any]:
    """Return the metrics of a run."""
    metrics: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    return metrics


def camera_names(run: Path, split: str) -> list[str]:
    """Return the views of a run that are of a split."""
    cameras = json.loads((run / "cameras.json").read_text())
    return [camera["img_name"] for camera in cameras if camera["split"] == split]
