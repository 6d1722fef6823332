"""Loss and gradients of a batch of windows: by the event-driven kernels, or on a GPU.

The kernels are for processors; `networks.training_device` is for what `training.device` names
else.
"""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.metrics.classification import IntArray
from sliplab.analysis.networks.network import SPIKING, by_parameter
from sliplab.analysis.networks.spiking import Job, Trainer, WindowLoss
from sliplab.analysis.networks.training_batch import Batch, Work
from sliplab.analysis.networks.training_device import CPU, on_device
from sliplab.analysis.windows.sparse import SparseWindows

MICRO_BATCH = 4
"""Samples whose gradients are computed at once by the kernels; they are summed up to
``training.batch``. Small enough for the processor's cache, and to give every thread something to
do."""


def work_on(device: str, net: nn.Sequential, cells: int, gain: float) -> Work:
    """The way to compute batches on a device.

    Args:
        device: ``cpu``, ``cuda`` or ``cuda:1``, ...
        net: from `analysis.networks.network.build`.
        cells: along a sample's side.
        gain: what a spike counts in the cross-entropy.

    Raises:
        ValueError: there is no such device.
    """
    return EventDriven(net, cells, gain) if device == CPU else on_device(net, gain, device)


class EventDriven:
    """The kernels of `analysis.networks.spiking_gradients`, in the threads of a pool."""

    def __init__(self, net: nn.Sequential, cells: int, gain: float) -> None:
        self._trainer, self._gain = Trainer(net, cells), gain

    def take(self, weights: list[npt.NDArray[np.float32]]) -> None:
        """Use these from now on."""
        self._trainer.take(weights)

    def batch(self, x: SparseWindows, y: IntArray, rows: IntArray, pool: Executor) -> Batch:
        """Parts are computed in any order and added up in theirs: the same bits on any threads."""
        leaves = self._trainer.leaves

        def compute(some: IntArray) -> tuple[float, Job, tuple[torch.Tensor, ...]]:
            job = Job(self._trainer, x, some, y[some], self._gain)
            loss = WindowLoss.apply(job, *leaves)  # type: ignore[no-untyped-call]
            return loss.item(), job, torch.autograd.grad(loss, leaves)

        parts = [rows[k : k + MICRO_BATCH] for k in range(0, len(rows), MICRO_BATCH)]
        done = list(pool.map(compute, parts))
        fired = dict.fromkeys(SPIKING, 0.0)
        for some, (_, job, _) in zip(parts, done, strict=True):
            for name, rate in job.rates().items():
                fired[name] += rate * len(some)
        sums = [
            torch.stack(each).sum(dim=0).numpy()
            for each in zip(*(grads for _, _, grads in done), strict=True)
        ]
        return Batch(
            sum(loss for loss, _, _ in done),
            np.concatenate([job.counts for _, job, _ in done]),
            fired,
            by_parameter(self._trainer.layout.unpack(sums)),
        )
