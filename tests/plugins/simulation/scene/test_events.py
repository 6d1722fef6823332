"""Event times against closed forms, and what must not depend on how a trial is cut up."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.plugins.simulation.scene.edges import level_at, rim_of
from sliplab.plugins.simulation.scene.events import EventOptics, Events, MarkerSensor
from sliplab.plugins.simulation.scene.rim_pixels import no_lists
from tests.plugins.simulation.scene.steps import QUIET
from tests.plugins.simulation.scene.test_event_paths import crossings

STEP_NS = 1_000_000
ONE = np.zeros((1, 2))


def loads_for(centre_px: np.ndarray, optics: EventOptics, growth_px: np.ndarray | None = None):
    """Loads (m, 3) that put one marker `centre_px` (m, 2; y down) off the picture's centre."""
    scale = optics.px_per_mm * optics.shift_mm_per_n
    loads = np.zeros((len(centre_px), 3))
    loads[:, 0] = -centre_px[:, 0] / scale
    loads[:, 1] = centre_px[:, 1] / scale
    if growth_px is not None:
        loads[:, 2] = growth_px / (optics.px_per_mm * optics.growth_mm_per_n)
    return loads


def straight(optics: EventOptics, v: tuple[float, float], steps: int) -> np.ndarray:
    return loads_for(np.arange(steps + 1)[:, None] * 1e-3 * np.array(v), optics)


def times(rows: int, first_step: int = 0) -> np.ndarray:
    """True times (ns) of rows a millisecond apart."""
    return (first_step + np.arange(rows, dtype=np.int64)) * STEP_NS


def sense(sensor: MarkerSensor, loads: np.ndarray, first_step: int = 0, seed: int = 1) -> Events:
    sensor.reset(loads[0], seed)
    return sensor.sense(loads, times(len(loads), first_step))


def test_the_profile_and_its_inverse() -> None:
    for level in np.linspace(0.01, 2.07, 50):
        assert level_at(rim_of(level, 2.08, 0.8), 2.08, 0.8) == pytest.approx(level, rel=1e-12)
    assert level_at(0.0, 2.08, 0.8) == pytest.approx(1.04)
    assert level_at(4.0, 2.08, 0.8) == 0.0
    assert level_at(-4.0, 2.08, 0.8) == 2.08
    assert rim_of(0.0, 2.08, 0.8) == 4.0
    assert rim_of(2.08, 2.08, 0.8) == -4.0
    assert rim_of(-0.01, 2.08, 0.8) > 1e5
    assert rim_of(2.09, 2.08, 0.8) < -1e5


