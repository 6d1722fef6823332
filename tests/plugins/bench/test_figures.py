"""Figures of detectors in the bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sliplab.analysis.detectors.alarms import Level, SceneEvidence
from sliplab.analysis.detectors.detector import Evidence, Slip
from sliplab.plugins.bench import figures
from sliplab.plugins.bench.figures import accuracy, disturbed_rate, scores
from sliplab.storage.schema.evaluation import AlarmRate

SLIP = Slip(5_000_000, 5_100_000, 8_000_000)


def judged(*pairs: tuple[float, float], slip: Slip = SLIP) -> SceneEvidence:
    """Evidence of (seconds, value)."""
    t_s, value = zip(*pairs, strict=True)
    return SceneEvidence(Evidence.of(np.round(1e6 * np.array(t_s)), value), slip)


def test_a_median_with_half_of_the_slips_missed_is_infinite() -> None:
    seen, missed = judged((5.2, 9)), judged((5.2, 0))
    assert scores([seen, missed, missed], 1).latency_ms.value is None
    found = scores([seen] * 7 + [missed], 1)
    assert found.latency_ms.value == pytest.approx(200.0)
    assert found.latency_paper_ms.value == pytest.approx(100.0)
    assert found.latency_ms.high is None, "a missed one is among the ranks"


def in_world(world: str, *at_s: float) -> SceneEvidence:
    """A scene whose evidence exceeds 1 at these times, s, and 1.2 s after the slip began."""
    return replace(judged(*((t, 9.0) for t in (*at_s, 6.2))), world=world)


def test_interval_of_false_alarms_is_wider_where_one_world_has_all() -> None:
    # Garwood 1936, table for 95 %: four events lie between 1.09 and 10.24
    hours = 8 * 5 / 3600
    spread = scores([in_world(f"{k}", *([1.0] if k % 2 else [])) for k in range(8)], 1)
    assert spread.false_alarms.low == pytest.approx(1.0899 / hours, rel=1e-4)
    assert spread.false_alarms.high == pytest.approx(10.2416 / hours, rel=1e-4)
    one = scores([in_world(f"{k}", *([0.1, 1.2, 2.3, 3.4] if k == 0 else [])) for k in range(8)], 1)
    assert one.false_alarms.value == spread.false_alarms.value == pytest.approx(4 / hours)
    assert one.false_alarms.high is not None
    assert one.false_alarms.high > 2 * 10.2416 / hours


@pytest.mark.parametrize(("at_s", "promised"), [((), True), ((1.0,), True), ((1.0, 3.0), False)])
def test_test_scenes_refute_a_promise(at_s: tuple[float, ...], promised: bool) -> None:
    slides = [in_world(f"{k}", *(at_s if k < 2 else ())) for k in range(40)]  # of 200 s
    none = AlarmRate(alarms=0, hours=1.0, value=0.0, low=None, high=None)
    (point,) = figures.tested(slides, [Level(5.0, 1.0, none, promised=True)])
    assert point.promised is promised


def test_scenes_of_a_world_are_one_in_intervals() -> None:
    """Sixty slides of six worlds, of which each has one latency: no more is known than of six."""
    slides = [
        replace(judged((5.1 + 0.1 * k, 9)), world=f"{k}") for k in range(6) for _ in range(10)
    ]
    found = scores(slides, 1)
    assert (found.slides, found.worlds) == (60, 6)
    assert (found.latency_ms.low, found.latency_ms.high) == pytest.approx((100.0, 600.0))
    alone = scores([replace(one, world="") for one in slides], 1)
    assert alone.worlds == 60
    assert alone.latency_ms.high is not None
    assert found.latency_ms.high is not None
    assert alone.latency_ms.high < found.latency_ms.high


def test_nuisances_in_one_world_have_a_rate_without_interval() -> None:
    found = disturbed_rate({"tap": [in_world("1", 1.0)], "brush": [in_world("1")]}, 1)
    assert found is not None
    assert (found.alarms, found.low, found.high) == (1, None, None)
    assert disturbed_rate({}, 1) is None


def test_accuracy_weighs_classes_and_not_windows() -> None:
    t_us = np.arange(1, 1000) * 10_000
    middle = t_us - 15_000
    true = (middle >= SLIP.paper_us).astype(int) + (middle >= SLIP.gross_us)
    values = np.zeros(len(t_us))
    assert accuracy([SceneEvidence(Evidence.of(t_us, values, true), SLIP)]) == 1.0
    never = SceneEvidence(Evidence.of(t_us, values, np.zeros(len(t_us))), SLIP)
    assert accuracy([never]) == pytest.approx(1 / 3)
    assert accuracy([SceneEvidence(Evidence.of(t_us, values), SLIP)]) is None
