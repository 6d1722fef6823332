"""What a pass over the training windows gave, and which layers of a network do nothing for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import log_softmax

from sliplab.analysis.metrics import classification as metrics

SILENT_RATE = 1e-5
"""Spikes per neuron and step at or below which a layer counts as silent."""

SATURATED_RATE = 0.9
"""Spikes per neuron and step at or above which a layer counts as saturated (1 is the most)."""


@dataclass(frozen=True)
class EpochRecord:
    """What one pass over the training samples gave.

    Attributes:
        epoch: 1 for the first.
        loss: mean cross-entropy of the training samples, each before the step it was used in.
        train_argmax: their accuracy, likewise, ties shared (`metrics.classification.Accuracy`).
        val_loss: mean cross-entropy of the validation samples after the epoch.
        val_argmax, val_strict, val_margin: their accuracies.
        rates: mean spikes per neuron and step of each spiking layer over the epoch, by name.
    """

    epoch: int
    loss: float
    train_argmax: float
    val_loss: float
    val_argmax: float
    val_strict: float
    val_margin: float
    rates: dict[str, float]

    @property
    def merit(self) -> tuple[float, float, float]:
        """What epochs are compared by, the larger the better: see `fit`."""
        return (self.val_strict, self.val_argmax, -self.val_loss)


def epoch_record(
    epoch: int,
    loss: float,
    train_counts: metrics.IntArray,
    train_y: metrics.IntArray,
    val_counts: metrics.IntArray,
    val_y: metrics.IntArray,
    rates: dict[str, float],
    gain: float,
    margin: float,
) -> EpochRecord:
    """The record of an epoch from the output spikes (n, 3) and classes of both parts."""
    val = metrics.accuracy(val_counts, val_y, margin)
    train = metrics.accuracy(train_counts, train_y)
    log_p = log_softmax(gain * val_counts, axis=1)
    return EpochRecord(
        epoch=epoch,
        loss=loss,
        train_argmax=train.argmax or 0.0,
        val_loss=-float(log_p[np.arange(len(val_y)), val_y].mean()),
        val_argmax=val.argmax or 0.0,
        val_strict=val.strict or 0.0,
        val_margin=val.margin or 0.0,
        rates=rates,
    )


def layer_warnings(record: EpochRecord) -> tuple[str, ...]:
    """Layers that are silent or saturated, by name."""
    found = []
    for name, rate in record.rates.items():
        if rate <= SILENT_RATE:
            found.append(f"layer {name} is silent: {rate:.2g} spikes per neuron and step")
        elif rate >= SATURATED_RATE:
            found.append(f"layer {name} is saturated: {rate:.2g} spikes per neuron and step")
    return tuple(found)
