"""Events of a light that flickers: closed forms, and a pixel stepped through time."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.plugins.simulation.scene.events import EventOptics, Events, MarkerSensor
from sliplab.plugins.simulation.scene.flicker import new_flicker
from tests.plugins.simulation.scene.test_events import ONE, QUIET, sense, straight, times

SMALL = {**QUIET, "width": 64, "height": 64, "radius_mm": 0.2}


def swing(share: float) -> float:
    """Log intensity between the darkest and the brightest moment."""
    return math.log((1 + share) / (1 - share))


def still(optics: EventOptics, flicker: tuple[float, float], rows: int = 321) -> Events:
    """Events of a sensor that sees one marker at rest."""
    sensor = MarkerSensor(optics, ONE, 1)
    sensor.reset(np.zeros(3), 1)
    return sensor.sense(np.zeros((rows, 3)), times(rows), (*flicker, 0))


def stepped(
    on: float, off: float, level: float, share: float, hz: float, origin_ns: float, ends_us: int
) -> list[tuple[int, int]]:
    """Time (us) and polarity of the events of one pixel that is looked at every microsecond."""
    t_us = np.arange(ends_us + 1)
    seen = np.log(1 + share * np.sin(2 * np.pi * hz * (t_us * 1e3 - origin_ns) * 1e-9))
    found = []
    for t, u in zip(t_us.tolist(), seen.tolist(), strict=True):
        while u >= level + on:
            level += on
            found.append((t, 1))
        while u <= level - off:
            level -= off
            found.append((t, 0))
    return found


@pytest.mark.quick(2)
@pytest.mark.parametrize("off", [None, 0.13])
@pytest.mark.parametrize(("share", "hz"), [(0.1, 100.0), (0.31, 120.0), (0.5, 77.0)])
def test_events_are_those_of_a_pixel_stepped_through_time(
    share: float, hz: float, off: float | None
) -> None:
    optics = EventOptics(
        **{**SMALL, "threshold": 0.12, "threshold_sigma": 0.02, "threshold_off": off}
    )
    sensor = MarkerSensor(optics, ONE, 1)
    sensor.reset(np.zeros(3), 5)
    t_ns, x, y, p = sensor.sense(np.zeros((97, 3)), times(97), (share, hz, 0))
    on = sensor.threshold
    negative = on if off is None else sensor._circuit.cells[..., 4]
    light = new_flicker(share, hz, on, negative, 0, 5)
    assert len(light.place) > 3500
    events = 0
    for k in range(0, len(light.place), 400):
        column, row = light.place[k] >> 12, light.place[k] & 4095
        expected = stepped(
            light.on[k], light.off[k], light.level[k], share, hz, light.origin_ns, 96_000
        )
        assert light.on[k] == on[row, column]
        own = (x == column) & (y == row)
        events += len(expected)
        assert p[own].tolist() == [polarity for _, polarity in expected]
        late_us = np.array([t for t, _ in expected]) - t_ns[own] / 1e3
        # what happens within a microsecond is seen at its end
        assert np.all((late_us > -1e-3) & (late_us <= 1.0 + 1e-3))
    assert events > 60


@pytest.mark.parametrize("hz", [100.0, 120.0])
def test_a_pixel_has_as_many_events_as_thresholds_fit_into_the_swing(hz: float) -> None:
    share, most = 0.2, 2.4
    optics = EventOptics(**{**SMALL, "threshold": swing(share) / most})
    seconds = 1.2
    t_ns, x, y, p = still(optics, (share, hz), rows=1201)
    halves = 2 * hz * seconds
    rate = np.bincount(y.astype(int) * 64 + x, minlength=4096) / halves
    # a ladder of levels in an interval 2.4 rungs long has 2 or 3 of them, one more than events
    assert np.all((np.abs(rate - 1) < 2.5 / halves) | (np.abs(rate - 2) < 2.5 / halves))
    assert rate.mean() == pytest.approx(most - 1, abs=0.03)
    assert np.mean(p) == pytest.approx(0.5, abs=0.01)
    # all pixels brighten together, and darken together
    light = new_flicker(share, hz, np.ones((1, 1)), np.ones((1, 1)), 0, 1)
    rising = np.cos(2 * np.pi * hz * (t_ns - light.origin_ns) * 1e-9) > 0
    assert np.array_equal(p == 1, rising)


def test_a_light_below_the_thresholds_is_not_seen() -> None:
    optics = EventOptics(**{**SMALL, "threshold": 0.2})
    assert swing(0.0996) < 0.2 < swing(0.0998)
    assert len(still(optics, (0.0996, 100.0))[0]) == 0
    # an OFF threshold above the swing stops a pixel, whatever the other one is
    assert len(still(EventOptics(**{**SMALL, "threshold_off": 0.5}), (0.15, 100.0))[0]) == 0
    assert len(still(optics, (0.15, 100.0))[0]) > 1000


def test_a_moving_marker_and_the_light_add_their_events() -> None:
    optics = EventOptics(**{**QUIET, "width": 160, "height": 120, "threshold_sigma": 0.03})
    loads = straight(optics, (40.0, 7.0), 320)
    moving = sense(MarkerSensor(optics, ONE, 1), loads)
    light = still(optics, (0.1, 100.0))
    sensor = MarkerSensor(optics, ONE, 1)
    sensor.reset(loads[0], 1)
    both = sensor.sense(loads, times(321), (0.1, 100.0, 0))
    assert min(len(moving[0]), len(light[0])) > 1000
    together = np.concatenate([np.stack(moving), np.stack(light)], axis=1)
    order, found = np.lexsort(together), np.stack(both)
    assert np.array_equal(together[:, order], found[:, np.lexsort(found)])


@pytest.mark.long
def test_a_light_keeps_the_refractory_period_and_the_scans() -> None:
    optics = EventOptics(
        **{**SMALL, "threshold": 0.05, "refractory_us": 500.0, "readout_hz": 5000.0}
    )
    t_ns, x, y, _ = still(optics, (0.5, 100.0))
    pixel = y.astype(np.int64) * 64 + x
    order = np.lexsort((t_ns, pixel))
    gaps = np.diff(t_ns[order])[np.diff(pixel[order]) == 0]
    # the period holds for what happened, which is read in the next scan
    assert gaps.min() >= 400_000
    every = still(EventOptics(**{**SMALL, "threshold": 0.05}), (0.5, 100.0))
    assert 4 * len(t_ns) < 3 * len(every[0])
    assert len(set((t_ns - (x * optics.column_ns).astype(np.int64)) % 200_000)) == 1


@pytest.mark.long
@settings(max_examples=25, deadline=None)
@given(
    first=st.integers(0, 100),
    since=st.integers(0, 400),
    readout=st.sampled_from([0.0, 5000.0]),
    hz=st.sampled_from([10.0, 100.0, 333.3]),
    off=st.sampled_from([None, 0.18]),
    data=st.data(),
)
def test_chunks_do_not_matter(
    first: int, since: int, readout: float, hz: float, off: float | None, data: st.DataObject
) -> None:
    optics = EventOptics(
        width=64, height=64, noise_hz=1.0, readout_hz=readout, threshold_off=off, radius_mm=0.2
    )
    loads, t_ns = straight(optics, (30.0, 4.0), 600), times(601, first)
    sensor = MarkerSensor(optics, ONE, 7)
    light = (0.15, hz, since * 1_000_000 + 17)
    sensor.reset(loads[0], 3)
    whole = sensor.sense(loads, t_ns, light)
    sensor.reset(loads[0], 3)
    ends = [k for k in range(1, 600) if t_ns[k] % optics.block_ns == 0]
    cuts = sorted({0, 600, *data.draw(st.sets(st.sampled_from(ends)))})
    parts = [
        sensor.sense(loads[a : b + 1], t_ns[a : b + 1], light) for a, b in itertools.pairwise(cuts)
    ]
    assert len(whole[0]) > 1000
    for column, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        assert np.array_equal(column, np.concatenate(pieces))


def test_a_light_that_begins_later_is_steady_until_then() -> None:
    optics = EventOptics(**SMALL)
    sensor = MarkerSensor(optics, ONE, 1)
    sensor.reset(np.zeros(3), 1)
    t_ns, _, _, _ = sensor.sense(np.zeros((321, 3)), times(321), (0.2, 100.0, 123_456_789))
    assert 123_456_789 <= t_ns[0] < 133_456_789
    sensor.reset(np.zeros(3), 1)
    assert len(sensor.sense(np.zeros((65, 3)), times(65), (0.2, 100.0, 123_456_789))[0]) == 0


def test_a_steady_light_after_a_trial_with_flicker() -> None:
    optics = EventOptics(**{**SMALL, "noise_hz": 1.0})
    sensor = MarkerSensor(optics, ONE, 1)
    loads = straight(optics, (30.0, 4.0), 320)
    fresh = sense(sensor, loads)
    sensor.reset(loads[0], 2)
    sensor.sense(loads, times(321), (0.3, 100.0, 0))
    again = sense(sensor, loads)
    assert all(np.array_equal(a, b) for a, b in zip(fresh, again, strict=True))
