"""Instructions that numba's compiler does not find by itself: four neighbours at once, fused multiply-adds, prefetching."""

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
def spline_of_four(typing_context: Any, f: Any, stride: Any, place: Any, weights: Any, size: Any, t: Any, out: Any) -> Any:
    """out[s] = sum_i sum_j x_i[s] y_j[s] f[place[s] + j stride + i], i, j = 0 .. 3, for the four samples s = t .. t + 3.

    C arrays: ``place`` int32, ``f``, ``out`` and ``weights`` of one type; ``weights`` are x_0 .. x_3, y_0 .. y_3, one after the
    other, each of ``size`` samples. ``stride``, ``size``, ``t`` are uint64; nothing is checked.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        f, stride, place, weights, size, t, out = arguments
        scalar, kinds = context.get_data_type(signature.args[0].dtype), signature.args
        four, align = ir.VectorType(scalar, 4), context.get_abi_sizeof(scalar)
        lane = ir.IntType(32)

        def data(array: Any, kind: Any) -> Any:
            return make_array(kind)(context, builder, array).data

        def shuffle(a: Any, b: Any, *lanes: int) -> Any:
            return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(lane, 4), list(lanes)))

        def vector(pointer: Any) -> Any:
            return builder.load(builder.bitcast(pointer, four.as_pointer()), align=align)

        def weighted(terms: Any) -> Any:
            total = None
            for a, b in terms:
                term = builder.fmul(a, b, flags=FLAGS)
                total = term if total is None else builder.fadd(total, term, flags=FLAGS)
            return total

        f, weights = data(f, kinds[0]), builder.gep(data(weights, kinds[3]), [t])
        at = [vector(builder.gep(weights, [builder.mul(size, ir.Constant(size.type, k))])) for k in range(8)]
        columns = []
        for s in range(4):
            first = builder.load(builder.gep(data(place, kinds[2]), [builder.add(t, ir.Constant(t.type, s))]))
            row, terms = builder.gep(f, [builder.zext(first, t.type)]), []
            for weight in at[4:]:
                terms.append((shuffle(weight, weight, s, s, s, s), vector(row)))
                row = builder.gep(row, [stride])
            columns.append(weighted(terms))
        a, b, c, d = columns
        halves = [[shuffle(p, q, *lanes) for p, q in ((a, b), (c, d))] for lanes in ((0, 4, 1, 5), (2, 6, 3, 7))]
        turned = [shuffle(*pair, *lanes) for pair in halves for lanes in ((0, 1, 4, 5), (2, 3, 6, 7))]
        total = weighted([(x, column) for x, column in zip(at[:4], turned, strict=True)])
        builder.store(total, builder.bitcast(builder.gep(data(out, kinds[6]), [t]), four.as_pointer()), align=align)
        return context.get_dummy_value()

    return types.void(f, types.uint64, place, weights, types.uint64, types.uint64, out), generate


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


@intrinsic
def prefetch(typing_context: Any, array: Any, place: Any) -> Any:
    """Fetch element ``place`` (uint64) of a C array, which is going to be written, into the cache. It need not exist."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer = ir.IntType(32)
        data = make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(data, [arguments[1]]), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [address.type, integer, integer, integer])
        to_write, keep, of_data = integer(1), integer(3), integer(1)
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        builder.call(fetch, [address, to_write, keep, of_data])
        return context.get_dummy_value()

    return types.void(array, types.uint64), generate
