"""How kernels are run must not show in what they return: dtype, threads, compiled or not, fresh or from the cache."""

import errno
import gc
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba.core import event
from numpy.testing import assert_allclose

import minisplat_ref
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.geometry import kernels as geometry_kernels
from minisplat_ref.extensions.geometry.weights import GeometricWeights
from minisplat_ref.jit import compile as _jit
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import AdamStep, ProjectionGradient, TileGrid
from scenes import activated, as_dtype, make_camera, make_gaussians
from tolerances import COVERAGE_MIN, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE

PACKAGE = Path(minisplat_ref.__file__).parent
HELPERS = Path(__file__).parents[1] / "helpers"


# --- compiling ---


def test_no_garbage_is_collected_while_compiling():
    """Nor while what a function calls is compiled; afterwards, and after an error, the collector runs as before."""
    seen = []

    class Watch(event.Listener):
        def on_start(self, event):
            seen.append(gc.isenabled())

        def on_end(self, event):
            pass

    inner = numba.njit(lambda x: x + 1)
    outer = numba.njit(lambda x: inner(x) + 1)
    with event.install_listener("numba:compile", Watch()):
        assert outer(1) == 3 and seen == [False, False] and gc.isenabled()
        with pytest.raises(numba.TypingError):
            outer("one")
        assert len(seen) > 2 and not any(seen) and gc.isenabled()
        gc.disable()
        try:
            assert outer(1.0) == 3.0 and not gc.isenabled()  # stopped before, stopped after
        finally:
            gc.enable()


# --- dtype ---


def stages_of_training(dtype, size=(24, 18), n=20, **wanted):
    """What the stages that every training uses return for a scene, by the stage's name, and what the others need."""
    rng, (width, height) = np.random.default_rng(20240229), size
    gaussians = as_dtype(make_gaussians(rng, n, size=0.25), dtype)
    camera = make_camera(width, height, fx=1.25 * width, fy=1.2 * width, rng=rng)
    means, quats, scales, opacities = activated(gaussians)
    primitives = (means, quats, scales, opacities, camera, GSPLAT_MAIN)
    projection = CPU.project(*primitives)
    sh = (means, gaussians.sh_dc, gaussians.sh_rest, camera, 3, projection.radii)
    colors, background = CPU.sh_colors(*sh), np.zeros(3, dtype)
    bins = CPU.bin_gaussians(projection, TileGrid(width, height, CPU.tile_width, CPU.tile_height), GSPLAT_MAIN)
    composited = (projection, colors, background, bins, GSPLAT_MAIN)
    output = CPU.composite(*composited, **wanted)
    v = CPU.composite_vjp(*composited, output, output.image, output.alpha)
    v_projection = ProjectionGradient(v.means2d, v.opacities, v.conics, v.opacities)
    values = means.copy(), np.ones_like(means), np.zeros_like(means), np.ones_like(means)
    CPU.adam_update(*values, None, AdamStep(0.1, 0.9, 0.999, 1e-15))
    CPU.adam_update(*values, np.arange(0, n, 2), AdamStep(0.1, 0.9, 0.999, 1e-15))
    results = {
        "project": projection,
        "project_vjp": CPU.project_vjp(*primitives, projection, v_projection),
        "sh_colors": (colors,),
        "sh_colors_vjp": CPU.sh_colors_vjp(*sh, v.colors),
        "bin_gaussians": bins[:4],
        "composite": (output.image, output.alpha),
        "composite_vjp": v,
        "adam_update": values,
    }
    return results, (primitives, composited, output)


def every_stage(dtype, *scene):
    """Everything that the stages return for a scene, and what they write beside it, by the stage's name."""
    results, for_others = stages_of_training(dtype, *scene, with_stats=True, with_median_depth=True)
    (means, quats, scales, _, camera, _), composited, output = for_others
    ids = output.stats.dominant_ids
    points = CPU.surface_points(means, quats, scales, camera, ids)
    loss, tape = CPU.photometric_loss(output.image, output.image[::-1].copy(), 0.2)
    geometry = (output.image[..., 0] + 1, output.alpha, output.image, camera, means.astype(float))
    _, geometric_tape = geometry_kernels.geometric_loss(*geometry, GeometricWeights(1.0, 1.0, 1.0))
    return results | {
        "statistics": (output.median_depth, *output.stats),
        "composite without statistics": CPU.composite(*composited)[:2],
        "surface_points": points,
        "surface_points_vjp": CPU.surface_points_vjp(means, quats, scales, camera, ids, points.points, points.depths),
        "photometric_loss": (np.array(loss),),
        "photometric_loss_vjp": (CPU.photometric_loss_vjp(tape),),
        "geometric_loss_vjp": geometry_kernels.geometric_loss_vjp(geometric_tape),
    }


