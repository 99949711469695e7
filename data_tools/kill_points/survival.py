"""Kill a small training at every place where it could hurt, continue it, and compare with one that was left alone.

``python -m data_tools.kill_points`` prints a table. Whatever lies in the folder of a training that was killed at one of
the :data:`POINTS` of :mod:`data_tools.kill_points.points` must continue by ``train --resume``, or begin again by
the same command where nothing had been done, and end with the same bytes as an undisturbed training. The same must
hold after a full disk, a limit to the size of files, a read-only disk and a photograph that disappears; the
first and the third mount disks, which takes a system administrator's rights.

Of the log, times are left out, and loss and PSNR, which are running means and start again.
"""

import argparse
import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from data_tools.kill_points.points import NOWHERE, OFTEN_SAVED, POINTS
from minisplat_ref.app.runs import checkpoints, run_folder
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io.atomic import is_part
from minisplat_ref.io.checkpoint import load_checkpoint

SCENE: dict[str, Any] = {"n_views": 6, "width": 32, "height": 24, "n_points": 120, "test_every": 4}
# Mini-Splatting, whose events at 240 iterations are: densify at 20, start again from depth at 40 and 80, simplify and
# start again from the centres at 120, prune the tail at 160.
ITERATIONS = 240
OPTIONS = ("--recipe", "mini-splatting", "--iterations", str(ITERATIONS), "--test-every", "4", "--eval-every", "90")
# What no two trainings have in common:
TIMES = ("seconds", "cpu_seconds", "its/s", "train_seconds", "train_cpu_seconds", "peak_rss_mb")
MEANS = ("loss", "psnr")  # of the log

_CHILD = "import sys; from data_tools.kill_points.points import train_until as t; t(sys.argv[1], sys.argv[2:])"

Done = subprocess.CompletedProcess[str]


class Row(NamedTuple):
    """What became of one training."""

    what: str
    """What happened to it."""
    left: str
    """What it left behind, and what it said if it had the time."""
    then: str
    """How it continued."""
    is_good: bool


def train(scene: Path, out: Path, point: str = NOWHERE, **options: Any) -> Done:
    """Train, to be killed at a point if one is given."""
    return _run(["-c", _CHILD, point, "train", str(scene), *OPTIONS, "--out", str(out)], **options)


def resume(out: Path, **options: Any) -> Done:
    """Continue a training, undisturbed."""
    return _run(["-c", _CHILD, NOWHERE, "train", "--resume", str(out)], **options)


def _run(command: Sequence[str], **options: Any) -> Done:
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False, **options)


def prepare(folder: Path) -> tuple[Path, Path]:
    """Make a scene and a training that is not disturbed; return their folders."""
    scene, whole = folder / "scene", folder / "whole"
    write_scene(make_scene("room", supersampling=1, **SCENE), scene, SCENE)
    done = train(scene, whole)
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    return scene, whole


def kill_and_go_on(point: str, scene: Path, whole: Path, out: Path) -> Row:
    """Kill a training at a point, continue it or begin it again, and compare it with the whole one."""
    environment = dict(os.environ)
    if point.startswith("compiling"):
        environment["NUMBA_CACHE_DIR"] = str(out.with_name(f"{out.name}-kernels"))
    died = train(scene, out, point, env=environment)
    if died.returncode != -signal.SIGKILL:
        return Row(point, f"did not die: {_last_line(died)}", "", False)
    left = _what_is_left(out)
    if not (out / run_folder.CONFIG).exists():
        return _compare_runs(point, left, "began again", train(scene, out, env=environment), whole, out)
    done = resume(out, env=environment)
    if f"has done {ITERATIONS} iterations" in done.stderr:
        return Row(point, left, f"was complete, {differences(whole, out) or 'same bytes'}", not differences(whole, out))
    return _compare_runs(point, left, "resumed", done, whole, out)


def _compare_runs(what: str, left: str, how: str, done: Done, whole: Path, out: Path) -> Row:
    """Judge a training that has gone on."""
    differs = differences(whole, out) if done.returncode == 0 else _last_line(done)
    return Row(what, left, f"{how}, {differs or 'same bytes'}", not differs)


def _what_is_left(out: Path) -> str:
    if not out.exists() or not any(out.iterdir()):
        return "nothing"
    step, n_parts = checkpoints.read_step(out), sum(map(is_part, out.iterdir()))
    saved = "no checkpoint" if step is None else f"iteration {step}"
    return f"{saved}, {n_parts} unfinished" if n_parts else saved


def _last_line(done: Done) -> str:
    return (done.stderr.strip().splitlines() or [""])[-1]


# --- comparing ---


def differences(whole: Path, other: Path) -> str:
    """Say which files of two runs differ; nothing where none does."""
    names = {path.name for path in whole.iterdir()} ^ {path.name for path in other.iterdir()}
    return ", ".join([*(f"{name} in one only" for name in sorted(names)), *_find_differences(whole, other)])


