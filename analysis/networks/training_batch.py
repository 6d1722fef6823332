"""What a batch of windows comes to, and what can compute one."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from sliplab.analysis.metrics.classification import IntArray
from sliplab.analysis.windows.sparse import SparseWindows


@dataclass(frozen=True)
class Batch:
    """What the windows of a batch come to.

    Attributes:
        loss: summed over windows.
        counts: output spikes int64 (n, 3).
        fired: of each spiking layer, spikes per neuron and step, summed over windows.
        gradients: of the summed loss, float32, by parameter; biases that the network has not may
            be among them.
    """

    loss: float
    counts: IntArray
    fired: dict[str, float]
    gradients: dict[str, torch.Tensor]


class Work(Protocol):
    """Something that computes batches with the weights that it was last given."""

    def take(self, weights: list[npt.NDArray[np.float32]]) -> None:
        """Use these (`analysis.networks.network.matrices`) from now on."""

    def batch(self, x: SparseWindows, y: IntArray, rows: IntArray, pool: Executor) -> Batch:
        """Loss and gradients of the windows `rows` with their labels ``y[rows]``."""
