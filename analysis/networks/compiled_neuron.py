"""The network with its neurons' time loop fused by torch's compiler, for a GPU.

Sinabs runs a layer step by step, some ten small kernels each: a GPU then waits for launches. Here a
layer's loop over time, forward and back, is one function each that `torch.compile` fuses into a
kernel or three (Triton's on a GPU), with a neuron's potential in a register. Convolutions are
products of matrices, because the libraries' fast ways to convolve (Winograd's, Fourier's) pass
through numbers that are not on the weights' grid, and then spikes would no longer be the same to
the last one.

The layers keep the names and weights of `analysis.networks.network.build`: what works with the one
works with the other.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import torch
from torch import nn

from sliplab.analysis.networks.network import SPIKING, WEIGHTED
from sliplab.analysis.networks.spiking import neuron


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
    carried = torch.zeros_like(by_spikes[:, 0])
    found = []
    for t in reversed(range(by_spikes.shape[1])):
        over = potentials[:, t] - threshold
        slope = scale / width * torch.exp(-over.abs() / width)
        carried = by_spikes[:, t] * slope + torch.where(over >= 0, 0.0, carried)
        found.append(carried)
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
        """There are none between calls."""


class ExactConvolution(nn.Conv2d):
    """A convolution as one product of matrices: sums of its own terms and of nothing else."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """As of `torch.nn.Conv2d`, in whole float32."""
        size, stride = self.kernel_size, self.stride
        pads = cast(tuple[int, int], self.padding)
        rows, columns = (
            (side + 2 * pad - kernel) // step + 1
            for side, pad, kernel, step in zip(x.shape[2:], pads, size, stride, strict=True)
        )
        taps = nn.functional.unfold(x, size, padding=pads, stride=stride)
        return (self.weight.flatten(1) @ taps).unflatten(2, (rows, columns))  # type: ignore[no-untyped-call]


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
    """Why neurons cannot be compiled for a device, in words; None where they can.

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
