"""Eight numbers as one value: eight pixels of a row, or eight Gaussians.

A formula written for one number holds for eight: ``+ - * /``, comparisons and the functions below take lanes as they
take single numbers. Compiled, eight float32 lanes are one AVX register, so that a loop over rows of pixels is vector
code because it says so, and not because the compiler could prove that it may be: nothing is tested before the loop,
nothing is left over after it, and every sum has the order that is written. In plain Python lanes are an array of eight.

A single number that meets lanes is taken eight times. It may be narrower than they are but not wider: a float64 that
meets float32 lanes by mistake does not compile. Where the lanes differ in what they should do, ``select`` chooses.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import infer, infer_global, make_intrinsic_template
from numba.extending import models, overload, register_model

__all__ = [
    "WIDTH", "any_of", "ceil", "columns_of", "converted", "counted", "exp_of", "filled", "floor", "gather", "larger",
    "largest_of", "load", "log_of", "nearest", "scaled_by_power", "scatter", "select", "smaller", "sqrt", "store",
    "sum_of", "sums_of",
]  # fmt: skip

WIDTH = 8
_I32 = ir.IntType(32)


class _Lanes(types.Type):
    """Numba's type of eight numbers or booleans."""

    def __init__(self, element: types.Type) -> None:
        self.element = element
        super().__init__(f"lanes({element})")


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    """A vector of LLVM."""

    def __init__(self, manager: Any, lanes: _Lanes) -> None:
        element = ir.IntType(1) if lanes.element == types.boolean else manager.lookup(lanes.element).get_value_type()
        super().__init__(manager, lanes, ir.VectorType(element, WIDTH))


# --- how operations are made ---


def _joined(*kinds: types.Type) -> _Lanes | None:
    """Lanes that all operands become; None where none are lanes, or one is too wide for them."""
    lanes = next((kind for kind in kinds if isinstance(kind, _Lanes)), None)
    if lanes is None:
        return None
    for kind in kinds:
        is_narrow = isinstance(kind, types.Float) and kind.bitwidth <= getattr(lanes.element, "bitwidth", 0)
        if kind != lanes and not is_narrow and not isinstance(kind, types.Integer | types.IntegerLiteral):
            return None
    return lanes


def _spread(context: Any, builder: Any, value: Any, kind: types.Type, lanes: _Lanes) -> Any:
    """Take a single number eight times; lanes are what they are."""
    if isinstance(kind, _Lanes):
        return value
    nothing = ir.Constant(context.get_value_type(lanes), ir.Undefined)
    single = builder.insert_element(nothing, context.cast(builder, value, kind, lanes.element), _I32(0))
    return builder.shuffle_vector(single, nothing, ir.Constant(ir.VectorType(_I32, WIDTH), [0] * WIDTH))


def _operands(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    lanes = _joined(*signature.args)
    return [_spread(context, builder, *pair, lanes) for pair in zip(args, signature.args, strict=True)]


def _call(builder: Any, name: str, result: Any, args: Any) -> Any:
    """Call one of LLVM's vector intrinsics, whose name ends with the operand's type."""
    element = {"float": "f32", "double": "f64"}[str(args[-1].type.element)]
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{WIDTH}{element}"), args)


def _compiled(function: Callable) -> Callable[[Callable], None]:
    """Register what a function is in compiled code.

    Numba's ``overload`` would do, but compiles a function around each of them, which takes longer than all the rest.
    """

    def register(definition: Callable) -> None:
        template = make_intrinsic_template(function, definition, function.__name__)
        infer(template)
        infer_global(function, types.Function(template))

    return register


def _typed(emit: Callable, has_boolean_result: bool = False) -> Callable:
    """Return the typing of a function of lanes, and with it ``emit``, which writes its instruction."""

    def typed(*kinds: Any) -> Any:
        lanes = _joined(*kinds)
        if lanes is None:
            return None
        result = _Lanes(types.boolean) if has_boolean_result else lanes

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, *_operands(context, builder, signature, args))

        return result(*kinds), generate

    return typed


