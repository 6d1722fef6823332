"""Carried states against Sinabs' own layers, never reset."""

import numpy as np
import pytest
import torch

from analysis.carried import CHUNK, carried_spikes, trailing_sums
from analysis.network import build, reset_states, spike_counts
from protocols.settings import Network, Windows

WINDOWS = Windows(length_ms=6, crop_px=160)
NETWORK = Network(conv1_channels=2, conv2_channels=3, hidden=6, weight_scale=(6, 5, 6, 6))


def samples(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.poisson(0.4, (n, WINDOWS.steps, 1, WINDOWS.cells, WINDOWS.cells)).astype(np.uint8)


def test_it_is_sinabs_without_a_reset() -> None:
    net, x = build(NETWORK, WINDOWS, 3), samples(CHUNK + 5)
    reset_states(net)
    with torch.no_grad():
        # a window at a time: Sinabs' layers go on from where the last call left them
        expected = np.concatenate(
            [net(torch.from_numpy(window.astype(np.float32))).numpy() for window in x]
        )
    found = carried_spikes(net, x)
    assert found.sum() > 20
    assert (found == expected).all()
    # neither what the network's own neurons hold nor an earlier trial matters
    assert (carried_spikes(net, x) == found).all()


def test_the_first_window_is_that_of_a_reset_network() -> None:
    net, x = build(NETWORK, WINDOWS, 3), samples(9)
    found = trailing_sums(carried_spikes(net, x), WINDOWS.steps, WINDOWS.steps)
    reset = spike_counts(net, x)
    assert (found[0] == reset[0]).all()
    assert (found != reset).any()


def test_it_looks_back_only() -> None:
    net, x = build(NETWORK, WINDOWS, 3), samples(8)
    other = np.concatenate([x[:5], samples(3, seed=9)])
    same = 5 * WINDOWS.steps
    assert (carried_spikes(net, x)[:same] == carried_spikes(net, other)[:same]).all()


def test_no_windows() -> None:
    net = build(NETWORK, WINDOWS, 3)
    assert carried_spikes(net, samples(0)).shape == (0, 3)
    assert trailing_sums(np.zeros((0, 3), np.uint8), 6, 2).shape == (0, 3)


@pytest.mark.parametrize(("length", "stride"), [(6, 6), (6, 2), (3, 5), (20, 1), (21, 1)])
def test_sums_are_of_the_last_steps(length: int, stride: int) -> None:
    values = np.random.default_rng(0).integers(0, 2, (20, 3)).astype(np.uint8)
    expected = [
        values[k : k + length].sum(axis=0) for k in range(0, len(values) - length + 1, stride)
    ]
    assert trailing_sums(values, length, stride).tolist() == np.array(expected).tolist()
