"""Quantisation of the network for the chip: 8-bit weights, integer thresholds, and the effect.

Each layer has one scale. It is the largest whole number that keeps the layer's weights and biases
within 8 bits, and because the threshold is 1 it is the threshold too: exactly, without rounding.
Every potential is then a whole number, which float32 adds without error: what is computed here is
what an integer machine computes.

On the fast kernels, which take one threshold for all layers: a whole potential u reaches a whole
threshold s exactly where m u reaches any T above m (s - 1) and up to m s. So each layer's weights
are multiplied by a whole number per layer, and all layers share one T. Sums stay whole, and float32
holds them exactly below 2^24, which is 2^24 / T thresholds. Potentials are not cut off at the
chip's 16 bits there: those that far down do not come back in a window.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.networks.network import SPIKING, WEIGHTED, build, parameters, set_weights
from sliplab.analysis.networks.training import Fitted

WEIGHT_BITS = 8
"""Of the chip (`plugins/deploy/speck.py` has its limits)."""

I8 = npt.NDArray[np.int8]


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
        real = layer_numbers(net, name)
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


def layer_numbers(net: nn.Sequential, layer: str) -> npt.NDArray[np.float64]:
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
    """The network in whole numbers with one threshold, as `networks.spiking.SpikeEngine` takes it.

    Raises:
        ValueError: as `common_threshold`.
    """
    threshold, multiples = common_threshold([found.thresholds[name] for name in SPIKING])
    factors = dict(zip(WEIGHTED, multiples, strict=True))
    return whole_net(fitted, found, factors, dict.fromkeys(SPIKING, threshold))


def whole_net(
    fitted: Fitted, found: Quantised, factors: Mapping[str, int], thresholds: Mapping[str, int]
) -> nn.Sequential:
    """The network in whole numbers, as Sinabs modules.

    Args:
        factors: by which the weights of each layer are multiplied.
        thresholds: of the spiking layers.
    """
    net = build(fitted.network, fitted.windows, fitted.seed)
    whole = {
        key: torch.from_numpy(value.astype(np.float32) * factors[key.split(".")[0]])
        for key, value in found.weights.items()
    }
    set_weights(net, whole)
    for name, threshold in thresholds.items():
        one = nn.Parameter(torch.tensor(float(threshold)), requires_grad=False)
        getattr(net, name).spike_threshold = one
    return net
