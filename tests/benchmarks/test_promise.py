"""The benchmark that holds promises of false alarms against other worlds."""

from __future__ import annotations

import pytest

from benchmarks import promise
from sliplab.plugins.bench.definition import SIZES


def test_promise_counts_sets_hours_and_alarms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(promise, "SIZES", {"full": SIZES["small"]})
    found = promise.measure(sets=2, seed=1, worlds="usual")
    assert found["sets"] == found["kept_sets"] == 2.0
    assert 4 * 100 / 3600 < found["hours"] < 1.0  # four holds of at least 100 s
    assert found["least_alarms"] == found["least_per_hour"] * found["hours"] == 0.0
    assert found["least_per_hour_low"] == 0.0
    assert found["least_per_hour_high"] == pytest.approx(3.689 / found["hours"], rel=1e-3)


def test_other_sets_have_other_worlds() -> None:
    one, two = (promise.other_validation(SIZES["small"], 1, n, "hard") for n in (0, 1))
    again = promise.other_validation(SIZES["small"], 1, 0, "hard")
    assert [scene.rig for scene in one] == [scene.rig for scene in again]
    assert one[0].rig != two[0].rig