def _register_unary(function: Callable, emit: Callable, of_one: Callable | None = None) -> None:
    """Register a function of lanes; ``of_one`` is the function of single numbers, where Numba knows none."""
    typed = _typed(emit)
    _compiled(function)(lambda typing, a: typed(a))
    if of_one is not None:
        overload(function)(lambda a: None if isinstance(a, _Lanes) else of_one)


def _register_binary(
    function: Callable, emit: Callable, has_boolean_result: bool = False, of_one: Callable | None = None
) -> None:
    typed = _typed(emit, has_boolean_result)
    _compiled(function)(lambda typing, a, b: typed(a, b))
    if of_one is not None:
        overload(function)(lambda a, b: None if isinstance(a, _Lanes) or isinstance(b, _Lanes) else of_one)


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


def larger(a, b):
    """Return the larger of two, lane by lane; ``a`` where one is NaN."""
    return np.where(b > a, b, a)[()]


def smaller(a, b):
    """Return the smaller of two, lane by lane; ``a`` where one is NaN."""
    return np.where(b < a, b, a)[()]


def floor(a):
    """Return the next integer below."""
    return np.floor(a)


def ceil(a):
    """Return the next integer above."""
    return np.ceil(a)


def nearest(a):
    """Return the nearest integer, as a float."""
    return np.rint(a)


def sqrt(a):
    """Return the square root."""
    return np.sqrt(a)


def exp_of(a):
    """Return libm's exp of every lane."""
    return np.exp(a)


def log_of(a):
    """Return libm's natural logarithm of every lane."""
    return np.log(a)


