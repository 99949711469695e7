"""Both passes in few launches: their results beside the reference's, and what they ask of the device.

They run in Numba's simulator, in a process of its own.
"""

import numpy as np
import pytest

from cuda_passes import CASES, SMALL, make_inputs
from cuda_simulator import run_in_simulator
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import REFERENCE
from scenes import as_dtype
from tolerances import CUDA_FLOAT32_GRADIENT, CUDA_FLOAT32_IMAGE, PARITY_FLOAT64

pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")

MOST_FORWARD, MOST_BACKWARD = 12, 10  # launches


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return run_in_simulator("cuda_passes.py", tmp_path_factory.mktemp("cuda") / "results.pickle")


def relative_error(found, expected):
    assert found.shape == expected.shape
    return np.max(np.abs(found - expected)) / np.max(np.abs(expected))


@pytest.mark.parametrize("name", CASES)
def test_image_and_gradient_are_those_of_the_reference(name, simulated):
    case, found = CASES[name], simulated[0][name]
    g, camera, given = make_inputs(case)
    v = [x.astype(float) for x in given.pop("v")]
    given["background"] = given["background"].astype(float)
    rules = {"conventions": case.conventions, "backend": REFERENCE, "with_stats": True}
    output, tape = render(as_dtype(g, np.float64), camera, **given, **rules)
    expected = render_vjp(tape, *v)
    is_wide = case.dtype == np.float64
    image, gradient = (PARITY_FLOAT64,) * 2 if is_wide else (CUDA_FLOAT32_IMAGE, CUDA_FLOAT32_GRADIENT)
    np.testing.assert_array_equal(found["radii"], tape.splats.projection.radii)
    assert np.any(found["radii"] == 0) and np.count_nonzero(found["radii"][:, 0]) > 3
    assert relative_error(found["output"].image, output.image) <= image
    assert relative_error(found["output"].alpha, output.alpha) <= image
    for x, y in zip(found["v"].gaussians, expected.gaussians, strict=True):
        assert relative_error(x, y) <= gradient and x.dtype == case.dtype
    assert relative_error(found["v"].means2d, expected.means2d) <= gradient
    if name == "plain":  # ellipses miss some of the tiles under their boxes
        assert 0 < found["n_pairs"] < len(tape.splats.bins.gaussian_ids)
    if case.with_stats:
        assert np.array_equal(found["output"].stats.hit_count, output.stats.hit_count)
        assert np.array_equal(found["output"].stats.dominant_ids, output.stats.dominant_ids)
    else:
        assert found["output"].stats is None


def test_without_room_for_its_pairs_a_view_is_empty_and_says_so(simulated):
    enough, again = simulated[1]
    refused, accepted = again["attempts"]
    assert refused["n_pairs"] == refused["capacity"] + 1 == enough["n_pairs"] <= accepted["capacity"]
    assert not refused["output"].alpha.any() and not any(field.any() for field in refused["v"].gaussians)
    assert not refused["output"].stats.hit_count.any()
    np.testing.assert_array_equal(refused["output"].image[0, 0], make_inputs(SMALL)[2]["background"])
    for x, y in zip(accepted["v"].gaussians, enough["v"].gaussians, strict=True):
        assert x.tobytes() == y.tobytes()


def test_more_room_takes_the_bytes_of_the_pairs_and_the_host_asks_for_them_before(simulated):
    before, after = simulated[1][1]["attempts"]
    pair_bytes = 6 * 4 + 3 * 4 + (6 + 3) * 4  # of lists, of statistics, and of moments and colours, in float32
    more = after["capacity"] - before["capacity"]
    assert after["held"] - before["held"] == more * pair_bytes > 0
    assert before["asked"] == [after["capacity"] * pair_bytes - before["capacity"] * 6 * 4] and after["asked"] == []


@pytest.mark.parametrize("place", [0, 1], ids=["that ran", "a million"])
def test_later_passes_allocate_copy_and_wait_for_nothing(place, simulated):
    first, (forward, backward) = simulated[2][place]
    assert first[0].allocations > 0 < first[1].allocations  # the counter would see them
    for work in (forward, backward):
        assert (work.allocations, work.copies, work.synchronizations) == (0, 0, 0)
    assert 0 < forward.n_launches <= MOST_FORWARD and 0 < backward.n_launches <= MOST_BACKWARD


def test_the_launches_of_a_million_gaussians_in_full_hd(simulated):
    forward, backward = simulated[2][1][1]
    lists = ["prepare_rows", *["sort_digit"] * 4, "write_pairs", *["sort_digit"] * 2, "gather_pairs"]
    assert forward.kernels == ["clear_counters", *lists, "composite_tiles"]
    assert backward.kernels == ["composite_tiles_vjp", "chain_rows"]
