"""A population is checked against its recipe before the first iteration, not by the action that stumbles over it.

Training loops over fields by name and needs none but ``means``. What does need others are actions: that of 3DGS, which
splits, draws children from ``quats`` and ``log_scales``. Which fields of 3DGS an action reads is in its compiled code
and in that of the functions that it calls, so that no action has to declare it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from types import CodeType, FunctionType, ModuleType
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.training.schedule import Recipe, action_name
from minisplat_ref.types import Floats

SHAPES: Mapping[str, tuple[int, ...] | None] = {
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "opacity_logits": (),
    "sh_dc": (3,),
    "sh_rest": None,  # [N, K - 1, 3], for any K
}
"""Of a row, by the names of the fields of 3DGS."""
WALKED = ("minisplat_ref.strategy", "minisplat_ref.methods")
"""Modules whose functions are followed: what is called elsewhere works on any population."""


def check_population(recipe: Recipe, population: Any, shared: Mapping[str, Floats]) -> None:
    """Refuse a population that an action of the recipe, or its files, cannot work with.

    Raises
    ------
    InputError
        Names the action and the field that it needs, the field of a wrong shape, or the unit of no field.
    """
    name, fields = recipe.representation.name, population._fields
    if fields[0] != "means":
        raise InputError(f"population {name} begins with {fields[0]}: its first field is means")
    for field, shape in SHAPES.items():
        if shape is None or field not in fields:
            continue
        found = getattr(population, field).shape[1:]
        if found != shape:
            raise InputError(
                f"population {name} has {field} {_spell(found)}, and everywhere else that is {_spell(shape)}: give the"
                " field another name"
            )
    known = {*fields, *shared, *recipe.representation.rates.of}
    if strange := [unit for unit in recipe.representation.units if unit not in known]:
        raise InputError(
            f"population {name} has a unit of {strange[0]}, which it has not: give units of its own fields, which are"
            f" {', '.join(fields)}"
        )
    for event in recipe.events:
        if lacking := sorted(fields_read(event.action) - set(fields)):
            raise InputError(
                f"recipe {recipe.name}: its action {action_name(event)} needs {', '.join(lacking)}, which"
                f" population {name} has not: leave it out of the events, or give one of your own"
            )


def fields_read(action: Callable[..., Any]) -> frozenset[str]:
    """Return the fields of 3DGS that an action, or a function that it calls, reads or replaces by name."""
    return frozenset(_names(action, set()) & {*SHAPES} - {"means"})


def _names(value: Any, seen: set[int]) -> set[str]:
    """Return the names in the code of a function, of functions bound to it, and of those that it calls."""
    if isinstance(value, partial):
        parts: Iterable[Any] = (value.func, *value.args, *value.keywords.values())
        return {name for part in parts for name in _names(part, seen)}
    if not isinstance(value, FunctionType) or id(value) in seen:
        return set()
    seen.add(id(value))
    names: set[str] = set()
    for code in _codes(value.__code__):
        names |= {*code.co_names, *_keywords(code)}
    called = [value.__globals__[name] for name in names if name in value.__globals__]
    modules = [module for module in called if isinstance(module, ModuleType) and module.__name__.startswith(WALKED)]
    called += [getattr(module, name, None) for module in modules for name in names]
    called += [cell.cell_contents for cell in value.__closure__ or ()]
    called += [*(value.__defaults__ or ()), *(value.__kwdefaults__ or {}).values()]
    for function in called:
        if str(getattr(function, "__module__", "")).startswith(WALKED) or isinstance(function, partial):
            names |= _names(function, seen)
    return names


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _keywords(code: CodeType) -> set[str]:
    """Return the names by which arguments are passed, such as those of ``_replace``."""
    tuples = (constant for constant in code.co_consts if isinstance(constant, tuple))
    return {name for constant in tuples for name in constant if isinstance(name, str)}


def _spell(shape: tuple[int, ...]) -> str:
    return f"[{', '.join(('N', *map(str, shape)))}]"
