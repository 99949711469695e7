"""The check of a GPU: without one it says so; in the simulator, with tiny sizes, it does everything but time."""

import os
import subprocess
import sys

from data_tools.check_gpu import CUDA, failures, run_oracle


def run(*arguments, **variables):
    command = [sys.executable, "-m", "data_tools.check_gpu", *arguments]
    return subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True)


def test_without_a_gpu_it_says_so_in_one_line():
    done = run(NUMBA_ENABLE_CUDASIM="0", CUDA_VISIBLE_DEVICES="-1")
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("check_gpu: backend cuda ")


def test_the_oracle_is_asked():
    assert run_oracle("reference", "ordinary") == {"scenes": ["ordinary"], "n_failed": 0}


def test_what_does_not_hold_is_named():
    equal, different = {"n_different": 1}, {"n_different": 3}
    speed = {CUDA: {"forward_ms": 7.0, "backward_ms": 2.0}, "gsplat": {"forward_ms": 2.0, "backward_ms": 1.0}}
    assert failures({"bytes": {CUDA: equal, "cuda-atomic": different}}) == []
    assert failures(
        {"oracle": {"n_failed": 2}, "hard_cases": {"failed": ["a"]}, "bytes": {CUDA: different}, "speed": speed}
    ) == [
        "oracle: 2 scenes",
        "hard case a",
        "cuda: runs differ in their bytes",
        "forward_ms is 7.0 of cuda, more than 3 times gsplat's 2.0",
    ]
