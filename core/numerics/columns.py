"""Instructions that numba's compiler does not find by itself: four neighbours at once, fused
multiply-adds, prefetching.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, register_jitable

FLAGS = ("contract", "nsz")


def make_array(kind: Any) -> Any:
    """numba's, imported where something is compiled: a run whose kernels are kept needs none of its
    compiler.
    """
    from numba.np import arrayobj

    return arrayobj.make_array(kind)


@intrinsic
def spline_of_four(
    typing_context: Any,
    f: Any,
    stride: Any,
    place: Any,
    weights: Any,
    size: Any,
    t: Any,
    out: Any,
) -> Any:
    """out[s] = sum_i sum_j x_i[s] y_j[s] f[place[s] + j stride + i], i, j = 0 .. 3, for the four
    samples s = t .. t + 3.

    C arrays: ``place`` int32, ``f``, ``out`` and ``weights`` of one type; ``weights`` are x_0 ..
    x_3, y_0 .. y_3, one after the other, each of ``size`` samples. ``stride``, ``size``, ``t`` are
    uint64; nothing is checked.
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
        at = [
            vector(builder.gep(weights, [builder.mul(size, ir.Constant(size.type, k))]))
            for k in range(8)
        ]
        columns = []
        for s in range(4):
            first = builder.load(
                builder.gep(data(place, kinds[2]), [builder.add(t, ir.Constant(t.type, s))])
            )
            row, terms = builder.gep(f, [builder.zext(first, t.type)]), []
            for weight in at[4:]:
                terms.append((shuffle(weight, weight, s, s, s, s), vector(row)))
                row = builder.gep(row, [stride])
            columns.append(weighted(terms))
        a, b, c, d = columns
        halves = [
            [shuffle(p, q, *lanes) for p, q in ((a, b), (c, d))]
            for lanes in ((0, 4, 1, 5), (2, 6, 3, 7))
        ]
        turned = [
            shuffle(*pair, *lanes) for pair in halves for lanes in ((0, 1, 4, 5), (2, 3, 6, 7))
        ]
        total = weighted([(x, column) for x, column in zip(at[:4], turned, strict=True)])
        builder.store(
            total,
            builder.bitcast(builder.gep(data(out, kinds[6]), [t]), four.as_pointer()),
            align=align,
        )
        return context.get_dummy_value()

    return types.void(f, types.uint64, place, weights, types.uint64, types.uint64, out), generate


@intrinsic
def fused(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, rounded once, for three floats of one type: the same bits in a vector loop as at its
    end.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, b, c), generate