def _find_differences(whole: Path, other: Path) -> Iterator[str]:
    if (whole / run_folder.POINT_CLOUD).read_bytes() != (other / run_folder.POINT_CLOUD).read_bytes():
        yield f"other {run_folder.POINT_CLOUD}"
    if not _is_same_state(whole / run_folder.CHECKPOINT, other / run_folder.CHECKPOINT):
        yield f"other {run_folder.CHECKPOINT}"
    for name in (run_folder.METRICS, run_folder.CONFIG, run_folder.CAMERAS):
        one, two = (json.loads((folder / name).read_text()) for folder in (whole, other))
        if _without(one, TIMES) != _without(two, TIMES):
            yield f"other {name}"
    for name, left_out in ((run_folder.LOG, (*TIMES, *MEANS)), (run_folder.CURVE, TIMES)):
        one, two = ([_without(record, left_out) for record in read_log(folder / name)] for folder in (whole, other))
        if one != two:
            yield f"other {name}"
    one, two = ({p.name: p.read_bytes() for p in (folder / run_folder.RENDERS).iterdir()} for folder in (whole, other))
    if one != two:
        yield f"other {run_folder.RENDERS}"


def _without(value: Any, keys: Sequence[str]) -> Any:
    return {key: v for key, v in value.items() if key not in keys} if isinstance(value, dict) else value


def _is_same_state(one: Path, other: Path) -> bool:
    (arrays, metadata), (arrays2, metadata2) = load_checkpoint(one), load_checkpoint(other)
    if metadata != metadata2 or arrays.keys() != arrays2.keys():
        return False
    return all(array.tobytes() == arrays2[name].tobytes() for name, array in arrays.items())


# --- disks ---


def fill_disk(scene: Path, whole: Path, out: Path) -> Row:
    """Train where three checkpoints of the beginning fit and not a larger one; then make room."""
    out.mkdir()
    size = int(4.2 * (whole / run_folder.PREVIOUS).stat().st_size)
    with _mount("-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(out)):
        failed = train(scene, out / "run", OFTEN_SAVED)
        left = f"{_what_is_left(out / 'run')}; {_last_line(failed)}"
        _system("mount", "-o", "remount,size=64m", str(out))
        return _after_refusal("full disk (tmpfs)", left, failed, whole, out / "run")


def limit_files(scene: Path, whole: Path, out: Path) -> Row:
    """Train where no file may be much larger than the first checkpoint, as with ``ulimit -f``; then lift the limit."""
    most = (whole / run_folder.PREVIOUS).stat().st_size + 6000

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    failed = train(scene, out, OFTEN_SAVED, preexec_fn=limit)
    return _after_refusal("file size limit", f"{_what_is_left(out)}; {_last_line(failed)}", failed, whole, out)


def forbid_writing(scene: Path, whole: Path, out: Path) -> Row:
    """Continue a killed run on a disk that can only be read; then where it can be written."""
    train(scene, out, "training: after iteration 133")
    with _mount("--bind", str(out), str(out)):
        _system("mount", "-o", "remount,bind,ro", str(out))
        failed = resume(out)
    return _after_refusal("read-only disk", f"{_what_is_left(out)}; {_last_line(failed)}", failed, whole, out)


def lose_photograph(scene: Path, whole: Path, out: Path) -> Row:
    """Let a photograph disappear while a training runs, which needs it no more; measuring it again does."""
    photograph = next(path for path in sorted(scene.rglob("view_0002.png")) if path.parent.name == "images")
    hidden = photograph.with_suffix(".hidden")
    command = [sys.executable, "-c", _CHILD, NOWHERE, "train", str(scene), *OPTIONS, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not (out / run_folder.LOG).exists():
            time.sleep(0.02)
        photograph.rename(hidden)
    refused = _run(["-c", _CHILD, NOWHERE, "eval", str(out)])
    hidden.rename(photograph)
    differs = differences(whole, out)
    is_named = refused.returncode == 2 and photograph.name in refused.stderr
    return Row("photograph gone", f"eval: {_last_line(refused)}", differs or "same bytes", is_named and not differs)


def _after_refusal(what: str, left: str, failed: Done, whole: Path, out: Path) -> Row:
    """Continue a training that had to be refused in one line."""
    if failed.returncode != 2 or "Traceback" in failed.stderr:
        return Row(what, left, f"ended with code {failed.returncode}", False)
    return _compare_runs(what, left, "resumed", resume(out), whole, out)


@contextlib.contextmanager
def _mount(*arguments: str) -> Iterator[None]:
    """Mount something on the last argument for a while."""
    _system("mount", *arguments)
    try:
        yield
    finally:
        _system("umount", arguments[-1])


def _system(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


DISKS: dict[str, Callable[[Path, Path, Path], Row]] = {
    "disk: full": fill_disk,
    "disk: file size limit": limit_files,
    "disk: read-only": forbid_writing,
    "disk: photograph gone": lose_photograph,
}


def main() -> None:
    """Do all that is asked for, print a table, and exit with 1 if something was bad."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.kill_points", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--only", default="", metavar="TEXT", help="points that have this in their names")
    args = parser.parse_args()
    tasks = {point: partial(kill_and_go_on, point) for point in POINTS} | DISKS
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        scene, whole = prepare(Path(name))
        for title, task in tasks.items():
            if args.only in title:
                out = Path(name, "run")
                rows.append(task(scene, whole, out))
                print(f"{len(rows)}: {rows[-1]}", file=sys.stderr, flush=True)
                for folder in (out, out.with_name(f"{out.name}-kernels")):
                    shutil.rmtree(folder, ignore_errors=True)
    table = [[row.what, row.left.replace(name, "..."), row.then, "yes" if row.is_good else "NO"] for row in rows]
    print(markdown_table(["killed at", "left behind", "continued", "good"], table, is_aligned=False))
    print(f"\n{sum(row.is_good for row in rows)} of {len(rows)} are good")
    sys.exit(not all(row.is_good for row in rows))
