"""Vector instructions give the bits of the plain loops that they stand for."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sliplab.analysis.networks.lanes import BLOCK, LANES, add, add_times, fires, fires_kept, lowest
from sliplab.storage.kernels import njit

F32 = npt.NDArray[np.float32]
ROOM = 96
"""Length of the arrays here: more than a block, so that what lies around it is seen too."""

NUMBERS = st.floats(width=32, allow_nan=False)
"""With infinities, zeros of both signs and numbers too small to be normal."""
ROWS = arrays(np.float32, ROOM, elements=NUMBERS)


@njit()
def _add(a: Any, at: Any, b: Any, of: Any) -> None:
    add(a, at, b, of)


@njit()
def _add_times(a: Any, at: Any, b: Any, of: Any, factor: Any) -> None:
    add_times(a, at, b, of, factor)


@njit()
def _fires(current: Any, v: Any, at: Any, threshold: Any) -> Any:
    return fires(current, v, at, threshold)


@njit()
def _fires_kept(current: Any, v: Any, u: Any, at: Any, threshold: Any) -> Any:
    return fires_kept(current, v, u, at, threshold)


@njit()
def _lowest(bits: Any) -> Any:
    return lowest(bits)


def bits(values: F32) -> list[int]:
    """The very bits, in which zeros of two signs differ."""
    return values.view(np.uint32).tolist()


@given(ROWS, ROWS, st.integers(0, ROOM - LANES), st.integers(0, ROOM - LANES), NUMBERS)
def test_runs_are_added_where_they_belong(a: F32, b: F32, at: int, of: int, factor: float) -> None:
    """At any place, aligned or not; nothing around them changes; a product is rounded first."""
    with np.errstate(all="ignore"):
        for times in (None, np.float32(factor)):
            expected, found = a.copy(), a.copy()
            run = b[of : of + LANES]
            expected[at : at + LANES] += run if times is None else run * times
            if times is None:
                _add(found, np.uint64(at), b, np.uint64(of))
            else:
                _add_times(found, np.uint64(at), b, np.uint64(of), times)
            known = ~np.isnan(expected)
            assert bits(found[known]) == bits(expected[known])
            assert np.isnan(found[~known]).all()


@given(ROWS, ROWS, st.integers(0, ROOM - BLOCK), st.floats(2**-20, 2**20, width=32), st.data())
def test_a_block_steps_as_its_neurons_do(
    current: F32, v: F32, at: int, threshold: float, data: st.DataObject
) -> None:
    """Some exactly at the threshold, some at minus infinity, as in a border."""
    limit = np.float32(threshold)
    met = data.draw(arrays(np.bool_, ROOM))
    v = np.where(met, limit - current, v).astype(np.float32)
    with np.errstate(all="ignore"):
        u = v + current
        over = u - limit >= 0
    inside = np.zeros(ROOM, np.bool_)
    inside[at : at + BLOCK] = True
    known = ~np.isnan(u)
    for keep in (False, True):
        i, potential, kept = current.copy(), v.copy(), np.full(ROOM, 7, np.float32)
        if keep:
            word = _fires_kept(i, potential, kept, np.uint64(at), limit)
        else:
            word = _fires(i, potential, np.uint64(at), limit)
        fired = [bool(int(word) >> k & 1) for k in range(BLOCK)]
        assert fired == over[at : at + BLOCK].tolist()
        assert bits(i[inside]) == [0] * BLOCK
        assert bits(i[~inside]) == bits(current[~inside])
        after = np.where(inside, np.where(over, np.float32(0), u), v).astype(np.float32)
        assert bits(potential[known | ~inside]) == bits(after[known | ~inside])
        expected = np.where(inside, u, np.float32(7)) if keep else np.full(ROOM, np.float32(7))
        assert bits(kept[known]) == bits(expected[known])


@given(st.integers(1, 2**64 - 1))
def test_lowest_bit(word: int) -> None:
    assert int(_lowest(np.uint64(word))) == (word & -word).bit_length() - 1
