"""A computer that stood still is not taken for a device that does."""

from __future__ import annotations

import time

import pytest

from sliplab.rigs.core.stall_timer import STEP_S, Patience


def test_only_time_that_somebody_watched_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic_ns", lambda: round(now_s * 1e9))
    patience = Patience()
    assert patience.waited_s(1) == 0.0
    now_s = 0.05
    assert patience.waited_s(1) == pytest.approx(0.05)
    now_s = 20.05  # it stood still
    assert patience.waited_s(1) == pytest.approx(0.05 + STEP_S)
    now_s = 20.1
    assert patience.waited_s(2) == 0.0  # it moved
