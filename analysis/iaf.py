"""The same network, faster: integrate-and-fire over all time steps in one pass of memory.

Sinabs steps through time in Python and makes half a dozen tensors at every step. The neuron
needs one number of state, so a compiled loop does a whole window with one read and one write of
each value. The dense layers stay torch's, called once with time folded into the batch, exactly as
Sinabs calls them: the currents are the same to the bit, so the spikes are the same too.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from numba import njit
from sinabs.activation import MembraneReset, SingleExponential, SingleSpike
from sinabs.layers import IAFSqueeze
from torch import nn

from analysis.metrics import CLASSES
from analysis.network import check_samples

INFERENCE_BATCH = 16
"""Samples at a time without gradients: their currents stay in the processor's cache."""

_F0, _F1, _F2 = np.float32(0.0), np.float32(1.0), np.float32(2.0)


@njit(cache=True, nogil=True)
def _fire(current: Any, threshold: Any, spikes: Any) -> None:
    """Spikes of currents (n, steps, features); `spikes` may be `current` itself."""
    n, steps, features = current.shape
    v = np.empty(features, np.float32)
    for i in range(n):
        v[:] = _F0
        for t in range(steps):
            for f in range(features):
                u = v[f] + current[i, t, f]
                fired = u - threshold >= _F0
                spikes[i, t, f] = _F1 if fired else _F0
                v[f] = _F0 if fired else u


@njit(cache=True, nogil=True)
def _fire_and_keep(current: Any, threshold: Any, spikes: Any, potential: Any) -> None:
    """As `_fire`, and keeps the potentials before the reset for the way back."""
    n, steps, features = current.shape
    v = np.empty(features, np.float32)
    for i in range(n):
        v[:] = _F0
        for t in range(steps):
            for f in range(features):
                u = v[f] + current[i, t, f]
                potential[i, t, f] = u
                fired = u - threshold >= _F0
                spikes[i, t, f] = _F1 if fired else _F0
                v[f] = _F0 if fired else u


@njit(cache=True, nogil=True, inline="always")
def _exp(x: Any) -> Any:
    """exp(x) for x <= 0, float32, without a call, so that the loop around it is vectorised.

    2^k times the Taylor sum of the rest in |r| <= ln(2)/2; relative error under 2e-7. Below -80
    it gives exp(-80), which is nothing.
    """
    x = max(x, np.float32(-80.0))
    k = np.floor(x * np.float32(1.4426950408889634) + np.float32(0.5))
    # ln 2 in two parts (the first has few digits) keeps the rest exact
    r = (x - k * np.float32(0.693359375)) + k * np.float32(2.12194440e-4)
    p = np.float32(1.0 / 5040.0)
    p = p * r + np.float32(1.0 / 720.0)
    p = p * r + np.float32(1.0 / 120.0)
    p = p * r + np.float32(1.0 / 24.0)
    p = p * r + np.float32(1.0 / 6.0)
    p = p * r + np.float32(0.5)
    p = p * r + _F1
    p = p * r + _F1
    power = np.int32((np.int32(k) + np.int32(127)) << np.int32(23))
    return p * power.view(np.float32)


@njit(cache=True, nogil=True)
def _back(grad: Any, potential: Any, threshold: Any, width: Any, scale: Any, out: Any) -> None:
    """Gradient by the currents from that by the spikes, all (n, steps, features).

    With u the potential before the reset: dL/du(t) = g(t) s(u(t)) + [no spike at t] dL/du(t+1),
    s(u) = scale / width exp(-|u - threshold| / width) (Shrestha and Orchard, 2018), and
    du(t)/dI(t) = 1. The reset is not differentiated, as in Sinabs.
    """
    n, steps, features = grad.shape
    carry = np.empty(features, np.float32)
    height = scale / width
    inverse = _F1 / width
    for i in range(n):
        carry[:] = _F0
        for t in range(steps - 1, -1, -1):
            for f in range(features):
                over = potential[i, t, f] - threshold
                slope = height * _exp(-abs(over) * inverse)
                kept = _F0 if over >= _F0 else carry[f]
                total = grad[i, t, f] * slope + kept
                out[i, t, f] = total
                carry[f] = total


