"""Kernels on disk: nothing stale is loaded, what is compiled ahead is what is used, only our own folders go."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile
from numba.core.registry import cpu_target

import minisplat_ref
from minisplat_ref import extensions
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import first_use
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions import warm_up as extensions_warm_up
from minisplat_ref.extensions.warm_up import warm_up
from minisplat_ref.jit import compile as _jit
from minisplat_ref.jit.kernel_cache import kernel_folders
from minisplat_ref.rendering import render
from minisplat_ref.rendering import warm_up as stages_module
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.rendering.warm_up import FIRST_ITERATION, STAGES
from scenes import as_dtype, make_camera, make_gaussians

PACKAGE = Path(minisplat_ref.__file__).parent
ROOT = PACKAGE.parent


def files(folder, suffix):
    return sorted(path.name for path in folder.rglob(f"*{suffix}"))


@pytest.fixture
def root(tmp_path, monkeypatch):
    """An empty place for kernels, with a folder of an old version and things that are not ours."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    for name, file in (
        ("0123456789abcdef", "cpu_1/adam.step-1.py311.1.nbc"),
        ("fedcba9876543210", "diary.txt"),  # named like ours, but holds something else
        ("other_package_0123456789abcdef", "f-1.py311.1.nbc"),
        (_jit.source_hash(), "cpu_1/adam.step-1.py311.1.nbc"),
    ):
        path = tmp_path / "kernels" / name / file
        path.parent.mkdir(parents=True)
        path.write_bytes(bytes(1000))
    return tmp_path / "kernels"


# --- nothing stale ---


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        (_jit.np, "__version__", "9.9"),
        (_jit.numba, "__version__", "9.9"),
        (_jit.llvmlite, "__version__", "9.9"),
        (_jit.platform, "python_version", lambda: "9.9"),
        (_jit.numba.config, "OPT", 1),
        (_jit.numba.config, "BOUNDSCHECK", 1),
    ],
)
def test_folder_follows_what_compiles(owner, name, value, monkeypatch):
    before = _jit.source_hash.__wrapped__()
    monkeypatch.setattr(owner, name, value)
    assert _jit.source_hash.__wrapped__() != before


def test_every_kernel_is_in_the_hash():
    users = {path.parent.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if "@kernel" in path.read_text()}
    users |= {path.parent.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if "@scalar" in path.read_text()}
    folders = {path.parts[0] for path in users} - {"extensions", "mechanisms"}  # hashed separately, as below
    assert folders == {"jit", "scalar", "cpu", "bench"}, "see _jit.source_hash"


def test_kernels_of_an_extension_are_hashed_with_its_sources():
    """Every kernel of every extension of the package is kept in a folder inside the core's, named by the extension."""
    n_kernels = 0
    for name, folder in extensions.folders().items():
        for file in folder.rglob("*.py"):
            if "@kernel" not in file.read_text():
                continue
            module = import_module(
                ".".join((extensions.module_of(name), *file.relative_to(folder).with_suffix("").parts))
            )
            wrapped = (f.__wrapped__ for f in vars(module).values() if hasattr(f, "__wrapped__"))
            for function in (f for f in wrapped if f.__module__ == module.__name__):
                kept = Path(_jit.cache_folder(function))
                assert kept.name.startswith(f"{name.replace('-', '_')}-") and kept.parent.name == _jit.source_hash()
                n_kernels += 1
    assert n_kernels > 0


@pytest.mark.parametrize("module", ["minisplat_ref.mechanisms", "minisplat_ref.extensions.rays"])
def test_kernels_are_hashed_with_the_mechanisms_that_they_may_call(tmp_path, monkeypatch, module):
    import_module(module)
    for file in ("rays/kernels.py", "rays/formulas.py"):
        (tmp_path / "mechanisms" / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "mechanisms" / file).write_text("")
    monkeypatch.setattr(_jit, "_PACKAGE", tmp_path)
    before = _jit._folder_of_module(module)
    assert _jit._folder_of_module(module) == before
    (tmp_path / "mechanisms/rays/formulas.py").write_text("ONE = 1\n")
    assert _jit._folder_of_module(module) != before


def times(factor, note):
    @_jit.scalar
    def product(x):
        return factor * x

    product.note = note  # part of its pickle, and not of what is computed

    @_jit.kernel(parallel=False)
    def multiply(x):
        for i in range(len(x)):
            x[i] = product(x[i])

    return multiply


