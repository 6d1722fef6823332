"""Loss and gradients of a batch of windows on a GPU, or by any device of torch's.

Neurons are compiled (`networks.compiled_neuron`) where that can be, else they are Sinabs' own
layers, which are what both are the definition of. Weights are on the grid
(`analysis.networks.network.on_grid`) and all sums are whole float32, so the spikes are those of the
processor to the last one; gradients agree to rounding, so a training ends with other last bits.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.metrics.classification import IntArray
from sliplab.analysis.networks.compiled_neuron import compiled_net, exact_net, why_not
from sliplab.analysis.networks.network import (
    SPIKING,
    by_class,
    parameters,
    reset_states,
    set_matrices,
)
from sliplab.analysis.networks.training_batch import Batch
from sliplab.analysis.windows.sparse import SparseWindows

CPU = "cpu"


def devices() -> list[str]:
    """What `training.device` may be on this machine."""
    found = torch.cuda.device_count()
    return [CPU, *(["cuda"] if found else []), *(f"cuda:{k}" for k in range(found))]


def on_device(net: nn.Sequential, gain: float, device: str) -> OnDevice:
    """Compiled neurons, or Sinabs' with a warning that says why.

    Raises:
        ValueError: there is no such device.
    """
    _check(device)
    iaf1: Any = net.iaf1
    reason = why_not(device, int(iaf1.num_timesteps))
    if reason is not None:
        warnings.warn(
            f"neurons could not be compiled for {device}, Sinabs' layers compute: {reason}",
            stacklevel=2,
        )
    return OnDevice(net, gain, device, compiled=reason is None)


class OnDevice:
    """The whole network by torch on one device.

    Args:
        net: from `analysis.networks.network.build`; copied.
        gain: what a spike counts in the cross-entropy.
        device: of `devices`.
        compiled: neurons are compiled, not Sinabs'.

    Raises:
        ValueError: there is no such device.
    """

    def __init__(self, net: nn.Sequential, gain: float, device: str, compiled: bool) -> None:
        _check(device)
        self._net = (compiled_net(net) if compiled else exact_net(net)).to(device)
        self._gain, self._device = gain, device
        self._fired: dict[str, torch.Tensor] = {}
        for name in SPIKING:
            getattr(self._net, name).register_forward_hook(self._count(name))

    def _count(self, name: str) -> Any:
        def note(_module: nn.Module, _given: Any, spikes: torch.Tensor) -> None:
            self._fired[name] = spikes.detach().mean()  # asked for at the end: a GPU need not wait

        return note

    def take(self, weights: list[npt.NDArray[np.float32]]) -> None:
        """Use these from now on."""
        set_matrices(self._net, weights)

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
            {name: float(rate) * len(rows) for name, rate in self._fired.items()},
            {name: grad.cpu() for name, grad in zip(wanted, grads, strict=True)},
        )


def _check(device: str) -> None:
    if device not in devices():
        raise ValueError(f"device {device}: must be one of {', '.join(devices())}")


@contextmanager
def _exact_sums() -> Iterator[None]:
    """Whole float32: a GPU's shorter TF32 would not hold the grid."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before
