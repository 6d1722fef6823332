"""One threshold for all layers changes no spike: the fast kernels against the chip's arithmetic."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.networks.network import SPIKING, build, weights
from sliplab.analysis.networks.quantised import common_net, common_threshold, quantise
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.networks.training import Fitted
from sliplab.plugins.deploy.chip import chip_run, quantised_net
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows

WINDOWS = Windows(length_ms=12, crop_px=140)


@settings(max_examples=30)
@given(st.lists(st.integers(1, 30), min_size=1, max_size=4))
def test_the_common_threshold_is_the_lowest_that_serves_all(thresholds: list[int]) -> None:
    common, multiples = common_threshold(thresholds)

    for s, m in zip(thresholds, multiples, strict=True):
        for u in range(-3, 2 * s + 3):
            assert (u >= s) == (m * u >= common)
    for lower in range(max(thresholds), common):
        # u reaches s exactly where m u reaches `lower`: for no whole m, for one of them at least
        assert not all(
            any(m * (s - 1) < lower <= m * s for m in (lower // s, lower // s + 1))
            for s in thresholds
        )


def test_thresholds_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="positive"):
        common_threshold([3, 0])


@pytest.mark.parametrize("seed", [0, 1])
def test_spikes_are_those_of_the_chips_arithmetic(seed: int) -> None:
    network = NetworkSettings(conv1_channels=4, conv2_channels=6, hidden=9)
    state = weights(build(network, WINDOWS, seed))
    fitted = Fitted(state, network, WINDOWS, Training(), seed, (), 1, ())
    whole = quantise(build(network, WINDOWS, seed))
    assert len({whole.thresholds[name] for name in SPIKING}) > 1
    x = np.random.default_rng(seed).poisson(0.5, (80, 12, 1, 7, 7)).astype(np.uint8)
    expected = chip_run(quantised_net(fitted, whole), x)
    assert set(expected.saturated.values()) == {0.0}
    assert expected.counts.sum() > 0
    assert np.array_equal(SpikeEngine(common_net(fitted, whole), 7).counts(x), expected.counts)
