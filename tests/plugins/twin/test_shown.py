"""What is shown of a pilot and its twin, on slides drawn with known values."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.plugins.twin.pilot import Forces, PilotTrial, SlideEvents, SlideMotion
from sliplab.plugins.twin.shown import (
    QUANTITIES,
    SameTrials,
    SlideCurves,
    compare,
    event_map,
    quantities,
    rate_per_s,
    show,
    slips_s,
)
from sliplab.storage.streams import EventChunk

PLACES = np.array([[0.0, 0.0], [5.6, 0.0], [0.0, 5.6]])


def drawn(slip_s: float = 1.0, events: EventChunk | None = None) -> PilotTrial:
    """Three markers: the second slips at `slip_s`, the first a second later, the third never."""
    t = np.arange(-1.0, 4.0, 0.01)
    path = np.zeros((len(t), 3))
    path[:, 0] = np.maximum(t - slip_s - 1.0, 0.0)
    path[:, 1] = np.maximum(t - slip_s, 0.0)
    tips = PLACES + path[..., None] * [1.0, 0.0]
    base = np.maximum(t, 0.0)[:, None] * [1.0, 0.0]
    camera = None if events is None else SlideEvents(events, (640, 480))
    force_s = np.arange(-1.0, 4.0, 0.001)
    load = np.column_stack([0.0 * force_s, 3.0 * (force_s > 2.0), 0.0 * force_s + 2.5])
    slide = SlideMotion(2.8, 1.0, np.array([1.0, 0.0]))
    return PilotTrial("t", slide, -1.0, 4.0, t, tips, base, camera, Forces(force_s, load))


def events(t_us: list[int], x: list[int], y: list[int], p: list[int]) -> EventChunk:
    return EventChunk(
        np.array(x, np.uint16), np.array(y, np.uint16), np.array(p, np.uint8), np.array(t_us)
    )


def test_a_marker_slips_where_it_passed_a_tenth_of_a_millimetre() -> None:
    # at 1 mm/s that is 0.1 s after it let go, between frames too
    assert slips_s(drawn(1.0)) == pytest.approx([2.1, 1.1, np.nan], abs=1e-9, nan_ok=True)
    assert slips_s(drawn(1.003))[1] == pytest.approx(1.103, abs=1e-9)


def test_quantities_of_a_trial() -> None:
    seen = events([-500_000, 200_000, 300_000, 1_500_000], [0] * 4, [0] * 4, [1, 1, 0, 1])
    found = quantities(drawn(1.0, seen))
    assert found["first_slip_s"] == pytest.approx(1.1)
    assert found["centre_slip_s"] == pytest.approx(2.1)
    assert found["hold_events_per_s"] == pytest.approx(1.0)
    assert found["loading_events_per_s"] == pytest.approx(1 / 1.1)
    assert found["sliding_events_per_s"] == pytest.approx(1 / 2.9)
    assert found["normal_n"] == pytest.approx(2.5)
    assert found["tangential_n"] == pytest.approx(3.0)


def test_rates_and_maps_count_positive_events_only() -> None:
    seen = events(
        [-950_000, 50_000, 60_000, 70_000], [0, 80, 559, 79], [0, 0, 479, 0], [1, 1, 1, 1]
    )
    trial = drawn(1.0, seen)
    middles, rates = rate_per_s(trial)
    assert middles[0] == pytest.approx(-0.95)
    assert rates[0] == pytest.approx(10.0)
    assert rates[10] == pytest.approx(30.0)
    counts = event_map(trial)
    assert counts.sum() == 2  # those within the middle 480 columns, in the slide
    assert counts[0, 0] == counts[-1, -1] == 1
    with pytest.raises(ValueError, match="has no events"):
        rate_per_s(drawn())


def test_worlds_are_compared_trial_by_trial() -> None:
    def shown(*slips_s: float) -> list[SlideCurves]:
        return [show(drawn(slip_s)) for slip_s in slips_s]

    pilot = shown(1.0, 1.4)
    twin = [shown(1.1, 1.5), shown(0.9, 1.3)]
    before = [shown(1.5, 1.9)] * 2
    found = compare(SameTrials(pilot, twin, before, np.zeros(3), frozenset()))
    first = found[0]
    assert first.title == QUANTITIES["first_slip_s"]
    assert first.pilot == pytest.approx(1.3)
    assert first.twin == pytest.approx(0.0, abs=1e-9)
    assert first.before == pytest.approx(0.5)
    assert first.scatter == pytest.approx(0.2 / np.sqrt(2))
    assert QUANTITIES["hold_events_per_s"] not in {it.title for it in found}
