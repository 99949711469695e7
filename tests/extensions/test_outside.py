"""A stranger's extension in its own folder: everything works, from training to its own kernel, without an edit."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minisplat_ref
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.io.images import read_image
from minisplat_ref.io.ply import load_ply, read_vertices, save_ply
from minisplat_ref.jit.compile import cache_root, source_hash
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.representation import GAUSSIANS
from photo_scenes import edit_transforms, write_transforms
from scenes import as_dtype, make_gaussians

ROOT = Path(minisplat_ref.__file__).parent.parent
N = 20
ITERATIONS = 250
OPTIONS = ("--iterations", str(ITERATIONS), "--test-every", "3", "--set", "glow_penalty=0.5", "--set", "target=0.25")

FILES = {
    "__init__.py": '''\
"""Glow: every Gaussian has a brightness that grows with time.

The colour of degree 0 at time t is sh_dc + t g, the same for red, green and blue.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.glow import brightest
from minisplat_ref.extensions.glow.method import GLOWING, PENALTY, RECIPE

EXTENSION = Extension(
    "glow",
    recipes=(RECIPE,),
    representation=GLOWING,
    losses=(PENALTY,),
    commands=(brightest,),
)
''',
    "kernels.py": '''\
"""The loop of the glow."""

from minisplat_ref.jit.compile import kernel, prange


@kernel()
def add_glow(sh_dc, glow, time, out):
    for n in prange(len(glow)):
        for c in range(3):
            out[n, c] = sh_dc[n, c] + time * glow[n]
''',
    "method.py": '''\
