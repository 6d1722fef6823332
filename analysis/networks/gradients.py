"""Loss and gradients of a batch of windows: by the event-driven kernels, or by torch on a GPU.

The kernels (`networks.spiking`) are for processors. On a GPU Sinabs runs a layer step by step, some
ten small kernels each, and the GPU waits for launches. So a layer's loop over time, forward and
backward, is one function each that `torch.compile` fuses (Triton's on a GPU). Where that cannot be,
Sinabs' own layers compute; they define what the others must give.

Weights are on the grid (`networks.network.on_grid`) and all sums are whole float32, so the spikes
are those of the processor to the last one. Convolutions are products of matrices, because the
libraries' fast convolutions (Winograd, Fourier) pass through numbers that are off the grid.
Gradients agree to rounding, so a training on a GPU ends with other last bits.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.metrics.classification import IntArray
from sliplab.analysis.networks.network import (
    SPIKING,
    WEIGHTED,
    by_class,
    by_parameter,
    classes_of,
    parameters,
    reset_states,
    set_matrices,
)
from sliplab.analysis.networks.spiking import Trainer, WindowGradients, neuron
from sliplab.analysis.windows.sparse import SparseWindows


@dataclass(frozen=True)
class GradientBatch:
    """Loss, spikes and gradients of a batch.

    Attributes:
        loss: summed over windows.
        counts: output spikes int64 (n, classes).
        fired: of each spiking layer, spikes per neuron and step, summed over windows.
        gradients: of the summed loss, float32, by parameter; biases that the network has not may
            be among them.
    """

    loss: float
    counts: IntArray
    fired: dict[str, float]
    gradients: dict[str, torch.Tensor]


class Work(Protocol):
    """Engine that computes batches with the weights set last."""

    def take(self, weights: list[npt.NDArray[np.float32]]) -> None:
        """Use these (`analysis.networks.network.matrices`) from now on."""

    def batch(self, x: SparseWindows, y: IntArray, rows: IntArray, pool: Executor) -> GradientBatch:
        """Loss and gradients of the windows `rows` with their labels ``y[rows]``."""


MICRO_BATCH = 4
"""Samples whose gradients are computed at once by the kernels; they are summed up to
``training.batch``. Small enough for the processor's cache, and to give every thread something to
do."""


def work_on(device: str, net: nn.Sequential, cells: int, gain: float) -> Work:
    """Computation of batches on a device.

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

    def batch(self, x: SparseWindows, y: IntArray, rows: IntArray, pool: Executor) -> GradientBatch:
        """Compute parts in any order and sum them in theirs: the same bits with any threads."""

        def compute(some: IntArray) -> WindowGradients:
            return self._trainer.gradients(x, some, y[some], self._gain)

        parts = [rows[k : k + MICRO_BATCH] for k in range(0, len(rows), MICRO_BATCH)]
        done = list(pool.map(compute, parts))
        fired = dict.fromkeys(SPIKING, 0.0)
        for some, found in zip(parts, done, strict=True):
            for name, rate in found.rates.items():
                fired[name] += rate * len(some)
        sums = [
            torch.stack([*map(torch.from_numpy, each)]).sum(dim=0).numpy()
            for each in zip(*(found.grads for found in done), strict=True)
        ]
        return GradientBatch(
            sum(found.loss for found in done),
            np.concatenate([found.counts for found in done]),
            fired,
            by_parameter(self._trainer.layout.unpack(sums)),
        )


