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


def test_stall_timer_counts_on_the_clock_and_step_given() -> None:
    now_ns = [0]
    stall = StallTimer(lambda: now_ns[0], step_s=1.0)
    assert stall.waited_s((None,)) == 0.0
    now_ns[0] = 700_000_000
    assert stall.waited_s((None,)) == pytest.approx(0.7)
    now_ns[0] = 9_000_000_000
    assert stall.waited_s((None,)) == pytest.approx(1.7)
