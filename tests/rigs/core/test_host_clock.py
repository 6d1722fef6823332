"""A computer that stood still is not taken for a device that does."""

from __future__ import annotations

import time

import pytest

from sliplab.rigs.core.host_clock import STEP_S, StallTimer


def test_only_time_that_somebody_watched_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic_ns", lambda: round(now_s * 1e9))
    stall = StallTimer()
    assert stall.waited_s(1) == 0.0
    now_s = 0.05
    assert stall.waited_s(1) == pytest.approx(0.05)
    now_s = 20.05  # it stood still
    assert stall.waited_s(1) == pytest.approx(0.05 + STEP_S)
    now_s = 20.1
    assert stall.waited_s(2) == 0.0  # it moved
