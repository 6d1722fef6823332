"""A batch by the kernels and by Sinabs' layers: the same spikes, gradients alike to rounding.

On a GPU the same is asked of it, where there is one.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from analysis.nets.metrics import IntArray
from analysis.nets.network import build, matrices, on_grid
from analysis.nets.sparse import SparseWindows
from analysis.nets.training import Fitted, fit
from analysis.nets.training_work import Batch, BySinabs, EventDriven, devices, work_on
from protocols.settings import Network, Training, Windows

pytestmark = pytest.mark.usefixtures("one_thread")

NETWORK, GAIN = Network(), 0.25
WINDOWS = Windows()
CELLS = WINDOWS.cells
GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=GPU)]


def samples(n: int, seed: int) -> tuple[SparseWindows, IntArray]:
    """Windows from empty to crowded, and classes."""
    rng = np.random.default_rng(seed)
    rate = rng.choice([0.0, 0.01, 0.05, 0.3], (n, 1, 1, 1, 1))
    x = rng.poisson(rate, (n, WINDOWS.steps, 1, CELLS, CELLS)).astype(np.uint8)
    return SparseWindows.of(x), rng.integers(0, 3, n)


def batch(device: str | None, rows: IntArray, seed: int = 0) -> Batch:
    """By Sinabs on a device; by the kernels for None."""
    net = build(NETWORK, WINDOWS, seed)
    work = EventDriven(net, CELLS, GAIN) if device is None else BySinabs(net, GAIN, device)
    work.take(on_grid(matrices(build(NETWORK, WINDOWS, seed + 1))))
    x, y = samples(20, 3)
    with ThreadPoolExecutor(1) as pool:
        work.batch(x, y, np.arange(5), pool)  # leaves nothing behind
        return work.batch(x, y, rows, pool)


@pytest.mark.parametrize("device", DEVICES)
def test_both_ways_count_the_same_spikes_and_agree_on_gradients(device: str) -> None:
    rows = np.array([3, 17, 0, 8, 9, 11, 2])
    ours, theirs = batch(None, rows), batch(device, rows)
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


@pytest.mark.parametrize("device", DEVICES)
def test_the_same_batch_gives_the_same_bits(device: str) -> None:
    rows = np.arange(9)
    once, again = batch(device, rows), batch(device, rows)
    assert once.loss == again.loss
    for name, gradient in once.gradients.items():
        assert torch.equal(gradient, again.gradients[name])


@pytest.mark.parametrize("device", DEVICES)
def test_a_training_by_sinabs_goes_the_same_way(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y = samples(24, 5)
    settings = Training(epochs=2, batch=8, learning_rate=1e-3, warm_up=0.0)

    def trained() -> Fitted:
        return fit(x, y, x, y, NETWORK, WINDOWS, settings, 0)

    ours = trained()
    monkeypatch.setattr(
        "analysis.nets.training_run.work_on",
        lambda _device, net, _cells, gain: BySinabs(net, gain, device),
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


def test_a_device_that_is_not_there_is_named() -> None:
    net = build(NETWORK, WINDOWS, 0)
    with pytest.raises(ValueError, match=r"device cuda:99: must be one of cpu"):
        work_on("cuda:99", net, CELLS, GAIN)
    assert devices()[0] == "cpu"
    assert isinstance(work_on("cpu", net, CELLS, GAIN), EventDriven)
