"""The fast path gives Sinabs' spikes exactly and Sinabs' gradients to rounding."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from sinabs.activation import MembraneReset, MembraneSubtract, MultiSpike, PeriodicExponential
from torch import nn

from analysis.iaf import FusedIAF, fused_counts, fused_forward, fused_layers, lone_workers
from analysis.network import SPIKING, WEIGHTED, build, reset_states, spike_counts
from protocols.settings import Network, Windows

SMALL = Network(conv1_channels=3, conv2_channels=4, hidden=8)
TINY = Windows(length_ms=10, crop_px=120)
FULL = Windows()


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """These nets are too small to share: beside other work, waiting threads cost the most."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def sparse(n: int, windows: Windows, seed: int, share: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = (n, windows.steps, windows.channels, windows.cells, windows.cells)
    return rng.poisson(share, shape).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.004, 0.03, 0.5])
def test_spike_counts_are_sinabs_own(seed: int, share: float) -> None:
    net = build(Network(), FULL, seed)
    x = sparse(32, FULL, seed, share)
    expected = spike_counts(net, x)
    np.testing.assert_array_equal(fused_counts(net, x, batch=64), expected)
    np.testing.assert_array_equal(fused_counts(net, x), expected)
    if share > 0.01:
        assert expected.any()


def test_dense_real_valued_input() -> None:
    net = build(SMALL, TINY, 2)
    x = np.random.default_rng(0).normal(0.3, 2, (40, 10, 1, 6, 6)).astype(np.float32)
    expected = spike_counts(net, x)
    assert len(np.unique(expected)) > 3
    np.testing.assert_array_equal(fused_counts(net, x, batch=64), expected)


def test_every_layer_spikes_the_same() -> None:
    net = build(SMALL, TINY, 0)
    x = torch.from_numpy(sparse(5, TINY, 0, 0.3).astype(np.float32))
    seen: dict[str, torch.Tensor] = {}
    hooks = [
        getattr(net, n).register_forward_hook(lambda _m, _i, out, n=n: seen.update({n: out}))
        for n in SPIKING
    ]
    with torch.no_grad():
        net(x.flatten(0, 1))
        fused = fused_layers(net, x)
    for hook in hooks:
        hook.remove()
    assert list(fused) == list(SPIKING)
    for name in SPIKING:
        assert torch.equal(fused[name].flatten(), seen[name].flatten())
        assert fused[name].any()
    # with gradients another kernel runs
    for name, spikes in fused_layers(net, x).items():
        assert torch.equal(spikes, fused[name])


def gradients(net: nn.Sequential, out: torch.Tensor, y: torch.Tensor) -> dict[str, torch.Tensor]:
    net.zero_grad()
    nn.functional.cross_entropy(out, y).backward()
    return {n: getattr(net, n).weight.grad.clone() for n in WEIGHTED}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("windows", [TINY, FULL], ids=["tiny", "full"])
def test_gradients_are_sinabs_own(seed: int, windows: Windows) -> None:
    net = build(SMALL, windows, seed)
    x = torch.from_numpy(sparse(6, windows, seed, 0.1).astype(np.float32))
    y = torch.tensor([0, 1, 2, 0, 1, 2])
    reset_states(net)
    slow = gradients(net, net(x.flatten(0, 1)).unflatten(0, (6, -1)).sum(dim=1), y)
    fast = gradients(net, fused_forward(net, x), y)
    for name in WEIGHTED:
        size = slow[name].abs().max()
        assert size > 0
        assert (fast[name] - slow[name]).abs().max() <= 2e-6 * size


def test_gradient_of_one_neuron_in_closed_form() -> None:
    # potentials 0.5, 1.25 (fires), 0.25, 0.5; the reset at step 2 cuts the way back in time
    current = torch.tensor([[[0.5], [0.75], [0.25], [0.25]]], requires_grad=True)
    spikes = FusedIAF.apply(current, 1.0, 0.5, 1.0)
    assert spikes.flatten().tolist() == [0, 1, 0, 0]
    up = torch.tensor([[[1.0], [10.0], [100.0], [1000.0]]])
    spikes.backward(up)
    slope = 2 * np.exp(-np.abs(np.array([0.5, 1.25, 0.25, 0.5]) - 1) / 0.5)
    each = up.numpy().ravel() * slope
    expected = [each[0] + each[1], each[1], each[2] + each[3], each[3]]
    assert current.grad is not None
    np.testing.assert_allclose(current.grad.flatten(), expected, rtol=1e-6)


