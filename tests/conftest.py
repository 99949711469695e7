"""Fixtures for all test files."""

import gc
import os

# The workers of pytest-xdist and the processes that tests start share the cores. A thread that spins while it waits for
# work keeps another process from running: small trainings take four times the processor time. So the threads of OpenMP
# sleep, and NumPy's matrix products have one. Both libraries read this once, when they are loaded.
os.environ |= {"GOMP_SPINCOUNT": "0", "OPENBLAS_NUM_THREADS": "1"}
# Processes that tests start find sources compiled; otherwise each compiles all that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
gc.disable()  # until all is imported and collected, which stays

import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from browser import Browser, find_browser
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.rendering.backends import BACKENDS, CPU, REFERENCE

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collection_finish():
    """Let the garbage collector run again, but never over the thousands of items and what their modules imported."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def ctrl_c_is_heard():
    """Have Ctrl-C interrupt, here and in processes that tests start: a shell starts what runs behind it deaf to it."""
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


@pytest.fixture
def rng():
    return np.random.default_rng(20240229)


@pytest.fixture(params=[REFERENCE, CPU], ids=lambda b: b.name)
def backend(request):
    """The backends that share no formula: closed forms, gradients and hard cases hold for each."""
    return request.param


@pytest.fixture(params=[b for b in BACKENDS.values() if b is not REFERENCE], ids=lambda b: b.name)
def fast_backend(request):
    """Every backend but the reference, for parity with it."""
    return request.param


@pytest.fixture
def small_proof(monkeypatch):
    """Let the oracle check a model on less: Jacobians with colours of degree 0, inner products of half the Gaussians.

    The inner products have colours of all degrees, and two by two of the kernels' tiles.
    """

    def smaller(rng, n, width, height, *rest, **named):
        return make_setting(rng, n // 2, 36, 20, *rest, **named)

    monkeypatch.setattr("minisplat_ref.oracle.models.tiny_setting", partial(tiny_setting, sh_degree=0))
    monkeypatch.setattr("minisplat_ref.oracle.models.make_setting", smaller)


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real scenes, beside the repository; tests that need it are skipped where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real scenes at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A headless Chromium, in which reports are opened."""
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium), in which reports would be opened")
    with Browser(program, tmp_path_factory.mktemp("browser")) as opened:
        yield opened
