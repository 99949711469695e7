"""Rays: splatting on the axis, the edge of a shadow, and small runs of both claims."""

import re

import numpy as np
import pytest

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.rays import measures as claims
from measured_claims import measured
from tolerances import PARITY_FLOAT32_IMAGE, RAY_ORDER


def test_small_gaussians_on_the_axis_are_splatted_alike():
    """The difference falls with the square of the angular size; the low-pass is left out."""
    errors = claims.splatting_errors()["0 degrees"]
    assert errors[0] < 5e-4 and 3.5 < errors[1] / errors[0] < 4.5


def test_the_speed_is_told_with_its_error(capsys):
    assert measure_claim(["rays/speed", "--gaussians", "200", "--repeats", "1"]) == 0
    out = capsys.readouterr().out
    assert " a ray takes " in out and float(re.search(r"error of float32 +\| +(\S+)", out)[1]) < PARITY_FLOAT32_IMAGE
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["rays/speed", "--repeats", "0"])


def test_the_edge_of_a_shadow_is_where_the_tangent_cone_meets_the_floor():
    assert claims.shadow_edge()["pixels"] < 0.01


def test_the_claim_draws_and_prints(tmp_path, capsys):
    out = tmp_path / "measured"
    result = measured(["rays/claims", "--gaussians", "60", "--out", str(out)])
    for name in ("tree against brute force", "tracing against exact order", "mirror against mirrored camera"):
        assert result[name] < RAY_ORDER
    errors = result["splatting against tracing"]["errors"]
    assert all((np.diff(values) > 0).all() for values in errors.values())
    assert (out / "figure.png").stat().st_size > 20_000 and "| edge of a shadow" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        measure_claim(["rays/claims", "--gaussians", "0", "--out", str(tmp_path / "none")])