def test_slope_over_the_whole_range() -> None:
    """The kernel's own exponential, from the threshold to where nothing is left."""
    u = torch.linspace(-60, 60, 20_001).view(1, 1, -1).requires_grad_()
    FusedIAF.apply(u, 1.0, 0.5, 1.0).sum().backward()
    assert u.grad is not None
    v = u.detach().double()
    expected = 2 * torch.exp(-(v - 1).abs() / 0.5)
    far = expected < 1e-30
    # the argument is rounded to float32 first: at -58 that alone is a few 1e-6
    assert ((u.grad - expected).abs() / expected)[~far].max() < 1e-5
    near = (v - 1).abs() < 2
    assert ((u.grad - expected).abs() / expected)[near].max() < 1e-6
    assert u.grad[far].abs().max() < 1e-29
    assert torch.isfinite(u.grad).all()


def test_infinite_currents_stay_finite_on_the_way_back() -> None:
    current = torch.tensor([[[torch.inf], [-torch.inf], [0.0]]], requires_grad=True)
    spikes = FusedIAF.apply(current, 1.0, 0.5, 1.0)
    spikes.sum().backward()
    assert spikes.flatten().tolist() == [1, 0, 0]
    assert current.grad is not None
    assert torch.isfinite(current.grad).all()


def test_the_networks_own_states_are_left_alone() -> None:
    net = build(SMALL, TINY, 0)
    x = sparse(3, TINY, 0, 0.3)
    before = fused_counts(net, x)
    with torch.no_grad():
        net(torch.from_numpy(x.astype(np.float32)).flatten(0, 1))
    np.testing.assert_array_equal(fused_counts(net, x), before)
    assert any(getattr(net, n).v_mem.any() for n in SPIKING)


def test_threads_do_not_disturb_each_other() -> None:
    net = build(SMALL, TINY, 0)
    batches = [sparse(20, TINY, k, 0.3) for k in range(8)]
    expected = [fused_counts(net, x) for x in batches]
    with ThreadPoolExecutor(4) as pool:
        for found, want in zip(
            pool.map(lambda x: fused_counts(net, x), batches), expected, strict=True
        ):
            np.testing.assert_array_equal(found, want)


@pytest.mark.parametrize("threads", [1, 3])
def test_batches_side_by_side_keep_their_places(threads: int) -> None:
    net = build(SMALL, TINY, 0)
    x = sparse(50, TINY, 0, 0.3)
    expected = spike_counts(net, x)
    torch.set_num_threads(threads)
    for batch in (1, 7, 50, 64):
        np.testing.assert_array_equal(fused_counts(net, x, batch=batch), expected)
    assert torch.get_num_threads() == threads
    torch.set_num_threads(1)


def test_the_number_of_threads_comes_back_after_a_fault() -> None:
    torch.set_num_threads(3)
    with lone_workers() as pool:
        assert torch.get_num_threads() == 1
        assert set(pool.map(lambda _: torch.get_num_threads(), range(9))) == {1}
    assert torch.get_num_threads() == 3
    with pytest.raises(ZeroDivisionError), lone_workers() as pool:
        list(pool.map(lambda k: 1 / k, [1, 0]))
    assert torch.get_num_threads() == 3
    torch.set_num_threads(1)


def test_other_thresholds_are_taken_from_the_layer() -> None:
    net = build(SMALL, TINY, 0)
    x = sparse(10, TINY, 0, 0.3)
    first = spike_counts(net, x)
    for name in SPIKING:
        getattr(net, name).spike_threshold.data.fill_(0.625)
    second = spike_counts(net, x)
    assert (first != second).any()
    np.testing.assert_array_equal(fused_counts(net, x), second)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("spike_fn", MultiSpike),
        ("reset_fn", MembraneSubtract()),
        ("reset_fn", MembraneReset(0.5)),
        ("surrogate_grad_fn", PeriodicExponential()),
    ],
)
def test_a_neuron_of_another_kind_is_refused(name: str, value: object) -> None:
    net = build(SMALL, TINY, 0)
    setattr(net.iaf3, name, value)
    with pytest.raises(TypeError, match="iaf3"):
        fused_counts(net, sparse(1, TINY, 0, 0.1))


def test_wrong_samples_are_named() -> None:
    net = build(SMALL, TINY, 0)
    with pytest.raises(ValueError, match="expected"):
        fused_counts(net, np.zeros((1, 9, 1, 6, 6), np.uint8))
    assert fused_counts(net, np.zeros((0, 10, 1, 6, 6), np.uint8)).shape == (0, 3)
