"""The same network in the libraries that a user would pick, for those that are installed.

Each has the same weights and dense layers with time folded into the batch, and its own
integrate-and-fire neuron with a reset to zero. Their surrogate gradients and details of the reset
differ from the paper's, so spike counts do too: only time is compared. They are installed in an
environment of their own, because they ask for other versions of torch.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import torch
from torch import nn

from sliplab.analysis.networks.network import WEIGHTED, build, by_class
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows

Neuron = Callable[[torch.Tensor], torch.Tensor]
"""Currents (n, steps, ...) to spikes of the same shape, from rest."""


def installed() -> dict[str, Callable[[], Neuron]]:
    """Makers of neurons, by library."""
    makers: dict[str, tuple[str, Callable[[], Neuron]]] = {
        "snntorch": ("snntorch", _snntorch),
        "spikingjelly": ("spikingjelly", _spikingjelly),
        "norse": ("norse", _norse),
    }
    return {name: make for name, (module, make) in makers.items() if find_spec(module)}


class RivalNetwork(nn.Module):
    """The network with another library's neurons."""

    def __init__(self, make: Callable[[], Neuron], windows: Windows, seed: int) -> None:
        super().__init__()
        net = build(NetworkSettings(), windows, seed)
        self.dense = nn.ModuleList([getattr(net, name) for name in WEIGHTED])
        self._fire = [make() for _ in WEIGHTED]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Output spikes (n, 3) of samples (n, steps, channels, cells, cells)."""
        n, steps = x.shape[:2]
        y = x.flatten(0, 1)
        for layer, fire in zip(self.dense, self._fire, strict=True):
            if isinstance(layer, nn.Linear):
                y = y.flatten(1)
            y = layer(y)
            y = fire(y.unflatten(0, (n, steps))).flatten(0, 1)
        return by_class(y.unflatten(0, (n, steps)).sum(dim=1))


def _stepwise(step: Callable[[torch.Tensor, Any], tuple[torch.Tensor, Any]], start: Any) -> Neuron:
    def fire(current: torch.Tensor) -> torch.Tensor:
        state = start(current[:, 0])
        spikes = []
        for t in range(current.shape[1]):
            spike, state = step(current[:, t], state)
            spikes.append(spike)
        return torch.stack(spikes, dim=1)

    return fire


def _snntorch() -> Neuron:
    import snntorch  # type: ignore[import-not-found,unused-ignore]  # where it is installed

    neuron = snntorch.Leaky(beta=1.0, threshold=1.0, reset_mechanism="zero")
    return _stepwise(neuron, torch.zeros_like)


def _spikingjelly() -> Neuron:
    from spikingjelly.activation_based import (  # type: ignore[import-not-found,unused-ignore]
        functional,
        neuron,
    )

    node = neuron.IFNode(v_threshold=1.0, v_reset=0.0, step_mode="m")

    def fire(current: torch.Tensor) -> torch.Tensor:
        functional.reset_net(node)
        spikes: torch.Tensor = node(current.transpose(0, 1))
        return spikes.transpose(0, 1)

    return fire


def _norse() -> Neuron:
    from norse.torch.functional.iaf import (  # type: ignore[import-not-found,unused-ignore]
        IAFFeedForwardState,
        iaf_feed_forward_step,
    )

    return _stepwise(
        iaf_feed_forward_step, lambda current: IAFFeedForwardState(v=torch.zeros_like(current))
    )
