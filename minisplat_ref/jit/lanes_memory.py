"""Compilation of lanes, continued: between lanes and single numbers, arrays and bits."""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from minisplat_ref.jit.lanes import (
    WIDTH,
    accumulate,
    broadcast,
    cast,
    gather,
    iota,
    load,
    lowest_bit,
    prefetch,
    range_mask,
    reduce_any,
    reduce_max,
    reduce_sum,
    reduce_sums,
    scatter,
    store,
    transpose,
)
from minisplat_ref.jit.lanes_arithmetic import (
    I32,
    LanesType,
    broadcast_value,
    join_types,
    maximum_lanes,
    register_lowering,
)


@register_lowering(broadcast)
def _broadcast(typing: Any, number: Any) -> Any:
    lanes = LanesType(number)
    return lanes(number), lambda context, builder, signature, args: broadcast_value(
        context, builder, args[0], number, lanes
    )


@register_lowering(iota)
def _iota(typing: Any, zero: Any) -> Any:
    lanes = LanesType(zero)
    return lanes(zero), lambda context, builder, signature, args: ir.Constant(
        context.get_value_type(lanes), [float(k) for k in range(WIDTH)]
    )


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array, vector = signature.args[0], context.get_value_type(LanesType(signature.args[0].dtype))
    data = context.make_array(array)(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [args[1]], inbounds=True), vector.as_pointer())


@register_lowering(load)
def _load(typing: Any, array: Any, i: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, signature, args), align=array.dtype.bitwidth // 8)

    return LanesType(array.dtype)(array, i), generate


def _type_writing(typing: Any, array: Any, i: Any, lanes: Any, is_added: bool) -> Any:
    """Return the typing of a function that writes lanes, or a tuple of them, to an array, or adds them to it."""
    kind = LanesType(array.dtype)
    kinds = list(lanes) if isinstance(lanes, types.BaseTuple) else [lanes]
    if any(join_types(kind, one) is None for one in kinds):
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        first, align = _pointer(context, builder, signature, args), array.dtype.bitwidth // 8
        for k, of_one in enumerate(kinds):
            one = builder.extract_value(args[2], k) if isinstance(lanes, types.BaseTuple) else args[2]
            value, place = broadcast_value(context, builder, one, of_one, kind), builder.gep(first, [I32(k)])
            if is_added:
                value = builder.fadd(builder.load(place, align=align), value, flags=["contract"])
            builder.store(value, place, align=align)
        return context.get_dummy_value()

    return types.void(array, i, lanes), generate


register_lowering(store)(lambda typing, array, i, lanes: _type_writing(typing, array, i, lanes, is_added=False))
register_lowering(accumulate)(lambda typing, array, i, lanes: _type_writing(typing, array, i, lanes, is_added=True))


