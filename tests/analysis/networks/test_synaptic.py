"""Synaptic operations are those that one finds by following every spike through torch's layers."""

import numpy as np
import pytest
import torch
from sinabs.layers import IAFSqueeze
from torch import nn

from sliplab.analysis.networks.network import (
    SPIKING,
    WEIGHTED,
    build,
    matrices,
    on_grid,
    parameters,
    reset_states,
    set_matrices,
    set_weights,
    weights,
)
from sliplab.analysis.networks.synaptic import count_work, reached
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows

WINDOWS = Windows(length_ms=8, crop_px=140, polarity="both")  # (8, 2, 7, 7): an odd side


def untrained(network: NetworkSettings, windows: Windows) -> Fitted:
    net = build(network, windows, 3)
    values = matrices(net)
    for value in values[2:]:
        value[:, -1] = np.random.default_rng(0).normal(0.02, 0.05, len(value))
    set_matrices(net, on_grid(values))
    return Fitted(weights(net), network, windows, Training(), 3, (), 1, ())


@pytest.mark.parametrize("kernel", [1, 3, 5, 7])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("side", [5, 8])
def test_reach_is_the_column_sum_of_torchs_convolution(kernel: int, stride: int, side: int) -> None:
    line = torch.ones(1, 1, side, requires_grad=True)
    taps = torch.ones(1, 1, kernel)
    nn.functional.conv1d(line, taps, stride=stride, padding=kernel // 2).sum().backward()
    assert reached(side, kernel, stride).tolist() == line.grad.flatten().tolist()


@pytest.mark.parametrize("biases", [True, False])
def test_operations_are_those_of_sinabs_spikes_followed_one_by_one(biases: bool) -> None:
    network = NetworkSettings(
        conv1_channels=3, conv2_channels=4, hidden=5, conv1_kernel=5, biases=biases
    )
    fitted = untrained(network, WINDOWS)
    rng = np.random.default_rng(0)
    x = rng.poisson(0.4, (70, 8, 2, 7, 7)).astype(np.uint8)  # more than a thread takes at a time
    x[2] = 0
    found = count_work(fitted, SparseWindows.of(x))

    net = build(network, WINDOWS, 3)
    set_weights(net, fitted.state_dict)
    synapses, spikes, dense = dict.fromkeys(WEIGHTED, 0.0), {}, {}
    with torch.no_grad():
        for name in WEIGHTED:
            getattr(net, name).weight  # noqa: B018
        reset_states(net)
        signal = torch.from_numpy(x.astype(np.float32)).flatten(0, 1)
        for name, layer in net.named_children():
            if name in WEIGHTED:
                ones = nn.utils.skip_init(type(layer), **_shape_of(layer))
                for value in ones.parameters():
                    value.fill_(1.0)
                synapses[name] = float(ones(signal).double().sum()) / len(x)
                everywhere = torch.ones_like(signal[:1])
                dense[name] = int(ones(everywhere).double().sum()) * WINDOWS.steps
            signal = layer(signal)
            if name in SPIKING:
                spikes[name] = float(signal.double().sum()) / len(x)
    reset_states(net)
    assert min(spikes.values()) > 0
    every = sum(synapses.values())
    assert found.synaptic_operations == pytest.approx({**synapses, "all": every}, rel=1e-12)
    assert found.spikes == pytest.approx(spikes, rel=1e-12)
    assert found.dense_multiply_adds == {**dense, "all": sum(dense.values())}
    assert found.events == pytest.approx(x.sum() / len(x))
    assert found.share == pytest.approx(every / sum(dense.values()))
    assert found.rates["iaf4"] == pytest.approx(spikes["iaf4"] / (8 * 12))
    # NeuroBench counts what is 0: weights, and outputs of all spiking layers
    potentials = sum(layer.v_mem[0].numel() for layer in net if isinstance(layer, IAFSqueeze))
    stored = sum(values.numel() for values in parameters(net).values())
    assert found.footprint_bytes == 4 * (potentials + stored)
    assert found.connection_sparsity == 0
    silent = 1 - sum(spikes.values()) / (8 * potentials)
    assert found.activation_sparsity == pytest.approx(silent, rel=1e-12)


def _shape_of(layer: nn.Module) -> dict[str, object]:
    if isinstance(layer, nn.Conv2d):
        names = ("in_channels", "out_channels", "kernel_size", "stride", "padding")
    else:
        names = ("in_features", "out_features")
    return {
        "bias": layer.bias is not None,  # a synapse that is active in every step
        **{name: getattr(layer, name) for name in names},
    }


def test_no_windows_are_no_work() -> None:
    none = SparseWindows.of(np.zeros((0, 8, 2, 7, 7), np.uint8))
    assert count_work(untrained(NetworkSettings(), WINDOWS), none) is None
