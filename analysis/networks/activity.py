"""The cost of a window in spikes: rates by layer, and synaptic operations against multiply-adds.

A chip of spikes works only where a spike arrives, so its cost is counted in synaptic operations:
for each input spike (or event), the synapses that it reaches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.networks.network import SPIKING, WEIGHTED, reset_states
from sliplab.storage.schema.evaluation import WindowCost


@dataclass(frozen=True)
class Activity:
    """Means over some windows, by layer.

    Attributes:
        windows: how many.
        events: that the windows hold.
        rates: spikes per neuron and step of the spiking layers.
        operations: synaptic operations a window of the layers with weights; an event that counts
            k times in its cell is k operations a synapse.
        dense: multiply-adds a window that the same layers take without looking at zeros.
    """

    windows: int
    events: float
    rates: dict[str, float]
    operations: dict[str, float]
    dense: dict[str, int]

    def cost(self) -> WindowCost:
        """Return the document of it, with totals."""
        total, dense = sum(self.operations.values()), sum(self.dense.values())
        return WindowCost(
            windows=self.windows,
            events_a_window=self.events,
            rates=self.rates,
            synaptic_operations={**self.operations, "all": total},
            dense_multiply_adds={**self.dense, "all": dense},
            share_of_dense=total / dense,
        )


def activity(net: nn.Sequential, x: npt.NDArray[np.uint8], batch: int = 64) -> Activity:
    """Count spikes and synaptic operations over windows x (n, T, C, H, W), n at least 1."""
    n, steps = x.shape[:2]
    operations, rates = dict.fromkeys(WEIGHTED, 0.0), dict.fromkeys(SPIKING, 0.0)
    dense: dict[str, int] = {}
    layers: dict[str, Any] = dict(net.named_children())
    with torch.no_grad():
        for start in range(0, n, batch):
            part = torch.from_numpy(x[start : start + batch].astype(np.float32))
            reset_states(net)
            at = part.flatten(0, 1)
            for weighted, spiking in zip(WEIGHTED, SPIKING, strict=True):
                layer = layers[weighted]
                if isinstance(layer, nn.Linear):
                    at = at.flatten(1)
                    # a bias counts as one synapse that is active in every step
                    total = float(at.sum(dtype=torch.float64)) + len(at)
                    operations[weighted] += total * layer.out_features
                    dense[weighted] = steps * (layer.in_features + 1) * layer.out_features
                else:
                    ones = torch.ones_like(layer.weight[:1])
                    reached = nn.functional.conv2d(
                        at, ones, stride=layer.stride, padding=layer.padding
                    )
                    total = float(reached.sum(dtype=torch.float64))
                    operations[weighted] += total * layer.out_channels
                    every = nn.functional.conv2d(
                        torch.ones_like(at[:1]), ones, stride=layer.stride, padding=layer.padding
                    )
                    dense[weighted] = int(steps * layer.out_channels * float(every.sum()))
                at = layers[spiking](layer(at))
                rates[spiking] += float(at.mean(dtype=torch.float64)) * len(part)
    reset_states(net)
    return Activity(
        windows=n,
        events=float(x.sum(dtype=np.int64)) / n,
        rates={name: total / n for name, total in rates.items()},
        operations={name: total / n for name, total in operations.items()},
        dense=dense,
    )
