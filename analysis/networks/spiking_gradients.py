"""Backward pass of the event-driven network: gradients of weights for windows of spikes.

With u the potential before the reset, g(t) the gradient by a neuron's spikes and s the surrogate
slope, dL/du(t) = g(t) s(u(t)) + [no spike at t] dL/du(t+1) and du(t)/dI(t) = 1. The reset is not
differentiated, as in Sinabs. s(u) = scale / width exp(-|u - threshold| / width) (Shrestha and
Orchard, 2018). A weight's gradient is the sum of dL/dI over the spikes that went through it: a run
of numbers a spike, as in the forward pass (gather). Gradients by spikes have no zeros, so the
backward pass from a layer to the one below is dense; but it ends at the first event of a window.

The loss is the cross-entropy of a window's own output counts, so a window goes forward and back at
once, while its potentials (some 0.8 MB) are in the cache.

The order of sums is that of the loops and vector lanes: the same on every run.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sliplab.analysis.networks.lanes import LANES, add, add_times
from sliplab.analysis.networks.spiking_kernels import add_bias, fire, scatter
from sliplab.storage.kernels import njit

_F0, _F1 = np.float32(0.0), np.float32(1.0)
_U0, _LANES = np.uint64(0), np.uint64(LANES)
_AT_ONCE = 4
"""Steps per matrix product: few enough for the library to use a single thread."""

_LEAST = np.float32(-80.0)
"""Arguments below which exp counts as 0; it would give denormal numbers, which are slow."""


@njit(cache=True, nogil=True)
def forward_kept(
    cell: Any,
    count: Any,
    offsets: Any,
    row: int,
    steps: int,
    layers: Any,
    spans: Any,
    threshold: Any,
    rest: Any,
    state: Any,
    scratch: Any,
    potentials: Any,
    lists: Any,
    ends: Any,
    out: Any,
) -> None:
    """Run one window forward, and record what the backward pass needs.

    Args:
        spans: of each layer uint64 (n, 2), where its neurons lie; see `fire`.
        potentials: of each layer float32 (steps, neurons), filled with u inside the spans.
        lists: of each layer, filled with its spikes, one step after the other.
        ends: of each layer uint64 (steps + 1,), filled with where a step's spikes end.
        out: int64 (classes,), grows by the output spikes; neuron j is of class j % classes.
        the rest: see `analysis.networks.spiking_kernels`.
    """
    reach, weights, shape, bias = layers
    currents = scratch[0]
    last, classes = len(state) - 1, np.uint64(out.size)
    for k in range(len(state)):
        state[k][:] = rest[k]
        ends[k][0] = _U0
    for t in range(steps):
        at = row * steps + t
        scatter(
            cell, count, offsets[at], offsets[at + 1], reach[0], weights[0], shape[0], currents[0]
        )
        for k in range(len(state)):
            if k > 0:
                scatter(
                    lists[k - 1],
                    None,
                    ends[k - 1][t],
                    ends[k - 1][t + 1],
                    reach[k],
                    weights[k],
                    shape[k],
                    currents[k],
                )
                add_bias(bias[k], weights[k], shape[k][3], currents[k])
            n = ends[k][t]
            for i in range(spans[k].shape[0]):
                n = fire(
                    currents[k],
                    state[k],
                    potentials[k][t],
                    threshold,
                    spans[k][i, 0],
                    spans[k][i, 1],
                    lists[k],
                    n,
                )
            ends[k][t + 1] = n
    for e in range(ends[last][steps]):
        out[lists[last][e] % classes] += 1


@njit(cache=True, nogil=True, inline="always")
def _exp(x: Any) -> Any:
    """exp(x) for x <= 0, float32, without a call, so that the loop around it is vectorised.

    2^k times the Taylor sum of the rest in |r| <= ln(2)/2; relative error under 2e-7. Zero below
    `_LEAST`.
    """
    y = max(x, _LEAST)
    k = np.floor(y * np.float32(1.4426950408889634) + np.float32(0.5))
    # ln 2 in two parts (the first has few digits) keeps the rest exact
    r = (y - k * np.float32(0.693359375)) + k * np.float32(2.12194440e-4)
    p = np.float32(1.0 / 5040.0)
    p = p * r + np.float32(1.0 / 720.0)
    p = p * r + np.float32(1.0 / 120.0)
    p = p * r + np.float32(1.0 / 24.0)
    p = p * r + np.float32(1.0 / 6.0)
    p = p * r + np.float32(0.5)
    p = p * r + _F1
    p = p * r + _F1
    power = np.int32((np.int32(k) + np.int32(127)) << np.int32(23))
    return p * power.view(np.float32) if x > _LEAST else _F0


@njit(cache=True, nogil=True, fastmath={"contract"})
def _through(
    g: Any, u: Any, threshold: Any, width: Any, scale: Any, du: Any, begin: Any, end: Any
) -> None:
    """dL/du(t+1) in `du` becomes dL/du(t); all (m,); neurons [begin, end), uint64."""
    height, inverse = scale / width, _F1 / width
    for j in range(begin, end):
        over = u[j] - threshold
        carry = _F0 if over >= _F0 else du[j]
        du[j] = g[j] * (height * _exp(-abs(over) * inverse)) + carry


@njit(cache=True, nogil=True)
def _back_in_time(
    g: Any, u: Any, start: int, threshold: Any, width: Any, scale: Any, du: Any
) -> None:
    """The gradient by a layer's spikes in `g` (steps, m) becomes dL/du; `du` (m,) is scratch.

    Of the potentials (steps, ...) the first m of a step are meant.
    """
    n = np.uint64(g.shape[1])
    du[:] = _F0
    for t in range(u.shape[0] - 1, start - 1, -1):
        _through(g[t], u[t], threshold, width, scale, du, _U0, n)
        g[t] = du


@njit(cache=True, nogil=True)
def _spread(taps: Any, pixels: Any, rows: int, stride: Any, g: Any) -> None:
    """Return the gradient by the spikes of layer 1: the sum over every pixel's taps.

    Args:
        taps: (pixels with the border, taps of a pixel), row by row of the kernel.
        pixels: uint32 (pixels, 2): a pixel's row in `taps`, and where its first tap falls in `g`.
        rows: of the kernel.
        stride: uint64, from a row of `g` to the next.
        g: flat plane of layer 1.
    """
    g[:] = _F0
    run = np.uint64(taps.shape[1] // rows)
    for i in range(pixels.shape[0]):
        of = taps[pixels[i, 0]]
        at, k = np.uint64(pixels[i, 1]), _U0
        for _ in range(rows):
            for j in range(_U0, run, _LANES):
                add(g, at + j, of, k + j)
            k += run
            at += stride


@njit(cache=True, nogil=True)
def _gather(
    sources: Any, counts: Any, begin: Any, end: Any, reach: Any, du: Any, shape: Any, grad: Any
) -> None:
    """Collect the gradient by a source's weights from the currents it reaches."""
    stride_w, stride, runs, length = shape
    for e in range(begin, end):
        at, w = np.uint64(reach[sources[e], 0]), np.uint64(reach[sources[e], 1])
        amount = _F1 if counts is None else np.float32(counts[e])
        for _ in range(runs):
            for j in range(_U0, length, _LANES):
                if counts is None:
                    add(grad, w + j, du, at + j)
                else:
                    add_times(grad, w + j, du, at + j, amount)
            at += stride
            w += stride_w


