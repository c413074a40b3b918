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
def four_columns_at(
    typing_context: Any, address: Any, stride: Any, v0: Any, v1: Any, v2: Any, v3: Any, fields: Any, out: Any, at: Any
) -> Any:
    """out[at + k] = sum_j v_j f[j stride + k], k = 0 .. 4 n - 1, for the float32 numbers ``f`` at a memory ``address``.

    ``fields``: a tuple of n numbers, one for each of the fields whose values alternate in ``f``. ``out`` is a C array of the type
    of ``v_j``, float32 or float64; ``address``, ``stride``, ``at`` are uint64; nothing is checked. The sums are not contracted,
    so that they are the same wherever they are made.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place, stride, *v, _, out, at = arguments
        scalar, lanes = context.get_data_type(signature.args[2]), 4 * len(signature.args[6])
        single, many, size = ir.VectorType(ir.FloatType(), lanes), ir.VectorType(scalar, lanes), context.get_abi_sizeof(scalar)
        nothing, integer = ir.Constant(many, ir.Undefined), ir.IntType(32)
        zeros = ir.Constant(ir.VectorType(integer, lanes), [0] * lanes)

        def spread(value: Any) -> Any:
            return builder.shuffle_vector(builder.insert_element(nothing, value, ir.Constant(integer, 0)), nothing, zeros)

        four_bytes = builder.mul(stride, ir.Constant(stride.type, 4))
        total = None
        for weight in v:
            row = builder.load(builder.inttoptr(place, single.as_pointer()), align=4)
            term = builder.fmul(spread(weight), row if many == single else builder.fpext(row, many))
            total = term if total is None else builder.fadd(total, term)
            place = builder.add(place, four_bytes)
        first = make_array(signature.args[7])(context, builder, out).data
        builder.store(total, builder.bitcast(builder.gep(first, [at]), many.as_pointer()), align=size)
        return context.get_dummy_value()

    return types.void(types.uint64, types.uint64, v0, v1, v2, v3, fields, out, types.uint64), generate


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


@intrinsic
def bits_of(typing_context: Any, value: Any) -> Any:
    """The bits of a float64 as int64: those of positive numbers are in their order."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def of_bits(typing_context: Any, bits: Any) -> Any:
    """The float64 with these bits, int64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate


def _vector(builder: Any, pointer: Any, kind: Any) -> Any:
    """The eight numbers from ``pointer`` on."""
    return builder.bitcast(pointer, ir.VectorType(kind, 8).as_pointer())


def _eight_times(builder: Any, value: Any) -> Any:
    """A vector of eight times one number."""
    nothing, lane = ir.Constant(ir.VectorType(value.type, 8), ir.Undefined), ir.IntType(32)
    first = builder.insert_element(nothing, value, lane(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(lane, 8), [0] * 8))


@intrinsic
def running_terms(typing_context: Any, c: Any, s: Any, x: Any, y: Any, magic: Any, run: Any, size: Any, out: Any) -> Any:
    """Sums over the samples 0 .. t of the bits of (x c, x s, x c c, x c s, x s s, y, y c, y s) + ``magic``, each in float64.

    They go to out[8 run[t]] and on, so that those of the last sample of each run stay. With 1.5 2^52 for ``magic``, the sum over
    a run of integers of up to 51 bits is the difference of two of these, less the bits of ``magic`` once a sample: exact, as all
    of it is taken modulo 2^64. C arrays: ``c``, ``s``, ``x``, ``y`` float64, ``run`` int32, ``out`` int64; ``size`` (int64)
    samples; nothing is checked.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        from numba.core import cgutils

        kinds, (size, magic) = signature.args, (arguments[6], arguments[4])
        c, s, x, y, run, out = (make_array(kinds[k])(context, builder, arguments[k]).data for k in (0, 1, 2, 3, 5, 7))
        double, integer, lane = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
        ones = ir.Constant(ir.VectorType(double, 8), [1.0] * 8)
        magic = _eight_times(builder, magic)

        def choose(a: Any, b: Any, lanes: str) -> Any:
            """Lanes of ``a``, where there is a 1 those of ``b``."""
            places = [k + 8 * int(which) for k, which in enumerate(lanes)]
            return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(lane, 8), places))

        total = cgutils.alloca_once_value(builder, ir.Constant(ir.VectorType(integer, 8), [0] * 8))
        with cgutils.for_range(builder, size) as loop:
            at = [_eight_times(builder, builder.load(builder.gep(data, [loop.index]))) for data in (c, s, x, y)]
            first = choose(at[2], at[3], "00000111")
            second = choose(choose(ones, at[0], "00110000"), at[1], "00001000")
            third = choose(choose(at[0], at[1], "01011001"), ones, "00000100")
            term = builder.fadd(builder.fmul(builder.fmul(first, second), third), magic)
            added = builder.add(builder.load(total), builder.bitcast(term, ir.VectorType(integer, 8)))
            builder.store(added, total)
            place = builder.mul(builder.zext(builder.load(builder.gep(run, [loop.index])), integer), integer(8))
            builder.store(added, _vector(builder, builder.gep(out, [place]), integer), align=8)
        return context.get_dummy_value()

    return types.void(c, s, x, y, magic, run, size, out), generate


@intrinsic
def add_change(typing_context: Any, f: Any, at: Any, sums: Any, run: Any, less: Any) -> Any:
    """f[at + k] += sums[8 run + k] - sums[8 run - 8 + k] - less, k = 0 .. 7, of int64 C arrays; ``at``, ``run`` are uint64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, (_, at, _, run, less) = signature.args, arguments
        f, sums = (make_array(kinds[k])(context, builder, arguments[k]).data for k in (0, 2))
        integer = ir.IntType(64)
        last = builder.gep(sums, [builder.mul(run, integer(8))])
        pointers = (last, builder.gep(last, [integer(-8)]), builder.gep(f, [at]))
        now, before, to = (_vector(builder, pointer, integer) for pointer in pointers)
        change = builder.sub(builder.load(now, align=8), builder.load(before, align=8))
        change = builder.sub(change, _eight_times(builder, less))
        builder.store(builder.add(builder.load(to, align=8), change), to, align=8)
        return context.get_dummy_value()

    return types.void(f, types.uint64, sums, types.uint64, types.int64), generate
