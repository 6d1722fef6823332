"""A network of taxels that begins as a logistic regression, at any rate of events."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import regression_start
from sliplab.analysis.networks.baselines import fit_logistic
from sliplab.analysis.networks.network import build, exact, matrices, on_grid, spike_counts
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.networks.training import fit, restore
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.windows import Windows

pytestmark = pytest.mark.usefixtures("one_thread")

TAXELS, STEPS, CLASSES = 12, 40, 6
WINDOWS = Windows(length_ms=400, step_ms=10, taxels=TAXELS)
NETWORK = NetworkSettings(start="regression")


def touches(n: int, seed: int, rate: float = 0.3) -> tuple[SparseWindows, np.ndarray]:
    """Windows of classes that differ by the rates of taxels, as objects do in a grasp.

    Args:
        rate: mean events of a taxel and step.
    """
    profiles = np.random.default_rng(7).gamma(1.0, 1.0, (CLASSES, TAXELS))
    rng = np.random.default_rng(seed)
    y = np.arange(n) % CLASSES
    force = rng.lognormal(0.0, 0.2, n)
    mean = rate * force[:, None] * profiles[y]
    x = rng.poisson(mean[:, None].repeat(STEPS, axis=1)).clip(max=255).astype(np.uint8)
    return SparseWindows.of(x[..., None, None]), y


def begun(rate: float) -> tuple[Any, SparseWindows, np.ndarray]:
    x, y = touches(240, 1, rate)
    net = build(regression_start.sized(NETWORK, WINDOWS, CLASSES), WINDOWS, 0, CLASSES)
    regression_start.begin(net, x, y)
    return net, x, y


def event_weight(net: Any) -> float:
    """Weight of an event in the first layer, thresholds."""
    return float(matrices(net)[0].max())


@pytest.mark.parametrize("rate", [0.03, 0.3, 3.0, 60.0])
def test_it_tells_apart_what_the_regression_does_before_any_training(rate: float) -> None:
    net, x, y = begun(rate)
    test_x, test_y = touches(240, 2, rate)
    found = metrics.accuracy(SpikeEngine(net, 1).counts(test_x), test_y).argmax
    sums, test_sums = (each.dense().sum(axis=(1, 3, 4)).astype(float) for each in (x, test_x))
    regression = fit_logistic(sums, y, CLASSES).scores(test_sums).argmax(axis=1)
    assert found > (regression == test_y).mean() - 0.08  # 240 windows: two standard errors
    assert found > 2.0 / CLASSES


def test_spikes_that_are_passed_on_are_those_of_the_first_layers() -> None:
    net, x, _ = begun(0.3)
    _, fired = SpikeEngine(net, 1).spikes(x)
    passed = regression_start.passed(x, event_weight(net))
    np.testing.assert_array_equal(fired[:, 0], passed.sum(axis=1))
    np.testing.assert_array_equal(fired[:, 1], passed.sum(axis=1))


def test_dense_events_are_weighted_less() -> None:
    weights = [event_weight(begun(rate)[0]) for rate in (0.03, 0.3, 60.0)]
    assert weights[0] == weights[1] == regression_start.PASSED
    assert weights[2] < 0.1


@pytest.mark.parametrize("rate", [0.0, 0.0005])
def test_few_events_or_none_give_weights_that_are_exact(rate: float) -> None:
    net, x, _ = begun(rate)
    values = on_grid(matrices(net))
    assert all(np.isfinite(value).all() for value in values)
    assert exact(values)
    assert SpikeEngine(net, 1).counts(x).max() < STEPS * 4


def test_training_keeps_it_and_gives_an_ordinary_network() -> None:
    settings = AnalysisSettings(windows=WINDOWS, network=NETWORK)
    assert settings.training.learning_rate == pytest.approx(5e-4)
    names = [f"class {number}" for number in range(CLASSES)]
    train, validation, test = (touches(240, seed) for seed in (1, 3, 2))
    how = settings.training.model_copy(update={"epochs": 3})
    fitted = fit(*train, *validation, NETWORK, WINDOWS, how, 0, classes=names)
    again = fit(*train, *validation, NETWORK, WINDOWS, how, 0, classes=names)
    assert fitted.history == again.history
    for name, value in fitted.state_dict.items():
        assert torch.equal(value, again.state_dict[name])
    assert fitted.network.start == "random"  # its weights are given
    assert fitted.network.hidden == CLASSES * 4 + regression_start.SPARE
    counts = fitted.engine.counts(test[0])
    before = SpikeEngine(begun(0.3)[0], 1).counts(test[0])
    accuracy = [metrics.accuracy(each, test[1]).argmax or 0.0 for each in (before, counts)]
    assert accuracy[1] > accuracy[0] - 0.05


def test_sinabs_gives_the_same_counts() -> None:
    names = [f"class {number}" for number in range(CLASSES)]
    train, validation, test = (touches(120, seed) for seed in (1, 3, 2))
    how = AnalysisSettings(windows=WINDOWS, network=NETWORK).training
    fitted = fit(*train, *validation, NETWORK, WINDOWS, how, 0, classes=names)
    dense = test[0].dense()
    np.testing.assert_array_equal(fitted.engine.counts(dense), spike_counts(restore(fitted), dense))
