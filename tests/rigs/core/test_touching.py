"""The two ways to notice a touch."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.touching import MarkerTouch, NoiseWatch, RateTouch, count_central
from sliplab.storage.streams import EventChunk

Floats = NDArray[np.float64]
FRAMES = 400
TOUCHED = 250


def way(kind: str, seed: int = 1, noise: float = 0.005) -> Floats:
    """Markers of 19 papillae over 400 frames; the centre touches in frame 250 (or never)."""
    rng = np.random.default_rng(seed)
    layout = rng.uniform(100, 600, (19, 2))
    t = np.arange(FRAMES)
    sway = 0.3 * np.column_stack([np.sin(t / 3), np.cos(t / 4)])
    drift = np.column_stack([0.002 * t, -0.001 * t])
    places = layout + sway[:, None] + drift[:, None] + noise * rng.standard_normal((FRAMES, 19, 2))
    after = np.maximum(t - TOUCHED, 0)
    if kind == "sticks":
        places[TOUCHED:, 0] -= sway[TOUCHED:] - sway[TOUCHED]
    elif kind == "leaves":
        places[:, 0, 0] += 0.02 * after
    elif kind == "drifts":  # the view changes slowly: no touch
        places[:, 0, 0] += 0.003 * t
    elif kind == "appears":
        places[:TOUCHED, 0] = np.nan
    elif kind == "flickers":  # seen now and then, for a frame or two
        places[:, 0] = np.where((t % 10 < 2)[:, None], places[:, 0], np.nan)
    elif kind == "others are lost":
        places[100:, 1:9] = np.nan
    elif kind == "knocked":
        places[TOUCHED:] += [5.0, -3.0]
    elif kind == "one jump":
        places[TOUCHED : TOUCHED + 2, 0] += 4.0
    return places


def noticed(places: Floats, pieces: int) -> int | None:
    watch = MarkerTouch()
    host = np.arange(len(places), dtype=np.int64) * 10_000_000
    for part, when in zip(
        np.array_split(places, pieces), np.array_split(host, pieces), strict=True
    ):
        found = watch.add(part, when)
        if found is not None:
            return found // 10_000_000
    return None


@pytest.mark.parametrize("pieces", [1, 400])
@pytest.mark.parametrize(("kind", "within"), [("sticks", 12), ("leaves", 12), ("appears", 0)])
def test_a_touch_is_noticed_soon_and_never_before(kind: str, within: int, pieces: int) -> None:
    found = noticed(way(kind), pieces)
    assert found is not None
    assert TOUCHED <= found <= TOUCHED + within


@pytest.mark.parametrize(
    "kind", ["nothing", "drifts", "flickers", "others are lost", "knocked", "one jump"]
)
def test_what_is_no_touch_is_not_taken_for_one(kind: str) -> None:
    assert noticed(way(kind), 80) is None


@pytest.mark.long
@pytest.mark.parametrize("noise", [0.001, 0.02, 0.2])
def test_noise_alone_is_no_touch(noise: float) -> None:
    assert all(noticed(way("nothing", seed, noise), 1) is None for seed in range(20))


def creep(
    rates_hz: Floats, seed: int = 0, quiet_hz: float = 35.0, period_s: float = 0.01
) -> RateTouch:
    """Creep in from -1.5 mm at 0.5 mm/s to the first touch, with rates of central events."""
    rng = np.random.default_rng(seed)
    watch = RateTouch(int(rng.poisson(0.5 * quiet_hz)))
    for number, rate in enumerate(rates_hz):
        at_s = (number + 1) * period_s
        if watch.touched(int(rng.poisson(rate * period_s)), 0.5 * at_s - 1.5, int(1e9 * at_s)):
            break
    return watch


def rates(kind: str, noise_hz: float = 35.0) -> Floats:
    """Rates of central events in 600 counts."""
    t = np.arange(600)
    if kind == "rises":  # to five times the noise, and never near a touch within 50 ms
        return np.where(t < 350, noise_hz, 5.0 * noise_hz)
    if kind == "doubles":
        return np.where(t < 350, noise_hz, 2.2 * noise_hz)
    if kind == "moves":  # since the arm moves
        return np.where(t < 30, noise_hz, 2.2 * noise_hz)
    if kind == "brightens":
        return noise_hz * (1.0 + t / 600)
    if kind == "flashes":
        return np.where((t >= 350) & (t < 353), 100.0 + noise_hz, noise_hz)
    if kind == "goes out":
        return np.where(t < 350, noise_hz, noise_hz / 3.0)
    return np.full(600, noise_hz)


def test_a_rate_is_a_touch_only_above_its_noise() -> None:
    quiet = RateTouch(quiet=1000)  # 100 in 50 ms
    assert not any(quiet.touched(20, 0.0, 10_000_000 * k) for k in range(200))
    five_deviations = (quiet.touched(30, 0.0, 10_000_000 * k) for k in range(200, 400))
    assert not any(five_deviations)
    assert any(quiet.touched(45, 0.0, 10_000_000 * k) for k in range(400, 405))
    silent = RateTouch(quiet=0)
    assert not silent.touched(10, 0.0, 0)
    assert silent.touched(1, 0.0, 10_000_000)


def test_a_touch_within_50_ms_is_half_of_these_before_it_is_noticed() -> None:
    jump = np.append(np.full(400, 35.0), np.full(200, 2000.0))
    watch = creep(jump)
    assert watch.surface_mm(0.5) == pytest.approx(0.5 * 4.01 - 1.5 - 0.0125, abs=0.011)


@pytest.mark.parametrize(("kind", "noise_hz"), [("rises", 35.0), ("doubles", 350.0)])
def test_a_rate_that_rises_too_little_for_50_ms_is_a_touch_where_it_rose(
    kind: str, noise_hz: float
) -> None:
    """A soft skin on a rig of little noise, and the shipped skin in ten times the noise."""
    for seed in range(30):
        surface = creep(rates(kind, noise_hz), seed, noise_hz).surface_mm(0.5)
        assert surface == pytest.approx(0.25, abs=0.15)


def test_a_touch_that_is_noticed_late_is_where_the_rate_rose() -> None:
    late = np.append(rates("rises")[:500], np.full(20, 2000.0))
    assert creep(late).surface_mm(0.5) == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize("kind", ["nothing", "moves", "brightens", "flashes", "goes out"])
@pytest.mark.parametrize("noise_hz", [1.0, 35.0, 150.0])
def test_a_rate_that_changes_otherwise_is_no_touch(kind: str, noise_hz: float) -> None:
    assert all(
        creep(rates(kind, noise_hz), seed, noise_hz).surface_mm(0.5) is None for seed in range(30)
    )


def test_counts_that_come_less_often_are_no_rise() -> None:
    """A busy computer reads the events late: more at once, in as much more time."""
    watch = RateTouch(quiet=175)
    rng = np.random.default_rng(1)
    at_s = np.cumsum(np.append(np.full(300, 0.01), np.full(100, 0.025)))
    for when, took in zip(at_s, np.diff(at_s, prepend=0.0), strict=True):
        watch.touched(int(rng.poisson(350 * took)), 0.5 * when, int(1e9 * when))
    assert watch.surface_mm(0.5) is None


def test_a_creep_without_counts_is_no_touch() -> None:
    assert RateTouch(0).surface_mm(0.5) is None


def test_only_events_near_the_centre_count() -> None:
    x = np.array([320, 349, 350, 320, 100], np.uint16)
    y = np.array([240, 240, 240, 271, 100], np.uint16)
    chunk = EventChunk(x, y, np.ones(5, np.uint8), np.arange(5, dtype=np.int64))
    assert count_central(chunk, (640, 480), None) == 2
    assert count_central(chunk, (640, 480), (100.0, 100.0)) == 1


@pytest.mark.parametrize(("rate", "seconds"), [(1.0, 60.0), (0.9999, 60.0), (0.5, 0.7)])
def test_noise_that_lags_more_and_more_is_no_noise(rate: float, seconds: float) -> None:
    """Each event is newer than the one before; by the last one the arm is already deeper."""
    now_ns = [0]

    def noise(until_s: float) -> EventChunk:
        t_us = np.arange(int(1e6 * (until_s - 0.5)), int(1e6 * until_s), 2000)
        return EventChunk(
            *(np.zeros(len(t_us), kind) for kind in (np.uint16, np.uint16, np.uint8)), t_us
        )

    watch = NoiseWatch(noise(0.0), lambda: now_ns[0], may_be_silent=False)
    polls = np.arange(0.01, seconds, 0.01)

    def run() -> None:
        for now_s in polls:
            now_ns[0] = round(now_s * 1e9)
            watch.check(noise(rate * now_s))

    if rate > 0.9:
        run()
    else:
        with pytest.raises(RigError, match=r"no newer event for 0\.2\d s"):
            run()