def _larger(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


def _smaller(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", b, a), b, a)


_register_binary(larger, _larger, of_one=lambda a, b: b if b > a else a)
_register_binary(smaller, _smaller, of_one=lambda a, b: b if b < a else a)
_register_unary(floor, lambda builder, a: _call(builder, "llvm.floor", a.type, [a]))
_register_unary(ceil, lambda builder, a: _call(builder, "llvm.ceil", a.type, [a]))
_register_unary(nearest, lambda builder, a: _call(builder, "llvm.rint", a.type, [a]))
_register_unary(sqrt, lambda builder, a: _call(builder, "llvm.sqrt", a.type, [a]), of_one=lambda a: math.sqrt(a))
_register_unary(exp_of, lambda builder, a: _call(builder, "llvm.exp", a.type, [a]))
_register_unary(log_of, lambda builder, a: _call(builder, "llvm.log", a.type, [a]))


def scaled_by_power(a, n):
    """Return ``a 2^n`` of float32 lanes, for integers n that keep it a normal number: n is added to the exponent."""
    return np.ldexp(a, np.asarray(n, np.int32))


@_compiled(scaled_by_power)
def _scaled_by_power(typing: Any, a: Any, n: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = ir.VectorType(_I32, WIDTH)
        exponent = builder.shl(builder.fptosi(args[1], bits), ir.Constant(bits, [23] * WIDTH))
        return builder.bitcast(builder.add(builder.bitcast(args[0], bits), exponent), args[0].type)

    return a(a, n), generate


def select(condition, a, b):
    """Return ``a`` in the lanes where the condition holds and ``b`` in the others."""
    return np.where(condition, a, b)[()]


@overload(select)
def _select_one(condition, a, b):
    return None if isinstance(condition, _Lanes) else lambda condition, a, b: a if condition else b


@_compiled(select)
def _select(typing: Any, condition: Any, a: Any, b: Any) -> Any:
    lanes = _joined(a, b)
    if lanes is None or not isinstance(condition, _Lanes):
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pair = zip(args[1:], signature.args[1:], strict=True)
        return builder.select(args[0], *(_spread(context, builder, *one, lanes) for one in pair))

    return lanes(condition, a, b), generate


# --- from and to single numbers ---


def filled(number):
    """Return lanes that all hold a number."""
    return np.full(WIDTH, number)


def counted(zero):
    """Return lanes 0, 1, ... 7 of the dtype of a number."""
    return np.arange(WIDTH).astype(zero.dtype)


def load(array, i):
    """Return the eight numbers of a 1-d array from ``i`` on."""
    return array[i : i + WIDTH].copy()


def store(array, i, lanes):
    """Write lanes, or a tuple of lanes one after the other, to a 1-d array from ``i`` on."""
    numbers = np.ravel(lanes)
    array[i : i + max(numbers.size, WIDTH)] = numbers


def gather(table, rows, column):
    """Return one number from each of eight rows of a C-contiguous table [N, ...], whose rows count as flat."""
    return table.reshape(len(table), -1)[list(rows), column]


def scatter(table, rows, column, lanes):
    """Write one number to each of eight rows of a table, rounded to its dtype: the inverse of ``gather``."""
    table.reshape(len(table), -1)[list(rows), column] = lanes


def columns_of(a, b, c, d, e, f, g, h):
    """Return the columns of the square whose rows are eight lanes: the first number of each, the second, and so on."""
    return tuple(np.array([a, b, c, d, e, f, g, h]).T)


def converted(lanes, zero):
    """Return lanes in the dtype of a number."""
    return lanes.astype(zero.dtype)


def sum_of(lanes):
    """Return the sum of the lanes: of halves, then of quarters, then of the last two."""
    while len(lanes) > 1:
        lanes = lanes[: len(lanes) // 2] + lanes[len(lanes) // 2 :]
    return lanes[0]


def sums_of(a, b, c, d, e, f, g, h):
    """Return the sums of eight lanes as lanes: what eight times ``sum_of`` gives, for half of the instructions."""
    return np.array([sum_of(lanes) for lanes in (a, b, c, d, e, f, g, h)])


def largest_of(lanes):
    """Return the largest lane."""
    while len(lanes) > 1:
        lanes = larger(lanes[: len(lanes) // 2], lanes[len(lanes) // 2 :])
    return lanes[0]


def any_of(condition):
    """Whether a condition holds in any lane."""
    return bool(np.any(condition))


@_compiled(filled)
def _filled(typing: Any, number: Any) -> Any:
    lanes = _Lanes(number)
    return lanes(number), lambda context, builder, signature, args: _spread(context, builder, args[0], number, lanes)


@_compiled(counted)
def _counted(typing: Any, zero: Any) -> Any:
    lanes = _Lanes(zero)
    return lanes(zero), lambda context, builder, signature, args: ir.Constant(
        context.get_value_type(lanes), [float(k) for k in range(WIDTH)]
    )


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array, vector = signature.args[0], context.get_value_type(_Lanes(signature.args[0].dtype))
    data = context.make_array(array)(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]], inbounds=True), vector.as_pointer())


@_compiled(load)
def _load(typing: Any, array: Any, i: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, signature, args), align=array.dtype.bitwidth // 8)

    return _Lanes(array.dtype)(array, i), generate


@_compiled(store)
def _store(typing: Any, array: Any, i: Any, lanes: Any) -> Any:
    kind = _Lanes(array.dtype)
    kinds = list(lanes) if isinstance(lanes, types.BaseTuple) else [lanes]

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        first = _pointer(context, builder, signature, args)
        for k, of_one in enumerate(kinds):
            one = builder.extract_value(args[2], k) if isinstance(lanes, types.BaseTuple) else args[2]
            value = _spread(context, builder, one, of_one, kind)
            builder.store(value, builder.gep(first, [_I32(k)]), align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, i, lanes), generate


def _row_pointers(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    """Where the numbers of a column stand; a table of one dimension has one column, 0."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    stride, byte = builder.extract_value(array.strides, 0), ir.IntType(8).as_pointer()
    start = builder.bitcast(builder.gep(array.data, [args[2]], inbounds=True), byte)
    rows = (builder.extract_value(args[1], k) for k in range(WIDTH))
    return [builder.bitcast(builder.gep(start, [builder.mul(row, stride)]), array.data.type) for row in rows]


@_compiled(gather)
def _gather(typing: Any, table: Any, rows: Any, column: Any) -> Any:
    lanes = _Lanes(table.dtype)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.Constant(context.get_value_type(lanes), ir.Undefined)
        for k, pointer in enumerate(_row_pointers(context, builder, signature, args)):
            vector = builder.insert_element(vector, builder.load(pointer), _I32(k))
        return vector

    return lanes(table, rows, types.int64), generate


@_compiled(scatter)
def _scatter(typing: Any, table: Any, rows: Any, column: Any, lanes: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = _convert(builder, args[3], context.get_value_type(_Lanes(table.dtype)))
        for k, pointer in enumerate(_row_pointers(context, builder, signature, args)):
            builder.store(builder.extract_element(vector, _I32(k)), pointer)
        return context.get_dummy_value()

    return types.void(table, rows, types.int64, lanes), generate


def _convert(builder: Any, vector: Any, kind: Any) -> Any:
    if vector.type == kind:
        return vector
    if isinstance(kind.element, ir.IntType):
        return builder.fptosi(vector, kind)
    return (builder.fptrunc if isinstance(kind.element, ir.FloatType) else builder.fpext)(vector, kind)


@_compiled(converted)
def _converted(typing: Any, lanes: Any, zero: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _convert(builder, args[0], context.get_value_type(_Lanes(zero)))

    return _Lanes(zero)(lanes, zero), generate


@_compiled(columns_of)
def _columns_of(typing: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    result = types.UniTuple(a, WIDTH)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors = list(args)
        for size in (4, 2, 1):  # blocks of this size change places across the diagonal
            for k in (k for k in range(WIDTH) if not k & size):
                pair = vectors[k], vectors[k + size]
                for place, shift in ((k, 0), (k + size, size)):
                    mask = [i + shift if not i & size else WIDTH + (i ^ size) + shift for i in range(WIDTH)]
                    mask = ir.Constant(ir.VectorType(_I32, WIDTH), mask)
                    vectors[place] = builder.shuffle_vector(*pair, mask)
        return context.make_tuple(builder, result, vectors)

    return result(a, b, c, d, e, f, g, h), generate


def _register_reduction(function: Callable, emit: Callable) -> None:
    """Fold lanes in halves with an instruction for two operands."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        (vector,) = args
        width = WIDTH
        while width > 1:
            width //= 2
            halves = (
                ir.Constant(ir.VectorType(_I32, width), list(range(start, start + width))) for start in (0, width)
            )
            vector = emit(builder, *(builder.shuffle_vector(vector, vector, half) for half in halves))
        return builder.extract_element(vector, _I32(0))

    _compiled(function)(lambda typing, lanes: (lanes.element(lanes), generate))


@_compiled(sums_of)
def _sums_of(typing: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors, width = list(args), WIDTH
        while width > 1:  # two vectors become one: the sums of the halves of what each holds, one after the other
            width //= 2
            firsts = [k for k in range(2 * WIDTH) if k // width % 2 == 0]
            masks = [ir.Constant(ir.VectorType(_I32, WIDTH), [k + shift for k in firsts]) for shift in (0, width)]
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [builder.fadd(*(builder.shuffle_vector(*pair, mask) for mask in masks)) for pair in pairs]
        return vectors[0]

    return a(a, b, c, d, e, f, g, h), generate


_register_reduction(sum_of, lambda builder, a, b: builder.fadd(a, b))
_register_reduction(largest_of, _larger)


@_compiled(any_of)
def _any_of(typing: Any, condition: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.IntType(WIDTH)(0))

    return types.boolean(condition), generate


def prefetch(table, row):
    """Ask for a row of a table [N, D] before it is needed: memory answers while something else is computed."""


@_compiled(prefetch)
def _prefetch(typing: Any, table: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(table)(context, builder, args[0])
        address = builder.add(
            builder.ptrtoint(array.data, ir.IntType(64)),
            builder.mul(context.cast(builder, args[1], row, types.int64), builder.extract_value(array.strides, 0)),
        )
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, _I32, _I32, _I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        for line in (0, 60):
            pointer = builder.inttoptr(builder.add(address, ir.IntType(64)(line)), byte)
            builder.call(function, [pointer, _I32(0), _I32(3), _I32(1)])
        return context.get_dummy_value()

    return types.void(table, row), generate


def lowest_bit(bits):
    """Return the place of the lowest bit that is set in an integer that is not zero."""
    return (int(bits) & -int(bits)).bit_length() - 1


@_compiled(lowest_bit)
def _lowest_bit(typing: Any, bits: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(bits), generate
