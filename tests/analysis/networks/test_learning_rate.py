"""The learning rate rises in a line and falls along half a cosine, or stays."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.networks.learning_rate import learning_rate
from sliplab.protocols.settings import Training


def test_the_rate_falls_along_half_a_cosine() -> None:
    falling = Training(epochs=10, learning_rate=1e-2, schedule="cosine")
    rates = [learning_rate(falling, done) for done in range(10)]
    assert rates[0] == 1e-2
    assert rates[5] == pytest.approx(5e-3)
    assert 0 < rates[-1] < 3e-4
    assert rates == sorted(rates, reverse=True)
    at = np.array([learning_rate(falling, k // 7, k % 7, 7) for k in range(70)])
    ramp = np.minimum(1.0, np.arange(1, 71) / (falling.warm_up * 70))
    np.testing.assert_allclose(at, 1e-2 * ramp * np.cos(np.pi * np.arange(70) / 140) ** 2)
    flat = Training(epochs=6, learning_rate=1e-2, schedule="constant")
    assert {learning_rate(flat, done) for done in range(5)} == {flat.learning_rate}


def test_the_rate_rises_in_a_line_first() -> None:
    rising = Training(epochs=10, learning_rate=1e-2, schedule="constant", warm_up=0.15)
    rates = [learning_rate(rising, k // 100, k % 100, 100) for k in range(1000)]
    np.testing.assert_allclose(rates[:150], 1e-2 * np.arange(1, 151) / 150, rtol=1e-12)
    assert set(rates[150:]) == {1e-2}
    flat = rising.model_copy(update={"warm_up": 0.0})
    assert learning_rate(flat, 0, 0, 100) == 1e-2
