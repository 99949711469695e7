"""What the modules promise about each other."""

import inspect
from dataclasses import fields
from importlib import import_module
from pkgutil import iter_modules

import pytest

from minisplat_ref import reference
from minisplat_ref.backends import BACKENDS, REFERENCE, Backend

MODULES = [module.name for module in iter_modules(reference.__path__)]
STAGES = [field.name for field in fields(Backend) if field.name not in ("name", "tile_width", "tile_height")]


def public_functions(name):
    """Functions that a module of the reference defines, in the order of the file."""
    module = import_module(f"minisplat_ref.reference.{name}")
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
