"""The event-driven network gives Sinabs' spikes exactly, whole, step by step and in any company."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sinabs.activation import MembraneReset, MembraneSubtract, MultiSpike, PeriodicExponential
from torch import nn

from sliplab.analysis.networks.network import (
    GRID,
    SPIKING,
    build,
    by_class,
    exact,
    matrices,
    on_grid,
    reset_states,
    set_matrices,
    spike_counts,
)
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows
from tests.patching import loose

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = NetworkSettings(conv1_channels=3, conv2_channels=4, hidden=9)
TINY = Windows(length_ms=10, crop_px=120)
FULL = Windows()
TAXELS = Windows(length_ms=250, taxels=39, polarity="both")


def put(net: nn.Sequential, values: list[np.ndarray]) -> nn.Sequential:
    set_matrices(net, values)
    return net


def biased(net: nn.Sequential, seed: int) -> nn.Sequential:
    """With biases that make some neurons fire by themselves and keep some down."""
    values = matrices(net)
    for value in values[2:]:
        value[:, -1] = np.random.default_rng(seed).normal(0.02, 0.05, len(value))
    return put(net, values)


def gridded(network: NetworkSettings, windows: Windows, seed: int) -> nn.Sequential:
    """Fresh weights and biases, on the grid."""
    return on_own_grid(biased(build(network, windows, seed), seed))


def on_own_grid(net: nn.Sequential) -> nn.Sequential:
    """The same with its numbers at the nearest points of their grids."""
    return put(net, on_grid(matrices(net)))


def sparse(n: int, windows: Windows, seed: int, share: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = (n, windows.steps, windows.channels, windows.cells, windows.cells)
    return rng.poisson(share, shape).astype(np.uint8)


@pytest.mark.quick(2)
@pytest.mark.parametrize("share", [0.004, 0.03, 0.5, 80.0])
def test_spike_counts_are_sinabs_own(share: float) -> None:
    for seed in range(3):
        net = gridded(NetworkSettings(), FULL, seed)
        assert exact(matrices(net))
        x = sparse(24, FULL, seed, share)
        expected = spike_counts(net, x)
        engine = SpikeEngine(net, FULL.cells)
        np.testing.assert_array_equal(engine.counts(x), expected)
        np.testing.assert_array_equal(engine.counts(SparseWindows.of(x)), expected)
        assert expected.any() or share < 0.01


@pytest.mark.parametrize("polarity", ["positive", "both"])
@pytest.mark.parametrize(
    ("k1", "k2", "outputs"),
    [(1, 1, 1), (3, 5, 2), (5, 3, 4), (7, 7, 11), (1, 7, 3), (7, 1, 64)],
)
@pytest.mark.parametrize("crop", [20, 100, 120])
def test_every_shape_of_network(polarity: str, k1: int, k2: int, outputs: int, crop: int) -> None:
    """One cell a side, an odd number, an even number; channels that fill no vector."""
    windows = Windows(length_ms=8, crop_px=crop, polarity=polarity)
    network = NetworkSettings(
        conv1_channels=3,
        conv2_channels=5,
        hidden=9,
        biases=outputs != 2,
        outputs_per_class=outputs,
        conv1_kernel=k1,
        conv2_kernel=k2,
    )
    net = gridded(network, windows, 1)
    x = sparse(6, windows, 2, 0.5)
    np.testing.assert_array_equal(SpikeEngine(net, windows.cells).counts(x), spike_counts(net, x))


def test_how_often_each_layer_fires() -> None:
    net = on_own_grid(build(SMALL, TINY, 0))
    x = sparse(5, TINY, 0, 0.3)
    seen: dict[str, np.ndarray] = {}
    hooks = [
        getattr(net, n).register_forward_hook(
            lambda _m, _i, out, n=n: seen.update({n: out.detach().numpy()})
        )
        for n in SPIKING
    ]
    spike_counts(net, x)
    for hook in hooks:
        hook.remove()
    _, fired = SpikeEngine(net, TINY.cells).spikes(x)
    each = [seen[n].reshape(5, -1).sum(axis=1) for n in SPIKING]
    np.testing.assert_array_equal(fired, np.stack(each, axis=1))
    assert fired.all()


grid_weights = st.integers(-3, 3)


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_extremes(data: st.DataObject) -> None:
    """Weights of a few whole quarters, so that thresholds are met exactly again and again."""
    windows = Windows(
        length_ms=5, crop_px=60, polarity=data.draw(st.sampled_from(["positive", "both"]))
    )
    network = NetworkSettings(
        conv1_channels=2,
        conv2_channels=2,
        hidden=3,
        outputs_per_class=data.draw(st.integers(1, 4)),
        conv1_kernel=3,
    )
    net = build(network, windows, 0)
    values = [
        data.draw(hnp.arrays(np.int8, w.shape, elements=st.integers(-4, 4))).astype(np.float32) / 4
        for w in matrices(net)
    ]
    put(net, values)
    shape = (data.draw(st.integers(1, 4)), 5, windows.channels, 3, 3)
    counts = st.sampled_from([0, 0, 0, 1, 1, 2, 4, 255])
    x = data.draw(hnp.arrays(np.uint8, shape, elements=counts))
    engine = SpikeEngine(net, windows.cells)
    expected = spike_counts(net, x)
    np.testing.assert_array_equal(engine.counts(x), expected)
    one_by_one = np.concatenate([spike_counts(net, x[k : k + 1]) for k in range(len(x))])
    np.testing.assert_array_equal(one_by_one, expected)
    for sample, total in zip(x, expected, strict=True):
        stream = engine.stream()
        steps = np.array([stream.push(plane) for plane in sample])
        np.testing.assert_array_equal(steps.sum(axis=0), total)


def test_a_threshold_that_is_reached_exactly_fires() -> None:
    windows = Windows(length_ms=4, step_ms=1, crop_px=20)
    network = NetworkSettings(
        conv1_channels=1, conv2_channels=1, hidden=1, conv1_kernel=1, conv2_kernel=1
    )
    net = build(network, windows, 0)
    first, *rest = (np.ones_like(w) for w in matrices(net))
    for value in rest[1:]:
        value[:, -1] = 0.0
    x = np.array([1, 1, 0, 3], np.uint8).reshape(1, 4, 1, 1, 1)
    for weight, spikes in ((0.5, 2), (0.5 - GRID[0], 1), (0.2, 1), (0.25, 1), (-1.0, 0)):
        put(net, [np.full_like(first, weight), *rest])
        expected = [[spikes * network.outputs_per_class] * 3]
        assert SpikeEngine(net, 1).counts(x).tolist() == expected
        np.testing.assert_array_equal(spike_counts(net, x), expected)


@pytest.mark.parametrize("fill", [0, 1, 255])
def test_empty_and_saturated_windows(fill: int) -> None:
    net = gridded(NetworkSettings(), FULL, 3)
    x = np.full((3, 30, 1, 20, 20), fill, np.uint8)
    expected = spike_counts(net, x)
    np.testing.assert_array_equal(SpikeEngine(net, 20).counts(x), expected)
    assert expected.any()  # by the biases alone where there is no event
    plain = put(net, [matrices(net)[0] * 0, *matrices(net)[1:]])
    silent = spike_counts(plain, x)
    np.testing.assert_array_equal(SpikeEngine(plain, 20).counts(x), silent)
    if fill == 0:
        np.testing.assert_array_equal(expected, silent)


def test_whole_and_step_by_step_for_long() -> None:
    """A stream without resets is Sinabs' own network that keeps its states."""
    windows = Windows(length_ms=200, crop_px=120)
    net = gridded(SMALL, windows, 5)
    x = sparse(1, windows, 6, 0.2)
    reset_states(net)
    with torch.no_grad():
        expected = by_class(net(torch.from_numpy(x[0].astype(np.float32)))).numpy()
    stream = SpikeEngine(net, windows.cells).stream()
    np.testing.assert_array_equal([stream.push(plane) for plane in x[0]], expected)
    assert expected.any()


