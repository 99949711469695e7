"""A training through the command line ends with the same bytes, however many threads and processes there are."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene

ROOT = Path(__file__).parent.parent
ITERATIONS = {"3dgs-accel": 60, "mini-splatting2": 120}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room in four images of 39 lines: half of them and a third of them are odd."""
    folder = tmp_path_factory.mktemp("room")
    settings = {"n_views": 4, "width": 50, "height": 39, "n_points": 1000}
    write_scene(make_scene("room", supersampling=1, **settings), folder, settings)
    return folder


def started(scene, out, recipe, n_threads):
    """Start a training in a separate process."""
    command = [sys.executable, "-m", "minisplat_ref", "train", str(scene), "--out", str(out), "--recipe", recipe]
    command += ["--iterations", str(ITERATIONS[recipe]), "--seed", "3"]
    environment = os.environ | {"NUMBA_NUM_THREADS": str(n_threads)}
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def digest(process, out):
    """Wait for a training; return the hash of its Gaussians."""
    printed, _ = process.communicate(timeout=600)
    assert process.returncode == 0, printed.decode()
    ply = (out / "point_cloud.ply").read_bytes()
    assert len(ply) > 10_000
    return hashlib.sha256(ply).hexdigest()


@pytest.mark.parametrize("recipe", ITERATIONS)
def test_same_bytes_at_any_number_of_threads_and_two_at_once(recipe, scene, tmp_path):
    outs = [tmp_path / f"threads{n_threads}" for n_threads in (1, 2, 3)]
    digests = {digest(started(scene, outs[0], recipe, 1), outs[0])}
    both = [started(scene, out, recipe, n_threads) for n_threads, out in enumerate(outs[1:], 2)]
    digests.update(digest(process, out) for process, out in zip(both, outs[1:], strict=True))
    assert len(digests) == 1