@pytest.mark.quick(1)
@pytest.mark.parametrize("v", [(37.0, 0.0), (0.0, -21.0), (13.0, 29.0), (-2.0, 0.7)])
def test_a_disc_that_moves_straight_fires_at_the_closed_form_times(v: tuple[float, float]) -> None:
    optics = EventOptics(**QUIET)
    steps = 500
    t_ns, x, y, p = sense(MarkerSensor(optics, ONE, 1), straight(optics, v, steps))
    assert np.all(np.diff(t_ns) >= 0)
    pixels = sorted(set(zip(x.tolist(), y.tolist(), strict=True)))
    total = 0
    for px, py in pixels[:: max(len(pixels) // 40, 1)]:
        here = (x == px) & (y == py)
        expected = crossings(lambda t: (v[0] * t, v[1] * t, 0.0), px, py, steps * 1e-3, 1.25e-4)
        assert p[here].tolist() == [sign for _, sign in expected]
        assert t_ns[here] == pytest.approx([t * 1e9 for t, _ in expected], abs=1000)
        total += len(expected)
    assert total > 40


def test_a_growing_disc_fires_where_its_rim_is() -> None:
    optics = EventOptics(**QUIET)
    grown = np.linspace(0.0, 3.0, 301)
    loads = loads_for(np.zeros((301, 2)), optics, grown)
    t_ns, x, y, p = sense(MarkerSensor(optics, ONE, 1), loads)
    assert len(t_ns) > 1000
    assert np.all(p == 1)
    away = np.hypot(x - 319.5, y - 239.5) - 16.8
    start, level = (
        np.array([level_at(d, optics.contrast, optics.edge_px) for d in away - grown_px])
        for grown_px in (0.0, t_ns * 1e-9 * 10.0)
    )
    share = (level - start) / optics.threshold
    assert np.abs(share - np.rint(share)).max() < 1e-4


def test_standing_still_makes_no_signal() -> None:
    optics = EventOptics(**QUIET)
    loads = loads_for(np.full((200, 2), 3.3), optics)
    assert len(sense(MarkerSensor(optics, ONE, 1), loads)[0]) == 0


def test_a_threshold_above_the_contrast_makes_no_signal() -> None:
    optics = EventOptics(threshold=2.1, contrast=2.08, **QUIET)
    assert len(sense(MarkerSensor(optics, ONE, 1), straight(optics, (40, 10), 500))[0]) == 0


def test_a_pixel_tangent_to_the_rim_has_both_crossings_or_none() -> None:
    # the rim of one threshold passes above a pixel's row at exactly its distance
    optics = EventOptics(**QUIET)
    rim = rim_of(optics.threshold, optics.contrast, optics.edge_px)
    for offset in (-1e-9, 0.0, 1e-9, 1e-4):
        above = 0.5 * (optics.height - 1) - 100 - (16.8 + rim) + offset
        row = above - 0.5 * (optics.height - 1)
        path = np.column_stack([np.linspace(-60, 60, 241), np.full(241, row)])
        t_ns, x, y, p = sense(MarkerSensor(optics, ONE, 1), loads_for(path, optics))
        here = (y == round(above + 16.8 + rim)) & (x == 320)
        assert sorted(p[here].tolist()) in ([], [0, 1])
        assert np.all((t_ns >= 0) & (t_ns <= 240 * STEP_NS))


def test_going_there_and_back_leaves_every_pixel_as_it_was() -> None:
    optics = EventOptics(**QUIET)
    out = np.linspace(0, 30, 301)[:, None] * np.array([1.0, 0.4])
    sensor = MarkerSensor(optics, ONE, 1)
    _, x, y, p = sense(sensor, loads_for(np.vstack([out, out[-2::-1]]), optics))
    balance = np.zeros((optics.height, optics.width), int)
    np.add.at(balance, (y, x), np.where(p == 1, 1, -1))
    # a pixel that began on the edge may have one event outstanding: it needs a whole threshold
    rows, columns = np.mgrid[: optics.height, : optics.width]
    away = np.abs(np.hypot(columns - 319.5, rows - 239.5) - 16.8)
    assert len(p) > 10_000
    assert np.all(balance[away >= 4.0] == 0)
    assert np.abs(balance).max() <= 1


def winding(
    optics: EventOptics, layout: np.ndarray, steps: int, seed: int, kick_n: float = 2e-4
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    kicks = rng.standard_normal((steps + 1, len(layout) * 3)) * kick_n
    kicks[: steps // 4] = 0.0
    loads = np.cumsum(kicks, axis=0)
    loads[:, 2::3] = np.abs(loads[:, 2::3])
    return loads


SPACINGS_MS = (1, 2, 4, 8, 16, 32)


def uneven_times(rng: np.random.Generator, first_ms: int, end_ms: int) -> np.ndarray:
    """Times (ns) 1 to 32 ms apart that never skip a multiple of 32 ms, as the world has them."""
    now, found = first_ms, [first_ms]
    while now < end_ms:
        fits = [ms for ms in SPACINGS_MS if now % ms == 0 and now % 32 + ms <= 32]
        now = min(now + int(rng.choice(fits)), end_ms)
        found.append(now)
    return np.array(found, np.int64) * 1_000_000


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 100),
    first=st.integers(0, 70),
    readout=st.sampled_from([0, 1000, 3300, 5000]),
    uneven=st.booleans(),
    path=st.sampled_from(["cubic", "chord"]),
    data=st.data(),
)
def test_chunks_do_not_matter(
    seed: int, first: int, readout: float, uneven: bool, path: str, data: st.DataObject
) -> None:
    optics = EventOptics(width=160, height=120, noise_hz=1.0, readout_hz=readout, path=path)
    layout = np.array([[-2.5, 0.0], [2.0, 1.0]])
    loads = winding(optics, layout, 600, seed)
    t_ns = times(601, first)
    if uneven:
        t_ns = uneven_times(np.random.default_rng(seed), first, first + 600)
        loads = loads[(t_ns - t_ns[0]) // 1_000_000]
    sensor = MarkerSensor(optics, layout, 7)
    sensor.reset(loads[0], 1)
    whole = sensor.sense(loads, t_ns)
    sensor.reset(loads[0], 1)
    # a camera hands over whole blocks of the global grid; the last one may be short
    ends = [k for k in range(1, len(t_ns) - 1) if t_ns[k] % optics.block_ns == 0]
    cuts = sorted({0, len(t_ns) - 1, *data.draw(st.sets(st.sampled_from(ends)))})
    parts = [sensor.sense(loads[a : b + 1], t_ns[a : b + 1]) for a, b in itertools.pairwise(cuts)]
    assert len(whole[0]) > 500
    assert np.all(np.diff(whole[0]) >= 0)
    for column, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        assert np.array_equal(column, np.concatenate(pieces))
    assert [column.dtype for column in whole] == [np.int64, np.uint16, np.uint16, np.uint8]


@pytest.mark.parametrize("slots", [0, 40])
def test_lists_of_pixels_change_no_event(slots: int) -> None:
    """Return whether a marker's pixels come from its list or are all examined."""
    optics = EventOptics(width=160, height=120, **QUIET)
    layout = np.array([[-2.5, 0.0], [2.0, 1.0]])
    sensor = MarkerSensor(optics, layout, 7)
    loads = winding(optics, layout, 960, 3, 2e-3)
    whole = sense(sensor, loads)
    sensor.reset(loads[0], 1)
    sensor._lists = no_lists(2, slots)
    again = sensor.sense(loads, times(961))
    assert len(whole[0]) > 5000
    assert all(np.array_equal(a, b) for a, b in zip(whole, again, strict=True))


def test_a_trial_leaves_nothing_behind_in_the_pixels() -> None:
    optics = EventOptics(width=160, height=120, noise_hz=1.0)
    layout = np.array([[-2.5, 0.0], [2.0, 1.0]])
    sensor = MarkerSensor(optics, layout, 7)
    loads = winding(optics, layout, 300, 5)
    fresh = sense(sensor, loads)
    sense(sensor, winding(optics, layout, 700, 6), seed=2)
    again = sense(sensor, loads)
    assert all(np.array_equal(a, b) for a, b in zip(fresh, again, strict=True))


def test_the_refractory_period_is_kept() -> None:
    optics = EventOptics(**{**QUIET, "threshold_sigma": 0.03, "refractory_us": 500.0})
    t_ns, x, y, _ = sense(MarkerSensor(optics, ONE, 1), straight(optics, (2000.0, 0.0), 40))
    pixel = y.astype(np.int64) * optics.width + x
    order = np.lexsort((t_ns, pixel))
    gaps = np.diff(t_ns[order])[np.diff(pixel[order]) == 0]
    assert len(gaps) > 100
    assert gaps.min() >= 500_000
