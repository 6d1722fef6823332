"""Figures of a study at a setting of its scene."""

from __future__ import annotations

import pytest

from benchmarks.guesses.document import SettingScores, TrialAtSetting
from benchmarks.guesses.results import changes, figures
from sliplab.storage.schema.evaluation import TrialLatency


def setting(*latencies_ms: float | None) -> SettingScores:
    """Kinematic trials with these incipient latencies, None late; gross slip is always missed."""
    trials = [
        TrialAtSetting.model_construct(
            campaign="c",
            trial=str(k),
            experiment="kinematic",
            depth_zero_mm=None,
            latency=TrialLatency(
                latency_incipient_ms=ms,
                latency_gross_ms=None,
                lead_ms=None,
                late_incipient_ms=10.0 if ms is None else None,
                late_gross_ms=None,
                missed_incipient=False,
                missed_gross=True,
                false_early_incipient=False,
                false_early_gross=False,
            ),
        )
        for k, ms in enumerate(latencies_ms)
    ]
    return SettingScores.model_construct(trials=tuple(trials), windows={"c/0": (9, 10)})


def test_late_detections_are_infinite_in_the_median_of_a_setting() -> None:
    found = figures(setting(10.0, 20.0, 30.0, None, None))
    assert found["incipient_ms"] == pytest.approx(30.0)
    assert found["gross_ms"] is None, "all were missed"
    assert figures(setting(10.0, None, None))["incipient_ms"] is None


def test_change_of_a_median_counts_late_detections() -> None:
    base = setting(*(10.0 * k for k in range(1, 21)))
    other = setting(*(None if k <= 4 else 10.0 * k for k in range(1, 21)))
    span = changes(base, other)["incipient_ms"]
    assert span is not None
    assert span[0] >= 0
    assert span[1] > 0
