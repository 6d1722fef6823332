"""The whole network in one compiled loop a window, which works only where something happens.

A window holds some 200 non-empty cells and its layers fire in a few percent of their steps, so
nearly all multiplications of the dense layers are by zero. Here every event and every spike adds
its runs of weights to the currents of the neurons that it reaches (scatter), and neurons take a
step together, in vector lanes. `analysis.networks.spiking_layout` makes the layout:

- A plane of neurons is flat, channels last, filled up to whole vectors of channels, with a border
  wide enough that no tap of a kernel leaves it; the taps of a kernel's row are then one contiguous
  run. Neurons of the border are at minus infinity and never fire.
- ``reach``: for each source (a cell of the input, a neuron of the layer below) where its first run
  begins among the currents and among the weights.
- ``shape``: of a layer, from a run to the next among weights and among currents, how many runs a
  source has and how long they are. All sources of a layer have the same, filled up with weights
  of zero: a processor that can foresee each loop's end is twice as fast.
- ``bias``: where a layer's biases begin among its weights, or -1: currents of every step.

A neuron's step is u = v + I; it fires where u - threshold >= 0; then v = 0, else u: in float32 and
in this order, as Sinabs has it. Indices are unsigned: a signed one may count from the end, and a
compiler that must ask cannot use vectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sliplab.analysis.networks.lanes import BLOCK, LANES, add, add_times, fires, fires_kept, lowest
from sliplab.storage.kernels import njit

_U0, _U1 = np.uint64(0), np.uint64(1)
_F1 = np.float32(1.0)
_LANES, _BLOCK = np.uint64(LANES), np.uint64(BLOCK)


@njit(cache=True, nogil=True)
def scatter(
    sources: Any,
    counts: Any,
    begin: Any,
    end: Any,
    reach: Any,
    weights: Any,
    shape: Any,
    current: Any,
) -> None:
    """Currents grow by the weights of each source, times its count.

    Args:
        sources: non-empty cells, or neurons that fired; those at [begin, end).
        counts: how often each is active; None for once.
        reach: uint32 (sources, 2): first current, first weight.
        weights, current: float32, flat.
        shape: uint64: from a run to the next among weights, among currents, runs, length of one.
    """
    stride_w, stride, runs, length = shape
    for e in range(begin, end):
        at, w = np.uint64(reach[sources[e], 0]), np.uint64(reach[sources[e], 1])
        amount = _F1 if counts is None else np.float32(counts[e])
        for _ in range(runs):
            for j in range(_U0, length, _LANES):
                if counts is None:
                    add(current, at + j, weights, w + j)
                else:
                    add_times(current, at + j, weights, w + j, amount)
            at += stride
            w += stride_w


@njit(cache=True, nogil=True)
def add_bias(bias: int, weights: Any, length: Any, current: Any) -> None:
    """Currents [0, length) grow by the biases; not at all where `bias` is below 0."""
    if bias >= 0:
        for j in range(_U0, length, _LANES):
            add(current, j, weights, np.uint64(bias) + j)


@njit(cache=True, nogil=True)
def fire(
    current: Any, v: Any, potential: Any, threshold: Any, begin: Any, end: Any, spikes: Any, n: Any
) -> Any:
    """A step of the neurons [begin, end); their currents are cleared.

    Args:
        current, v: float32, what neurons get and what they are at.
        potential: float32, filled with u, the potentials before the reset; or None.
        begin, end: uint64, multiples of `BLOCK`.
        spikes: filled with who fired, ascending, from place n on.

    Returns:
        the number of spikes that the list holds now.
    """
    for j in range(begin, end, _BLOCK):
        if potential is None:
            left = fires(current, v, j, threshold)
        else:
            left = fires_kept(current, v, potential, j, threshold)
        while left != _U0:
            spikes[n] = j + lowest(left)
            n += _U1
            left &= left - _U1
    return n


@njit(cache=True, nogil=True)
def step(
    cell: Any,
    count: Any,
    begin: int,
    end: int,
    layers: Any,
    threshold: Any,
    state: Any,
    scratch: Any,
    fired_by: Any,
) -> Any:
    """One time step of the whole network.

    Neurons that get nothing are left alone: they stay below the threshold.

    Args:
        cell, count: non-empty cells and their counts; those at [begin, end) are now.
        layers: (reach, weights, shape, bias) of each layer, as four tuples.
        state: potentials of each layer, changed.
        scratch: (currents, spikes, low, high); currents are zero before and after.
        fired_by: int64 (layers,), grows by the spikes of each layer.

    Returns:
        how many output neurons fired; which ones, the first places of the last list of spikes say.
    """
    reach, weights, shape, bias = layers
    currents, spikes, low, high = scratch
    rows = low.size if begin < end else 0
    _, stride, runs, length = shape[0]
    for y in range(rows):
        low[y], high[y] = np.uint64(currents[0].size), _U0
    for e in range(begin, end):
        at = np.uint64(reach[0][cell[e], 0])
        y = at // stride
        for _ in range(runs):
            low[y] = min(low[y], at)
            high[y] = max(high[y], at + length)
            at += stride
            y += _U1
    scatter(cell, count, begin, end, reach[0], weights[0], shape[0], currents[0])
    n, done = _U0, _U0
    for y in range(rows):
        if low[y] < high[y]:
            # rows need not begin with a block: what two share was done with the first
            first = max(low[y] // _BLOCK * _BLOCK, done)
            done = (high[y] + _BLOCK - _U1) // _BLOCK * _BLOCK
            n = fire(currents[0], state[0], None, threshold, first, done, spikes[0], n)
    fired_by[0] += np.int64(n)
    for k in range(1, len(currents)):
        if n == _U0 and bias[k] < 0:
            continue
        scatter(spikes[k - 1], None, _U0, n, reach[k], weights[k], shape[k], currents[k])
        add_bias(bias[k], weights[k], shape[k][3], currents[k])
        n = fire(
            currents[k],
            state[k],
            None,
            threshold,
            _U0,
            np.uint64(currents[k].size),
            spikes[k],
            _U0,
        )
        fired_by[k] += np.int64(n)
    return n


@njit(cache=True, nogil=True)
def windows(
    cell: Any,
    count: Any,
    offsets: Any,
    begin: int,
    end: int,
    steps: int,
    layers: Any,
    threshold: Any,
    rest: Any,
    state: Any,
    scratch: Any,
    out: Any,
    fired_by: Any,
) -> None:
    """Output spikes of the windows [begin, end), each from rest.

    Args:
        cell, count, offsets: see `analysis.windows.sparse.SparseWindows`.
        rest: potentials of each layer at rest.
        out: int64 (n, classes), filled in its rows [begin, end): spikes of the outputs by class;
            output neuron j is of class j % classes.
        fired_by: int64 (n, layers), likewise, spikes of each layer.
    """
    classes = np.uint64(out.shape[1])
    for i in range(begin, end):
        for k in range(len(state)):
            state[k][:] = rest[k]
        for t in range(i * steps, i * steps + steps):
            n = step(
                cell,
                count,
                offsets[t],
                offsets[t + 1],
                layers,
                threshold,
                state,
                scratch,
                fired_by[i],
            )
            last = scratch[1][len(state) - 1]
            for k in range(n):
                out[i, last[k] % classes] += 1
