"""Compilation of lanes: their type, arithmetic, and the functions that work lane by lane.

Each Python function of :mod:`minisplat_ref.jit.lanes` gets a compiled implementation here, an LLVM instruction for a
vector of eight. No kernel imports this file.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import infer, infer_global, make_intrinsic_template
from numba.extending import models, overload, register_model

from minisplat_ref.jit.lanes import (
    WIDTH,
    ceil,
    floor,
    ldexp,
    libm_exp,
    libm_log,
    maximum,
    minimum,
    rint,
    select,
    sqrt,
)

I32 = ir.IntType(32)


class LanesType(types.Type):
    """Numba's type of eight numbers or booleans."""

    def __init__(self, element: types.Type) -> None:
        self.element = element
        super().__init__(f"lanes({element})")


@register_model(LanesType)
class _Model(models.PrimitiveModel):
    """An LLVM vector."""

    def __init__(self, manager: Any, lanes: LanesType) -> None:
        element = ir.IntType(1) if lanes.element == types.boolean else manager.lookup(lanes.element).get_value_type()
        super().__init__(manager, lanes, ir.VectorType(element, WIDTH))


# --- how operations are made ---


def join_types(*kinds: types.Type) -> LanesType | None:
    """Return the type of lanes that all operands become; None if none are lanes, or one is too wide for them."""
    lanes = next((kind for kind in kinds if isinstance(kind, LanesType)), None)
    if lanes is None:
        return None
    for kind in kinds:
        is_narrow = isinstance(kind, types.Float) and kind.bitwidth <= getattr(lanes.element, "bitwidth", 0)
        if kind != lanes and not is_narrow and not isinstance(kind, types.Integer | types.IntegerLiteral):
            return None
    return lanes


def broadcast_value(context: Any, builder: Any, value: Any, kind: types.Type, lanes: LanesType) -> Any:
    """Broadcast a single number; lanes stay as they are."""
    if isinstance(kind, LanesType):
        return value
    nothing = ir.Constant(context.get_value_type(lanes), ir.Undefined)
    single = builder.insert_element(nothing, context.cast(builder, value, kind, lanes.element), I32(0))
    return builder.shuffle_vector(single, nothing, ir.Constant(ir.VectorType(I32, WIDTH), [0] * WIDTH))


def _operands(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    lanes: Any = join_types(*signature.args)
    return [broadcast_value(context, builder, *pair, lanes) for pair in zip(args, signature.args, strict=True)]


def _call(builder: Any, name: str, result: Any, args: Any) -> Any:
    """Call one of LLVM's vector intrinsics, whose name ends with the operand's type."""
    element = {"float": "f32", "double": "f64"}[str(args[-1].type.element)]
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{WIDTH}{element}"), args)


def register_lowering(function: Callable) -> Callable[[Callable], None]:
    """Register a function's compiled implementation.

    Numba's ``overload`` would do, but compiles a wrapper for each of them, which takes longer than everything else.
    """

    def register(definition: Callable) -> None:
        template = make_intrinsic_template(function, definition, function.__name__)
        infer(template)
        infer_global(function, types.Function(template))

    return register


def _type_lanes(emit: Callable, has_boolean_result: bool = False) -> Callable:
    """Return the typing of a function of lanes, together with ``emit``, which writes its instruction."""

    def typed(*kinds: Any) -> Any:
        lanes = join_types(*kinds)
        if lanes is None:
            return None
        result = LanesType(types.boolean) if has_boolean_result else lanes

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, *_operands(context, builder, signature, args))

        return result(*kinds), generate

    return typed


def _register_unary(function: Callable, emit: Callable, of_one: Callable | None = None) -> None:
    """Register a function of lanes; ``of_one`` is the function of single numbers if Numba has none."""
    typed = _type_lanes(emit)
    register_lowering(function)(lambda typing, a: typed(a))
    if of_one is not None:
        overload(function)(lambda a: None if isinstance(a, LanesType) else of_one)


def _register_binary(
    function: Callable, emit: Callable, has_boolean_result: bool = False, of_one: Callable | None = None
) -> None:
    typed = _type_lanes(emit, has_boolean_result)
    register_lowering(function)(lambda typing, a, b: typed(a, b))
    if of_one is not None:
        overload(function)(lambda a, b: None if isinstance(a, LanesType) or isinstance(b, LanesType) else of_one)


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


# --- functions; for each, its version for single numbers first ---


def maximum_lanes(builder: Any, a: Any, b: Any) -> Any:
    """Emit the larger of two vectors lane by lane; ``a`` where one is NaN."""
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


def _minimum(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", b, a), b, a)


_register_binary(maximum, maximum_lanes, of_one=lambda a, b: b if b > a else a)
_register_binary(minimum, _minimum, of_one=lambda a, b: b if b < a else a)
_register_unary(floor, lambda builder, a: _call(builder, "llvm.floor", a.type, [a]))
_register_unary(ceil, lambda builder, a: _call(builder, "llvm.ceil", a.type, [a]))
_register_unary(rint, lambda builder, a: _call(builder, "llvm.rint", a.type, [a]))
_register_unary(sqrt, lambda builder, a: _call(builder, "llvm.sqrt", a.type, [a]), of_one=lambda a: math.sqrt(a))
_register_unary(libm_exp, lambda builder, a: _call(builder, "llvm.exp", a.type, [a]))
_register_unary(libm_log, lambda builder, a: _call(builder, "llvm.log", a.type, [a]), of_one=lambda a: math.log(a))


@register_lowering(ldexp)
def _ldexp(typing: Any, a: Any, n: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        is_wide = a.element == types.float64
        bits = ir.VectorType(ir.IntType(64) if is_wide else I32, WIDTH)
        n_32 = builder.fptosi(args[1], ir.VectorType(I32, WIDTH))  # not every processor has one to 64 bits
        n_bits = builder.sext(n_32, bits) if is_wide else n_32
        exponent = builder.shl(n_bits, ir.Constant(bits, [52 if is_wide else 23] * WIDTH))
        return builder.bitcast(builder.add(builder.bitcast(args[0], bits), exponent), args[0].type)

    return a(a, n), generate


@overload(select)
def _select_one(condition, a, b):
    return None if isinstance(condition, LanesType) else lambda condition, a, b: a if condition else b


@register_lowering(select)
def _select(typing: Any, condition: Any, a: Any, b: Any) -> Any:
    lanes = join_types(a, b)
    if lanes is None or not isinstance(condition, LanesType):
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pair = zip(args[1:], signature.args[1:], strict=True)
        return builder.select(args[0], *(broadcast_value(context, builder, *one, lanes) for one in pair))

    return lanes(condition, a, b), generate