def test_samples_know_nothing_of_each_other() -> None:
    net = gridded(SMALL, TINY, 0)
    x = np.concatenate([sparse(150, TINY, k, share) for k, share in enumerate((0.05, 2.0))])
    engine = SpikeEngine(net, TINY.cells)
    expected = engine.counts(x)
    order = np.random.default_rng(0).permutation(len(x))
    np.testing.assert_array_equal(engine.counts(x[order]), expected[order])
    for k in (0, 17, 299):
        np.testing.assert_array_equal(engine.counts(x[k : k + 1])[0], expected[k])


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_number_of_threads_changes_nothing(threads: int) -> None:
    net = gridded(SMALL, TINY, 0)
    x = sparse(300, TINY, 0, 0.3)
    engine = SpikeEngine(net, TINY.cells)
    np.testing.assert_array_equal(engine.counts(x, threads), spike_counts(net, x))


def test_threads_do_not_disturb_each_other() -> None:
    engine = SpikeEngine(gridded(SMALL, TINY, 0), TINY.cells)
    batches = [sparse(20, TINY, k, 0.3) for k in range(8)]
    expected = [engine.counts(x) for x in batches]
    with ThreadPoolExecutor(4) as pool:
        for found, want in zip(pool.map(engine.counts, batches), expected, strict=True):
            np.testing.assert_array_equal(found, want)


