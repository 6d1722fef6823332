"""Quantisation of the network for the chip: 8-bit weights, integer thresholds, and the effect.

Each layer has one scale. It is the largest whole number that keeps the layer's weights and biases
within 8 bits, and because the threshold is 1 it is the threshold too: exactly, without rounding.
Every potential is then a whole number, which float32 adds without error: what is computed here is
what an integer machine computes.

On the fast kernels, which take one threshold for all layers: a whole potential u reaches a whole
threshold s exactly where m u reaches any T above m (s - 1) and up to m s. So each layer's weights
are multiplied by a whole number per layer, and all layers share one T. Sums stay whole, and float32
holds them exactly below 2^24, which is 2^24 / T thresholds. Potentials are not cut off at the
chip's 16 bits there (`chip_run` does that): those that far down do not come back in a window.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.metrics.classification import winners
from sliplab.analysis.networks.network import (
    SPIKING,
    WEIGHTED,
    build,
    by_class,
    classes_of,
    parameters,
    set_weights,
)
from sliplab.analysis.networks.training import Fitted
from sliplab.storage.kernels import njit
from sliplab.storage.schema.evaluation import CountChange

WEIGHT_BITS, STATE_BITS = 8, 16
"""Of the chip (`plugins/deploy/speck.py` has its limits)."""
LOWEST = np.float32(-(1 << STATE_BITS - 1))
HIGHEST = np.float32((1 << STATE_BITS - 1) - 1)
"""Range of a potential of the chip; it saturates there."""

I8 = npt.NDArray[np.int8]
Counts = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Quantised:
    """A network in whole numbers.

    Attributes:
        weights: int8, weights and biases in torch's layout and by torch's names.
        thresholds: whole thresholds of the spiking layers by name.
        scales: by which weights and threshold of a layer were multiplied.
    """

    weights: dict[str, I8]
    thresholds: dict[str, int]
    scales: dict[str, float]

    def rounding(self, net: nn.Sequential) -> dict[str, float]:
        """RMS of each layer's rounding error, as a share of the RMS of its weights."""
        found = {}
        for name in WEIGHTED:
            real = _numbers(net, name)
            whole = np.concatenate([w.ravel() for k, w in self.weights.items() if _of(name, k)])
            off = whole / self.scales[name] - real
            found[name] = float(np.sqrt((off**2).mean() / (real**2).mean()))
        return found

    def times(self, factors: Mapping[str, int]) -> dict[str, torch.Tensor]:
        """The whole numbers by so many a layer, as `networks.network.set_weights` takes."""
        return {
            key: torch.from_numpy(whole.astype(np.float32) * factors[key.split(".")[0]])
            for key, whole in self.weights.items()
        }


def quantise(net: nn.Sequential) -> Quantised:
    """Whole numbers for a network from `analysis.networks.network.build`.

    Raises:
        ValueError: a layer of zeros, or with weights of which one outgrows the
            threshold so far that no whole threshold is left.
    """
    low, high = -(1 << WEIGHT_BITS - 1), (1 << WEIGHT_BITS - 1) - 1
    whole: dict[str, I8] = {}
    scales, thresholds = {}, {}
    for name, spiking in zip(WEIGHTED, SPIKING, strict=True):
        real = _numbers(net, name)
        limits = [high / real.max()] if real.max() > 0 else []
        limits += [low / real.min()] if real.min() < 0 else []
        if not limits:
            raise ValueError(f"{name}: all weights are zero")
        threshold = float(getattr(net, spiking).spike_threshold)
        scale = float(np.floor(min(limits) * threshold)) / threshold
        if scale <= 0:
            raise ValueError(f"{name}: a weight is over {high} times the threshold")
        scales[name] = scale
        thresholds[spiking] = round(scale * threshold)
        for key, value in parameters(net).items():
            if _of(name, key):
                each = np.rint(value.detach().double().numpy() * scale)
                whole[key] = np.clip(each, low, high).astype(np.int8)
    return Quantised(whole, thresholds, scales)


def quantised_net(fitted: Fitted, found: Quantised) -> nn.Sequential:
    """The network in whole numbers, as Sinabs modules; `chip_run` runs it."""
    net = build(fitted.network, fitted.windows, fitted.seed)
    set_weights(net, found.times(dict.fromkeys(WEIGHTED, 1)))
    for name, threshold in found.thresholds.items():
        whole = nn.Parameter(torch.tensor(float(threshold)), requires_grad=False)
        getattr(net, name).spike_threshold = whole
    return net


@dataclass(frozen=True)
class ChipRun:
    """Result of the chip's arithmetic for some windows.

    Attributes:
        counts: output spikes, int64 (n, classes).
        potentials: lowest and highest potential of each spiking layer before saturation.
        saturated: share of each layer's potentials, over neurons and steps, that were cut off.
    """

    counts: Counts
    potentials: dict[str, tuple[float, float]]
    saturated: dict[str, float]