def test_stages_keep_float32_but_for_conics():
    results = every_stage(np.float32)
    wide = {stage: results[stage].conics for stage in ("project", "composite_vjp")} | {
        "photometric_loss": results["photometric_loss"][0]
    }
    assert all(array.dtype == np.float64 for array in wide.values())  # and nothing else
    for stage, arrays in results.items():
        floats = [array for array in arrays if array.dtype.kind == "f" and array is not wide.get(stage)]
        assert {array.dtype for array in floats} <= {np.dtype(np.float32)}, stage
        assert any(array.any() for array in arrays), stage


# --- the same result however it is run ---


def drawn(gaussians, camera, backend):
    """Image, alpha and every gradient of one view."""
    output, tape = render(gaussians, camera, backend=backend, with_depth=True)
    gradient = render_vjp(tape, output.image, output.alpha)
    return output.image, output.alpha, *gradient.gaussians, *gradient[1:5]


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_same_bytes_at_any_number_of_threads(dtype, rng):
    gaussians, camera = as_dtype(make_gaussians(rng, 150), dtype), make_camera(64, 48, fx=80, fy=75)
    n_threads = numba.get_num_threads()
    results = []
    try:
        for n in (1, 2, 2):
            numba.set_num_threads(n)
            results.append(drawn(gaussians, camera, CPU))
    finally:
        numba.set_num_threads(n_threads)
    assert results[0][1].mean() > COVERAGE_MIN
    for one, *others in zip(*results, strict=True):
        assert one.any() and all(one.tobytes() == other.tobytes() for other in others)


IN_PYTHON = """
import sys
import numba
import numpy as np
from test_kernels import drawn, small_view
from minisplat_ref.rendering.backends import CPU
assert numba.config.DISABLE_JIT and not hasattr(numba.njit(lambda: 0), "signatures"), "kernels are compiled after all"
np.savez(sys.argv[1], *drawn(*small_view(), CPU))
"""


def small_view():
    return make_gaussians(np.random.default_rng(5), 4), make_camera(8, 8, fx=10.0, fy=10.0)


def test_kernels_run_as_python(tmp_path):
    path = tmp_path / "drawn.npz"
    folders = os.pathsep.join(map(str, (Path(__file__).parent, HELPERS, PACKAGE.parent)))
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": folders}
    subprocess.run([sys.executable, "-W", "error", "-c", IN_PYTHON, str(path)], env=environment, check=True)
    # In Python a float32 literal times a float of `math` is float32: half of the digits of the compiled kernels.
    expected = drawn(*small_view(), REFERENCE)
    assert expected[1].mean() > COVERAGE_MIN
    with np.load(path) as actual:
        for i, (array, key) in enumerate(zip(expected, actual.files, strict=True)):
            assert array.any()
            tolerance = PARITY_FLOAT32_IMAGE if i < 2 else PARITY_FLOAT32_GRADIENT
            assert_allclose(actual[key], array, rtol=0, atol=tolerance * np.abs(array).max())


# --- kernel cache ---


def test_the_cache_has_one_writer_at_a_time(tmp_path):
    order = []

    def write():
        with _jit._one_process_at_a_time(str(tmp_path)):
            order.append("second")

    with _jit._one_process_at_a_time(str(tmp_path)):
        second = threading.Thread(target=write)
        second.start()
        second.join(0.2)
        order.append("first")
    second.join()
    assert order == ["first", "second"]


def test_kernels_are_saved_under_the_lock(tmp_path, monkeypatch):
    locked = []
    monkeypatch.setattr(_jit, "cache_folder", lambda function: str(tmp_path))
    monkeypatch.setattr(_jit, "_one_process_at_a_time", lambda *of: nullcontext(locked.append(of[:2])))

    @_jit.kernel(parallel=False)
    def doubled(values):
        for i in range(values.size):
            values[i] *= 2

    for dtype in (np.float32, np.float64, np.float32):
        values = np.ones(3, dtype)
        doubled(values)
        assert (values == 2).all()
    assert [folder for folder, *_ in locked] == [str(tmp_path)] * 4 and len(list(tmp_path.rglob("*.nbc"))) == 2
    assert [len(names) for _, *names in locked] == [1, 0] * 2  # one to compile it, and another to save it


