"""Trainings whose arrays stay on the device, in Numba's simulator, against the same by the reference."""

import numpy as np
import pytest

from cuda_simulator import run_in_simulator
from cuda_training import N_GAUSSIANS, TRAININGS, train_by
from minisplat_ref.rendering.backends import REFERENCE
from tolerances import CUDA_TRAINING

pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")

COPIES = [(1,), (1, 2)]  # of an iteration: the number of pairs, and the sums of a loss over tiles


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return run_in_simulator("cuda_training.py", tmp_path_factory.mktemp("cuda") / "results.pickle")


@pytest.mark.parametrize("name", TRAININGS)
def test_parameters_and_moments_are_those_of_the_reference(simulated, name):
    expected, found = train_by(TRAININGS[name], REFERENCE), simulated[name]
    assert found.keys() == expected.keys()
    for key, x in expected.items():
        assert found[key].shape == x.shape and found[key].dtype == x.dtype, key
        difference = np.abs(found[key].astype(float) - x)
        error = np.max(difference, initial=0) / max(np.max(np.abs(x), initial=0), 1e-30)
        assert error <= CUDA_TRAINING, f"{key}: {error}"
    n = len(expected["p.means"])
    assert (n > N_GAUSSIANS) == (name == "events")  # rows were added in the middle


def test_no_parameter_is_copied_where_nobody_looks(simulated):
    first, second, third = simulated["copies"]
    parameters = {(N_GAUSSIANS, 3), (N_GAUSSIANS, 4), (N_GAUSSIANS, 3, 3)}
    moved = [shape for shape in first["to"] if shape in parameters]
    assert len(moved) == 3 * 5  # once, each of them with two moments; opacities have the shape of counts
    assert not parameters & {*first["from"], *second["to"], *second["from"]}
    assert first["to"].count((7, 9, 3)) == second["to"].count((7, 9, 3)) == 1  # a photograph, each seen the first time
    assert (7, 9, 3) not in {*first["from"], *second["from"]}
    assert third == {"to": [], "from": COPIES, "new": []}


def test_who_looks_sees_what_is_true_and_may_change_it(simulated):
    seen, means = simulated["looked"]
    assert not np.array_equal(seen[0][1:], seen[1][1:])  # an iteration moved the others
    assert abs(seen[1][0] - 7).max() < 0.01  # on from where it had been put
    assert np.all(means[0] == 7)


def test_what_has_no_kernels_says_so_once(simulated):
    assert simulated["notes"] == [
        "backend cuda: the renderer foreign has no kernels for the GPU; arrays stay on the host, and stages that have"
        " kernels copy them"
    ]
