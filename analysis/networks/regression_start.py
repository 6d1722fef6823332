"""First weights by the data, for sensors of taxels: the network begins as a logistic regression.

A random draw needs sizes and scales that fit the rates of a data set. Here they follow from it.
Each input has a neuron in both first layers, which passes its events on. The full layers begin as
a multinomial logistic regression on the spikes of these neurons, with `SPREAD` between the neurons
of a class, so that they do not fire as one. A non-leaking neuron turns its summed current into a
rate, so the counts of the outputs rank the classes as the regression does (Rueckauer et al.,
Frontiers in Neuroscience 11:682, 2017). Training begins there; hidden neurons beyond those of the
regression begin at random, and may learn what it lacks.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from sliplab.analysis.metrics.classification import Labels
from sliplab.analysis.networks.baselines import fit_logistic
from sliplab.analysis.networks.network import classes_of, set_weights, weights
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import MOST_CHANNELS, NetworkSettings
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import F64

SPARE = 100
"""Hidden neurons beyond those of the regression."""
PASSED = 1.5
"""Weight of a connection that passes every spike on, in thresholds: training may lower it by a
third before a spike is lost."""
MOST_RATE = 0.5
"""Spikes of a first neuron in a step, at the most; more would leave nothing to tell apart."""
WEAKEST = 2.0**-8
"""Least weight of an event, for sensors with very many, in thresholds."""
LEAD, IDLE = 0.6, 0.15
"""Current of the regression's choice above the mean class, and of the mean class, in thresholds a
step."""
STRONGEST = 4.0
"""Largest weight of a spike, in thresholds: a taxel that fires in few windows has a steep slope,
and sums of weights must stay exact (`networks.network.EXACT`)."""
SPREAD = 0.3
"""Of the gains of a class's neurons, between the first and beyond the last, relative."""
CHUNK = 256
"""Windows that are looked at together."""


def sized(network: NetworkSettings, windows: Windows, classes: int) -> NetworkSettings:
    """Return the settings with the sizes that the start needs; a random start is left as it is."""
    if network.start == "random":
        return network
    sizes = {
        "start": "random",  # the weights of a trained network are given
        "conv1_channels": windows.channels,
        "conv2_channels": windows.channels,
        "conv1_kernel": 1,
        "conv2_kernel": 1,
        "hidden": min(classes * network.outputs_per_class + SPARE, MOST_CHANNELS),
        "weight_scale": (1.0, 1.0, 1.0, 1.0),
    }
    return NetworkSettings.model_validate({**network.model_dump(), **sizes})


def begin(net: nn.Sequential, x: SparseWindows, y: Labels) -> None:
    """Put the first weights into a network of these sizes.

    Args:
        x: event counts (n, steps, channels, 1, 1) to learn from.
        y: their classes, integer (n,).
    """
    classes, steps = classes_of(net), x.shape[0]
    gain = _gain(x)
    features = passed(x, gain)
    fitted = fit_logistic(features, np.asarray(y, np.int64), classes)
    slope = fitted.weights[1:] / fitted.scale[:, None]
    offset = fitted.weights[0] - fitted.mean @ slope
    scores = features @ slope + offset
    lead = float((scores.max(axis=1) - scores.mean(axis=1)).mean())
    unit = LEAD * steps / max(lead, 1e-9)

    values = weights(net)
    outputs = len(values["fc2.weight"])
    copies = outputs // classes
    for name, weight in (("conv1", gain), ("conv2", PASSED)):
        values[f"{name}.weight"] = weight * torch.eye(features.shape[1])[:, :, None, None]
    for output in range(outputs):
        kind, copy = output % classes, output // classes
        scale = unit * (1.0 + SPREAD * ((copy + 0.5) / copies - 0.5))
        steep = np.clip(scale * slope[:, kind], -STRONGEST, STRONGEST)
        values["fc1.weight"][output] = torch.from_numpy(steep).float()
        drive = (offset[kind] - scores.mean()) * scale / steps + IDLE
        values["fc1.bias"][output] = float(drive)
    values["fc2.weight"].zero_()
    values["fc2.weight"][:, :outputs] = PASSED * torch.eye(outputs)
    values["fc2.bias"].zero_()
    set_weights(net, values)


def passed(x: SparseWindows, gain: float) -> F64:
    """Spikes of a neuron of each input over a window (n, channels), by the paper's neuron.

    Args:
        x: event counts (n, steps, channels, 1, 1).
        gain: weight of an event, in thresholds.
    """
    found = []
    for first in range(0, len(x), CHUNK):
        part = x.take(np.arange(first, min(first + CHUNK, len(x)))).dense()[..., 0, 0]
        potential = np.zeros((len(part), part.shape[2]))
        spikes = np.zeros_like(potential)
        for step in range(part.shape[1]):
            potential += gain * part[:, step]
            fires = potential >= 1.0
            spikes += fires
            potential[fires] = 0.0
        found.append(spikes)
    return np.concatenate(found)


def _gain(x: SparseWindows) -> float:
    """Return the weight of an event at which the first neurons fire seldom enough."""
    some = x.take(np.unique(np.linspace(0, len(x) - 1, CHUNK).astype(np.int64)))
    gain = PASSED
    while gain > WEAKEST and passed(some, gain).mean() > MOST_RATE * x.shape[0]:
        gain /= 2.0
    return gain