@njit(cache=True, nogil=True)
def backward(
    cell: Any,
    count: Any,
    offsets: Any,
    row: int,
    steps: int,
    layers: Any,
    back: Any,
    constants: Any,
    potentials: Any,
    lists: Any,
    ends: Any,
    by_count: Any,
    planes: Any,
    grads: Any,
) -> None:
    """One window back: grows the gradients of the packed weights.

    The three layers above the first go back one after the other, each through all steps; the
    first, whose planes are large, step by step, while a step's planes are in the cache.

    Args:
        back: (where layer 1's neurons lie, uint64 (n, 2); pixels, weights (channels of layer 2,
            taps) and kernel rows of layer 2; weights of layer 3 (H, F), of layer 4
            (outputs, H); all filled up with zeros).
        constants: threshold, width and scale of the surrogate.
        potentials, lists, ends: from `forward_kept`.
        by_count: float32, gradient by the window's spikes of each output, zero beyond the outputs.
        planes: scratch, (dL/du of layers 2 to 4 (steps, neurons), dL/du of the largest layer,
            gradient by the spikes of layer 1, taps of a step).
        grads: of each layer, in the packed order.
    """
    reach, _, shape, bias = layers
    runs, pixels, back2, rows, back3, back4 = back
    threshold, width, scale = constants
    above, du, g, taps = planes
    du2, du3, du4 = above
    channels = back2.shape[0]
    start = 0
    while start < steps and offsets[row * steps + start] == offsets[row * steps + start + 1]:
        start += 1
    for t in range(steps):
        du4[t] = by_count
    _back_in_time(du4, potentials[3], 0, threshold, width, scale, du[: du4.shape[1]])
    np.dot(du4, back4, du3)
    _back_in_time(du3, potentials[2], 0, threshold, width, scale, du[: du3.shape[1]])
    for k in range(2, len(grads)):
        for t in range(steps):
            _gather(
                lists[k - 1],
                None,
                ends[k - 1][t],
                ends[k - 1][t + 1],
                reach[k],
                above[k - 1][t],
                shape[k],
                grads[k],
            )
            if bias[k] >= 0:
                for j in range(_U0, shape[k][3], _LANES):
                    add(grads[k], np.uint64(bias[k]) + j, above[k - 1][t], j)
    for t in range(start, steps, _AT_ONCE):
        until = min(t + _AT_ONCE, steps)
        np.dot(du3[t:until], back3, du2[t:until])
    _back_in_time(du2, potentials[1], start, threshold, width, scale, du[: du2.shape[1]])
    du[:] = _F0
    for t in range(steps - 1, start - 1, -1):
        np.dot(du2[t, : taps.shape[0] * channels].reshape((-1, channels)), back2, taps)
        _spread(taps, pixels, rows, shape[0][1], g)
        for i in range(runs.shape[0]):
            _through(g, potentials[0][t], threshold, width, scale, du, runs[i, 0], runs[i, 1])
        _gather(lists[0], None, ends[0][t], ends[0][t + 1], reach[1], du2[t], shape[1], grads[1])
        at = row * steps + t
        _gather(cell, count, offsets[at], offsets[at + 1], reach[0], du, shape[0], grads[0])


