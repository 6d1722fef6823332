"""The network in 8-bit weights on the fast kernels, with the spikes of the chip's arithmetic.

Layers in whole numbers have a threshold each, and the kernels take one for all. A whole potential
u reaches a whole threshold s exactly where m u reaches any T above m (s - 1) and up to m s; so
each layer's weights are multiplied by a whole number of its own, and one T serves them all. All
sums stay whole, and float32 holds them exactly below 2^24, which is 2^24 / T thresholds.

Potentials are not cut off at the chip's 16 bits (`analysis.networks.quantised.chip_run` does that):
some are that far down in a window, hundreds of thresholds, from where none comes back before it
ends.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from sliplab.analysis.networks.network import SPIKING, WEIGHTED, build, set_weights
from sliplab.analysis.networks.quantised import Quantised
from sliplab.analysis.networks.training import Fitted

MOST, BLOCK = 1 << 20, 1 << 13
"""Where the search for a common threshold ends, and how many are tried at once."""


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
    raise ValueError(f"thresholds {list(thresholds)}: no common one below {MOST}")


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
