"""The claim ``precision``: every training really has the precision that its row names."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from data_tools.claims import precision
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.precision import FAST, PRECISIONS, STORED, n_bytes, train_in_precision
from measured_claims import measured
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.types import Model

ITERATIONS = 30


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=6, width=32, height=24, n_points=120, supersampling=1).scene


@pytest.fixture(scope="module")
def states(scene):
    """One training of a recipe that starts again half way, for each precision."""
    recipe = get_recipe("mini-splatting", ITERATIONS)
    return {name: train_in_precision(scene, recipe, each, 0) for name, each in PRECISIONS.items()}


def test_dtypes_last_through_a_reinitialisation(states):
    for name, each in PRECISIONS.items():
        arrays = (*states[name].gaussians, *states[name].adam.first, *states[name].adam.second)
        assert {array.dtype for array in arrays} == {np.dtype(each.dtype)}, name


def test_colours_are_numbers_of_float16_and_nothing_else_is(states):
    half = states["float16 throughout"].gaussians
    for name, field in half._asdict().items():
        is_half = bool((field == field.astype(np.float16)).all())
        assert is_half == (name in precision.COLOURS), name


def test_precisions_differ(states):
    means = [states[name].gaussians.means for name in PRECISIONS]
    for k, first in enumerate(means):
        for second in means[:k]:
            assert first.shape != second.shape or (first != second).any()


def test_half_colours_change_the_colours_alone(states):
    fast = states[FAST].gaussians
    rounded = precision.with_half_colours(Model(fast)).gaussians
    assert_array_equal(rounded.means, fast.means)
    assert rounded.sh_dc.dtype == np.float32 and (rounded.sh_dc != fast.sh_dc).any()
    np.testing.assert_allclose(rounded.sh_dc, fast.sh_dc, rtol=2**-11, atol=2**-25)  # half a unit of its last place


def test_bytes(states):
    population = states[FAST].gaussians
    n = len(population.means)
    assert n_bytes(population, has_half_colours=False) == 59 * 4 * n
    assert n_bytes(population, has_half_colours=True) == (11 * 4 + 48 * 2) * n
    assert n_bytes(states["float64"].gaussians, has_half_colours=False) == 59 * 8 * len(
        states["float64"].gaussians.means
    )


def test_command(tmp_path, capsys):
    scene = ["--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "120"]
    assert main(["synthetic", "room", "--out", str(tmp_path / "room"), *scene]) == 0
    options = ["--iterations", "10", "--recipe", "3dgs-accel", "--seeds", "0,1", "--out", str(tmp_path / "out")]
    result = measured(["precision", str(tmp_path / "room"), *options])
    assert len(result["runs"]) == 2 * 5 and list(result["summary"]) == [*PRECISIONS, STORED]
    by_hand = [
        run["psnr"] - fast["psnr"]
        for run in result["runs"]
        for fast in result["runs"]
        if run["precision"] == "float64" and fast["precision"] == FAST and run["seed"] == fast["seed"]
    ]
    assert result["summary"]["float64"]["difference"][0] == pytest.approx(np.mean(by_hand))
    printed = capsys.readouterr().out
    assert all(f"| {name} " in printed for name in (*PRECISIONS, STORED))
    assert measure_claim(["precision", str(tmp_path / "room"), *options]) == 0, "continues, with nothing left to do"
    assert len((tmp_path / "out" / "runs.jsonl").read_text().splitlines()) == 1 + 2 * 5
