"""SIMD instructions for compiled loops that a compiler would not vectorise by itself.

Two things cost the spiking kernels most: loops over a few dozen numbers, each of which first
checked whether its arrays overlap, and the search for the few neurons that fired. Here a loop over
a run is written as the vectors that it is, and a comparison of 64 neurons gives 64 bits at once.
The code is LLVM's own vector code, so it runs on any processor and gives the same bits as a plain
loop (`test_lanes.py`); nothing is rounded otherwise, and nothing is looked up twice.

Places are uint64 and are not checked: the callers' tables keep them inside the arrays.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES = 8
"""Numbers that `add` and `add_times` take at a time."""

BLOCK = 64
"""Neurons that `fires` and `fires_kept` take at a time."""

_BITS = ir.IntType(BLOCK)


def _vector(lanes: int) -> ir.VectorType:
    return ir.VectorType(ir.FloatType(), lanes)


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any, lanes: int) -> Any:
    """Pointer to `lanes` numbers of an array from `index` on."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _vector(lanes).as_pointer())


def _load(builder: Any, place: Any, lanes: int) -> Any:
    value = builder.load(place, typ=_vector(lanes))
    value.align = 4  # a run begins anywhere
    return value


def _store(builder: Any, value: Any, place: Any) -> None:
    builder.store(value, place).align = 4


def _all(builder: Any, value: Any, lanes: int) -> Any:
    """Broadcast one number to all lanes."""
    nothing = ir.Constant(_vector(lanes), ir.Undefined)
    first = builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    return builder.shuffle_vector(first, nothing, zeros)


def _add(context: Any, builder: Any, signature: Any, given: Any) -> Any:
    """The code of `add` and `add_times`."""
    kinds, (a, at, b, of, *factor) = signature.args, given
    to = _place(context, builder, kinds[0], a, at, LANES)
    by = _load(builder, _place(context, builder, kinds[2], b, of, LANES), LANES)
    for each in factor:
        by = builder.fmul(by, _all(builder, each, LANES))
    _store(builder, builder.fadd(_load(builder, to, LANES), by), to)
    return context.get_dummy_value()


@intrinsic
def add(typing: Any, a: Any, at: Any, b: Any, of: Any) -> Any:
    """``a[at:at + LANES] += b[of:of + LANES]``, float32."""
    return types.void(a, at, b, of), _add


@intrinsic
def add_times(typing: Any, a: Any, at: Any, b: Any, of: Any, factor: Any) -> Any:
    """``a[at:at + LANES] += b[of:of + LANES] * factor``, float32, rounded twice."""
    return types.void(a, at, b, of, factor), _add


def _fires(context: Any, builder: Any, signature: Any, given: Any) -> Any:
    """The code of `fires` and `fires_kept`."""
    *arrays, at, threshold = given
    current, v, *retained = (
        _place(context, builder, kind, array, at, BLOCK)
        for kind, array in zip(signature.args, arrays, strict=False)
    )
    zero = ir.Constant(_vector(BLOCK), [0.0] * BLOCK)
    u = builder.fadd(_load(builder, v, BLOCK), _load(builder, current, BLOCK))
    for place in retained:
        _store(builder, u, place)
    over = builder.fsub(u, _all(builder, threshold, BLOCK))
    fired = builder.fcmp_ordered(">=", over, zero)
    _store(builder, builder.select(fired, zero, u), v)
    _store(builder, zero, current)
    return builder.bitcast(fired, _BITS)


@intrinsic
def fires(typing: Any, current: Any, v: Any, at: Any, threshold: Any) -> Any:
    """A step of the neurons [at, at + BLOCK): bit k says whether neuron at + k fires.

    u = v + current; it fires where u - threshold >= 0; then v = 0, else u; current = 0. All are
    float32, and the bits a uint64.
    """
    return types.uint64(current, v, at, threshold), _fires


@intrinsic
def fires_kept(typing: Any, current: Any, v: Any, u: Any, at: Any, threshold: Any) -> Any:
    """Like `fires`; fills ``u[at:at + BLOCK]`` with the potentials before the reset."""
    return types.uint64(current, v, u, at, threshold), _fires


@intrinsic
def lowest(typing: Any, bits: Any) -> Any:
    """Return the index of a uint64's lowest set bit, uint64; undefined where none is set."""

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.cttz(given[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(bits), code