def _row_pointers(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    """Return pointers to a column's numbers in eight rows; a table of one dimension has one column, 0."""
    table = signature.args[0]
    array = context.make_array(table)(context, builder, args[0])
    stride, byte = builder.extract_value(array.strides, 0), ir.IntType(8).as_pointer()
    is_strided = table.layout != "C" and table.ndim == 2
    step = builder.extract_value(array.strides, 1) if is_strided else ir.IntType(64)(table.dtype.bitwidth // 8)
    start = builder.gep(builder.bitcast(array.data, byte), [builder.mul(args[2], step)])
    rows = (builder.extract_value(args[1], k) for k in range(WIDTH))
    return [
        builder.bitcast(builder.gep(start, [builder.mul(builder.sext(row, stride.type), stride)]), array.data.type)
        for row in rows
    ]


@register_lowering(gather)
def _gather(typing: Any, table: Any, rows: Any, column: Any) -> Any:
    if table.ndim > 2 and table.layout != "C":
        return None
    lanes = LanesType(table.dtype)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.Constant(context.get_value_type(lanes), ir.Undefined)
        for k, pointer in enumerate(_row_pointers(context, builder, signature, args)):
            vector = builder.insert_element(vector, builder.load(pointer), I32(k))
        return vector

    return lanes(table, rows, types.int64), generate


@register_lowering(scatter)
def _scatter(typing: Any, table: Any, rows: Any, column: Any, lanes: Any) -> Any:
    if table.layout != "C" and (table.ndim > 2 or not isinstance(lanes, LanesType)):
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = context.get_value_type(LanesType(table.dtype))
        pointers = _row_pointers(context, builder, signature, args)
        if isinstance(lanes, LanesType):
            vector = _convert(builder, args[3], kind)
            for k, pointer in enumerate(pointers):
                builder.store(builder.extract_element(vector, I32(k)), pointer)
            return context.get_dummy_value()
        columns = [_convert(builder, builder.extract_value(args[3], k), kind) for k in range(WIDTH)]
        for row, pointer in zip(_transpose_rows(builder, columns), pointers, strict=True):
            builder.store(row, builder.bitcast(pointer, kind.as_pointer()), align=table.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(table, rows, types.int64, lanes), generate


def _convert(builder: Any, vector: Any, kind: Any) -> Any:
    if vector.type == kind:
        return vector
    if isinstance(kind.element, ir.IntType):
        return builder.fptosi(vector, kind)
    if isinstance(vector.type.element, ir.IntType):
        return builder.sitofp(vector, kind)
    return (builder.fptrunc if isinstance(kind.element, ir.FloatType) else builder.fpext)(vector, kind)


@register_lowering(cast)
def _cast(typing: Any, lanes: Any, zero: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _convert(builder, args[0], context.get_value_type(LanesType(zero)))

    return LanesType(zero)(lanes, zero), generate


def _transpose_rows(builder: Any, rows: list[Any]) -> list[Any]:
    """Return the columns of an 8 x 8 matrix, given its rows."""
    vectors = list(rows)
    for size in (4, 2, 1):  # swap blocks of this size across the diagonal
        for k in (k for k in range(WIDTH) if not k & size):
            pair = vectors[k], vectors[k + size]
            for place, shift in ((k, 0), (k + size, size)):
                mask = [i + shift if not i & size else WIDTH + (i ^ size) + shift for i in range(WIDTH)]
                mask = ir.Constant(ir.VectorType(I32, WIDTH), mask)
                vectors[place] = builder.shuffle_vector(*pair, mask)
    return vectors


@register_lowering(transpose)
def _transpose(typing: Any, rows: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_tuple(builder, rows, _transpose_rows(builder, cgutils.unpack_tuple(builder, args[0])))

    return rows(rows), generate


def _register_reduction(function: Callable, emit: Callable) -> None:
    """Register a reduction that folds lanes in halves with an instruction for two operands."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        (vector,) = args
        width = WIDTH
        while width > 1:
            width //= 2
            halves = (ir.Constant(ir.VectorType(I32, width), list(range(start, start + width))) for start in (0, width))
            vector = emit(builder, *(builder.shuffle_vector(vector, vector, half) for half in halves))
        return builder.extract_element(vector, I32(0))

    register_lowering(function)(lambda typing, lanes: (lanes.element(lanes), generate))


@register_lowering(reduce_sums)
def _reduce_sums(typing: Any, rows: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors, width = cgutils.unpack_tuple(builder, args[0]), WIDTH
        while width > 1:  # two vectors become one: the sums of the halves of what each holds, one after the other
            width //= 2
            firsts = [k for k in range(2 * WIDTH) if k // width % 2 == 0]
            masks = [ir.Constant(ir.VectorType(I32, WIDTH), [k + shift for k in firsts]) for shift in (0, width)]
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [builder.fadd(*(builder.shuffle_vector(*pair, mask) for mask in masks)) for pair in pairs]
        return vectors[0]

    return rows.dtype(rows), generate


_register_reduction(reduce_sum, lambda builder, a, b: builder.fadd(a, b))
_register_reduction(reduce_max, maximum_lanes)


@register_lowering(reduce_any)
def _reduce_any(typing: Any, condition: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.IntType(WIDTH)(0))

    return types.boolean(condition), generate


@register_lowering(prefetch)
def _prefetch(typing: Any, table: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(table)(context, builder, args[0])
        address = builder.add(
            builder.ptrtoint(array.data, ir.IntType(64)),
            builder.mul(context.cast(builder, args[1], row, types.int64), builder.extract_value(array.strides, 0)),
        )
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        for line in (0, 60):
            pointer = builder.inttoptr(builder.add(address, ir.IntType(64)(line)), byte)
            builder.call(function, [pointer, I32(0), I32(3), I32(1)])
        return context.get_dummy_value()

    return types.void(table, row), generate


@register_lowering(lowest_bit)
def _lowest_bit(typing: Any, bits: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(bits), generate


@register_lowering(range_mask)
def _range_mask(typing: Any, bounds: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        half = WIDTH // 2
        numbers = builder.fptosi(args[0], ir.VectorType(I32, WIDTH))
        masks = (ir.Constant(ir.VectorType(I32, half), list(range(start, start + half))) for start in (0, half))
        firsts, ends = (builder.shuffle_vector(numbers, numbers, mask) for mask in masks)
        ends = builder.select(builder.icmp_signed(">", ends, firsts), ends, firsts)
        one = ir.Constant(firsts.type, [1] * half)
        bits = builder.sub(builder.shl(one, ends), builder.shl(one, firsts))
        return builder.bitcast(builder.trunc(bits, ir.VectorType(ir.IntType(16), half)), ir.IntType(64))

    return types.uint64(bounds), generate