def chip_run(net: nn.Sequential, x: npt.NDArray[np.uint8], batch: int = 16) -> ChipRun:
    """Output spikes with potentials that saturate at the chip's 16 bits.

    Step by step as in training: spikes of a step are added up before the threshold is looked at.
    The chip itself has no steps and looks after every spike, which nothing here can show.

    Args:
        net: from `quantised_net`.
        x: uint8 (n, steps, channels, cells, cells), n at least 1.
    """
    ends = {name: np.zeros(2, np.float32) for name in SPIKING}
    cut, whole = dict.fromkeys(SPIKING, 0), dict.fromkeys(SPIKING, 0)
    layers: dict[str, Any] = dict(net.named_children())
    counts = []
    with torch.no_grad():
        for start in range(0, len(x), batch):
            part = torch.from_numpy(x[start : start + batch].astype(np.float32))
            n, steps = part.shape[:2]
            at = part.flatten(0, 1)
            for name, layer in layers.items():
                if name not in SPIKING:
                    at = layer(at)
                    continue
                spikes = at.contiguous().view(n, steps, -1)
                threshold = np.float32(float(layer.spike_threshold))
                cut[name] += _fire(spikes.numpy(), threshold, LOWEST, HIGHEST, ends[name])
                whole[name] += spikes.numel()
                at = spikes.view(at.shape)
            counts.append(
                by_class(at.view(n, steps, -1).sum(dim=1), classes_of(net)).numpy().astype(np.int64)
            )
    return ChipRun(
        np.concatenate(counts),
        {name: (float(low), float(high)) for name, (low, high) in ends.items()},
        {name: cut[name] / whole[name] for name in SPIKING},
    )


@njit(cache=True, nogil=True)
def _fire(current: Any, threshold: Any, lowest: Any, highest: Any, ends: Any) -> int:
    """Currents (n, steps, features) become spikes, in place; how many potentials were cut off.

    `ends` takes the lowest and the highest potential, before it is cut off.
    """
    n, steps, features = current.shape
    v = np.empty(features, np.float32)
    cut = 0
    for i in range(n):
        v[:] = np.float32(0.0)
        for t in range(steps):
            for f in range(features):
                u = v[f] + current[i, t, f]
                ends[0] = min(ends[0], u)
                ends[1] = max(ends[1], u)
                if u < lowest or u > highest:
                    cut += 1
                    u = min(max(u, lowest), highest)
                fired = u >= threshold
                current[i, t, f] = np.float32(1.0) if fired else np.float32(0.0)
                v[f] = np.float32(0.0) if fired else u
    return cut


def compare(real: Counts, whole: Counts, margin: float) -> CountChange:
    """Compare spike counts `real` with `whole`, both int64 (n, classes).

    Raises:
        ValueError: no windows, or not the same number of them.
    """
    n = len(real)
    if real.shape != whole.shape or not n:
        raise ValueError(f"counts of the shapes {real.shape} and {whole.shape}; expected as many")
    change = np.abs(real - whole)
    return CountChange(
        windows=n,
        equal_counts=float((change == 0).all(axis=1).mean()),
        equal_class=float((winners(real) == winners(whole)).mean()),
        equal_class_by_margin=float((winners(real, margin) == winners(whole, margin)).mean()),
        mean_change=float(change.mean()),
        largest_change=int(change.max()),
    )


def _numbers(net: nn.Sequential, layer: str) -> npt.NDArray[np.float64]:
    """All weights and biases of a layer, float64, in a row."""
    values = [v.detach().numpy().ravel() for k, v in parameters(net).items() if _of(layer, k)]
    return np.concatenate(values).astype(np.float64)


def _of(layer: str, key: str) -> bool:
    """Return whether a weight, by its name in torch, is this layer's."""
    return key.split(".")[0] == layer


MOST, BLOCK = 1 << 20, 1 << 13
"""Limit of the search for a common threshold, and candidates tried at once."""


def common_threshold(thresholds: Sequence[int]) -> tuple[int, tuple[int, ...]]:
    """The lowest T and the multiples m with ``m (s - 1) < T <= m s`` for each threshold s.

    Raises:
        ValueError: a threshold is not positive, or there is no T below `MOST`.
    """
    whole = np.asarray(thresholds, np.int64)
    if (whole < 1).any():
        raise ValueError(f"thresholds {list(thresholds)}: must be positive whole numbers")
    for start in range(int(whole.max(initial=1)), MOST, BLOCK):
        tried = np.arange(start, start + BLOCK, dtype=np.int64)
        multiple = -(-tried[:, None] // whole)
        fits = (multiple * (whole - 1) < tried[:, None]).all(axis=1)
        if fits.any():
            at = int(fits.argmax())
            return int(tried[at]), tuple(int(m) for m in multiple[at])
    raise ValueError(f"thresholds {list(thresholds)}: no common multiple below {MOST}")


def common_net(fitted: Fitted, found: Quantised) -> nn.Sequential:
    """The network in whole numbers with one threshold, as `networks.spiking.Engine` takes it.

    Raises:
        ValueError: as `common_threshold`.
    """
    threshold, multiples = common_threshold([found.thresholds[name] for name in SPIKING])
    net = build(fitted.network, fitted.windows, fitted.seed)
    set_weights(net, found.times(dict(zip(WEIGHTED, multiples, strict=True))))
    for name in SPIKING:
        one = nn.Parameter(torch.tensor(float(threshold)), requires_grad=False)
        getattr(net, name).spike_threshold = one
    return net
