"""What a hold, an unload and rubs say of a skin, on drawn events whose rates are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sliplab.analysis.detectors.papillae import FEWEST_PLACES, LEAST
from sliplab.analysis.detectors.skin_measurement import (
    HOLD,
    NOISE,
    RUB,
    UNLOAD,
    MeasuredSkin,
    SkinError,
    SkinMeasurement,
    fewest_places,
)
from sliplab.storage.streams import EVENTS_KIND, EventChunk
from tests.analysis.detectors.test_papillae import (
    CENTRES,
    END_S,
    HEIGHT,
    SLIP_S,
    WIDTH,
    Rates,
    drawn,
    moving,
    one_stops,
    still,
)

HOT = (100, 100)
DIRECTIONS = (0.0, 120.0, 240.0)


def with_hot_pixel(events: EventChunk, rng: np.random.Generator) -> EventChunk:
    """Add 100 events a second of one pixel."""
    n = round(100 * END_S)
    t_us = rng.integers(0, round(1e6 * END_S), n)
    place = [np.full(n, at, np.uint16) for at in HOT]
    both = EventChunk.concatenate([events, EventChunk(*place, np.ones(n, np.uint8), t_us)])
    return both[np.argsort(both.t_us, kind="stable")]


def measured(
    phases: list[tuple[str, Rates]], gap_s: float = 0.0, read_s: float = 0.02
) -> MeasuredSkin:
    """Play phases of 1.2 s one after the other in reads of so many seconds, with gaps between."""
    rng = np.random.default_rng(5)
    skin = SkinMeasurement(WIDTH, HEIGHT, len(CENTRES))
    begin_us = 7_000_000
    for phase, rates in phases:
        skin.step(phase)
        events = with_hot_pixel(drawn(rng, rates), rng)
        events = replace(events, t_us=events.t_us + begin_us)
        for k in range(round(END_S / read_s)):
            ends_us = begin_us + round(1e6 * read_s) * np.array([k, k + 1])
            edges = np.searchsorted(events.t_us, ends_us)
            skin.add(EVENTS_KIND, events[slice(*edges)])
        begin_us += round(1e6 * (END_S + gap_s))
    return skin.result(DIRECTIONS)


QUIET: list[tuple[str, Rates]] = [(NOISE, still), (HOLD, still), (HOLD, still), (UNLOAD, moving)]


def test_places_rates_hot_cells_and_level_are_those_drawn() -> None:
    found = measured([*QUIET, *[("settle", still), (RUB, one_stops)] * 3])
    assert found.settings.hot == ((HOT[1] // 8) * 80 + HOT[0] // 8,)
    assert found.settings.size_px == (WIDTH, HEIGHT)
    assert found.noise_hz == pytest.approx(3000 / 4800, rel=0.4)
    assert len(found.places) == len(CENTRES)
    for place in found.places:
        near = min(np.hypot(place.x_px - x, place.y_px - y) for x, y in CENTRES)
        assert near < 8, "a cell"
        assert place.rate_hz == pytest.approx(4000, rel=0.25)
    assert (found.level, found.hold_largest, found.unload_largest) == (LEAST, 0.0, 0.0)
    assert found.hold.hours == pytest.approx(2 * END_S / 3600, rel=0.02)
    assert found.hold.high == pytest.approx(3.689 / found.hold.hours, rel=1e-3)
    for rub, direction in zip(found.rubs, DIRECTIONS, strict=True):
        assert rub.direction_deg == direction
        assert rub.places >= len(CENTRES), "rings are in parts at first"
        assert rub.alarm_ms is not None
        assert 0 <= rub.alarm_ms - 1000 * SLIP_S < 20


@pytest.mark.long
def test_a_late_read_finds_the_same() -> None:
    phases = [*QUIET, *[("settle", still), (RUB, one_stops)] * 3]
    prompt, late = measured(phases), measured(phases, read_s=0.4)
    assert [rub.alarm_ms for rub in late.rubs] == pytest.approx(
        [rub.alarm_ms for rub in prompt.rubs], abs=10
    )
    assert len(late.places) == len(prompt.places) == len(CENTRES)


def test_the_level_is_above_all_evidence_without_slip() -> None:
    """An unload in which a place falls silent looks like slip, and so do the rubs then."""
    unload = [*QUIET[:-1], (UNLOAD, one_stops)]
    with pytest.raises(SkinError, match=r"no rub has evidence above \d+\.?\d*, which hold and unl"):
        measured([*unload, *[("settle", still), (RUB, moving)] * 3])


@pytest.mark.long
def test_a_skin_that_does_not_move_is_refused() -> None:
    rubs = [("settle", still), (RUB, one_stops), ("settle", still), (RUB, still)]
    with pytest.raises(SkinError, match="0 places moved at once in rub 2, at least 10 are needed"):
        measured([*QUIET, *rubs, ("settle", still), (RUB, one_stops)])


@pytest.mark.long
def test_a_camera_that_falls_silent_is_refused() -> None:
    with pytest.raises(SkinError, match=r"no events came for 20\.\d s"):
        measured([*QUIET, *[("settle", still), (RUB, one_stops)] * 3], gap_s=20.0)
    with pytest.raises(SkinError, match="no events came while the arm held still"):
        SkinMeasurement(WIDTH, HEIGHT, 19).result(DIRECTIONS)


def test_a_small_skin_needs_fewer_places() -> None:
    assert [fewest_places(n) for n in (1, 7, 19, 127)] == [3, 4, FEWEST_PLACES, FEWEST_PLACES]