class FusedIAF(torch.autograd.Function):
    """Spikes of currents (n, steps, features) float32, contiguous; states start at zero."""

    @staticmethod
    def forward(
        ctx: Any, current: torch.Tensor, threshold: float, width: float, scale: float
    ) -> torch.Tensor:
        """Float32 (n, steps, features) of zeros and ones."""
        spikes, potential = torch.empty_like(current), torch.empty_like(current)
        _fire_and_keep(
            current.detach().numpy(), np.float32(threshold), spikes.numpy(), potential.numpy()
        )
        ctx.save_for_backward(potential)
        ctx.constants = (np.float32(threshold), np.float32(width), np.float32(scale))
        return spikes

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        """Surrogate gradient by the currents."""
        (potential,) = ctx.saved_tensors
        out = torch.empty_like(potential)
        _back(grad.contiguous().numpy(), potential.numpy(), *ctx.constants, out.numpy())
        return out, None, None, None


def fused_layers(net: nn.Sequential, x: torch.Tensor) -> dict[str, torch.Tensor]:
    """Spikes of every spiking layer, by its name, with the weights of a Sinabs network.

    Args:
        net: from `analysis.network.build`. Its own neuron states are neither used nor changed.
        x: (n, steps, channels, height, width) float32.

    Returns:
        name -> float32 (n, steps, features), differentiable by the weights.

    Raises:
        ValueError: samples of another shape.
        TypeError: the network holds a neuron that the fused loop does not compute.
    """
    check_samples(net, tuple(x.shape))
    n, steps = x.shape[:2]
    spikes: dict[str, torch.Tensor] = {}
    y = x.flatten(0, 1)
    for name, layer in net.named_children():
        if isinstance(layer, IAFSqueeze):
            constants = _constants(name, layer)
            current = y.contiguous().view(n, steps, -1)
            if current.requires_grad:
                fired = FusedIAF.apply(current, *constants)  # type: ignore[no-untyped-call]
            else:
                fired = current  # nobody else holds the currents: write over them
                _fire(current.numpy(), np.float32(constants[0]), fired.numpy())
            spikes[name] = fired
            y = fired.view(y.shape)
        else:
            y = layer(y)
    return spikes


def fused_forward(net: nn.Sequential, x: torch.Tensor) -> torch.Tensor:
    """Output spikes summed over time, float32 (n, 3); see `fused_layers`."""
    *_, last = fused_layers(net, x).values()
    return last.sum(dim=1)


def fused_counts(
    net: nn.Sequential,
    x: npt.NDArray[Any],
    batch: int = INFERENCE_BATCH,
    pool: Executor | None = None,
) -> npt.NDArray[np.int64]:
    """`analysis.network.spike_counts`, faster: int64 (n, 3) for x (n, T, C, H, W).

    One batch is computed in the calling thread; more are shared among the threads of `pool`, by
    default those of `lone_workers`.

    Raises:
        ValueError: samples of another shape.
    """
    check_samples(net, x.shape)
    out = np.zeros((len(x), len(CLASSES)), np.int64)

    def one(start: int) -> None:
        part = torch.from_numpy(x[start : start + batch].astype(np.float32))
        with torch.no_grad():
            out[start : start + batch] = fused_forward(net, part).numpy().astype(np.int64)

    starts = range(0, len(x), batch)
    if len(starts) <= 1:
        list(map(one, starts))
    elif pool is not None:
        list(pool.map(one, starts))
    else:
        with lone_workers() as pool:
            list(pool.map(one, starts))
    return out


@contextmanager
def lone_workers() -> Iterator[ThreadPoolExecutor]:
    """As many threads as torch may use, in each of which torch computes alone.

    torch would share every single operation among its threads, which wait for each other after
    each: on a machine with other work to do that was eight times slower. Whole batches side by
    side never wait, and their results do not depend on the number of threads. The calling thread
    computes alone too while it lasts.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            yield pool
    finally:
        torch.set_num_threads(count)


def _constants(name: str, layer: Any) -> tuple[float, float, float]:
    """Threshold, width and scale of a neuron; a TypeError if it is not the paper's."""
    surrogate = layer.surrogate_grad_fn
    if not (
        layer.spike_fn is SingleSpike
        and layer.reset_fn == MembraneReset(0.0)
        and type(surrogate) is SingleExponential
        and layer.min_v_mem is None
        and layer.tau_syn is None
    ):
        raise TypeError(f"{name}: the fused loop computes only single spikes with reset to zero")
    threshold = float(layer.spike_threshold)
    return threshold, threshold * surrogate.grad_width, surrogate.grad_scale
