"""A batch by the kernels, by Sinabs' layers and by compiled ones: the same spikes, like gradients.

On a GPU the same is asked of it, where there is one.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from sliplab.analysis.metrics.classification import IntArray
from sliplab.analysis.networks import gradients
from sliplab.analysis.networks.gradients import (
    EventDriven,
    GradientBatch,
    OnDevice,
    devices,
    work_on,
)
from sliplab.analysis.networks.network import build, by_parameter, matrices, on_grid, set_weights
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.networks.training import Fitted, fit
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows

pytestmark = pytest.mark.usefixtures("one_thread")

NETWORK, GAIN = NetworkSettings(), 0.25
WINDOWS = Windows(length_ms=4)  # a compiler takes longer for each step
CELLS = WINDOWS.cells
GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
Way = tuple[str, bool]
"""Device, and whether neurons are compiled."""
WAYS = [
    ("cpu", False),
    ("cpu", True),
    pytest.param(("cuda", False), marks=GPU),
    pytest.param(("cuda", True), marks=GPU),
]


def samples(n: int, seed: int) -> tuple[SparseWindows, IntArray]:
    """Windows from empty to crowded, and classes."""
    rng = np.random.default_rng(seed)
    rate = rng.choice([0.0, 0.01, 0.05, 0.3], (n, 1, 1, 1, 1))
    x = rng.poisson(rate, (n, WINDOWS.steps, 1, CELLS, CELLS)).astype(np.uint8)
    return SparseWindows.of(x), rng.integers(0, 3, n)


def batch_counts(net: nn.Sequential, x: SparseWindows) -> IntArray:
    """By the kernels, with the weights on the grid."""
    set_weights(net, by_parameter(on_grid(matrices(net))))
    return SpikeEngine(net, CELLS).counts(x)


def batch(way: Way | None, rows: IntArray, seed: int = 0) -> GradientBatch:
    """By torch on a device; by the kernels for None."""
    net = build(NETWORK, WINDOWS, seed)
    work = EventDriven(net, CELLS, GAIN) if way is None else OnDevice(net, GAIN, *way)
    work.take(on_grid(matrices(build(NETWORK, WINDOWS, seed + 1))))
    x, y = samples(20, 3)
    with ThreadPoolExecutor(1) as pool:
        work.batch(x, y, np.arange(5), pool)  # leaves nothing behind
        return work.batch(x, y, rows, pool)


@pytest.mark.long
@pytest.mark.parametrize("way", WAYS)
def test_all_ways_count_the_same_spikes_and_agree_on_gradients(way: Way) -> None:
    rows = np.array([3, 17, 0, 8, 9, 11, 2])
    ours, theirs = batch(None, rows), batch(way, rows)
    np.testing.assert_array_equal(ours.counts, theirs.counts)
    assert ours.counts.any()
    assert ours.loss == pytest.approx(theirs.loss, rel=1e-12)
    assert ours.fired == pytest.approx(theirs.fired, rel=1e-5)
    assert min(ours.fired.values()) > 0
    assert set(ours.gradients) == set(theirs.gradients)
    for name, gradient in ours.gradients.items():
        assert gradient.dtype == theirs.gradients[name].dtype == torch.float32
        off = (gradient - theirs.gradients[name]).abs().max()
        # float32 Sinabs is itself up to 2e-6 off where sums cancel
        assert off <= 1e-5 * gradient.abs().max(), name
        assert gradient.abs().max() > 0, name


@pytest.mark.long
@pytest.mark.parametrize("way", WAYS)
def test_the_same_batch_gives_the_same_bits(way: Way) -> None:
    rows = np.arange(9)
    once, again = batch(way, rows), batch(way, rows)
    assert once.loss == again.loss
    for name, gradient in once.gradients.items():
        assert torch.equal(gradient, again.gradients[name])


@pytest.mark.quick(1)
@pytest.mark.parametrize("way", [WAYS[0], pytest.param(WAYS[1], marks=pytest.mark.long), *WAYS[2:]])
def test_a_training_on_a_device_goes_the_same_way(
    way: Way, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y = samples(24, 5)
    settings = Training(epochs=2, batch=8, learning_rate=1e-3, warm_up=0.0)

    def trained() -> Fitted:
        return fit(x, y, x, y, NETWORK, WINDOWS, settings, 0)

    ours = trained()
    monkeypatch.setattr(
        "sliplab.analysis.networks.training.work_on",
        lambda _device, net, _cells, gain: OnDevice(net, gain, *way),
    )
    theirs = trained()
    for a, b in zip(ours.history, theirs.history, strict=True):
        assert a.loss == pytest.approx(b.loss, rel=0.02)
    assert theirs.history[1].loss < theirs.history[0].loss


@GPU
def test_a_gpu_trains_by_the_settings() -> None:
    x, y = samples(24, 5)
    settings = Training(epochs=1, batch=8, device="cuda")
    found = [fit(x, y, x, y, NETWORK, WINDOWS, settings, 0) for _ in range(2)]
    assert found[0].history == found[1].history


def test_convolutions_as_products_give_the_same() -> None:
    net = build(NetworkSettings(conv1_kernel=7, conv2_kernel=5), Windows(crop_px=140), 0)
    x = torch.from_numpy(np.random.default_rng(0).poisson(0.3, (5, 1, 7, 7)).astype(np.float32))
    made: Any = gradients.exact_net(net)
    one, theirs = made.conv1(x), dict(net.named_children())["conv1"](x)
    torch.testing.assert_close(one, theirs, rtol=0, atol=1e-5)
    two, theirs = made.conv2(one), dict(net.named_children())["conv2"](theirs)
    assert two.shape == theirs.shape == (5, 16, 4, 4)
    torch.testing.assert_close(two, theirs, rtol=0, atol=1e-4)
    assert not isinstance(net.conv1, gradients.ExactConvolution)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=GPU)])
def test_windows_are_scattered_on_the_device_as_on_the_host(device: str) -> None:
    x, _ = samples(20, 3)
    held = gradients.HeldWindows.of(x, device)
    for rows in (np.array([3, 17, 3, 0]), np.arange(20), np.array([0])):
        expected = x.take(rows).dense().astype(np.float32)
        np.testing.assert_array_equal(held.dense(rows).cpu().numpy(), expected)


def test_where_nothing_compiles_sinabs_computes_and_it_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("Cannot find a working triton installation.\nmore")

    monkeypatch.setattr("sliplab.analysis.networks.gradients._compiled", lambda: (broken, broken))
    net = build(NETWORK, WINDOWS, 0)
    with pytest.warns(UserWarning, match="for cpu, Sinabs' layers compute: Cannot find a working"):
        work = gradients.on_device(net, GAIN, "cpu")
    work.take(on_grid(matrices(net)))
    x, y = samples(6, 1)
    with ThreadPoolExecutor(1) as pool:
        found = work.batch(x, y, np.arange(6), pool)
    np.testing.assert_array_equal(found.counts, batch_counts(net, x))


def test_a_device_that_is_not_there_is_named() -> None:
    net = build(NETWORK, WINDOWS, 0)
    with pytest.raises(ValueError, match=r"device cuda:99: must be one of cpu"):
        OnDevice(net, GAIN, "cuda:99", compiled=False)
    with pytest.raises(ValueError, match=r"device cuda:99: must be one of cpu"):
        work_on("cuda:99", net, CELLS, GAIN)
    assert devices()[0] == "cpu"
    assert isinstance(work_on("cpu", net, CELLS, GAIN), EventDriven)
