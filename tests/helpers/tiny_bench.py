"""Workloads so small that a benchmark of them takes no time, and a backend that renders them wrongly."""

from dataclasses import replace

import pytest

from minisplat_ref.bench import workloads
from minisplat_ref.rendering.backends import CPU


def tiny():
    return workloads.synth(400, width=48, height=40, focal=40.0)


@pytest.fixture
def tiny_workloads(monkeypatch):
    monkeypatch.setitem(workloads.FREE, "synth", tiny)
    monkeypatch.setitem(workloads.FREE, "synth5k", lambda: tiny()._replace(name="synth5k"))


def with_pixel(value):
    """The CPU backend with one pixel multiplied by a number."""

    def composite(*args, **kwargs):
        output = CPU.composite(*args, **kwargs)
        output.image[20, 24] *= value
        return output

    return replace(CPU, composite=composite)
