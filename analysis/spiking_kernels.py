"""The whole network in one compiled loop a window, which works only where something happens.

A window holds some 200 non-empty cells and its layers fire in a few percent of their steps, so
nearly all multiplications of the dense layers are by zero. Here every event and every spike adds
its runs of weights to the currents of the neurons that it reaches (scatter), and neurons take a
step together, in vector lanes. `analysis.spiking_layout` makes the layout:

- A plane of neurons is flat, channels last, with a border wide enough that no tap of a kernel
  leaves it; the taps of a kernel's row are then one contiguous run. Neurons of the border are at
  minus infinity and never fire.
- ``reach``: for each source (a cell of the input, a neuron of the layer below) where its first run
  begins among the currents and among the weights, how many runs it has and how long they are.
  A source without runs (border) has none.

A neuron's step is u = v + I; it fires where u - threshold >= 0; then v = 0, else u: in float32 and
in this order, as Sinabs has it. Indices are unsigned: a signed one may count from the end, and a
compiler that must ask cannot use vectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

_F0 = np.float32(0.0)
_U0, _U1, _U2, _U3 = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
_U7, _U56 = np.uint64(7), np.uint64(56)
_BYTE = np.uint64(0x0001020304050607)
"""Times a word whose only bit is the lowest of byte k gives k in the highest byte."""


@njit(cache=True, nogil=True)
def scatter_counts(
    cell: Any, count: Any, begin: int, end: int, reach: Any, weights: Any, stride_w: Any,
    stride: Any, current: Any,
) -> None:  # fmt: skip
    """Currents grow by the weights of each non-empty cell, times its count.

    Args:
        cell, count: sources and how often each is active; those at [begin, end).
        reach: uint32 (sources, 4): first current, first weight, runs, length of a run.
        weights, current: float32, flat.
        stride_w, stride: uint64, from a run to the next among weights and among currents.
    """
    for e in range(begin, end):
        s = cell[e]
        at, w = np.uint64(reach[s, 0]), np.uint64(reach[s, 1])
        length = np.uint64(reach[s, 3])
        amount = np.float32(count[e])
        for _ in range(reach[s, 2]):
            for j in range(length):
                current[at + j] += amount * weights[w + j]
            at += stride
            w += stride_w


@njit(cache=True, nogil=True)
def scatter(
    spikes: Any, begin: Any, end: Any, reach: Any, weights: Any, stride_w: Any, stride: Any,
    current: Any,
) -> None:  # fmt: skip
    """Currents grow by the weights of each spike at [begin, end); otherwise `scatter_counts`.

    Up to three neighbours that reach the same currents are added up first: an addition must
    wait for the one before it on the same current.
    """
    e = begin
    while e < end:
        s = spikes[e]
        at, w = np.uint64(reach[s, 0]), np.uint64(reach[s, 1])
        runs, length = reach[s, 2], np.uint64(reach[s, 3])
        alike = _U1
        while alike < _U3 and e + alike < end:
            other = spikes[e + alike]
            same = reach[other, 0] == reach[s, 0] and reach[other, 2] == reach[s, 2]
            if not same or reach[other, 3] != reach[s, 3]:
                break
            alike += _U1
        e += alike
        if alike == _U1:
            for _ in range(runs):
                for j in range(length):
                    current[at + j] += weights[w + j]
                at += stride
                w += stride_w
        elif alike == _U2:
            w2 = np.uint64(reach[spikes[e - _U1], 1])
            for _ in range(runs):
                for j in range(length):
                    current[at + j] += weights[w + j] + weights[w2 + j]
                at += stride
                w += stride_w
                w2 += stride_w
        else:
            w2 = np.uint64(reach[spikes[e - _U2], 1])
            w3 = np.uint64(reach[spikes[e - _U1], 1])
            for _ in range(runs):
                for j in range(length):
                    current[at + j] += weights[w + j] + weights[w2 + j] + weights[w3 + j]
                at += stride
                w += stride_w
                w2 += stride_w
                w3 += stride_w


@njit(cache=True, nogil=True)
def fire(
    current: Any, v: Any, potential: Any, threshold: Any, fired: Any, words: Any, begin: Any,
    end: Any, spikes: Any, n: Any,
) -> Any:  # fmt: skip
    """A step of the neurons [begin, end); their currents are cleared.

    Args:
        current, v: float32, what neurons get and what they are at.
        potential: float32, filled with u, the potentials before the reset; or None.
        fired, words: scratch bytes and the same as uint64: vector lanes
            write who fired, and eight at a time are passed over where none did.
        begin, end: uint64, multiples of 8.
        spikes: filled with who fired, ascending, from place n on.

    Returns:
        the number of spikes that the list holds now.
    """
    for j in range(begin, end):
        u = v[j] + current[j]
        over = u - threshold >= _F0
        if potential is not None:
            potential[j] = u
        fired[j] = over
        v[j] = _F0 if over else u
        current[j] = _F0
    for word in range(begin >> _U3, end >> _U3):
        left = words[word]
        while left != _U0:
            lowest = left & (~left + _U1)
            spikes[n] = (word << _U3) + ((lowest * _BYTE) >> _U56)
            n += _U1
            left ^= lowest
    return n


@njit(cache=True, nogil=True)
def step(
    cell: Any, count: Any, begin: int, end: int, layers: Any, threshold: Any, state: Any,
    scratch: Any, fired_by: Any,
) -> Any:  # fmt: skip
    """One time step of the whole network.

    Neurons that get nothing are left alone: they stay below the threshold.

    Args:
        cell, count: non-empty cells and their counts; those at [begin, end) are now.
        layers: (reach, weights, stride_w, stride) of each layer, as four tuples.
        state: potentials of each layer, changed.
        scratch: (currents, fired, words, spikes, low, high); currents are zero before
            and after.
        fired_by: int64 (layers,), grows by the spikes of each layer.

    Returns:
        how many output neurons fired; which ones, the first places of the last list of spikes say.
    """
    reach, weights, stride_w, stride = layers
    currents, fired, words, spikes, low, high = scratch
    if begin == end:
        return _U0
    rows = low.size
    for y in range(rows):
        low[y], high[y] = np.uint64(currents[0].size), _U0
    for e in range(begin, end):
        at = np.uint64(reach[0][cell[e], 0])
        length = np.uint64(reach[0][cell[e], 3])
        y = at // stride[0]
        for _ in range(reach[0][cell[e], 2]):
            low[y] = min(low[y], at)
            high[y] = max(high[y], at + length)
            at += stride[0]
            y += _U1
    scatter_counts(
        cell, count, begin, end, reach[0], weights[0], stride_w[0], stride[0], currents[0]
    )  # fmt: skip
    n, done = _U0, _U0
    for y in range(rows):
        if low[y] < high[y]:
            # rows need not begin at a multiple of 8: what two share was done with the first
            begin8 = max((low[y] >> _U3) << _U3, done)
            done = ((high[y] + _U7) >> _U3) << _U3
            n = fire(
                currents[0], state[0], None, threshold, fired, words, begin8, done,
                spikes[0], n,
            )  # fmt: skip
    fired_by[0] += np.int64(n)
    for k in range(1, len(currents)):
        if n == _U0:
            return _U0
        scatter(
            spikes[k - 1], _U0, n, reach[k], weights[k], stride_w[k], stride[k], currents[k]
        )  # fmt: skip
        n = fire(
            currents[k], state[k], None, threshold, fired, words, _U0,
            np.uint64(currents[k].size), spikes[k], _U0,
        )  # fmt: skip
        fired_by[k] += np.int64(n)
    return n


@njit(cache=True, nogil=True)
def windows(
    cell: Any, count: Any, offsets: Any, begin: int, end: int, steps: int, layers: Any,
    threshold: Any, rest: Any, state: Any, scratch: Any, out: Any, fired_by: Any,
) -> None:  # fmt: skip
    """Output spikes of the windows [begin, end), each from rest.

    Args:
        cell, count, offsets: see `analysis.sparse.SparseWindows`.
        rest: potentials of each layer at rest.
        out: int64 (n, 3), filled in its rows [begin, end).
        fired_by: int64 (n, layers), likewise, spikes of each layer.
    """
    outputs = out.shape[1]
    for i in range(begin, end):
        for k in range(len(state)):
            state[k][:] = rest[k]
        for t in range(i * steps, i * steps + steps):
            n = step(
                cell, count, offsets[t], offsets[t + 1], layers, threshold, state, scratch,
                fired_by[i],
            )  # fmt: skip
            last = scratch[3][len(state) - 1]
            for k in range(n):
                if last[k] < outputs:
                    out[i, last[k]] += 1