@njit(cache=True, nogil=True)
def windows_loss(
    cell: Any,
    count: Any,
    offsets: Any,
    rows: Any,
    labels: Any,
    gain: float,
    steps: int,
    layers: Any,
    spans: Any,
    back: Any,
    constants: Any,
    rest: Any,
    memory: Any,
    outputs: int,
    by_count: Any,
    out: Any,
    fired: Any,
    grads: Any,
) -> float:
    """Run windows forward and back one by one, so that a window's data stay in the cache.

    Args:
        rows, labels: int64 (n,), which windows, and their classes.
        gain: what a spike counts in the cross-entropy.
        memory: (state, scratch, record (potentials, lists, ends), planes) of one thread.
        outputs: output neurons; neuron j is of class ``j % classes``.
        by_count: scratch float32, zero beyond the outputs.
        out: int64 (n, classes), grows by the output spikes.
        fired: int64 (layers,), grows by every layer's spikes.
        grads: of each layer, in the packed order; grow by the gradient of what is returned.

    Returns:
        the sum of the cross-entropies of the output spike counts times the gain.
    """
    state, scratch, retained, planes = memory
    potentials, lists, ends = retained
    classes, loss = out.shape[1], 0.0
    for i in range(rows.size):
        forward_kept(
            cell,
            count,
            offsets,
            rows[i],
            steps,
            layers,
            spans,
            constants[0],
            rest,
            state,
            scratch,
            potentials,
            lists,
            ends,
            out[i],
        )
        for k in range(fired.size):
            fired[k] += np.int64(ends[k][steps])
        most, total = out[i].max(), 0.0
        for k in range(classes):
            total += math.exp(gain * (out[i, k] - most))
        loss += math.log(total) - gain * (out[i, labels[i]] - most)
        for k in range(classes):
            by_count[k] = np.float32(gain * math.exp(gain * (out[i, k] - most)) / total)
        by_count[labels[i]] -= np.float32(gain)
        for k in range(classes, outputs):
            by_count[k] = by_count[k - classes]
        backward(
            cell,
            count,
            offsets,
            rows[i],
            steps,
            layers,
            back,
            constants,
            potentials,
            lists,
            ends,
            by_count,
            planes,
            grads,
        )
    return loss
