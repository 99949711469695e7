"""The backend cuda against the reference: the kernels run in Numba's simulator, in a process of its own."""

import numpy as np
import pytest

from cuda_simulator import run_in_simulator
from cuda_stages import CASES, LOSSES, run_stages
from minisplat_ref.rendering.backends import REFERENCE
from tolerances import (
    CUDA_FLOAT32_GRADIENT,
    CUDA_FLOAT32_IMAGE,
    PARITY_FLOAT32_PROJECTION,
    PARITY_FLOAT64,
)

pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """What the stages return in the simulator, by case, and the gradient of blending in a second run."""
    return run_in_simulator("cuda_stages.py", tmp_path_factory.mktemp("cuda") / "results.pickle")


def assert_close(found, expected, tolerance, name):
    """Every array within a tolerance relative to the largest value, and integers equal."""
    for field, x, y in zip(found._fields, found, expected, strict=True):
        if y is None or isinstance(y, (dict, int)):
            continue
        if isinstance(y, tuple):
            assert_close(x, y, tolerance, f"{name}.{field}")
            continue
        assert_arrays_close(x, y, tolerance, f"{name}.{field}")


def assert_arrays_close(found, expected, tolerance, name):
    assert found.shape == expected.shape, name
    if expected.dtype.kind == "i":
        assert np.array_equal(found, expected) and found.dtype == expected.dtype, name
    elif expected.size:
        error = np.max(np.abs(found - expected)) / max(np.max(np.abs(expected)), 1e-300)
        assert error <= tolerance, f"{name}: {error}"


@pytest.mark.parametrize("name", CASES)
def test_every_stage_is_that_of_the_reference(simulated, name):
    case, found = CASES[name], simulated[0][name]
    expected = run_stages(case, REFERENCE, np.float64, found)
    is_wide = case.dtype == np.float64
    one, image, gradient = (
        (PARITY_FLOAT64,) * 3 if is_wide else (PARITY_FLOAT32_PROJECTION, CUDA_FLOAT32_IMAGE, CUDA_FLOAT32_GRADIENT)
    )
    assert_close(found["projection"], expected["projection"], one, "projection")
    assert_close(found["projection_vjp"], expected["projection_vjp"], gradient, "projection_vjp")
    assert found["colors"].dtype == case.dtype
    np.testing.assert_allclose(found["colors"], expected["colors"], atol=one)
    assert_close(found["colors_vjp"], expected["colors_vjp"], gradient, "colors_vjp")
    assert_close(found["output"], expected["output"], image, "output")
    assert_close(found["plain_output"], expected["plain_output"], image, "plain_output")
    assert_close(found["output_vjp"], expected["output_vjp"], gradient, "output_vjp")
    if "atomic_vjp" in found:
        assert_close(found["atomic_vjp"], expected["atomic_vjp"], gradient, "atomic_vjp")
    assert {x.dtype for x in found["output_vjp"]} <= {np.dtype(case.dtype), np.dtype(np.float64)}


@pytest.mark.parametrize("name", CASES)
def test_removal_points_loss_and_adam_are_those_of_the_reference(simulated, name):
    case, found = CASES[name], simulated[0][name]
    expected = run_stages(case, REFERENCE, np.float64, found)
    is_wide = case.dtype == np.float64
    one, gradient = (PARITY_FLOAT64,) * 2 if is_wide else (PARITY_FLOAT32_PROJECTION, CUDA_FLOAT32_GRADIENT)
    if "removal" in expected:
        assert_arrays_close(found["removal"], expected["removal"], gradient, "removal")
        assert found["removal"].dtype == np.float64
    assert_close(found["points"], expected["points"], one, "points")
    for place, (x, y) in enumerate(zip(found["points_vjp"], expected["points_vjp"], strict=True)):
        assert_arrays_close(x, y, gradient, f"points_vjp {place}")
    for kind in LOSSES.get(name, ()):
        v = found[f"loss_vjp {kind}"]
        assert v.dtype == case.dtype
        assert found[f"loss {kind}"] == pytest.approx(expected[f"loss {kind}"], rel=gradient)
        assert_arrays_close(v, expected[f"loss_vjp {kind}"], gradient, kind)
        assert np.any(v == 0) == (kind != "bytes") and np.any(v) == (kind != "uncounted")
    assert_arrays_close(found["adam"], expected["adam"], one, "adam")


@pytest.mark.parametrize("name", CASES)
def test_lists_are_those_of_the_reference_byte_for_byte(simulated, name):
    found = simulated[0][name]
    expected = run_stages(CASES[name], REFERENCE, np.float64, found)["bins"]
    for x, y in zip(found["bins"][:4], expected[:4], strict=True):
        assert (x.dtype, x.tobytes()) == (y.dtype, y.tobytes())
    assert found["bins"].grid == expected.grid


def test_the_cases_reach_what_they_are_for(simulated):
    results = simulated[0]
    assert len(results["four tiles"]["bins"].tile_offsets) - 1 == 4
    assert np.all(results["four tiles"]["projection"].radii[2:4] == 0)
    for name in ("two batches", "opaque"):
        assert np.max(np.diff(results[name]["bins"].tile_offsets)) > 32  # Gaussians that are read at once
    late = results["two batches"]["bins"].gaussian_ids[33:]
    assert np.any(results["two batches"]["output"].stats.hit_count[late] > 0)
    hidden = results["opaque"]["bins"].gaussian_ids[32:]  # every pixel is finished, and so is the block
    assert np.all(results["opaque"]["projection"].opacities[hidden] > 0.9)
    assert np.all(results["opaque"]["output"].stats.hit_count[hidden] == 0)
    assert np.any(results["four tiles"]["output"].median_depth > 0)


def test_a_second_run_gives_the_same_bytes(simulated):
    for x, y in zip(simulated[0]["four tiles"]["output_vjp"], simulated[1], strict=True):
        assert x.tobytes() == y.tobytes()