def test_an_engine_has_the_weights_of_its_beginning() -> None:
    net = gridded(SMALL, TINY, 0)
    x = sparse(3, TINY, 0, 0.3)
    engine = SpikeEngine(net, TINY.cells)
    before = engine.counts(x)
    put(net, [np.zeros_like(w) for w in matrices(net)])
    np.testing.assert_array_equal(engine.counts(x), before)
    assert before.any()


def test_other_thresholds_are_taken_from_the_layers() -> None:
    net = gridded(SMALL, TINY, 0)
    x = sparse(10, TINY, 0, 0.3)
    first = spike_counts(net, x)
    for name in SPIKING:
        getattr(net, name).spike_threshold.data.fill_(0.625)
    second = spike_counts(net, x)
    assert (first != second).any()
    np.testing.assert_array_equal(SpikeEngine(net, TINY.cells).counts(x), second)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("spike_fn", MultiSpike),
        ("reset_fn", MembraneSubtract()),
        ("reset_fn", MembraneReset(0.5)),
        ("surrogate_grad_fn", PeriodicExponential()),
        ("spike_threshold", torch.nn.Parameter(torch.tensor(0.0))),
        ("spike_threshold", torch.nn.Parameter(torch.tensor(0.5))),
    ],
)
def test_a_neuron_of_another_kind_is_refused(name: str, value: object) -> None:
    net = build(SMALL, TINY, 0)
    setattr(net.iaf3, name, value)
    with pytest.raises(TypeError, match=r"iaf3|differ"):
        SpikeEngine(net, TINY.cells)


def test_wrong_samples_are_named() -> None:
    engine = SpikeEngine(build(SMALL, TINY, 0), TINY.cells)
    for shape in ((1, 9, 1, 6, 6), (1, 10, 1, 5, 5)):
        with pytest.raises(ValueError, match="expected"):
            engine.counts(np.zeros(shape, np.uint8))
        with pytest.raises(ValueError, match="expected"):
            engine.counts(SparseWindows.of(np.zeros(shape, np.uint8)))
    with pytest.raises(ValueError, match="uint8"):
        loose(engine).counts(np.zeros((1, 10, 1, 6, 6)))  # as it says
    with pytest.raises(ValueError, match="a step is"):
        engine.stream().push(np.zeros((1, 5, 5), np.uint8))
    assert engine.counts(np.zeros((0, 10, 1, 6, 6), np.uint8)).shape == (0, 3)


def test_weights_off_the_grid_or_too_large_are_not_exact() -> None:
    values = on_grid(matrices(build(NetworkSettings(), FULL, 0)))
    assert exact(values)
    values[1][0, 0, 0, 0] += np.float32(GRID[1] / 2)
    assert not exact(values)
    values = on_grid(values)
    values[0][0] = 2.0
    assert not exact(values)
    assert exact(values, most=100)


@pytest.mark.parametrize("classes", [2, 5, 36])
@pytest.mark.parametrize("outputs", [1, 3])
def test_any_number_of_classes(classes: int, outputs: int) -> None:
    """Of taxels, 78 channels of one cell, over 250 steps; and of a square crop."""
    for windows, share in ((TAXELS, 0.13), (TINY, 0.3)):
        network = NetworkSettings(
            conv1_channels=9,
            conv2_channels=7,
            hidden=11,
            outputs_per_class=outputs,
            weight_scale=(1.0, 3.0, 4.0, 3.0),
        )
        net = on_own_grid(biased(build(network, windows, 4, classes), 4))
        x = sparse(5, windows, classes, share)
        expected = spike_counts(net, x)
        assert expected.shape == (5, classes)
        assert expected.any()
        engine = SpikeEngine(net, windows.cells)
        np.testing.assert_array_equal(engine.counts(x), expected)
        stream = engine.stream()
        steps = np.array([stream.push(plane) for plane in x[0]])
        np.testing.assert_array_equal(steps.sum(axis=0), expected[0])
