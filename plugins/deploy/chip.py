"""The arithmetic of a chip on a network in whole numbers: spikes, potentials and latencies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.latency import score_trial, summarise_latency, true_slip
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import winners
from sliplab.analysis.networks.models import rules_of
from sliplab.analysis.networks.network import SPIKING, WEIGHTED, by_class, classes_of
from sliplab.analysis.networks.quantised import Quantised, layer_numbers, whole_net
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows import dataset
from sliplab.storage.kernels import njit
from sliplab.storage.schema.evaluation import (
    CountChange,
    ExperimentLatency,
    Latencies,
    TrialLatency,
)

STATE_BITS = 16
"""Of the chip (`speck.py` has its limits)."""
LOWEST = np.float32(-(1 << STATE_BITS - 1))
HIGHEST = np.float32((1 << STATE_BITS - 1) - 1)
"""Range of a potential of the chip; it saturates there."""

Counts = npt.NDArray[np.int64]


def rounding(whole: Quantised, net: nn.Sequential) -> dict[str, float]:
    """RMS of each layer's rounding error, as a share of the RMS of its weights."""
    found = {}
    for name in WEIGHTED:
        real = layer_numbers(net, name)
        ours = [w.ravel() for key, w in whole.weights.items() if key.startswith(f"{name}.")]
        off = np.concatenate(ours) / whole.scales[name] - real
        found[name] = float(np.sqrt((off**2).mean() / (real**2).mean()))
    return found


def quantised_net(fitted: Fitted, found: Quantised) -> nn.Sequential:
    """The network in whole numbers, as Sinabs modules; `chip_run` runs it."""
    return whole_net(fitted, found, dict.fromkeys(WEIGHTED, 1), found.thresholds)


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


def latencies(
    campaigns: list[Collected],
    labels: StoreLabels,
    fitted: Fitted,
    whole: Quantised,
    on_trial: Callable[[], None] = lambda: None,
) -> tuple[Latencies, Latencies]:
    """Latency over the test trials of `campaigns`, as trained and with the whole numbers.

    Args:
        on_trial: called before each of them; some thousand windows take a second.
    """
    rules = rules_of(campaigns, fitted.network.outputs_per_class)
    fast, chip = fitted.engine, quantised_net(fitted, whole)
    found: tuple[dict[str, list[TrialLatency]], ...] = ({}, {})
    for item in campaigns:
        rule = rules[item.name]
        for _, recording in item.of_split("test"):
            on_trial()
            slip = true_slip(labels.read(item, recording))
            if slip is None:
                continue
            x, end_ns = dataset.trial_windows(recording, fitted.windows)
            both = fast.counts(x), chip_run(chip, x.dense()).counts
            for rows, counts in zip(found, both, strict=True):
                stated = detect(counts, end_ns, rule)
                scored = score_trial(stated, slip, round(rule.false_early_ms * 1e6))
                rows.setdefault(item.experiment, []).append(scored)
    real, chips = map(_summary, found)
    return real, chips


def _summary(rows: dict[str, list[TrialLatency]]) -> Latencies:
    return {
        experiment: ExperimentLatency(trials=len(each), latency_ms=summarise_latency(each))
        for experiment, each in rows.items()
    }