def test_a_kernel_is_found_by_what_it_closes_over_and_not_by_its_pickle(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for factor, note, n_kernels in ((3.0, "one process", 1), (3.0, "another", 1), (4.0, "another", 2)):
        x = np.ones(2)
        times(factor, note)(x)
        assert x.tolist() == [factor, factor] and len(files(tmp_path, ".nbc")) == n_kernels


def test_kernels_of_mechanisms_are_kept_together():
    function = import_module("minisplat_ref.mechanisms.rays.bvh").widest_axis
    assert _jit._modules_of(function) == {"minisplat_ref.mechanisms"}


def test_numba_notices_another_processor_and_another_numba(tmp_path, monkeypatch):
    """What the hash leaves to Numba's own index."""
    codegen = cpu_target.target_context.codegen()
    before = codegen.magic_tuple()
    monkeypatch.setattr(_jit.numba.config, "CPU_NAME", "another")
    assert codegen.magic_tuple() != before
    index = IndexDataCacheFile(str(tmp_path), "f", "stamp of its source file")
    index.save("key", "code")
    assert index.load("key") == "code"
    index._version = "another"
    assert index.load("key") is None


def test_a_training_starts_without_plots_and_readers_of_other_scenes():
    code = """
import sys
import minisplat_ref.app.runs.settings, minisplat_ref.app.runs.run
print("LOADED", {"matplotlib", "pycolmap", "torch", "IPython"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "LOADED set()" in done.stdout


# --- what is compiled ahead is what is used ---

UNDER_WATCH = """
import gc, sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.extensions.geometry import EXTENSION as GEOMETRY
from minisplat_ref.io import load_scene
from minisplat_ref.metrics import evaluate
from minisplat_ref.methods import get_recipe
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.strategy.importance import collect_importance
from minisplat_ref.training.loop import train
from minisplat_ref.extensions.warm_up import draw_extension
from minisplat_ref.rendering.warm_up import FIRST_ITERATION, STAGES


def signatures():
    functions = [f for f in gc.get_objects() if isinstance(f, Dispatcher)]
    kernels = [f for f in functions if f.py_func.__module__.startswith("minisplat_ref") and f._cache.cache_path]
    return {(kernel.py_func.__qualname__, str(types)) for kernel in kernels for types in kernel.signatures}


scene = load_scene(sys.argv[1])
recipe = get_recipe("3dgs-accel")._replace(iterations=2, events=())
for name in FIRST_ITERATION:
    STAGES[name](np.float32)
first = signatures()
state = train(scene, recipe, seed=0)
assert len(first) > 10 and signatures() == first, signatures() - first
for compile_stage in STAGES.values():
    compile_stage(np.float32)
draw_extension(GEOMETRY, np.float32)
every = signatures()
assert len(every) > len(first) + 5
camera = scene.train_views[0].camera
collect_importance(state.gaussians, scene.train_views[:1])
output, tape = render(state.gaussians, camera, with_stats=True)
g = tape.splats.primitives
CPU.surface_points(g.means, g.quats, g.scales, camera, output.stats.dominant_ids)
evaluate(state.gaussians, scene.train_views[:1], RenderSettings(scene.background))
smooth = recipe._replace(losses=(*recipe.losses, *(term._replace(weight=1.0) for term in GEOMETRY.losses[1:])))
train(scene, smooth, seed=0)
assert signatures() == every, signatures() - every
"""


def test_training_uses_what_was_compiled_ahead(tmp_path):
    settings = {"n_views": 2, "width": 32, "height": 24, "n_points": 60}
    write_scene(make_scene("room", supersampling=1, **settings), tmp_path, settings)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", UNDER_WATCH, str(tmp_path)], env=environment, check=True)


def test_reference_gives_the_types_that_kernels_give(rng):
    gaussians, camera = as_dtype(make_gaussians(rng, 9), np.float32), make_camera()
    both = (render(gaussians, camera, backend=b)[1].splats.projection for b in (CPU, stages_module.TYPED_REFERENCE))
    assert [(a.dtype, a.flags.c_contiguous) for a in next(both)] == [
        (b.dtype, b.flags.c_contiguous) for b in next(both)
    ]
    assert render(gaussians, camera, backend=REFERENCE)[1].projection.conics.dtype == np.float32


# --- processes and commands ---


def only_adam(monkeypatch):
    for module in (stages_module, extensions_warm_up):
        monkeypatch.setattr(module, "STAGES", {"Adam": STAGES["Adam"]})


def test_stages_are_compiled_by_other_processes(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    [compiled] = warm_up(["Adam"], n_processes=1)
    assert compiled.name == "Adam" and compiled.seconds > 0
    kernels = files(tmp_path, ".nbc")
    assert len(kernels) == 2 and all(kernel.startswith("adam.") for kernel in kernels)  # of all rows, and of some


def test_warm_says_what_it_did(root, monkeypatch, capsys):
    only_adam(monkeypatch)
    monkeypatch.setattr(extensions, "folders", dict)
    assert main(["cache", "warm"]) == 0
    captured = capsys.readouterr()
    assert "1 of 1" in captured.err and "Adam (float32)" in captured.err
    assert str(root / _jit.source_hash()) in captured.out and "ready after" in captured.out
    assert "1 folders of other versions hold 0.0 MB" in captured.out and "clear --stale" in captured.out
    assert len(files(root / _jit.source_hash(), ".nbc")) == 3  # two, and the made one


def test_warm_goes_on_after_a_broken_extension(root, tmp_path, monkeypatch, capsys):
    """One that does not import, and one that does not draw: a line each, and the kernels are there."""
    texts = {"broken": "raise RuntimeError('nothing')", "blank": BLANK}
    for name, text in texts.items():
        package = tmp_path / "mine" / name
        package.mkdir(parents=True)
        (package / "__init__.py").write_text(text)
    monkeypatch.setenv("MINISPLAT_EXTENSIONS", str(tmp_path / "mine"))  # for the other processes
    monkeypatch.setattr(extensions, "folders", lambda: dict.fromkeys(texts))
    only_adam(monkeypatch)
    assert main(["cache", "warm"]) == 0
    captured = capsys.readouterr()
    warnings = sorted(line for line in captured.err.splitlines() if "warning" in line)
    assert len(warnings) == 2 and all(line.startswith("minisplat-ref: warning: extension ") for line in warnings)
    assert "extension blank does not draw: KeyError: 'no colours'" in warnings[0]
    assert "extension broken in" in warnings[1] and "RuntimeError: nothing" in warnings[1]
    assert "3 of 3" in captured.err and "ready after" in captured.out
    assert len(files(root / _jit.source_hash(), ".nbc")) == 3  # as without them


BLANK = """
from minisplat_ref.extensions.extension import Extension
from minisplat_ref.training.representation import GAUSSIANS

def render(model, view, request):
    raise KeyError("no colours")

RENDERER = GAUSSIANS.renderer._replace(render=render)
EXTENSION = Extension("blank", representation=GAUSSIANS._replace(renderer=RENDERER))
"""


def test_warm_goes_on_where_two_extensions_have_one_name(root, tmp_path, monkeypatch, capsys):
    (tmp_path / "mine" / "velocity").mkdir(parents=True)
    (tmp_path / "mine" / "velocity" / "__init__.py").touch()
    monkeypatch.setattr(extensions, "__path__", [*extensions.__path__, str(tmp_path / "mine")])
    only_adam(monkeypatch)
    assert main(["cache", "warm"]) == 0
    captured = capsys.readouterr()
    assert "minisplat-ref: warning: extension velocity is in" in captured.err and "1 of 1" in captured.err


def test_info_lists_only_our_folders(root, capsys):
    assert main(["cache", "info"]) == 0
    out = capsys.readouterr().out
    assert f"place    {root}" in out and f"version  {_jit.source_hash()}" in out
    assert "in use " in out and "0123456789abcdef: 1 kernels, 0.0 MB" in out
    assert "fedcba" not in out and "other_package" not in out


@pytest.mark.parametrize(("options", "keeps_current"), [(["--stale"], True), ([], False)])
def test_clear_removes_only_our_folders(options, keeps_current, root, capsys):
    assert main(["cache", "clear", *options]) == 0
    assert "0123456789abcdef" in capsys.readouterr().out
    left = {path.name for path in root.iterdir()}
    assert left - {_jit.source_hash()} == {"fedcba9876543210", "other_package_0123456789abcdef"}
    assert (_jit.source_hash() in left) == keeps_current
    assert (root / "fedcba9876543210" / "diary.txt").exists()


def test_a_cleared_folder_is_made_again(tmp_path):
    with _jit._one_process_at_a_time(str(tmp_path / "gone" / "version")):
        assert (tmp_path / "gone" / "version" / "lock").exists()


@pytest.mark.parametrize(
    ("kernels", "backend", "expected"), [(0, "cpu", True), (1, "cpu", False), (0, "reference", False)]
)
def test_only_a_first_training_compiles_ahead(kernels, backend, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = tmp_path / _jit.source_hash()
    folder.mkdir()
    for i in range(kernels):
        (folder / f"f.{i}.nbc").touch()
    asked = []
    monkeypatch.setattr(first_use, "warm_up", lambda stages: asked.append(stages) or (stage for stage in stages))
    first_use.compile_kernels(backend)
    assert asked == ([FIRST_ITERATION] if expected else [])
    assert ("compiling" in capsys.readouterr().err) == expected


def test_no_folder_is_no_error(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "absent"))
    assert kernel_folders() == [] and main(["cache", "clear"]) == 0
