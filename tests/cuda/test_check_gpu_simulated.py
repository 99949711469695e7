"""``data_tools.check_gpu`` in Numba's simulator, with tiny sizes."""

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")

TINY = "--gaussians 3 --size 9x7 --points 4 --views 2 --train-size 9x7 --iterations 1 --runs 2 --recipes 3dgs"


def test_everything_but_the_times():
    parts = "--only hard_cases recipes bytes speed --against reference --cases".split()
    command = [sys.executable, "-m", "data_tools.check_gpu", *TINY.split(), *parts, "without-low-pass"]
    done = subprocess.run(command, env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["card"] == {"name": "Numba's simulator, no GPU"}
    assert found["hard_cases"]["n_cases"] >= 3 and found["failed"] == []
    cuda, reference = found["recipes"]["3dgs"]["cuda"], found["recipes"]["3dgs"]["reference"]
    assert cuda["psnr"] == pytest.approx(reference["psnr"], abs=0.01) and cuda["notes"] == []
    assert cuda["n_gaussians"] == reference["n_gaussians"] > 0
    assert found["bytes"]["cuda"] == {"n_runs": 2, "n_different": 1, "largest_difference": 0.0}
    assert found["speed"] == {"not_timed": "the simulator's times say nothing"}