@intrinsic
def four_columns_at(
    typing_context: Any,
    address: Any,
    stride: Any,
    v0: Any,
    v1: Any,
    v2: Any,
    v3: Any,
    fields: Any,
    out: Any,
    at: Any,
) -> Any:
    """out[at + k] = sum_j v_j f[j stride + k], k = 0 .. 4 n - 1, for the float32 numbers ``f`` at a
    memory ``address``.

    ``fields``: a tuple of n numbers, one for each of the fields whose values alternate in ``f``.
    ``out`` is a C array of the type of ``v_j``, float32 or float64; ``address``, ``stride``, ``at``
    are uint64; nothing is checked. The sums are not contracted, so that they are the same wherever
    they are made.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place, stride, *v, _, out, at = arguments
        scalar, lanes = context.get_data_type(signature.args[2]), 4 * len(signature.args[6])
        single, many, size = (
            ir.VectorType(ir.FloatType(), lanes),
            ir.VectorType(scalar, lanes),
            context.get_abi_sizeof(scalar),
        )
        nothing, integer = ir.Constant(many, ir.Undefined), ir.IntType(32)
        zeros = ir.Constant(ir.VectorType(integer, lanes), [0] * lanes)

        def spread(value: Any) -> Any:
            return builder.shuffle_vector(
                builder.insert_element(nothing, value, ir.Constant(integer, 0)),
                nothing,
                zeros,
            )

        four_bytes = builder.mul(stride, ir.Constant(stride.type, 4))
        total = None
        for weight in v:
            row = builder.load(builder.inttoptr(place, single.as_pointer()), align=4)
            term = builder.fmul(spread(weight), row if many == single else builder.fpext(row, many))
            total = term if total is None else builder.fadd(total, term)
            place = builder.add(place, four_bytes)
        first = make_array(signature.args[7])(context, builder, out).data
        builder.store(
            total,
            builder.bitcast(builder.gep(first, [at]), many.as_pointer()),
            align=size,
        )
        return context.get_dummy_value()

    return types.void(
        types.uint64,
        types.uint64,
        v0,
        v1,
        v2,
        v3,
        fields,
        out,
        types.uint64,
    ), generate


@intrinsic
def prefetch(typing_context: Any, array: Any, place: Any) -> Any:
    """Fetch element ``place`` (uint64) of a C array, which is going to be written, into the cache.
    It need not exist.
    """

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


def _vector(builder: Any, pointer: Any, kind: Any, size: int = 8) -> Any:
    """The numbers from ``pointer`` on."""
    return builder.bitcast(pointer, ir.VectorType(kind, size).as_pointer())


def _times(builder: Any, value: Any, size: int = 8) -> Any:
    """A vector of one number."""
    nothing = ir.Constant(ir.VectorType(value.type, size), ir.Undefined)
    lane = ir.IntType(32)
    first = builder.insert_element(nothing, value, lane(0))
    return builder.shuffle_vector(
        first,
        nothing,
        ir.Constant(ir.VectorType(lane, size), [0] * size),
    )


def _together(builder: Any, values: Any) -> Any:
    """Numbers in a vector, of which many are the same."""
    size = len(values)
    lane = ir.IntType(32)
    found = ir.Constant(ir.VectorType(values[0].type, size), ir.Undefined)
    for value in {id(one): one for one in values}.values():
        places = ir.Constant(
            ir.VectorType(lane, size),
            [k + size * (one is value) for k, one in enumerate(values)],
        )
        found = builder.shuffle_vector(found, _times(builder, value, size), places)
    return found


@intrinsic
def running_terms(
    typing_context: Any,
    c: Any,
    s: Any,
    x: Any,
    y: Any,
    first: Any,
    fields: Any,
    magic: Any,
    run: Any,
    size: Any,
    out: Any,
) -> Any:
    """Sums over the samples 0 .. t of the bits of (x c, x s, x c c, x c s, x s s, y, y c, y s) +
    ``magic``, each in float64.

    ``y`` are rows from ``first`` (uint64) on, one for each element of the tuple ``fields``, whose
    y, y c, y s follow each other. The sums go to out[L run[t]] and on, so that those of the last
    sample of each run stay; L is `lanes_of` their number. With 1.5 2^52 for ``magic``, the sum over
    a run of integers of up to 51 bits is the difference of two of these, less the bits of ``magic``
    once a sample: exact, as all of it is taken modulo 2^64. C arrays: ``c``, ``s``, ``x``, ``y``
    float64, ``run`` int32, ``out`` int64; ``size`` (int64) samples; nothing is checked.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        from numba.core import cgutils

        kinds, (size, magic) = signature.args, (arguments[8], arguments[6])
        c, s, x, run, out = (
            make_array(kinds[k])(context, builder, arguments[k]).data for k in (0, 1, 2, 7, 9)
        )
        double, integer, n = ir.DoubleType(), ir.IntType(64), len(kinds[5])
        matrix = make_array(kinds[3])(context, builder, arguments[3])
        width = builder.extract_value(matrix.shape, 1)
        rows = [
            builder.gep(matrix.data, [builder.mul(width, builder.add(arguments[4], integer(k)))])
            for k in range(n)
        ]
        one, lanes = ir.Constant(double, 1.0), lanes_of(n)
        groups = [range(k, min(k + 8, lanes)) for k in range(0, lanes, 8)]
        totals = [
            cgutils.alloca_once_value(
                builder,
                ir.Constant(ir.VectorType(integer, len(g)), [0] * len(g)),
            )
            for g in groups
        ]
        with cgutils.for_range(builder, size) as loop:
            cosine, sine, weight, *data = (
                builder.load(builder.gep(row, [loop.index])) for row in (c, s, x, *rows)
            )
            factors = [
                (weight, one, cosine),
                (weight, one, sine),
                (weight, cosine, cosine),
                (weight, cosine, sine),
            ]
            factors += [
                (weight, sine, sine),
                *((value, one, turn) for value in data for turn in (one, cosine, sine)),
            ]
            factors += factors[-1:] * (lanes - len(factors))
            place = builder.mul(
                builder.zext(builder.load(builder.gep(run, [loop.index])), integer),
                integer(lanes),
            )
            for group, total in zip(groups, totals, strict=True):
                a, b, d = (
                    _together(builder, values)
                    for values in zip(*(factors[k] for k in group), strict=True)
                )
                term = builder.fadd(
                    builder.fmul(builder.fmul(a, b), d),
                    _times(builder, magic, len(group)),
                )
                added = builder.add(
                    builder.load(total),
                    builder.bitcast(term, ir.VectorType(integer, len(group))),
                )
                builder.store(added, total)
                to = builder.gep(out, [builder.add(place, integer(group.start))])
                builder.store(added, _vector(builder, to, integer, len(group)), align=8)
        return context.get_dummy_value()

    return types.void(c, s, x, y, types.uint64, fields, magic, run, size, out), generate


@register_jitable
def lanes_of(n: int) -> int:
    """Numbers that `running_terms` keeps of a run, of n ``y``: a multiple of four."""
    return -(-(5 + 3 * n) // 4) * 4


@intrinsic
def add_change(
    typing_context: Any,
    f: Any,
    at: Any,
    sums: Any,
    run: Any,
    data: Any,
    fields: Any,
    less: Any,
) -> Any:
    """f[at + k] += sums[L run + j] - sums[L run - L + j] - less, with j = k for k = 0 .. 4, and j =
    data + k - 5 for k = 5 .. 7.

    L is `lanes_of` the length of the tuple ``fields``. int64 C arrays; ``at``, ``run``, ``data``
    are uint64; ``data`` is at least 5, and 5 where ``fields`` has one element; nothing is checked.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, (_, at, _, run, data, _, less) = signature.args, arguments
        f, sums = (make_array(kinds[k])(context, builder, arguments[k]).data for k in (0, 2))
        integer = ir.IntType(64)
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), 8), [0, 1, 2, 3, 4, 13, 14, 15])

        def eight(run: Any) -> Any:
            place = builder.mul(run, integer(lanes_of(len(kinds[5]))))
            first = builder.load(_vector(builder, builder.gep(sums, [place]), integer), align=8)
            if len(kinds[5]) == 1:
                return first
            place = builder.add(place, builder.sub(data, integer(5)))
            return builder.shuffle_vector(
                first,
                builder.load(_vector(builder, builder.gep(sums, [place]), integer), align=8),
                lanes,
            )

        change = builder.sub(eight(run), eight(builder.sub(run, integer(1))))
        change = builder.sub(change, _times(builder, less))
        to = _vector(builder, builder.gep(f, [at]), integer)
        builder.store(builder.add(builder.load(to, align=8), change), to, align=8)
        return context.get_dummy_value()

    return types.void(
        f,
        types.uint64,
        sums,
        types.uint64,
        types.uint64,
        fields,
        types.int64,
    ), generate
