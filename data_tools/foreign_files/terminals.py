"""Terminals that cannot show a name, a process that was forked, and what other libraries say on stderr."""

import io
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from data_tools.foreign_files.building import NAMES, OPTIONS, done, room
from data_tools.foreign_files.dialects import gaussians
from minisplat_ref import render
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.progress import Progress
from minisplat_ref.errors import InputError
from minisplat_ref.io import save_ply
from minisplat_ref.types import Camera

NAME = "\u0416\u00f3\u0142\u0107-\u732b"  # letters that no one-byte code page has together
CAMERA = Camera(np.eye(3), np.array([0.0, 0.0, 5.0]), 30.0, 30.0, 16.0, 12.0, 32, 24)


def printed(arguments: Sequence[object], encoding: str) -> tuple[int, str, str]:
    """Run a command whose stdout and stderr have a code page and refuse what is not in it; return what they got."""
    buffers = io.BytesIO(), io.BytesIO()
    out, err = (io.TextIOWrapper(buffer, encoding=encoding, errors="strict") for buffer in buffers)
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = out, err
    try:
        code = main([str(argument) for argument in arguments])
        out.flush()
        err.flush()
    finally:
        sys.stdout, sys.stderr = before
    assert out.errors == err.errors == "strict"  # as they were
    return code, buffers[0].getvalue().decode(encoding), buffers[1].getvalue().decode(encoding)


def _commands(folder: Path, encoding: str) -> None:
    """Commands whose output has names of files end as they would elsewhere."""
    scene = room(folder).rename(folder / NAME)
    images = scene / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(NAMES[4], NAME), encoding="utf-8")
    (scene / "images" / f"{NAMES[4]}.png").rename(scene / "images" / f"{NAME}.png")
    run = folder / f"run-{NAME}"
    mine = partial(printed, encoding=encoding)
    for arguments in (
        ("info", scene),
        ("train", scene, *OPTIONS, "--out", run),
        ("train", "--resume", run, "--iterations", 17),
        ("eval", run),
        ("info", run),
        ("render", run, "--out", folder / f"views-{NAME}"),
        ("convert", run, folder / f"{NAME}.ply"),
        ("convert", run, folder / f"{NAME}.spz"),
        ("info", folder / f"{NAME}.ply"),
        ("downscale", scene, "--downscale", 2),
    ):
        code, out, err = mine(arguments)
        assert code == 0, (arguments, err)
        assert "Error" not in err
        assert NAME not in out
    code, out, err = mine(("info", scene / "nothing.ply"))
    assert code == 2 and "does not exist" in err


def _undecodable(folder: Path) -> None:
    """A folder whose name is no text in UTF-8 gets a report as any other."""
    scene, run = room(folder), folder / os.fsdecode(b"run-\xff")
    done("train", scene, *OPTIONS, "--out", run)
    assert "</html>" in (run / "report.html").read_text(encoding="utf-8")
    code, _, err = printed(("info", run), "utf-8")
    assert code == 0, err


def _lone_surrogate(folder: Path) -> None:
    """A name in JSON that no text can hold is refused when it is read."""
    scene = folder / "scene"
    scene.mkdir()
    frames = [{"file_path": "images/a\udc80.png", "transform_matrix": np.eye(4).tolist()}]
    (scene / "transforms.json").write_text(json.dumps({"fl_x": 40, "frames": frames}))
    code, _, err = printed(("info", scene), "utf-8")
    assert code == 2 and err.count("minisplat-ref: error: ") == 1, err


def render_in_child(queue: Any, backend: str) -> None:
    """Render in another process, and send the image's mean or what was refused."""
    from minisplat_ref.rendering.backends import get_backend

    try:
        queue.put(float(render(gaussians(), CAMERA, backend=get_backend(backend))[0].image.mean()))
    except InputError as error:
        queue.put(str(error))


def _started(folder: Path, method: str, backend: str) -> None:
    """A child that was forked after a render says how to start it; others render."""
    expected = float(render(gaussians(), CAMERA)[0].image.mean())
    context: Any = multiprocessing.get_context(method)
    queue = context.SimpleQueue()
    child = context.Process(target=render_in_child, args=(queue, backend))
    child.start()
    child.join(timeout=60)
    assert child.exitcode == 0, child.exitcode
    said = queue.get()
    if method == "fork" and backend == "cpu":
        assert "get_context('spawn')" in said, said
    else:
        assert abs(said - expected) < 1e-6


def _quiet(folder: Path) -> None:
    """Numbers near the end of their range, and letters that a font lacks: stderr has lines of ours alone."""
    wild = gaussians()
    wild.log_scales[3] = 60.0
    wild.means[5] = 3e38
    wild.sh_dc[7] = 3e38
    wild.opacity_logits[9] = -3e38
    save_ply(folder / "wild.ply", wild)
    for arguments in (
        ("info", folder / "wild.ply"),
        ("render", folder / "wild.ply", "--frames", 1, "--size", "32x24", "--out", folder / "views"),
        ("render", folder / "wild.ply", "--frames", 1, "--size", "32x24", "--profile", "INRIA", "--out", folder / "b"),
    ):
        _, _, err = printed(arguments, "utf-8")
        assert all(line.startswith("minisplat-ref: ") for line in err.splitlines() if "%" not in line), err


def _estimated(folder: Path) -> None:
    """The time of the first iteration, which compiles, is not in the estimate of the rest."""
    n_gaussians = len(gaussians().means)
    view = SimpleNamespace(image=np.zeros((2, 2, 3), np.uint8), mask=None)
    output = SimpleNamespace(image=np.zeros((2, 2, 3)))

    def report(step: int) -> Any:
        sizes = {"n_gaussians": n_gaussians, "n_bytes": 236 * n_gaussians}
        return SimpleNamespace(step=step, last_step=100_000, notes=(), loss=0.1, output=output, view=view, **sizes)

    with Progress(folder / "log.jsonl", 0, 100_000) as progress:
        time.sleep(1.5)  # compiling
        for step in range(1, 40):
            progress(report(step))
            time.sleep(0.005)
        shown = progress._bar.format_dict
    rate = shown["rate"] or (shown["n"] - shown["initial"]) / shown["elapsed"]
    assert rate > 60, rate  # with the 1.5 s: 23
    assert progress.seconds > 1.5  # the log keeps all of it


CASES: dict[str, Callable[[Path], None]] = {
    **{f"commands in {encoding}": partial(_commands, encoding=encoding) for encoding in ("cp1252", "ascii")},
    "a folder that is no text": _undecodable,
    "a name that is no text": _lone_surrogate,
    **{
        f"{method}, {backend}": partial(_started, method=method, backend=backend)
        for method, backend in (("fork", "cpu"), ("fork", "reference"), ("spawn", "cpu"))
    },
    "numbers at the end of their range": _quiet,
    "estimate of the rest": _estimated,
}
