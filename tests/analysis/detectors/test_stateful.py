"""Stateful inference against Sinabs' own layers, never reset."""

import numpy as np
import pytest
import torch
from torch import nn

from sliplab.analysis.detectors.stateful import stateful_spikes, trailing_sums
from sliplab.analysis.networks.network import (
    build,
    by_class,
    by_parameter,
    matrices,
    on_grid,
    reset_states,
    set_weights,
    spike_counts,
)
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows

WINDOWS = Windows(length_ms=6, crop_px=160)
NETWORK = NetworkSettings(conv1_channels=2, conv2_channels=3, hidden=6, weight_scale=(6, 5, 6, 6))


def network() -> tuple[nn.Sequential, SpikeEngine]:
    """A network whose currents are exact, and the engine that runs it."""
    net = build(NETWORK, WINDOWS, 3)
    values = on_grid(matrices(net))
    set_weights(net, by_parameter(values))
    return net, SpikeEngine(net, WINDOWS.cells)


def carried(engine: SpikeEngine, x: np.ndarray) -> np.ndarray:
    return stateful_spikes(engine, SparseWindows.of(x))


def samples(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.poisson(0.4, (n, WINDOWS.steps, 1, WINDOWS.cells, WINDOWS.cells)).astype(np.uint8)


def test_it_is_sinabs_without_a_reset() -> None:
    (net, engine), x = network(), samples(37)
    reset_states(net)
    with torch.no_grad():
        # a window at a time: Sinabs' layers go on from where the last call left them
        expected = np.concatenate(
            [by_class(net(torch.from_numpy(window.astype(np.float32)))).numpy() for window in x]
        )
    found = carried(engine, x)
    assert found.sum() > 20
    assert (found == expected).all()
    # neither what the network's own neurons hold nor an earlier trial matters
    assert (carried(engine, x) == found).all()


def test_the_first_window_is_that_of_a_reset_network() -> None:
    (net, engine), x = network(), samples(9)
    found = trailing_sums(carried(engine, x), WINDOWS.steps, WINDOWS.steps)
    reset = spike_counts(net, x)
    assert (found[0] == reset[0]).all()
    assert (found != reset).any()


def test_it_looks_back_only() -> None:
    (_, engine), x = network(), samples(8)
    other = np.concatenate([x[:5], samples(3, seed=9)])
    same = 5 * WINDOWS.steps
    assert (carried(engine, x)[:same] == carried(engine, other)[:same]).all()


def test_no_windows() -> None:
    _, engine = network()
    assert carried(engine, samples(0)).shape == (0, 3)
    assert trailing_sums(np.zeros((0, 3), np.uint8), 6, 2).shape == (0, 3)


@pytest.mark.parametrize(("length", "stride"), [(6, 6), (6, 2), (3, 5), (20, 1), (21, 1)])
def test_sums_are_of_the_last_steps(length: int, stride: int) -> None:
    values = np.random.default_rng(0).integers(0, 2, (20, 3)).astype(np.uint8)
    expected = [
        values[k : k + length].sum(axis=0) for k in range(0, len(values) - length + 1, stride)
    ]
    assert trailing_sums(values, length, stride).tolist() == np.array(expected).tolist()


def test_samples_of_another_shape_are_named() -> None:
    with pytest.raises(ValueError, match="samples have the shape"):
        carried(network()[1], np.zeros((1, 5, 1, 8, 8), np.uint8))
