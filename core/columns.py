"""Instructions that numba's compiler does not find by itself: four neighbours at once, and fused multiply-adds."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

FLAGS = ("contract", "nsz")


def make_array(kind: Any) -> Any:
    """numba's, imported where something is compiled: a run whose kernels are kept needs none of its compiler."""
    from numba.np import arrayobj

    return arrayobj.make_array(kind)


@intrinsic
def four_columns(typing_context: Any, f: Any, p: Any, stride: Any, v0: Any, v1: Any, v2: Any, v3: Any, out: Any, at: Any) -> Any:
    """out[at + k] = sum_j v_j f[p + j stride + k], k = 0 .. 3, for C arrays ``f`` and ``out`` (n,) of the type of ``v_j``.

    ``p``, ``stride``, ``at`` are uint64; nothing is checked.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        f, p, stride, *v, out, at = arguments
        scalar = context.get_data_type(signature.args[0].dtype)
        four, size = ir.VectorType(scalar, 4), context.get_abi_sizeof(scalar)

        def place(array: Any, kind: Any, index: Any) -> Any:
            first = make_array(kind)(context, builder, array).data
            return builder.bitcast(builder.gep(first, [index]), four.as_pointer())

        nothing, integer = ir.Constant(four, ir.Undefined), ir.IntType(32)
        zeros = ir.Constant(ir.VectorType(integer, 4), [0] * 4)

        def spread(value: Any) -> Any:
            return builder.shuffle_vector(builder.insert_element(nothing, value, ir.Constant(integer, 0)), nothing, zeros)

        total = None
        for weight in v:
            row = builder.load(place(f, signature.args[0], p), align=size)
            term = builder.fmul(spread(weight), row, flags=FLAGS)
            total = term if total is None else builder.fadd(total, term, flags=FLAGS)
            p = builder.add(p, stride)
        builder.store(total, place(out, signature.args[7], at), align=size)
        return context.get_dummy_value()

    return types.void(f, types.uint64, types.uint64, v0, v1, v2, v3, out, types.uint64), generate


@intrinsic
def fused(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, rounded once, for three floats of one type: the same bits in a vector loop as at its end."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, b, c), generate


@intrinsic
def four_columns_at(typing_context: Any, address: Any, stride: Any, v0: Any, v1: Any, v2: Any, v3: Any, out: Any, at: Any) -> Any:
    """out[at + k] = sum_j v_j f[j stride + k], k = 0 .. 3, for the float32 numbers ``f`` at a memory ``address``.

    ``out`` is a C array of the type of ``v_j``, float32 or float64; ``address``, ``stride``, ``at`` are uint64; nothing is
    checked. The sums are not contracted, so that they are the same wherever they are made.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place, stride, *v, out, at = arguments
        scalar = context.get_data_type(signature.args[2])
        single, four, size = ir.VectorType(ir.FloatType(), 4), ir.VectorType(scalar, 4), context.get_abi_sizeof(scalar)
        nothing, integer = ir.Constant(four, ir.Undefined), ir.IntType(32)
        zeros = ir.Constant(ir.VectorType(integer, 4), [0] * 4)

        def spread(value: Any) -> Any:
            return builder.shuffle_vector(builder.insert_element(nothing, value, ir.Constant(integer, 0)), nothing, zeros)

        four_bytes = builder.mul(stride, ir.Constant(stride.type, 4))
        total = None
        for weight in v:
            row = builder.load(builder.inttoptr(place, single.as_pointer()), align=4)
            term = builder.fmul(spread(weight), row if four == single else builder.fpext(row, four))
            total = term if total is None else builder.fadd(total, term)
            place = builder.add(place, four_bytes)
        first = make_array(signature.args[6])(context, builder, out).data
        builder.store(total, builder.bitcast(builder.gep(first, [at]), four.as_pointer()), align=size)
        return context.get_dummy_value()

    return types.void(types.uint64, types.uint64, v0, v1, v2, v3, out, types.uint64), generate
