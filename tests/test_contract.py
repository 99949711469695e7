"""What the modules promise about each other."""

import ast
import inspect
import re
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pytest

import minisplat_ref
from minisplat_ref import cpu, reference, scalar
from minisplat_ref.rendering.backends import BACKENDS, REFERENCE, Backend

MODULES = [module.name for module in iter_modules(reference.__path__)]
STAGES = [
    field.name
    for field in fields(Backend)
    if field.name not in ("name", "is_compiled", "tile_width", "tile_height", "residence", "is_deterministic")
]

# Modules of cpu without a twin of their name: what several stages use. A stage of several files is a folder, and its
# functions stand in the folder's own module.
KERNEL_PARTS = {"gaussian_rows", "memory"}

# Public functions of cpu without a twin: they prepare arguments for kernels.
CPU_ONLY = {
    "projection.pack_pose": "the point that the camera maps to 0, in float64; the reference adds t instead",
    "projection.pack_constants": "conventions as float64 scalars",
    "depth.pack_intrinsics": "the camera's four numbers as an array",
    "compositing.composite_with": "the exponential is an argument, which compositing.exact fills in, too",
    "compositing.composite_vjp_with": "as composite_with",
}

# Backward formulas whose forward has another name, since one scalar function returns several things.
FORWARD_OF = {
    "compositing.sigma_vjp": "blend",
    "projection.compensation_vjp": "project_gaussian",
    "loss.photometric_vjp": "ssim_and_derivatives",
}

PACKAGE = Path(minisplat_ref.__file__).parent
ARGUMENTS_MAX = 8  # positional; what belongs together is a NamedTuple

# Functions with more positional arguments than that.
MANY_ARGUMENTS = {
    "rasterization": "gsplat's own call, argument by argument",
    "rasterization_vjp": "the arguments of rasterization and the cotangents",
    "rasterization_2dgs": "gsplat's own call, argument by argument",
    "rasterization_2dgs_vjp": "the arguments of rasterization_2dgs",
}


def public_functions(name, package="reference"):
    """Functions that a module defines, in the order of the file."""
    module = import_module(f"minisplat_ref.{package}.{name}")
    functions = [
        f for f in vars(module).values() if inspect.isfunction(f) and inspect.unwrap(f).__module__ == module.__name__
    ]
    return {f.__name__: f for f in functions if not f.__name__.startswith("_")}


def parameters(function):
    return [(p.name, p.kind, p.default) for p in inspect.signature(function).parameters.values()]


@pytest.mark.parametrize("backend", BACKENDS.values(), ids=BACKENDS.keys())
@pytest.mark.parametrize("stage", STAGES)
def test_stages_have_the_same_signature_everywhere(backend, stage):
    assert parameters(getattr(backend, stage)) == parameters(getattr(REFERENCE, stage))


@pytest.mark.parametrize("stage", STAGES)
def test_protocols_are_the_signatures_of_the_reference(stage):
    (protocol,) = (field.type for field in fields(Backend) if field.name == stage)
    assert parameters(protocol.__call__)[1:] == parameters(getattr(REFERENCE, stage))


def positional_arguments(source):
    """Names of all functions, methods and lambdas of a source, each with the number of its positional arguments."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
            yield getattr(node, "name", "lambda"), len([name for name in names if name not in ("self", "cls")])


def test_no_function_has_many_positional_arguments():
    counts = [pair for path in PACKAGE.rglob("*.py") for pair in positional_arguments(path.read_text())]
    assert len(counts) > 1000  # all folders were read, extensions too
    assert {name for name, n in counts if n > ARGUMENTS_MAX} == MANY_ARGUMENTS.keys()


def test_reading_order_names_every_module():
    _, _, table, *_ = reference.__doc__.split("===\n")
    assert sorted(line.split()[0] for line in table.splitlines() if not line.startswith("=")) == sorted(MODULES)


@pytest.mark.parametrize("module", MODULES)
def test_gradients_follow_their_functions(module):
    names = list(public_functions(module))
    for position, name in enumerate(names):
        if name.endswith("_vjp"):
            assert names[position - 1] == name.removesuffix("_vjp")


@pytest.mark.parametrize("module", MODULES)
def test_gradients_write_their_chain_rule(module):
    for name, function in public_functions(module).items():
        assert function.__doc__
        if name.endswith("_vjp"):
            assert "v_" in function.__doc__.split("Parameters")[0] and "=" in function.__doc__


def test_the_book_has_its_stages():
    assert sum(name.endswith("_vjp") for module in MODULES for name in public_functions(module)) >= 10


@pytest.mark.parametrize("module", MODULES)
def test_every_argument_is_documented(module):
    for name, function in public_functions(module).items():
        for argument in inspect.signature(function).parameters:
            assert re.search(rf"\b{argument}\b", function.__doc__), f"{name} does not mention {argument}"


def twins():
    """Public functions of cpu and what they must look like: (label, function, twin or None)."""
    names = [info.name for info in iter_modules(cpu.__path__) if info.name not in KERNEL_PARTS]
    for name in (*names, "compositing.exact", "compositing.plain_conic"):
        twin = public_functions(name.partition(".")[0])
        for key, function in public_functions(name, "cpu").items():
            if f"{name}.{key}" not in CPU_ONLY:
                yield f"{name}.{key}", function, twin.get(key)


@pytest.mark.parametrize(("function", "twin"), [row[1:] for row in twins()], ids=[row[0] for row in twins()])
def test_cpu_has_the_signature_of_the_reference(function, twin):
    assert twin is not None, "no function of this name in the reference"

    def arguments(f):
        # A tape belongs to its package; all other types are shared.
        rows = inspect.signature(f).parameters.values()
        return [(p.name, p.kind, p.default, p.annotation if p.name != "tape" else None) for p in rows]

    assert arguments(function) == arguments(twin)


def test_every_stage_is_compared():
    assert {row[0] for row in twins()} >= {
        *("projection.project", "projection.project_vjp", "tiling.bin_gaussians"),
        *("spherical_harmonics.sh_colors", "spherical_harmonics.sh_colors_vjp"),
        *("compositing.composite", "compositing.composite_vjp"),
        *("compositing.exact.composite", "compositing.exact.composite_vjp"),
        *("compositing.plain_conic.composite", "compositing.plain_conic.composite_vjp"),
        *("depth.surface_points", "depth.surface_points_vjp"),
        *("loss.photometric_loss", "loss.photometric_loss_vjp"),
    }


def test_exceptions_exist():
    for key in (*CPU_ONLY, *FORWARD_OF):
        module, _, name = key.partition(".")
        package = "cpu" if key in CPU_ONLY else "scalar"
        assert name in public_functions(module, package), f"{key} is gone: strike it out"


def test_every_scalar_gradient_has_its_forward():
    n_pairs = 0
    for info in iter_modules(scalar.__path__):
        names = public_functions(info.name, "scalar")
        for name in names:
            if name.endswith("_vjp"):
                n_pairs += 1
                assert FORWARD_OF.get(f"{info.name}.{name}", name.removesuffix("_vjp")) in names, name
    assert n_pairs >= 5
