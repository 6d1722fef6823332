"""The way back through the event-driven network: gradients of weights for windows of spikes.

With u the potential before the reset, g(t) the gradient by a neuron's spikes and s the surrogate
slope, dL/du(t) = g(t) s(u(t)) + [no spike at t] dL/du(t+1) and du(t)/dI(t) = 1. The reset is not
differentiated, as in Sinabs. s(u) = scale / width exp(-|u - threshold| / width) (Shrestha and
Orchard, 2018). A weight's gradient is the sum of dL/dI over the spikes that went through it: a run
of numbers a spike, as on the way forward (gather). Gradients by spikes have no zeros, so the way
from a layer to the one below is dense; but it ends at the first event of a window.

The order of sums is that of the loops and vector lanes: the same on every run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from analysis.spiking_kernels import fire, scatter, scatter_counts

_F0, _F1 = np.float32(0.0), np.float32(1.0)
_U0, _U1, _U2, _U3 = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
_LEAST = np.float32(-80.0)
"""exp below it is nothing (and would make denormal numbers, which are slow)."""


@njit(cache=True, nogil=True)
def forward_kept(
    cell: Any, count: Any, offsets: Any, row: int, steps: int, layers: Any, threshold: Any,
    rest: Any, state: Any, scratch: Any, potentials: Any, lists: Any, ends: Any, out: Any,
) -> None:  # fmt: skip
    """One window forward, with what the way back needs.

    Args:
        potentials: of each layer float32 (steps, neurons), filled with u.
        lists: of each layer, filled with its spikes, one step after the other.
        ends: of each layer uint64 (steps + 1,), filled with where a step's spikes end.
        out: int64 (3,), grows by the output spikes.
        the rest: see `analysis.spiking_kernels`.
    """
    reach, weights, stride_w, stride = layers
    currents, fired, words, _, _, _ = scratch
    last = len(state) - 1
    for k in range(len(state)):
        state[k][:] = rest[k]
        ends[k][0] = _U0
    for t in range(steps):
        at = row * steps + t
        scatter_counts(
            cell, count, offsets[at], offsets[at + 1], reach[0], weights[0], stride_w[0],
            stride[0], currents[0],
        )  # fmt: skip
        for k in range(len(state)):
            if k > 0:
                scatter(
                    lists[k - 1], ends[k - 1][t], ends[k - 1][t + 1], reach[k], weights[k],
                    stride_w[k], stride[k], currents[k],
                )  # fmt: skip
            ends[k][t + 1] = fire(
                currents[k], state[k], potentials[k][t], threshold, fired, words, _U0,
                np.uint64(currents[k].size), lists[k], ends[k][t],
            )  # fmt: skip
    for e in range(ends[last][steps]):
        if lists[last][e] < out.size:
            out[lists[last][e]] += 1


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
def _through(g: Any, u: Any, threshold: Any, width: Any, scale: Any, du: Any) -> None:
    """dL/du(t+1) in `du` becomes dL/du(t); all (m,)."""
    height, inverse = scale / width, _F1 / width
    for j in range(u.size):
        over = u[j] - threshold
        carried = _F0 if over >= _F0 else du[j]
        du[j] = g[j] * (height * _exp(-abs(over) * inverse)) + carried


@njit(cache=True, nogil=True, fastmath={"contract"})
def _below_full(du: Any, w: Any, g: Any) -> None:
    """Gradient by the spikes below a full layer: g (m,) = du (k,) @ w (k, m), four rows at once."""
    g[:] = _F0
    k = 0
    while k + 4 <= w.shape[0]:
        d0, d1, d2, d3 = du[k], du[k + 1], du[k + 2], du[k + 3]
        w0, w1, w2, w3 = w[k], w[k + 1], w[k + 2], w[k + 3]
        for j in range(g.size):
            g[j] += (d0 * w0[j] + d1 * w1[j]) + (d2 * w2[j] + d3 * w3[j])
        k += 4
    while k < w.shape[0]:
        row, d = w[k], du[k]
        for j in range(g.size):
            g[j] += d * row[j]
        k += 1


@njit(cache=True, nogil=True, fastmath={"contract"})
def _below_strided(du: Any, pixels: Any, w: Any, rows: int, stride: Any, taps: Any, g: Any) -> None:
    """Gradient by the spikes of layer 1 from that by layer 2's currents.

    A pixel's taps are summed up aside, where they are one run, and then added to the plane.

    Args:
        du: flat plane of layer 2.
        pixels: uint32 (pixels, 2): a pixel's first neuron in `du`, and where its first tap falls
            in `g`.
        w: (channels of layer 2, taps of a pixel), row by row of the kernel.
        rows: of the kernel.
        stride: uint64, from a row of `g` to the next.
        taps: scratch, (taps of a pixel,).
        g: flat plane of layer 1.
    """
    g[:] = _F0
    channels, size = w.shape
    run = np.uint64(size // rows)
    for i in range(pixels.shape[0]):
        first, at = np.uint64(pixels[i, 0]), np.uint64(pixels[i, 1])
        taps[:] = _F0
        o = 0
        while o + 4 <= channels:
            n = first + np.uint64(o)
            d0, d1, d2, d3 = du[n], du[n + _U1], du[n + _U2], du[n + _U3]
            w0, w1, w2, w3 = w[o], w[o + 1], w[o + 2], w[o + 3]
            for j in range(size):
                taps[j] += (d0 * w0[j] + d1 * w1[j]) + (d2 * w2[j] + d3 * w3[j])
            o += 4
        while o < channels:
            row, d = w[o], du[first + np.uint64(o)]
            for j in range(size):
                taps[j] += d * row[j]
            o += 1
        k = _U0
        for _ in range(rows):
            for j in range(run):
                g[at + j] += taps[k + j]
            k += run
            at += stride


@njit(cache=True, nogil=True, fastmath={"contract"})
def _gather(
    sources: Any, counts: Any, begin: Any, end: Any, reach: Any, du: Any, stride_w: Any,
    stride: Any, grad: Any,
) -> None:  # fmt: skip
    """What a source adds to currents, the gradient by its weights gets from them."""
    for e in range(begin, end):
        s = sources[e]
        at, w = np.uint64(reach[s, 0]), np.uint64(reach[s, 1])
        length = np.uint64(reach[s, 3])
        amount = _F1 if counts is None else np.float32(counts[e])
        for _ in range(reach[s, 2]):
            for j in range(length):
                grad[w + j] += amount * du[at + j]
            at += stride
            w += stride_w


@njit(cache=True, nogil=True)
def backward(
    cell: Any, count: Any, offsets: Any, row: int, steps: int, layers: Any, back: Any,
    constants: Any, potentials: Any, lists: Any, ends: Any, by_count: Any, planes: Any,
    grads: Any,
) -> None:  # fmt: skip
    """One window back: grows the gradients of the packed weights.

    Args:
        back: (pixels, weights and kernel rows of layer 2, weights of layer 3 (H, F), of layer 4
            (3, H)).
        constants: threshold, width and scale of the surrogate.
        potentials, lists, ends: from `forward_kept`.
        by_count: float32, gradient by the window's output counts, zero beyond the three.
        planes: scratch, (dL/du of each layer, gradient by the spikes of layers 1 to 3, taps of a
            pixel).
        grads: of each layer, in the packed order.
    """
    reach, _, stride_w, stride = layers
    pixels, back2, rows, back3, back4 = back
    threshold, width, scale = constants
    du, g, taps = planes
    for k in range(len(du)):
        du[k][:] = _F0
    start = 0
    while start < steps and offsets[row * steps + start] == offsets[row * steps + start + 1]:
        start += 1
    for t in range(steps - 1, start - 1, -1):
        _through(by_count, potentials[3][t], threshold, width, scale, du[3])
        _below_full(du[3], back4, g[2])
        _through(g[2], potentials[2][t], threshold, width, scale, du[2])
        _below_full(du[2], back3, g[1])
        _through(g[1], potentials[1][t], threshold, width, scale, du[1])
        _below_strided(du[1], pixels, back2, rows, stride[0], taps, g[0])
        _through(g[0], potentials[0][t], threshold, width, scale, du[0])
        for k in range(1, len(du)):
            _gather(
                lists[k - 1], None, ends[k - 1][t], ends[k - 1][t + 1], reach[k], du[k],
                stride_w[k], stride[k], grads[k],
            )  # fmt: skip
        at = row * steps + t
        _gather(
            cell, count, offsets[at], offsets[at + 1], reach[0], du[0], stride_w[0], stride[0],
            grads[0],
        )  # fmt: skip
