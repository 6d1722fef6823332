"""Loss and gradients of a batch of windows: by the event-driven kernels, or by Sinabs on a device.

The kernels are for processors. Where `training.device` names a GPU, Sinabs' own layers compute
there: it is what they are the definition of, and the fallback. Weights are on the grid
(`analysis.nets.network.on_grid`), so both count the same spikes to the last one; gradients agree to
rounding, so a training ends with other last bits on another device.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from analysis.nets.metrics import IntArray
from analysis.nets.network import (
    SPIKING,
    by_class,
    by_parameter,
    parameters,
    reset_states,
    set_weights,
)
from analysis.nets.sparse import SparseWindows
from analysis.nets.spiking import Job, Trainer, WindowLoss

MICRO_BATCH = 4
"""Samples whose gradients are computed at once by the kernels; they are summed up to
``training.batch``. Small enough for the processor's cache, and to give every thread something to
do."""

CPU = "cpu"


def devices() -> list[str]:
    """What `training.device` may be on this machine."""
    found = torch.cuda.device_count()
    return [CPU, *(["cuda"] if found else []), *(f"cuda:{k}" for k in range(found))]


@dataclass(frozen=True)
class Batch:
    """What the windows of a batch come to.

    Attributes:
        loss: summed over windows.
        counts: output spikes int64 (n, 3).
        fired: of each spiking layer, spikes per neuron and step, summed over windows.
        gradients: of the summed loss, float32, by parameter.
    """

    loss: float
    counts: IntArray
    fired: dict[str, float]
    gradients: dict[str, torch.Tensor]


class Work(Protocol):
    """Something that computes batches with the weights that it was last given."""

    def take(self, weights: list[npt.NDArray[np.float32]]) -> None:
        """Use these (`analysis.nets.network.matrices`) from now on."""

    def batch(self, x: SparseWindows, y: IntArray, rows: IntArray, pool: Executor) -> Batch:
        """Loss and gradients of the windows `rows` with their labels ``y[rows]``."""


def work_on(device: str, net: nn.Sequential, cells: int, gain: float) -> Work:
    """The way to compute batches on a device.

    Args:
        device: ``cpu``, ``cuda`` or ``cuda:1``, ...
        net: from `analysis.nets.network.build`.
        cells: along a sample's side.
        gain: what a spike counts in the cross-entropy.

    Raises:
        ValueError: there is no such device.
    """
    return EventDriven(net, cells, gain) if device == CPU else BySinabs(net, gain, device)


class EventDriven:
    """The kernels of `analysis.nets.spiking_gradients`, in the threads of a pool."""

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


class BySinabs:
    """Sinabs' own layers on a device of torch's."""

    def __init__(self, net: nn.Sequential, gain: float, device: str) -> None:
        if device not in devices():
            raise ValueError(f"device {device}: must be one of {', '.join(devices())}")
        self._net = copy.deepcopy(net).to(device)
        self._gain, self._device, self._fired = gain, device, dict.fromkeys(SPIKING, 0.0)
        for name in SPIKING:
            getattr(self._net, name).register_forward_hook(self._count(name))

    def _count(self, name: str) -> Any:
        def note(_module: nn.Module, _given: Any, spikes: torch.Tensor) -> None:
            self._fired[name] = float(spikes.detach().mean())

        return note

    def take(self, weights: list[npt.NDArray[np.float32]]) -> None:
        """Use these from now on."""
        set_weights(self._net, by_parameter(weights))

    def batch(self, x: SparseWindows, y: IntArray, rows: IntArray, pool: Executor) -> Batch:
        """The whole batch at once; the pool has nothing to do."""
        dense = torch.from_numpy(x.take(rows).dense()).to(self._device, torch.float32)
        reset_states(self._net)
        with _exact_sums():
            spikes = self._net(dense.flatten(0, 1)).unflatten(0, (len(rows), -1))
            counts = by_class(spikes.sum(dim=1))
            target = torch.from_numpy(y[rows]).to(self._device)
            loss = nn.functional.cross_entropy(
                self._gain * counts.double(), target, reduction="sum"
            )
            wanted = parameters(self._net)
            grads = torch.autograd.grad(loss, list(wanted.values()))
        reset_states(self._net)
        return Batch(
            loss.item(),
            counts.detach().cpu().numpy().astype(np.int64),
            {name: rate * len(rows) for name, rate in self._fired.items()},
            {name: grad.cpu() for name, grad in zip(wanted, grads, strict=True)},
        )


@contextmanager
def _exact_sums() -> Iterator[None]:
    """Whole float32 (a GPU's shorter TF32 would not hold the grid), and the same sums each time."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        with torch.backends.cudnn.flags(deterministic=True, allow_tf32=False):
            yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before
