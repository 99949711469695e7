"""The backend cuda where CUDA is missing: nothing imports it, and whoever asks for it is told what to do."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.cpu.compositing.tile_state import pack_lists
from minisplat_ref.errors import InputError
from minisplat_ref.methods.gaussian_splatting import GS
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE, get_backend
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.case import Case
from minisplat_ref.training.on_device import OnDevice
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import TileGrid, View
from scenes import activated, as_dtype, make_camera, make_gaussians


def run_python(code, **variables):
    environment = {**os.environ, **variables}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)


def test_nothing_imports_cuda_before_it_is_asked_for():
    code = """
import sys
import minisplat_ref, minisplat_ref.app.cli, minisplat_ref.rendering.backends, minisplat_ref.app.runs.run
minisplat_ref.rendering.backends.get_backend("cpu")
print([m for m in sys.modules if m.startswith(("minisplat_ref.cuda", "numba_cuda", "cuda.", "numba.cuda.cudadrv"))])
"""
    assert run_python(code).stdout.strip() == "[]"


def test_without_the_package_it_names_the_extra():
    code = """
import sys
sys.modules["numba_cuda"] = None
from minisplat_ref.rendering.backends import get_backend
get_backend("cuda")
"""
    assert (
        "InputError: backend cuda needs the package numba-cuda; pip install 'minisplat_ref[cuda]'"
        in run_python(code).stderr
    )


def test_without_a_gpu_it_says_so():
    pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")
    said = run_python(
        "from minisplat_ref.rendering.backends import get_backend; get_backend('cuda')",
        NUMBA_ENABLE_CUDASIM="0",
        CUDA_VISIBLE_DEVICES="-1",
    ).stderr
    assert "InputError: backend cuda found no NVIDIA GPU" in said


def test_the_names_of_all_backends_are_in_the_message():
    with pytest.raises(InputError, match="cpu, cpu-exact, cuda, cuda-atomic, reference"):
        get_backend("gpu")


def test_kernels_of_the_cpu_refuse_other_tiles():
    camera, g = make_camera(40, 30), make_gaussians(np.random.default_rng(0), 3)
    projection = REFERENCE.project(*activated(g), camera, GSPLAT_MAIN)  # nothing has to be compiled for it
    bins = REFERENCE.bin_gaussians(projection, TileGrid(40, 30, CPU.tile_width, CPU.tile_height), GSPLAT_MAIN)
    pack_lists(bins)
    bins = bins._replace(grid=TileGrid(40, 30, 16, 16))
    with pytest.raises(InputError, match="32 x 16 pixels, not of 16 x 16"):
        pack_lists(bins)


FAKE = """
import numpy as np
from types import SimpleNamespace
from minisplat_ref.cuda import target
device = SimpleNamespace(name=b"Old Card", compute_capability=CAPABILITY)
memory = SimpleNamespace(free=1e6, total=2e6)
target.cuda = SimpleNamespace(
    is_available=lambda: True, gpus=[device], get_current_device=lambda: device, jit=JIT,
    current_context=lambda: SimpleNamespace(get_memory_info=lambda: memory),
)
"""
REFUSE = "lambda function: (_ for _ in ()).throw(RuntimeError('[222] unsupported toolchain'))"


def say(code, capability=(8, 0), jit="None"):
    """The last line of what a process with a pretended card says."""
    pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")
    pretended = FAKE.replace("CAPABILITY", str(capability)).replace("JIT", jit)
    return run_python(pretended + code, NUMBA_ENABLE_CUDASIM="0").stderr.strip().splitlines()[-1]


def test_a_card_that_is_too_old_is_named():
    assert say("target.check_device()", capability=(6, 1)) == (
        "minisplat_ref.errors.InputError: the GPU Old Card has compute capability 6.1, and kernels are compiled for 7.5"
        " or later: use a newer GPU, or --backend cpu"
    )


def test_a_driver_that_is_too_old_is_told_in_one_line():
    said = say("target.check_device()", jit=REFUSE)
    assert "the GPU Old Card cannot run a kernel ([222] unsupported toolchain): update its driver" in said


def test_a_numpy_that_numba_cuda_does_not_know_is_told_from_a_driver():
    fails = "lambda function: (_ for _ in ()).throw(AttributeError('no attribute row_stack'))"
    said = say("target.check_device()", jit=fails)
    assert f"does not work with NumPy {np.__version__} (no attribute row_stack): pip install" in said
    assert "driver" not in said


def test_too_little_memory_is_foreseen():
    assert say("target.check_room(3e9, '60,000,000 pairs (tile, Gaussian)')").endswith(
        "the GPU has no memory for 60,000,000 pairs (tile, Gaussian): 3.00 GB are needed, 0.00 GB are free; use smaller"
        " images (--downscale), fewer Gaussians (--budget), or --backend cpu"
    )


def test_a_training_that_does_not_fit_is_refused_before_anything_is_copied():
    g = as_dtype(make_gaussians(np.random.default_rng(0), 50), np.float32)
    view = View("view", make_camera(40, 30), np.zeros((30, 40, 3), np.uint8), None)
    device = SimpleNamespace(free_bytes=lambda: 1_000.0)  # a call of anything else is an error
    state = TrainState(g, zero_moments(g), 0, [], np.random.default_rng(0), {})
    case = Case(1, state.model, view, None, Request(), GS)
    engine = OnDevice(SimpleNamespace(name="cuda", residence=device))
    with pytest.raises(InputError, match=r"no memory for 50 Gaussians in 40 x 30 pixels: some 0\.00 GB are needed"):
        engine.differentiate(state, case)
    assert state.gaussians is g