"""The population, its renderer, its loss, its recipe."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.glow.kernels import add_glow
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.training.losses import Cotangents, LossTerm
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Gaussians


class Glowing(NamedTuple):
    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    glow: Floats


class Tape(NamedTuple):
    inner: Any
    time: float


def extend(gaussians, rng):
    return Glowing(*gaussians, np.zeros_like(gaussians.opacity_logits))


def glowing_colors(sh_dc, glow, time, backend):
    time = sh_dc.dtype.type(time)
    if not backend.is_compiled:
        return sh_dc + time * glow[:, None]
    out = np.empty_like(sh_dc)
    add_glow(sh_dc, glow, time, out)
    return out


def render(model, view, request):
    *six, glow = model.gaussians
    plain = Gaussians(*six)
    plain = plain._replace(sh_dc=glowing_colors(plain.sh_dc, glow, view.time, request.backend))
    output, tape = SPLATTING.render(model._replace(gaussians=plain), view, request)
    return output, Tape(tape, view.time)


def render_vjp(tape, v_image, v_alpha):
    v = SPLATTING.render_vjp(tape.inner, v_image, v_alpha)
    v_glow = v.gaussians.sh_dc.dtype.type(tape.time) * v.gaussians.sh_dc.sum(axis=1)
    return v._replace(gaussians=Glowing(*v.gaussians, v_glow))


def penalty(rendered, *, target):
    glow = rendered.model.gaussians.glow
    return float(np.mean((glow - target) ** 2)), Cotangents(gaussians={"glow": 2 * (glow - target) / len(glow)})


GLOWING = Representation(
    "glowing Gaussians",
    population=Glowing,
    extend=extend,
    renderer=Renderer("glow", render, render_vjp, SPLATTING.channels),
    rates=Rates({"glow": 0.01}, frozenset()),
)
PENALTY = LossTerm("glow_penalty", partial(penalty, target=0.0), weight=0.0)
RECIPE = GS_ACCEL._replace(name="glow")
''',
    "brightest.py": '''\
"""The command that names the brightest Gaussian."""


def add_parser(commands):
    parser = commands.add_parser("brightest", help="say which Gaussian glows most")
    parser.add_argument("ply")
    parser.set_defaults(run=run)


def run(args):
    from minisplat_ref.extensions.glow.method import Glowing
    from minisplat_ref.io.ply import load_ply

    print("brightest", int(load_ply(args.ply, Glowing).glow.argmax()))
    return 0
''',
}


class Stranger:
    """A machine with the package as it is, and a folder of somebody's own."""

    def __init__(self, folder):
        self.folder = folder
        self.package = folder / "mine" / "glow"
        self.kernels = folder / "kernels" / source_hash()
        self.package.mkdir(parents=True)
        for name, text in FILES.items():
            (self.package / name).write_text(text)
        # A copy of the core's kernels; other processes may be writing theirs, whose names contain ".tmp." until then.
        shutil.copytree(cache_root() / source_hash(), self.kernels, ignore=shutil.ignore_patterns("*.tmp.*"))
        self.environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "MINISPLAT_EXTENSIONS": str(self.package.parent),
            "NUMBA_CACHE_DIR": str(folder / "kernels"),
        }

    def start(self, *arguments):
        command = [sys.executable, "-m", "minisplat_ref", *map(str, arguments)]
        return subprocess.Popen(
            command, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=self.folder
        )

    def run(self, *arguments):
        process = self.start(*arguments)
        out, err = process.communicate()
        assert process.returncode == 0, err
        return out

    def own_kernels(self):
        """Compiled code of the extension, by the folder."""
        return {
            folder.name: sorted(folder.rglob("*.nbc"))
            for folder in self.kernels.glob("glow-*")
            if any(folder.rglob("*.nbc"))
        }

    def core_kernels(self):
        """Every file of the core's kernels, with the moment of its last change."""
        own = {file for folder in self.kernels.glob("glow-*") for file in folder.rglob("*")}
        files = (file for file in self.kernels.rglob("*.nb?") if file not in own)
        return {file: file.stat().st_mtime_ns for file in files}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Six views of flat colours at six times, and some points."""
    path = tmp_path_factory.mktemp("scenes") / "scene"
    folder = write_transforms(path, n=6, fl_x=40.0, ply_file_path="points.ply")
    points = as_dtype(make_gaussians(np.random.default_rng(0), N, depth=0.0, size=0.3), np.float32)
    save_ply(folder / "points.ply", points)
    edit_transforms(folder / "transforms.json", lambda c: [f.update(time=i / 5) for i, f in enumerate(c["frames"])])
    return folder


@pytest.fixture(scope="module")
def core(scene, tmp_path_factory):
    """What the stranger uses of the core, compiled where all tests find it: each stranger starts with a copy."""
    out = tmp_path_factory.mktemp("core") / "run"
    options = ["--iterations", str(ITERATIONS), "--test-every", "3"]
    assert main(["train", str(scene), "--recipe", "3dgs-accel", *options, "--out", str(out)]) == 0
    assert check_model_gradients(CPU, GSPLAT_MAIN, GAUSSIANS).n_failed == 0


@pytest.fixture(scope="module")
def stranger(core, tmp_path_factory):
    return Stranger(tmp_path_factory.mktemp("stranger"))


@pytest.fixture(scope="module")
def run_folder(stranger, scene):
    """A training from the beginning to the end, after one that has compiled what there is to compile."""
    stranger.run("train", scene, "--recipe", "glow", "--iterations", "3", "--out", stranger.folder / "first")
    stranger.run("train", scene, "--recipe", "glow", *OPTIONS, "--out", stranger.folder / "whole")
    return stranger.folder / "whole"


def test_it_is_listed_and_described(stranger):
    listed = " ".join(stranger.run("extensions").split())  # whatever the width of the column of names
    assert "glow Glow: every Gaussian has a brightness that grows with time." in listed
    out = stranger.run("extensions", "glow")
    for line in (
        "The colour of degree 0 at time t is sh_dc + t g",
        f"folder    {stranger.package}",
        "recipes   glow",
        "trains    glowing Gaussians",
        "losses    glow_penalty",
        "commands  minisplat-ref glow brightest",
    ):
        assert line in out


def test_training_trains_it(run_folder):
    trained = read_vertices(run_folder / "point_cloud.ply")["glow"]
    assert len(trained) >= N and trained.std() > 1e-3  # the images move it, and ...
    assert abs(trained.mean() - 0.25) < 0.1  # ... the penalty keeps it near its target
    config = json.loads((run_folder / "config.json").read_text())
    assert config["recipe"]["losses"][1]["weight"] == 0.5
    assert config["recipe"]["losses"][1]["settings"] == {"target": 0.25}
    assert config["recipe"]["representation"]["name"] == "glowing Gaussians"


def test_killed_and_resumed_it_gives_the_same_bytes(stranger, scene, run_folder):
    out = stranger.folder / "killed"
    process = stranger.start("train", scene, "--recipe", "glow", *OPTIONS, "--out", out)
    while process.poll() is None and not ((out / "log.jsonl").exists() and (out / "log.jsonl").read_text()):
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130, err
    assert f"of {ITERATIONS} iterations, all saved" in err
    assert (out / "point_cloud.ply").read_bytes() != (run_folder / "point_cloud.ply").read_bytes()
    stranger.run("train", "--resume", out)
    assert (out / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()


def test_the_other_commands_know_it(stranger, run_folder):
    before = json.loads((run_folder / "metrics.json").read_text())
    stranger.run("eval", run_folder)
    assert json.loads((run_folder / "metrics.json").read_text())["psnr"] == before["psnr"]
    n = before["n_gaussians"]
    assert "further properties  glow\n" in stranger.run("info", run_folder / "point_cloud.ply")
    assert f"further fields  glow [{n}]" in stranger.run("info", run_folder / "checkpoint.npz")
    trained = read_vertices(run_folder / "point_cloud.ply")["glow"]
    assert stranger.run("glow", "brightest", run_folder / "point_cloud.ply") == f"brightest {trained.argmax()}\n"
    for backend in ("reference", "cpu"):
        said = stranger.run("oracle", "gradients", "--extension", "glow", "--backend", backend)
        assert "all 4 cases passed" in said and "loss term glow_penalty: Jacobian" in said


def test_its_ply_is_one_of_3dgs(run_folder):
    gaussians, columns = load_ply(run_folder / "point_cloud.ply"), read_vertices(run_folder / "point_cloud.ply")
    assert_array_equal(gaussians.opacity_logits, columns["opacity"])


def test_an_edited_kernel_is_compiled_alone(stranger, run_folder):
    """The image changes, the kernels of the core stay as they are, and so does what the old kernel left."""

    def image(name):
        stranger.run("render", run_folder, "--out", stranger.folder / name)
        return np.stack([read_image(file) for file in sorted((stranger.folder / name).glob("*.png"))]).astype(int)

    before, own, core = image("before"), stranger.own_kernels(), stranger.core_kernels()
    assert len(own) == 1 and len(core) > 10
    assert_array_equal(image("again"), before)
    assert (stranger.own_kernels(), stranger.core_kernels()) == (own, core)

    file = stranger.package / "kernels.py"
    file.write_text(file.read_text().replace("time * glow[n]", "time * glow[n] * 4"))
    after, new = image("after"), stranger.own_kernels()
    assert np.abs(after - before).max() > 3
    assert len(new) == 2 and new.items() > own.items()
    assert stranger.core_kernels() == core


WARM_UP = """
from minisplat_ref.extensions.warm_up import warm_up

if __name__ == "__main__":
    for compiled in warm_up([], extensions=["glow", "velocity"], n_processes=1):
        print(compiled.name, compiled.problem)
"""


def test_what_is_compiled_ahead_is_what_training_uses(tmp_path, scene, core):
    stranger = Stranger(tmp_path)
    (tmp_path / "warm.py").write_text(WARM_UP)
    command = [sys.executable, "warm.py"]
    done = subprocess.run(command, env=stranger.environment, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n") == ["extension glow ", "extension velocity ", ""]
    compiled = stranger.own_kernels()
    assert [len(kernels) for kernels in compiled.values()] == [1]
    stranger.run("train", scene, "--recipe", "glow", "--iterations", "3", "--out", tmp_path / "out")
    assert stranger.own_kernels() == compiled
