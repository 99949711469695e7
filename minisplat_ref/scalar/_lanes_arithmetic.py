"""How lanes are compiled: their type, arithmetic, and the functions that work lane by lane.

Each Python function of :mod:`minisplat_ref.scalar.lanes` gets a second meaning here, an instruction of LLVM for a
vector of eight. No kernel names this file.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

import numba.extending
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import models, overload, register_model

from minisplat_ref.scalar.lanes import (
    WIDTH,
    ceil,
    exp_of,
    floor,
    larger,
    log_of,
    nearest,
    scaled_by_power,
    select,
    smaller,
    sqrt,
)

intrinsic: Any = numba.extending.intrinsic  # its functions are called without their first argument
I32 = ir.IntType(32)


class LanesType(types.Type):
    """Numba's type of eight numbers or booleans."""

    def __init__(self, element: types.Type) -> None:
        self.element = element
        super().__init__(f"lanes({element})")


@register_model(LanesType)
class _Model(models.PrimitiveModel):
    """A vector of LLVM."""

    def __init__(self, manager: Any, lanes: LanesType) -> None:
        element = ir.IntType(1) if lanes.element == types.boolean else manager.lookup(lanes.element).get_value_type()
        super().__init__(manager, lanes, ir.VectorType(element, WIDTH))


# --- how operations are made ---


def joined(*kinds: types.Type) -> LanesType | None:
    """Lanes that all operands become; None where none are lanes, or one is too wide for them."""
    lanes = next((kind for kind in kinds if isinstance(kind, LanesType)), None)
    if lanes is None:
        return None
    for kind in kinds:
        is_narrow = isinstance(kind, types.Float) and kind.bitwidth <= getattr(lanes.element, "bitwidth", 0)
        if kind != lanes and not is_narrow and not isinstance(kind, types.Integer | types.IntegerLiteral):
            return None
    return lanes


def spread(context: Any, builder: Any, value: Any, kind: types.Type, lanes: LanesType) -> Any:
    """Take a single number eight times; lanes are what they are."""
    if isinstance(kind, LanesType):
        return value
    nothing = ir.Constant(context.get_value_type(lanes), ir.Undefined)
    single = builder.insert_element(nothing, context.cast(builder, value, kind, lanes.element), I32(0))
    return builder.shuffle_vector(single, nothing, ir.Constant(ir.VectorType(I32, WIDTH), [0] * WIDTH))


def _operands(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    lanes: Any = joined(*signature.args)
    return [spread(context, builder, *pair, lanes) for pair in zip(args, signature.args, strict=True)]


def _call(builder: Any, name: str, result: Any, args: Any) -> Any:
    """Call one of LLVM's vector intrinsics, whose name ends with the operand's type."""
    element = {"float": "f32", "double": "f64"}[str(args[-1].type.element)]
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{WIDTH}{element}"), args)


def _lower(emit: Callable, has_boolean_result: bool = False, of_one: Callable | None = None) -> Callable:
    """Return a function of one or two operands for compiled code.

    ``emit`` writes the instruction for lanes; ``of_one`` is the function of single numbers, where Numba knows none.
    """

    def typed(*kinds: Any) -> Any:
        lanes = joined(*kinds)
        if lanes is None:
            return None
        result = LanesType(types.boolean) if has_boolean_result else lanes

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, *_operands(context, builder, signature, args))

        return result(*kinds), generate

    @intrinsic
    def unary(typing: Any, a: Any) -> Any:
        return typed(a)

    @intrinsic
    def binary(typing: Any, a: Any, b: Any) -> Any:
        return typed(a, b)

    def compiled(*kinds: Any) -> Any:
        if joined(*kinds) is None:
            return None if any(isinstance(kind, LanesType) for kind in kinds) else of_one
        return (lambda a: unary(a)) if len(kinds) == 1 else (lambda a, b: binary(a, b))

    return compiled


def _register_unary(function: Callable, emit: Callable, of_one: Callable | None = None) -> None:
    compiled = _lower(emit, of_one=of_one)
    overload(function)(lambda a: compiled(a))


def _register_binary(
    function: Callable, emit: Callable, has_boolean_result: bool = False, of_one: Callable | None = None
) -> None:
    compiled = _lower(emit, has_boolean_result, of_one)
    overload(function)(lambda a, b: compiled(a, b))


# --- arithmetic and comparisons; a product that is added is rounded once, as everywhere in the kernels ---

_register_binary(operator.add, lambda builder, a, b: builder.fadd(a, b, flags=["contract"]))
_register_binary(operator.sub, lambda builder, a, b: builder.fsub(a, b, flags=["contract"]))
_register_binary(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=["contract"]))
_register_binary(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))
_register_unary(operator.neg, lambda builder, a: builder.fneg(a))
_register_unary(abs, lambda builder, a: _call(builder, "llvm.fabs", a.type, [a]))
_register_binary(operator.and_, lambda builder, a, b: builder.and_(a, b))
for _sign, _operator in {">": operator.gt, ">=": operator.ge, "<": operator.lt, "<=": operator.le}.items():
    _register_binary(
        _operator, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b), has_boolean_result=True
    )


# --- functions; each has its meaning in Python first ---


def larger_lanes(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


def _smaller(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", b, a), b, a)


_register_binary(larger, larger_lanes, of_one=lambda a, b: b if b > a else a)
_register_binary(smaller, _smaller, of_one=lambda a, b: b if b < a else a)
_register_unary(floor, lambda builder, a: _call(builder, "llvm.floor", a.type, [a]))
_register_unary(ceil, lambda builder, a: _call(builder, "llvm.ceil", a.type, [a]))
_register_unary(nearest, lambda builder, a: _call(builder, "llvm.rint", a.type, [a]))
_register_unary(sqrt, lambda builder, a: _call(builder, "llvm.sqrt", a.type, [a]), of_one=lambda a: math.sqrt(a))
_register_unary(exp_of, lambda builder, a: _call(builder, "llvm.exp", a.type, [a]))
_register_unary(log_of, lambda builder, a: _call(builder, "llvm.log", a.type, [a]))


@overload(scaled_by_power)
def _overload_scaled_by_power(a, n):
    return lambda a, n: _scaled_by_power(a, n)


@intrinsic
def _scaled_by_power(typing: Any, a: Any, n: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = ir.VectorType(I32, WIDTH)
        exponent = builder.shl(builder.fptosi(args[1], bits), ir.Constant(bits, [23] * WIDTH))
        return builder.bitcast(builder.add(builder.bitcast(args[0], bits), exponent), args[0].type)

    return a(a, n), generate


@overload(select)
def _overload_select(condition, a, b):
    if isinstance(condition, LanesType):
        return lambda condition, a, b: _select(condition, a, b)
    return lambda condition, a, b: a if condition else b


@intrinsic
def _select(typing: Any, condition: Any, a: Any, b: Any) -> Any:
    lanes: Any = joined(a, b)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pair = zip(args[1:], signature.args[1:], strict=True)
        return builder.select(args[0], *(spread(context, builder, *one, lanes) for one in pair))

    return lanes(condition, a, b), generate
