"""The backend cuda where CUDA is missing: nothing imports it, and whoever asks for it is told what to do."""

import os
import subprocess
import sys

import numpy as np
import pytest

from minisplat_ref.backends import CPU, get_backend
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.cpu.compositing.tile_state import lists_of
from minisplat_ref.errors import InputError
from minisplat_ref.types import TileGrid
from scenes import activated, make_camera, make_gaussians


def run_python(code, **variables):
    environment = {**os.environ, **variables}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)


def test_nothing_imports_cuda_before_it_is_asked_for():
    code = """
import sys
import minisplat_ref, minisplat_ref.cli, minisplat_ref.backends, minisplat_ref.runs.run
minisplat_ref.backends.get_backend("cpu")
print([m for m in sys.modules if m.startswith(("minisplat_ref.cuda", "numba_cuda", "cuda.", "numba.cuda.cudadrv"))])
"""
    assert run_python(code).stdout.strip() == "[]"


def test_without_the_package_it_names_the_extra():
    code = """
import sys
sys.modules["numba_cuda"] = None
from minisplat_ref.backends import get_backend
get_backend("cuda")
"""
    assert (
        "InputError: backend cuda needs the package numba-cuda; pip install 'minisplat_ref[cuda]'"
        in run_python(code).stderr
    )


def test_without_a_gpu_it_says_so():
    pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")
    said = run_python(
        "from minisplat_ref.backends import get_backend; get_backend('cuda')",
        NUMBA_ENABLE_CUDASIM="0",
        CUDA_VISIBLE_DEVICES="-1",
    ).stderr
    assert "InputError: backend cuda found no NVIDIA GPU" in said


def test_the_names_of_all_backends_are_in_the_message():
    with pytest.raises(InputError, match="cpu, cpu-exact, cuda, cuda-atomic, reference"):
        get_backend("gpu")


def test_kernels_of_the_cpu_refuse_other_tiles():
    camera, g = make_camera(40, 30), make_gaussians(np.random.default_rng(0), 3)
    projection = CPU.project(*activated(g), camera, GSPLAT_MAIN)
    bins = CPU.bin_gaussians(projection, TileGrid(40, 30, CPU.tile_width, CPU.tile_height), GSPLAT_MAIN)
    lists_of(bins)
    bins = bins._replace(grid=TileGrid(40, 30, 16, 16))
    with pytest.raises(InputError, match="32 x 16 pixels, not of 16 x 16"):
        lists_of(bins)