def _forward(current: torch.Tensor, threshold: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Spikes and potentials before the reset, both (n, steps, m), of currents (n, steps, m)."""
    v = torch.zeros_like(current[:, 0])
    found = []
    for t in range(current.shape[1]):
        u = v + current[:, t]
        v = torch.where(u - threshold >= 0, 0.0, u)
        found.append(u)
    potentials = torch.stack(found, dim=1)
    return (potentials - threshold >= 0).to(potentials.dtype), potentials


def _backward(
    by_spikes: torch.Tensor, potentials: torch.Tensor, threshold: float, width: float, scale: float
) -> torch.Tensor:
    """The gradient by currents; see `analysis.networks.spiking_gradients` for the formula."""
    carry = torch.zeros_like(by_spikes[:, 0])
    found = []
    for t in reversed(range(by_spikes.shape[1])):
        over = potentials[:, t] - threshold
        slope = scale / width * torch.exp(-over.abs() / width)
        carry = by_spikes[:, t] * slope + torch.where(over >= 0, 0.0, carry)
        found.append(carry)
    return torch.stack(found[::-1], dim=1)


@cache
def _compiled() -> tuple[Callable[..., Any], Callable[..., Any]]:
    return torch.compile(_forward, dynamic=True), torch.compile(_backward, dynamic=True)


class _Fire(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, current: torch.Tensor, constants: tuple[float, float, float]
    ) -> torch.Tensor:
        spikes, potentials = _compiled()[0](current.detach(), constants[0])
        ctx.save_for_backward(potentials)
        ctx.constants = constants
        return cast(torch.Tensor, spikes)

    @staticmethod
    def backward(ctx: Any, by_spikes: torch.Tensor) -> tuple[torch.Tensor, None]:
        (potentials,) = ctx.saved_tensors
        return _compiled()[1](by_spikes.contiguous(), potentials, *ctx.constants), None


class CompiledNeurons(nn.Module):
    """A layer of the paper's neurons, from rest at every call.

    Takes currents (n * steps, ...) and gives spikes of the same shape.
    """

    def __init__(self, steps: int, constants: tuple[float, float, float]) -> None:
        super().__init__()
        self._steps, self._constants = steps, constants

    def forward(self, current: torch.Tensor) -> torch.Tensor:
        """Spikes, 0 or 1."""
        by_step = current.reshape(-1, self._steps, current[0].numel())
        spikes = _Fire.apply(by_step, self._constants)  # type: ignore[no-untyped-call]
        return cast(torch.Tensor, spikes).reshape(current.shape)

    def reset_states(self) -> None:
        """Do nothing: there are no states between calls."""


class ExactConvolution(nn.Conv2d):
    """A convolution as one matrix product, which sums its terms and nothing else."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the convolution of `torch.nn.Conv2d`, in full float32."""
        row_pad, column_pad = cast(tuple[int, int], self.padding)
        taps = nn.functional.pad(x, (column_pad, column_pad, row_pad, row_pad))
        # views: torch.nn.functional.unfold launches some kernels for each image
        for axis, (size, stride) in enumerate(
            zip(self.kernel_size, self.stride, strict=True), start=2
        ):
            taps = taps.unfold(axis, size, stride)
        sums = taps.permute(0, 2, 3, 1, 4, 5).flatten(3) @ self.weight.flatten(1).T
        return sums.permute(0, 3, 1, 2)


def exact_net(net: nn.Sequential) -> nn.Sequential:
    """A copy whose convolutions are products of matrices."""
    made = copy.deepcopy(net)
    for name in WEIGHTED:
        layer = getattr(made, name)
        if isinstance(layer, nn.Conv2d):
            layer.__class__ = ExactConvolution
    return made


def compiled_net(net: nn.Sequential) -> nn.Sequential:
    """The same, and with compiled neurons.

    Raises:
        TypeError: its neurons are not the paper's.
    """
    made = exact_net(net)
    threshold, width, scale = map(float, neuron(net))
    for name in SPIKING:
        steps = int(getattr(net, name).num_timesteps)
        setattr(made, name, CompiledNeurons(steps, (threshold, width, scale)))
    return made


def why_not(device: str, steps: int) -> str | None:
    """Return the reason why neurons cannot be compiled for a device; None where they can.

    Compiling asks for Triton on a GPU and for a C++ compiler on a processor. It takes most of a
    minute, once.
    """
    current = torch.zeros(2, steps, 3, device=device, requires_grad=True)
    try:
        spikes = _Fire.apply(current, (1.0, 0.5, 1.0))  # type: ignore[no-untyped-call]
        torch.autograd.grad(cast(torch.Tensor, spikes).sum(), current)
    except (RuntimeError, ImportError, OSError) as error:  # what the compiler's own errors are
        return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    return None


CPU = "cpu"


def devices() -> list[str]:
    """List the values of `training.device` that this machine has."""
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


@dataclass(frozen=True)
class HeldWindows:
    """Windows held on a device, so that batches are scattered there without copies."""

    windows: SparseWindows
    begin: torch.Tensor
    size: torch.Tensor
    cell: torch.Tensor
    count: torch.Tensor

    @staticmethod
    def of(windows: SparseWindows, device: str) -> HeldWindows:
        offsets = torch.from_numpy(windows.offsets).to(device)
        cell = torch.from_numpy(windows.cell.astype(np.int32)).to(device)
        count = torch.from_numpy(windows.count).to(device)
        steps = windows.shape[0]
        begin, size = offsets[:-1].view(-1, steps), offsets.diff().view(-1, steps)
        return HeldWindows(windows, begin, size, cell, count)

    def dense(self, rows: IntArray) -> torch.Tensor:
        """Counts float32 (n, steps, channels, rows, columns)."""
        chosen = torch.from_numpy(np.asarray(rows, np.int64)).to(self.begin.device)
        begin, size = self.begin[chosen].flatten(), self.size[chosen].flatten()
        ends = size.cumsum(0)
        plane = torch.repeat_interleave(size)
        entry = torch.arange(len(plane), device=plane.device) + (begin - ends + size)[plane]
        flat = torch.zeros(len(size), math.prod(self.windows.shape[1:]), device=plane.device)
        flat[plane, self.cell[entry]] = self.count[entry].float()
        return flat.view(len(rows), *self.windows.shape)


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
        self._held: HeldWindows | None = None
        self._fired: dict[str, torch.Tensor] = {}
        for name in SPIKING:
            getattr(self._net, name).register_forward_hook(self._count(name))

    def _count(self, name: str) -> Any:
        def note(_module: nn.Module, _given: Any, spikes: torch.Tensor) -> None:
            self._fired[name] = spikes.detach().mean()  # read at the end: no GPU sync here

        return note

    def take(self, weights: list[npt.NDArray[np.float32]]) -> None:
        """Use these from now on."""
        set_matrices(self._net, weights)

    def batch(self, x: SparseWindows, y: IntArray, rows: IntArray, pool: Executor) -> GradientBatch:
        """Compute the whole batch at once; the pool is not used."""
        if self._held is None or self._held.windows is not x:
            self._held = HeldWindows.of(x, self._device)
        dense = self._held.dense(rows)
        reset_states(self._net)
        with _exact_sums():
            spikes = self._net(dense.flatten(0, 1)).unflatten(0, (len(rows), -1))
            counts = by_class(spikes.sum(dim=1), classes_of(self._net))
            target = torch.from_numpy(y[rows]).to(self._device)
            loss = nn.functional.cross_entropy(
                self._gain * counts.double(), target, reduction="sum"
            )
            trained = parameters(self._net)
            grads = torch.autograd.grad(loss, list(trained.values()))
        reset_states(self._net)
        return GradientBatch(
            loss.item(),
            counts.detach().cpu().numpy().astype(np.int64),
            {name: float(rate) * len(rows) for name, rate in self._fired.items()},
            {name: grad.cpu() for name, grad in zip(trained, grads, strict=True)},
        )


def _check(device: str) -> None:
    if device not in devices():
        raise ValueError(f"device {device}: must be one of {', '.join(devices())}")


@contextmanager
def _exact_sums() -> Iterator[None]:
    """Force full float32: a GPU's shorter TF32 cannot represent the grid."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before
