"""Reference definition of the spiking network, in Sinabs.

The fast kernels (`analysis.networks.spiking`) must reproduce its spike counts.
Sinabs' defaults are not the paper's neuron: an IAF there may fire many times a step and keeps what
is above the threshold, while the paper's fires once and is reset. Nothing here touches Sinabs' chip
back end, because that imports a vendor package which installs things when it is imported.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from sinabs.activation import MembraneReset, SingleExponential, SingleSpike
from sinabs.layers import IAFSqueeze
from torch import nn

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.protocols.network_settings import SPIKE_THRESHOLD, NetworkSettings
from sliplab.protocols.windows import Windows

WEIGHTED = ("conv1", "conv2", "fc1", "fc2")
"""Names of the layers with weights, in order; ``settings.weight_scale`` belongs to them."""

BIASED = ("fc1", "fc2")
"""Those of them with a bias as well, unless the settings leave it out: a current that their neurons
get in every step."""

FIRST_BIAS = (-0.5, 0.5)
"""Between which values the hidden neurons' biases begin, in thresholds a step: half of them fire by
themselves, so that events can also silence."""

FIRST_DRIVE = 0.3
"""Current of every output in a step of a window without events, before training, in thresholds. One
that began far below its threshold would never be reached."""

SPIKING = ("iaf1", "iaf2", "iaf3", "iaf4")
"""Names of the spiking layers, one after each layer of `WEIGHTED`."""

Array = npt.NDArray[Any]
Counts = npt.NDArray[np.int64]


def build(
    settings: NetworkSettings, windows: Windows, seed: int, classes: int = len(CLASSES)
) -> nn.Sequential:
    """A network with fresh weights: conv, conv of stride 2, two fully connected, IAF after each.

    Time is folded into the batch: the modules take (n * steps, channels, cells, cells) float32
    and give (n * steps, outputs) spikes; output j is of class j % classes (`by_class`). Weights are
    torch's default draw times ``settings.weight_scale``; hidden neurons' biases are drawn from
    `FIRST_BIAS`, outputs begin at `FIRST_DRIVE`, and convolutions have no biases
    (docs/decisions/networks.md); with ``settings.biases`` off no layer has. torch's global random
    state is unchanged.

    Args:
        settings: channels, kernels, hidden neurons, outputs, weight scale.
        windows: shape of a sample.
        seed: the same seed gives the same weights to the bit.
        classes: number of classes, at least 2; `classes_of` the network returns it.
    """
    side = math.ceil(windows.cells / 2)
    k1, k2 = settings.conv1_kernel, settings.conv2_kernel
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        conv1 = nn.Conv2d(
            windows.channels, settings.conv1_channels, k1, padding=k1 // 2, bias=False
        )
        conv2 = nn.Conv2d(
            settings.conv1_channels,
            settings.conv2_channels,
            k2,
            stride=2,
            padding=k2 // 2,
            bias=False,
        )
        biases, outputs = settings.biases, classes * settings.outputs_per_class
        fc1 = nn.Linear(settings.conv2_channels * side * side, settings.hidden, bias=biases)
        fc2 = nn.Linear(settings.hidden, outputs, bias=biases)
        if biases:
            nn.init.uniform_(fc1.bias, *FIRST_BIAS)
    layers: tuple[Any, ...] = (conv1, conv2, fc1, fc2)
    with torch.no_grad():
        for layer, scale in zip(layers, settings.weight_scale, strict=True):
            layer.weight.mul_(scale)
        if biases:
            fc2.bias.copy_(FIRST_DRIVE - fc2.weight @ rates_alone(fc1.bias, windows.steps))
    net = nn.Sequential(
        OrderedDict(
            conv1=conv1,
            iaf1=_iaf(windows.steps),
            conv2=conv2,
            iaf2=_iaf(windows.steps),
            flatten=nn.Flatten(),
            fc1=fc1,
            iaf3=_iaf(windows.steps),
            fc2=fc2,
            iaf4=_iaf(windows.steps),
        )
    )
    net.classes = classes  # type: ignore[assignment]  # torch knows only modules and tensors
    return net


def classes_of(net: nn.Sequential) -> int:
    """Return the number of classes of a network of `build`, or of a copy of one."""
    classes: Any = net.classes
    return int(classes)


def rates_alone(bias: torch.Tensor, steps: int) -> torch.Tensor:
    """Spikes a step of neurons that get nothing but their bias, by the paper's neuron (n,).

    A bias b > 0 takes ceil(1 / b) steps from reset to the threshold 1; one that takes more than
    `steps` does not fire within a window.
    """
    wait = torch.ceil(1.0 / bias.clamp(min=0.5 / steps))
    return torch.where((bias > 0) & (wait <= steps), 1.0 / wait, torch.zeros_like(bias))


def _iaf(steps: int) -> IAFSqueeze:
    """One spike a step at most, reset to zero, no lower bound."""
    return IAFSqueeze(
        num_timesteps=steps,
        spike_threshold=torch.tensor(SPIKE_THRESHOLD),
        spike_fn=SingleSpike,
        reset_fn=MembraneReset(),
        surrogate_grad_fn=SingleExponential(),
    )


def parameters(net: nn.Sequential) -> dict[str, nn.Parameter]:
    """Weights and biases by name (``conv1.weight`` ...), in the order of the layers."""
    return {
        f"{layer}.{kind}": getattr(getattr(net, layer), kind)
        for layer in WEIGHTED
        for kind in ("weight", "bias")
        if getattr(getattr(net, layer), kind) is not None
    }


def weights(net: nn.Sequential) -> dict[str, torch.Tensor]:
    """Copies of the same, without gradients."""
    return {name: value.detach().clone() for name, value in parameters(net).items()}


def set_weights(net: nn.Sequential, values: dict[str, torch.Tensor]) -> None:
    """Put weights into a network that `build` made.

    Raises:
        ValueError: a weight is missing or too many, or has another shape.
    """
    expected = parameters(net)
    if set(values) != set(expected):
        raise ValueError(f"weights {sorted(values)}; expected {sorted(expected)}")
    with torch.no_grad():
        for name, parameter in expected.items():
            if values[name].shape != parameter.shape:
                raise ValueError(
                    f"{name} has the shape {tuple(values[name].shape)}; "
                    f"expected {tuple(parameter.shape)}"
                )
            parameter.copy_(values[name])


def by_class(spikes: torch.Tensor, classes: int = len(CLASSES)) -> torch.Tensor:
    """Output spikes (..., outputs) added up by class (..., classes).

    Output j is of class j % classes.
    """
    return spikes.reshape(*spikes.shape[:-1], -1, classes).sum(dim=-2)


def reset_states(net: nn.Sequential) -> None:
    """Put every neuron to potential zero, as before an independent sample."""
    for name in SPIKING:
        getattr(net, name).reset_states()


def check_samples(net: nn.Sequential, shape: tuple[int, ...]) -> None:
    """A ValueError unless `shape` is (n, steps, channels, height, width) of this network."""
    iaf1: Any = net.iaf1
    conv1: Any = net.conv1
    steps, channels = iaf1.num_timesteps, conv1.in_channels
    if len(shape) != 5 or shape[1:3] != (steps, channels):
        raise ValueError(f"samples have the shape {shape}; expected (n, {steps}, {channels}, H, W)")


def spike_counts(net: nn.Sequential, x: Array, batch: int = 64) -> Counts:
    """Output spikes of each sample by Sinabs' own layers: the reference.

    States are reset before every batch, and the samples of a batch have states of their own.

    Args:
        net: from `build`.
        x: event counts (n, steps, channels, height, width), uint8 or float32.
        batch: samples at a time.

    Returns:
        int64 (n, classes); those of slip in the order of `metrics.classification.CLASSES`.

    Raises:
        ValueError: samples of another shape.
    """
    check_samples(net, x.shape)
    classes = classes_of(net)
    out = np.zeros((len(x), classes), np.int64)
    with torch.no_grad():
        for start in range(0, len(x), batch):
            part = torch.from_numpy(x[start : start + batch].astype(np.float32))
            reset_states(net)
            spikes = net(part.flatten(0, 1))
            counts = by_class(spikes.unflatten(0, (len(part), -1)).sum(dim=1), classes)
            out[start : start + batch] = counts.numpy().astype(np.int64)
    reset_states(net)
    return out


GRID = (2.0**-11, 2.0**-14, 2.0**-14, 2.0**-14)
"""Grid step of each layer of `WEIGHTED`; trained weights are multiples of it, see `on_grid`."""

EXACT = 2**24
"""Whole multiples of a grid below it are exact in float32, and so are their sums."""


def matrices(net: nn.Sequential) -> list[npt.NDArray[np.float32]]:
    """Copies of each layer's weights in torch's shape, a bias as one column more.

    A bias is the weight of a source that fires in every step; a layer of `BIASED` without one has
    zeros there.
    """
    found = []
    for name in WEIGHTED:
        layer = getattr(net, name)
        value = layer.weight.detach().numpy()
        if name in BIASED:
            none = np.zeros(len(value), np.float32)
            bias = none if layer.bias is None else layer.bias.detach().numpy()
            value = np.column_stack([value, bias])
        found.append(np.array(value, np.float32))
    return found


def by_parameter(values: list[npt.NDArray[np.float32]]) -> dict[str, torch.Tensor]:
    """The same, as `parameters` names them."""
    found = {}
    for name, value in zip(WEIGHTED, values, strict=True):
        if name in BIASED:
            found[f"{name}.weight"] = torch.from_numpy(np.ascontiguousarray(value[:, :-1]))
            found[f"{name}.bias"] = torch.from_numpy(np.ascontiguousarray(value[:, -1]))
        else:
            found[f"{name}.weight"] = torch.from_numpy(value)
    return found


def set_matrices(net: nn.Sequential, values: list[npt.NDArray[np.float32]]) -> None:
    """Put `matrices` into a network of their shape; biases that it has not are left out."""
    trained = parameters(net)
    set_weights(net, {name: w for name, w in by_parameter(values).items() if name in trained})


def on_grid(values: list[npt.NDArray[np.float32]]) -> list[npt.NDArray[np.float32]]:
    """Weights and biases (`matrices`) of each layer at the nearest points of its grid.

    On the grid every current is a whole multiple of it. Below `EXACT` multiples, 8192 thresholds
    in the first layer and 1024 in the others, float32 holds each partial sum exactly: then Sinabs,
    the event-driven kernels and an exported model give exactly the same spikes in any order of
    summation, at any batch and on any number of threads. The step is 0.05 % of a threshold in the
    first layer, whose inputs are counts of up to 255, and 0.006 % in the others.
    """
    return [
        (np.rint(w / np.float32(step)) * np.float32(step)).astype(np.float32)
        for w, step in zip(values, GRID, strict=True)
    ]


def exact(values: list[npt.NDArray[np.float32]], most: int = 255) -> bool:
    """Check that weights are on the grid and that float32 holds every current exactly.

    Args:
        most: events of a cell and step at the most.
    """
    limits = [EXACT * step / n for step, n in zip(GRID, (most, 1, 1, 1), strict=True)]
    return all(
        np.array_equal(w, rounded) and np.abs(w).reshape(len(w), -1).sum(axis=1).max() < limit
        for w, rounded, limit in zip(values, on_grid(values), limits, strict=True)
    )
