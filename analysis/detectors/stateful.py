"""Stateful inference: the network runs through a whole trial and its neurons are never reset.

Everywhere else a window is a separate sample and every neuron starts it at zero. Here each step
continues from the last, as it would on a chip without resets, and the spikes of the last 30 ms
are counted whenever one likes, at no more cost. The weights were trained with resets, and these
neurons neither leak nor have a lower bound, so what a quiet second adds up is still there in the
next; docs/detection.md says what that does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.windows.sparse import SparseWindows


def stateful_spikes(engine: SpikeEngine, x: SparseWindows) -> npt.NDArray[np.uint8]:
    """Return the output spikes of every step of consecutive windows, without resets in between.

    Args:
        engine: the network; see `analysis.networks.training.Fitted.engine`.
        x: n windows that follow each other.

    Returns:
        uint8 (n * steps, 3), by class.

    Raises:
        ValueError: samples of another shape.
    """
    if x.shape != engine.shape:
        raise ValueError(f"samples have the shape {x.shape}; expected {engine.shape}")
    planes = x.dense().reshape(-1, *engine.shape[1:])
    out = np.zeros((len(planes), len(CLASSES)), np.uint8)
    stream = engine.stream()
    for step, plane in enumerate(planes):
        out[step] = stream.push(plane)
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
