"""Nothing that is computed depends on what was in memory before."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from minisplat_ref.oracle.hard_cases import HARD_CASES
from poisoned import ENVIRONMENT

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc fills the memory that it hands out")
def test_no_result_depends_on_what_memory_held():
    environment = os.environ | ENVIRONMENT | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "tests/helpers/poisoned.py")]
    lines = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [line for line in lines if line.startswith("CHANGED")] == []
    assert lines == [case.name for case in HARD_CASES if case.refusal is None]
