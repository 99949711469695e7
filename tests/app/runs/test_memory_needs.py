"""What training and images take of memory, what there is, and how what does not fit is refused."""

import math
import resource
import subprocess
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from minisplat_ref import memory
from minisplat_ref.errors import InputError
from minisplat_ref.methods import gaussian_splatting
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import At
from tiny_training import PLAIN, scene  # noqa: F401  (a fixture)

GIGA = 10**9


# what is free


def files(folder, **contents):
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        (folder / name.replace("__", ".")).write_text(content)


def test_the_limit_of_a_container_counts_and_so_do_those_around_it(tmp_path):
    """Version 2: what is used without what can be given up, of the group itself or of one that it stands in."""
    root, own = tmp_path / "cgroup", tmp_path / "own"
    own.write_text("0::/batch/job\n")
    free = partial(memory._of_the_control_group, str(root), str(own))
    assert free() == math.inf
    files(root / "batch", memory__max="9000\n", memory__current="5000\n", memory__stat="anon 7\ninactive_file 1000\n")
    assert free() == 5000
    files(root / "batch" / "job", memory__max="max\n", memory__current="400\n", memory__stat="")
    assert free() == 5000
    files(root / "batch" / "job", memory__max="4500\n", memory__current="400\n", memory__stat="")
    assert free() == 4100


def test_the_limit_of_a_container_of_version_1(tmp_path):
    root, own = tmp_path / "cgroup", tmp_path / "own"
    own.write_text("9:name=systemd:/\n4:cpu,memory:/job\n0::/\n")
    limits = {"memory__limit_in_bytes": "9000\n", "memory__usage_in_bytes": "2000\n"}
    files(root / "memory" / "job", **limits, memory__stat="inactive_file 1\ntotal_inactive_file 10\n")
    assert memory._of_the_control_group(str(root), str(own)) == 7010


def test_a_limit_to_the_address_space_counts():
    code = "from minisplat_ref import memory; print(memory.free_bytes())"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 * GIGA, 4 * GIGA)),
    )
    assert 0 < float(done.stdout) < 4 * GIGA


def test_elsewhere_than_on_linux_free_is_what_the_system_says(monkeypatch, tmp_path):
    monkeypatch.setattr(memory.psutil, "LINUX", False)
    monkeypatch.delattr(memory.psutil.Process, "rlimit")
    monkeypatch.setattr(memory, "Path", lambda *_: tmp_path / "no such file")  # neither /proc nor /sys
    monkeypatch.setattr(memory.psutil, "virtual_memory", lambda: SimpleNamespace(available=100.0))
    assert memory.free_bytes() == 95.0


# what fits


@pytest.mark.parametrize(("free", "rows"), [(0, 0), (70_800, 100), (349_400, 200)])
def test_rows_that_fit(free, rows):
    """A hundred Gaussians of 59 float32, 5000 pairs: 4 x 23,600 + 100 x 150 + 240,000 = 349,400 bytes.

    Little memory is limited by the new parameters and moments beside the old, 708 bytes a row; much by what there is
    afterwards, where as much again is room for a hundred more.
    """
    assert memory.rows_that_fit(100, 23_600, 5000, free) == pytest.approx(rows)
    assert memory.rows_that_fit(0, 0, 0, free) == math.inf


def test_a_image_that_does_not_fit_names_the_size_that_does(monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda: 6.5e9)
    memory.check_render_size(10_000, 10_000, with_depth=False)
    with pytest.raises(InputError, match=r"20000x10000 takes about 13.0 GB, 6.5 GB are free: 14142x7071 fits"):
        memory.check_render_size(20_000, 10_000, with_depth=False)
    with pytest.raises(InputError, match="9705x9705 fits"):
        memory.check_render_size(10_000, 10_000, with_depth=True)


def test_photographs_keep_half_of_the_free_memory(monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda: 3e9)
    assert memory.shelf_bytes(1.5e9) is None
    assert memory.shelf_bytes(1.6e9) == 1.5e9
    monkeypatch.setattr(memory, "free_bytes", lambda: math.inf)
    assert memory.shelf_bytes(1e30) is None


def test_a_photograph_that_cannot_be_read_is_refused(monkeypatch):
    """Its pixels in the file take 10 bytes while they are decoded, twice 3 as they are trained on."""
    monkeypatch.setattr(memory, "free_bytes", lambda: 1.6e9)
    memory.check_photograph("lake", 10**8, 1)
    memory.check_photograph("lake", int(1.16e8), 2)
    with pytest.raises(InputError, match=r"lake: to read a photograph of 101.0 megapixels takes 1.6 GB of memory, 1.6"):
        memory.check_photograph("lake", int(1.01e8), 1)


def test_the_peak_is_that_of_an_iteration_or_of_a_measurement():
    """A hundred Gaussians of 59 float32, 5000 pairs: 349,400 bytes, without gradient and pairs 70,800."""
    needs = memory.Needs(100, 23_600, 5000, 1000, 70.0)
    assert needs.at_the_peak == 349_400 + 28 * 1000 + 70
    assert needs._replace(n_pixels=100_000).at_the_peak == 70_800 + 52 * 100_000 + 70
    assert needs._replace(kept_bytes=11.0).to_come == 349_400 + 28 * 1000 + 70 + 11 - 70_800


def test_twice_as_many_fit_where_they_are_said_to():
    for n_pairs in (0, 5000):
        free = memory.bytes_to_double(100, 23_600, n_pairs)
        assert memory.rows_that_fit(100, 23_600, n_pairs, free) == pytest.approx(200)


# in training


def double(recipe, step):
    """Let every Gaussian be cloned at an iteration."""
    events = gaussian_splatting.GS.events
    collect = events[0]
    clone = partial(gaussian_splatting.clone_and_split, threshold=0.0, size_fraction=100.0)
    return recipe._replace(iterations=20, events=(collect, At(step, clone)))


def test_training_is_stopped_before_there_are_more_gaussians_than_fit(scene, monkeypatch):
    recipe = double(PLAIN, 10)
    state = initial_state(scene, recipe, 0)
    n, row_bytes = len(state.gaussians.means), sum(field[:1].nbytes for field in state.gaussians)
    monkeypatch.setattr(memory, "free_bytes", lambda: (2 * n - 1) * 3 * row_bytes)
    with pytest.raises(
        InputError, match=rf"no memory for {2 * n} Gaussians, only for some \d+: train on smaller photo"
    ):
        train(scene, recipe, seed=0, state=state)
    assert len(state.gaussians.means) == n and np.isfinite(state.gaussians.means).all()


def test_training_goes_on_where_they_fit(scene, monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda: 1e9)
    state = train(scene, double(PLAIN, 10), seed=0)
    assert len(state.gaussians.means) == 2 * 30


def test_fewer_gaussians_are_never_refused(scene, monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda: 0.0)
    prune = partial(gaussian_splatting.prune_faint, min_opacity=0.09)
    recipe = PLAIN._replace(iterations=5, events=(At(3, prune),))
    assert train(scene, recipe, seed=0).step == 5
