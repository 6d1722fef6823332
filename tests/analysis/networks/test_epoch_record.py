"""Records of epochs: what they hold, how they are compared, which layers they name."""

from dataclasses import replace

import numpy as np
import pytest

from sliplab.analysis.networks.epoch_record import EpochRecord, epoch_record, layer_warnings

RATES = {"iaf1": 0.1, "iaf2": 0.2, "iaf3": 0.1, "iaf4": 0.1}
RECORD = EpochRecord(1, 0.5, 0.9, 0.25, 0.9, 0.8, 0.7, RATES)


def test_a_record_of_counts() -> None:
    train = np.array([[3, 0, 0], [0, 3, 3]])
    val = np.array([[4, 0, 0], [0, 4, 0], [2, 2, 2], [0, 0, 1]])
    found = epoch_record(
        2, 0.5, train, np.array([0, 0]), val, np.array([0, 1, 2, 0]), RATES, 0.5, 2.0
    )
    assert (found.epoch, found.loss, found.rates) == (2, 0.5, RATES)
    assert found.train_argmax == 0.5
    assert found.val_strict == 0.5
    assert found.val_argmax == pytest.approx((2 + 1 / 3) / 4)
    right, wrong = np.log1p(2 * np.exp(-2.0)), np.log(2 + np.exp(0.5))
    assert found.val_loss == pytest.approx((2 * right + np.log(3) + wrong) / 4)


def test_strict_accuracy_decides_then_argmax_then_loss() -> None:
    better = [
        replace(RECORD, val_strict=0.81, val_argmax=0.1, val_loss=9.0),
        replace(RECORD, val_argmax=0.91, val_loss=9.0),
        replace(RECORD, val_loss=0.2),
    ]
    assert all(other.merit > RECORD.merit for other in better)


def test_saturated_and_silent_layers_are_named() -> None:
    assert layer_warnings(RECORD) == ()
    found = layer_warnings(replace(RECORD, rates={**RATES, "iaf2": 0.95, "iaf4": 0.0}))
    assert [w.split(":")[0] for w in found] == [
        "layer iaf2 is saturated",
        "layer iaf4 is silent",
    ]
