"""The network run through a whole trial without a pause: its neurons keep what they hold.

Everywhere else a window is a sample of its own and every neuron starts it at zero. Here each step
goes on from the last, as it would on a chip that nobody resets, and the spikes of the last 30 ms
are counted whenever one likes, at no more cost. The weights were trained with resets, and these
neurons neither leak nor have a lower bound, so what a quiet second adds up is still there in the
next; docs/detection.md says what that does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from numba import njit
from torch import nn

from analysis.metrics import CLASSES
from analysis.network import SPIKING, check_samples

CHUNK = 32
"""Windows at a time; results do not depend on it."""


@njit(cache=True, nogil=True)
def _fire_on(current: Any, threshold: Any, potential: Any, spikes: Any) -> None:
    """Spikes of currents (steps, features) from `potential` (features,) on, which it leaves."""
    steps, features = current.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    for t in range(steps):
        for f in range(features):
            u = potential[f] + current[t, f]
            fired = u - threshold >= zero
            spikes[t, f] = one if fired else zero
            potential[f] = zero if fired else u


def carried_spikes(net: nn.Sequential, x: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Output spikes of every step of consecutive windows, states kept from each to the next.

    Args:
        net: from `analysis.network.build` or `analysis.training.restore`; single spikes, reset to
            zero. Its own neuron states are neither used nor changed.
        x: event counts (n, steps, channels, cells, cells), windows that follow each other.

    Returns:
        uint8 (n * steps, 3), 0 or 1.

    Raises:
        ValueError: samples of another shape.
    """
    check_samples(net, x.shape)
    steps = x.shape[1]
    out = np.zeros((len(x) * steps, len(CLASSES)), np.uint8)
    kept: dict[str, npt.NDArray[np.float32]] = {}
    with torch.no_grad():
        for start in range(0, len(x), CHUNK):
            y = torch.from_numpy(x[start : start + CHUNK].astype(np.float32)).flatten(0, 1)
            for name, layer in net.named_children():
                if name not in SPIKING:
                    y = layer(y)
                    continue
                current = y.contiguous().view(len(y), -1)
                potential = kept.setdefault(name, np.zeros(current.shape[1], np.float32))
                threshold = np.float32(float(layer.spike_threshold))  # type: ignore[arg-type]
                spikes = torch.empty_like(current)
                _fire_on(current.numpy(), threshold, potential, spikes.numpy())
                y = spikes.view(y.shape)
            out[start * steps : start * steps + len(y)] = y.numpy().astype(np.uint8)
    return out


def trailing_sums(values: npt.NDArray[Any], length: int, stride: int) -> npt.NDArray[np.int64]:
    """Sums over the last `length` steps, every `stride` steps from the first full window on.

    Args:
        values: whole numbers (steps, k).

    Returns:
        int64 (n, k), of the windows ``[i * stride, i * stride + length)``.
    """
    sums = np.zeros((len(values) + 1, values.shape[1]), np.int64)
    sums[1:] = values.cumsum(axis=0, dtype=np.int64)
    ends = np.arange(length, len(sums), stride)
    return sums[ends] - sums[ends - length]