def test_a_kernel_that_another_process_compiles_is_awaited_and_loaded(tmp_path, monkeypatch):
    folders, compiled = [str(tmp_path / name) for name in ("theirs", "ours")], []

    def make(folder):
        monkeypatch.setattr(_jit, "cache_folder", lambda function: folder)

        @_jit.kernel(parallel=False)
        def doubled(values):
            for i in range(values.size):
                values[i] *= 2

        return doubled

    class Watch(event.Listener):
        def on_start(self, event):
            compiled.append(event.data["dispatcher"])

        def on_end(self, event):
            pass

    def wait(folder, name="", patience=0.0):
        if folder == folders[1] and name:
            shutil.copytree(*folders, dirs_exist_ok=True)
        return nullcontext()

    monkeypatch.setattr(_jit, "_one_process_at_a_time", wait)
    theirs, ours = map(make, folders)
    values = np.ones(3)
    with event.install_listener("numba:compile", Watch()):
        theirs(values)
        assert len(compiled) == 1
        ours(values)
        assert len(compiled) == 1 and (values == 4).all()


@pytest.mark.parametrize("refused", ["lock", "kernel"])
def test_a_kernel_that_cannot_be_saved_is_used_all_the_same(refused, tmp_path, monkeypatch):
    """A disk that is full, before a lock of no bytes or before the kernel."""
    monkeypatch.setattr(_jit, "cache_folder", lambda function: str(tmp_path))

    def no_space(*of, **named):
        raise OSError(errno.ENOSPC, "No space left on device")

    if refused == "lock":
        monkeypatch.setattr(_jit, "_one_process_at_a_time", no_space)
    else:
        monkeypatch.setattr("numba.core.caching.IndexDataCacheFile._save_data", no_space)

    @_jit.kernel(parallel=False)
    def doubled(values):
        for i in range(values.size):
            values[i] *= 2

    values = np.ones(3)
    doubled(values)
    assert (values == 2).all() and not list(tmp_path.rglob("*.nbc"))


def test_a_suspended_process_holds_nobody_up_for_ever(tmp_path):
    with _jit._one_process_at_a_time(str(tmp_path), "f.lock"):
        with _jit._one_process_at_a_time(str(tmp_path), "f.lock", patience=0.05), open(tmp_path / "f.lock") as file:
            assert not _jit._lock(file)
    with open(tmp_path / "f.lock") as file:
        assert _jit._lock(file)


def test_a_kernel_that_does_not_compile_is_released(tmp_path, monkeypatch):
    monkeypatch.setattr(_jit, "cache_folder", lambda function: str(tmp_path))

    @_jit.kernel(parallel=False)
    def wrong(values):
        values.nothing()

    with pytest.raises(numba.TypingError):
        wrong(np.ones(3))
    (path,) = tmp_path.glob("*.lock")
    with open(path) as file:
        assert _jit._lock(file)


def test_a_function_is_named_after_what_it_closes_over():
    def make(number, other):
        @_jit.scalar
        def inner(x):
            return x + number

        @_jit.scalar
        def outer(x):
            return inner(x) * other

        return outer.__qualname__

    names = [make(1, 2), make(2, 2), make(1, 3)]
    assert len(set(names)) == 3  # by its own number, and by that of the function inside
    assert make(1, 2) == names[0]


def hit(x):
    return x


class Functions(NamedTuple):
    first: Callable
    second: Callable


def test_functions_of_one_name_are_told_apart():
    def make(*functions):
        bundle = Functions(*functions)

        @_jit.scalar
        def outer(x):
            return bundle.first(bundle.second(x))

        return outer.__qualname__

    other = ModuleType("other_module")
    exec("def hit(x):\n    return 2 * x", other.__dict__)
    assert make(hit, other.hit) not in (make(hit, hit), make(other.hit, hit))
    assert make(hit, hit) == make(hit, hit) and "0x" not in _jit._name_of(Functions(hit, other.hit))


def test_a_closure_without_a_lasting_name_is_refused():
    something = object()

    def outer():
        return something

    with pytest.raises(TypeError, match="closes over a object, whose name would be an address"):
        _jit.scalar(outer)


MODULES_OF_ONE_NAME = {
    "first.py": "def hit(x):\n    return x + 1\n",
    "second.py": "def hit(x):\n    return 10 * x\n",
    "factory.py": """
import numba
from minisplat_ref.jit.compile import kernel, scalar

def make(function):
    hit = scalar(function)

    @kernel(parallel=False)
    def apply(values):
        for i in range(values.size):
            values[i] = hit(values[i])

    return apply
""",
    "main.py": """
import sys
import numpy as np
import first, second
from factory import make
for name in sys.argv[1:]:
    values = np.full(3, 5.0)
    make({"first": first, "second": second}[name].hit)(values)
    print(values[0])
""",
}


