"""The kernels of the backend cuda, compiled without a GPU: registers, spills, and no float64 in blending."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import minisplat_ref

pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")

HELPERS = Path(__file__).parent.parent / "helpers"
CUDA = Path(minisplat_ref.__file__).parent / "cuda"
REGISTERS = {
    "composite_tiles": 64,
    "composite_tiles_vjp": 80,
    "remove_from_tiles": 64,
    "similarity_tiles": 88,
    "similarity_tiles_vjp": 88,
    "update_numbers": 40,
    "sort_digit": 40,
}
WIDE_REGISTERS = {"prepare_rows": 80, "chain_rows": 160}  # of kernels with float64, as projection has


def has_assembler():
    try:
        import nvidia
    except ImportError:
        return False
    return any(next(Path(root).rglob("bin/ptxas*"), None) for root in nvidia.__path__)


@pytest.fixture(scope="module", params=[80, 90], ids=["sm_80", "sm_90"])
def programs(request):
    if not has_assembler():
        pytest.skip("nvidia-cuda-nvcc is not installed")
    places = os.pathsep.join([str(HELPERS), str(HELPERS.parent.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": places, "NUMBA_ENABLE_CUDASIM": "0"}
    command = [sys.executable, HELPERS / "cuda_programs.py", str(request.param)]
    said = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return json.loads(said.stdout)


def kernels_of_the_package():
    """Names of the functions that are marked as kernels."""
    return {
        node.name
        for path in CUDA.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and any(getattr(d, "id", "") == "gpu_kernel" for d in node.decorator_list)
    }


def test_every_kernel_compiles_and_spills_nothing(programs):
    assert {program["kernel"] for program in programs} == kernels_of_the_package()
    for program in programs:
        assert program["registers"] > 0
        assert program["spills"] == program["stack"] == 0, program


def test_the_kernels_of_both_passes_have_few_registers(programs):
    found = [program for program in programs if program["kernel"] in WIDE_REGISTERS]
    assert len(found) == len(WIDE_REGISTERS) + 1  # the gradient with and without atomics
    for program in found:
        assert program["registers"] <= WIDE_REGISTERS[program["kernel"]] and program["doubles"] > 0, program


def test_blending_has_no_float64_and_few_registers(programs):
    tile_programs = [program for program in programs if program["kernel"] in REGISTERS]
    # Forward with and without statistics, backward with and without atomics; keys of tiles and of depths are alike.
    assert len(tile_programs) == len(REGISTERS) + 2
    for program in tile_programs:
        assert program["doubles"] == 0, program
        assert program["registers"] <= REGISTERS[program["kernel"]], program
    assert any(program["doubles"] > 0 for program in programs)  # the count would see them