def test_kernels_of_functions_of_one_name_are_not_mixed_up(tmp_path):
    for name, text in MODULES_OF_ONE_NAME.items():
        (tmp_path / name).write_text(text)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PYTHONPATH": str(PACKAGE.parent)}

    def run(*names):
        command = [sys.executable, "main.py", *names]
        done = subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True)
        return [float(line) for line in done.stdout.split()]

    assert run("first") == [6.0] and run("second") == [50.0]  # two processes, each compiles one
    assert run("first", "second") == [6.0, 50.0]  # a third loads both
    before = {path for path in (tmp_path / "kernels").rglob("*.nbc")}
    assert len(before) == 2
    (tmp_path / "second.py").write_text("def hit(x):\n    return 20 * x\n")
    assert run("first", "second") == [6.0, 100.0]  # and an edit of one compiles that one again
    assert len(set((tmp_path / "kernels").rglob("*.nbc")) - before) == 1


FROM_CACHE = """
import sys
import numpy as np
from test_kernels import every_stage, stages_of_training
from minisplat_ref.io import load_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.loop import train
arrays, given = {}, (np.dtype(sys.argv[3]), (101, 67), 150)
for stage, results in (every_stage(*given) if sys.argv[4] == "every" else stages_of_training(*given)[0]).items():
    arrays |= {f"{stage} {i}": array for i, array in enumerate(results)}
state = train(load_scene(sys.argv[2]), get_recipe("3dgs-accel")._replace(iterations=50), seed=0)
arrays |= {f"trained {name}": array for name, array in state.gaussians._asdict().items()}
np.savez(sys.argv[1], **arrays)
"""


@pytest.mark.parametrize(
    ("dtype", "which", "n_arrays", "n_kernels"),
    [
        ("float32", "of training", 38, 11),
        pytest.param("float32", "every", 55, 20, marks=pytest.mark.slow),  # compiling is the time
        pytest.param("float64", "every", 55, 20, marks=pytest.mark.slow),
    ],
)
def test_compiled_and_cached_kernels_give_the_same_bytes(dtype, which, n_arrays, n_kernels, tmp_path):
    """The stages, and a training; and the second process must not compile anything again.

    The body of a parallel loop is compiled two or three times, each time within other code, and a process that loads it
    may run another copy than the one that compiled it. The copies round alike if the same products are contracted in
    each, which nothing but this test makes sure of. Seen on Intel Xeon processors with AVX-512 (family 6, model 207,
    stepping 2): no difference, nor in the 10,492 arrays of all hard cases, of 1 to 13 channels and of 200 iterations.
    """
    scene, kernels = tmp_path / "room", tmp_path / "kernels"
    settings = {"n_views": 3, "width": 50, "height": 39, "n_points": 200}
    write_scene(make_scene("room", supersampling=1, **settings), scene, settings)
    folders = os.pathsep.join(map(str, (Path(__file__).parent, HELPERS, PACKAGE.parent)))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(kernels), "PYTHONPATH": folders}
    results, cached = [], []
    for name in ("compiled.npz", "cached.npz"):
        command = [sys.executable, "-c", FROM_CACHE, str(tmp_path / name), str(scene), dtype, which]
        subprocess.run(command, env=environment, check=True)
        with np.load(tmp_path / name) as arrays:
            results.append({key: arrays[key].tobytes() for key in arrays.files})
        cached.append(sorted(path.name for path in kernels.rglob("*.nbc")))
    assert len(results[0]) > n_arrays
    assert [key for key in results[0] if results[0][key] != results[1][key]] == []
    assert len(cached[0]) > n_kernels and cached[0] == cached[1]


@pytest.mark.parametrize(
    "source",
    [
        "scalar/covariance.py",
        "cpu/compositing/forward.py",
        "cpu/deeper/new.py",
        "bench/exponentials.py",
        "types.py",
    ],
)
def test_cache_folder_follows_the_sources(source, tmp_path, monkeypatch):
    # Numba notices no change in a function that a kernel calls from another file: hence a folder per source hash.
    copy = tmp_path / "minisplat_ref"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    before = _jit.source_hash.__wrapped__()
    monkeypatch.setattr(_jit, "_PACKAGE", copy)
    monkeypatch.setattr(_jit, "source_hash", _jit.source_hash.__wrapped__)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    folder = _jit.cache_folder()
    assert Path(folder) == tmp_path / "cache" / before and Path(folder).is_dir()
    (copy / source).parent.mkdir(exist_ok=True)
    with (copy / source).open("a") as file:
        file.write("\n")
    assert _jit.cache_folder() != folder


def test_cache_folder_ignores_what_no_kernel_is_made_of(tmp_path, monkeypatch):
    copy = tmp_path / "minisplat_ref"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(_jit, "_PACKAGE", copy)
    before = _jit.source_hash.__wrapped__()
    (copy / "rendering.py").write_text("")
    assert _jit.source_hash.__wrapped__() == before
