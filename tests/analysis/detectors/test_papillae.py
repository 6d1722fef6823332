"""Slip by what single papillae do, on drawn events whose rates and polarities are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import binom, chi2

from sliplab.analysis.detectors.papillae import (
    GAP_MS,
    MEMORY_MS,
    REMAINING_MEAN,
    Papillae,
    _advance,
    _log_ratio,
)
from sliplab.storage.streams import EventChunk

WIDTH, HEIGHT = 640, 480
RADIUS_PX, RATE_HZ = 28.0, 4000.0
CENTRES = [
    (120 + 100 * column, 90 + 100 * row)
    for row, columns in enumerate((5, 5, 5, 4))
    for column in range(columns)
]
"""19 markers, 44 pixels between the edges of neighbours."""
END_S, SLIP_S = 1.2, 0.8
LEVEL = 12.0

Rates = Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]


def drawn(
    rng: np.random.Generator,
    rates: Rates,
    noise_hz: float = 3000.0,
    on: Rates = lambda t: np.ones((len(t), len(CENTRES))),
    peak: float = 4,
) -> EventChunk:
    """Draw Poisson events on the markers' edges, and noise all over the sensor.

    Args:
        rates: of times, s, (n,): those of the markers, Hz, (n, 19), at most `peak` times `RATE_HZ`.
        on: their shares of ON events, likewise; noise is half ON.
    """
    most = peak * RATE_HZ
    parts = []
    for marker, (x, y) in enumerate(CENTRES):
        t = rng.uniform(0, END_S, rng.poisson(most * END_S))
        t = t[rng.uniform(0, most, len(t)) < rates(t)[:, marker]]
        angle = rng.uniform(0, 2 * np.pi, len(t))
        p = rng.uniform(0, 1, len(t)) < on(t)[:, marker]
        parts.append((t, x + RADIUS_PX * np.cos(angle), y + RADIUS_PX * np.sin(angle), p))
    n = rng.poisson(noise_hz * END_S)
    t, x, y = rng.uniform(0, END_S, n), rng.uniform(0, WIDTH, n), rng.uniform(0, HEIGHT, n)
    parts.append((t, x, y, rng.uniform(0, 1, n) < 0.5))
    t, x, y, p = (np.concatenate(each) for each in zip(*parts, strict=True))
    order = np.argsort(t)
    return EventChunk(
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        p[order].astype(np.uint8),
        (1e6 * t[order]).astype(np.int64),
    )


def evidence(events: EventChunk, chunk_us: int = 1_000_000) -> npt.NDArray[np.float64]:
    """Return the evidence of each millisecond, pushed in chunks."""
    detector = Papillae()
    detector.begin(WIDTH, HEIGHT)
    end_us = round(1e6 * END_S)
    edges = [*range(0, end_us, chunk_us), end_us]
    cuts = np.searchsorted(events.t_us, edges)
    found = [
        detector.push(events[cuts[k] : cuts[k + 1]], edges[k + 1]) for k in range(len(edges) - 1)
    ]
    times = np.concatenate([each.t_us for each in found])
    assert np.array_equal(times, np.arange(1000, end_us + 1, 1000))
    return np.concatenate([each.value for each in found])


def moving(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """All markers move alike from 0.3 s on."""
    return np.where(t[:, None] > 0.3, RATE_HZ, 0.0) * np.ones(len(CENTRES))


def one_stops(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The last marker comes to rest."""
    rates = moving(t)
    rates[t > SLIP_S, -1] = 0.0
    return rates


def one_slips_and_sticks(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The last marker jumps back within 6 ms, and is still until it is loaded again."""
    rates = moving(t)
    rates[(t > SLIP_S) & (t < SLIP_S + 0.006), -1] *= 15
    rates[(t > SLIP_S + 0.006) & (t < SLIP_S + 0.06), -1] = 0.0
    return rates


def slower(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """All markers move at a third, as when the arm slows down."""
    return moving(t) * np.where(t > SLIP_S, 1 / 3, 1.0)[:, None]


def stopping(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """All markers come to rest within 50 ms, as when the arm stops."""
    return moving(t) * np.clip((SLIP_S + 0.05 - t) / 0.05, 0, 1)[:, None]


def shaken(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """All markers swing at 15 Hz, and the swing dies away, as after a knock."""
    swing = 3 * np.abs(np.sin(2 * np.pi * 15 * t)) * np.exp(-np.maximum(t - SLIP_S, 0) / 0.1)
    return moving(t) * np.where(t > SLIP_S, 1 + swing, 1.0)[:, None]


def brushed(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """An object pushes one marker after the other; the skin itself rests."""
    places = np.array(CENTRES)[:, 0] / 100 + np.array(CENTRES)[:, 1] / 400
    front = 12 * (t[:, None] - 0.2) - places
    return RATE_HZ * np.exp(-(front**2) / 0.5)


def jolted(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Markers move slowly; for 60 ms a knock shakes each in its own way, ten times faster."""
    phase = 2.4 * np.arange(len(CENTRES))
    own = 0.5 + 0.5 * np.sin(2 * np.pi * 60 * t[:, None] + phase)
    knock = (t > SLIP_S) & (t < SLIP_S + 0.06)
    return moving(t) / 4 * np.where(knock[:, None], 1 + 15 * own, 1.0)


def held_back(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """An object pushes three neighbours while all move, and holds one of them for 60 ms."""
    rates = moving(t)
    rates[(t > SLIP_S) & (t < SLIP_S + 0.06), -3:] *= 4
    rates[(t > SLIP_S + 0.06) & (t < SLIP_S + 0.12), -1] = 0.0
    return rates


def most_let_go(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Twelve markers come to rest within 60 ms, as when a sensor twists."""
    rates = moving(t)
    for marker in range(12):
        rates[t > SLIP_S + 0.005 * marker, marker] = 0.0
    return rates


def still(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Noise alone."""
    return np.zeros((len(t), len(CENTRES)))


@pytest.mark.quick(3)
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("noise_hz", "within_ms"), [(3000.0, 20), (60000.0, 30)])
def test_a_marker_that_comes_to_rest_is_seen_at_once(
    seed: int, noise_hz: float, within_ms: int
) -> None:
    value = evidence(drawn(np.random.default_rng(seed), one_stops, noise_hz))
    slip_ms = round(1000 * SLIP_S)
    assert value[:slip_ms].max() < LEVEL
    assert (value[slip_ms : slip_ms + within_ms] > LEVEL).any()


@pytest.mark.parametrize("seed", range(5))
def test_tips_that_let_go_at_once_do_not_hide_each_other(seed: int) -> None:
    value = evidence(drawn(np.random.default_rng(seed), most_let_go))
    slip_ms = round(1000 * SLIP_S)
    assert value[:slip_ms].max() < LEVEL
    assert (value[slip_ms : slip_ms + 20] > LEVEL).any()


@pytest.mark.quick(1)
@pytest.mark.parametrize("seed", range(5))
def test_a_marker_that_comes_to_rest_while_all_swing_is_no_slip(seed: int) -> None:
    def swinging(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.full((len(t), len(CENTRES)), 0.5)

    assert evidence(drawn(np.random.default_rng(seed), one_stops, on=swinging)).max() < LEVEL


@pytest.mark.quick(2)
@pytest.mark.parametrize("seed", range(5))
def test_a_marker_that_jumps_and_sticks_again_is_no_touch(seed: int) -> None:
    value = evidence(drawn(np.random.default_rng(seed), one_slips_and_sticks, peak=15))
    slip_ms = round(1000 * SLIP_S)
    assert value[:slip_ms].max() < LEVEL
    assert (value[slip_ms : slip_ms + 40] > LEVEL).any()


@pytest.mark.quick(4)
@pytest.mark.parametrize(
    "rates", [moving, slower, stopping, shaken, brushed, jolted, held_back, still]
)
@pytest.mark.parametrize("seed", range(3))
def test_what_moves_all_alike_and_what_pushes_single_ones_is_no_slip(
    rates: Rates, seed: int
) -> None:
    assert evidence(drawn(np.random.default_rng(seed), rates)).max() < LEVEL


def shrinking(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """All markers shrink from 0.3 s on, at a fifth of the rate at which they move."""
    return moving(t) / 5


def dark(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Shares of ON events of markers that shrink."""
    return np.full((len(t), len(CENTRES)), 0.02)


def one_jumps(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The last marker moves, so that its edge causes five times the events."""
    rates = shrinking(t)
    rates[t > SLIP_S, -1] *= 5
    return rates


def one_turns(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Half of the last marker's edge becomes brighter."""
    share = dark(t)
    share[t > SLIP_S, -1] = 0.5
    return share


def faster(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """All markers shrink four times as fast, as when the arm speeds up."""
    return shrinking(t) * np.where(t > SLIP_S, 4.0, 1.0)[:, None]


def all_turn(t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """All markers swing for 60 ms, as after a knock."""
    return np.where(((t > SLIP_S) & (t < SLIP_S + 0.06))[:, None], 0.5, dark(t))


@pytest.mark.quick(3)
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("rates", "on", "within_ms"), [(one_jumps, dark, 30), (shrinking, one_turns, 120)]
)
def test_a_marker_that_turns_back_while_the_skin_is_unloaded_is_seen(
    seed: int, rates: Rates, on: Rates, within_ms: int
) -> None:
    value = evidence(drawn(np.random.default_rng(seed), rates, on=on))
    slip_ms = round(1000 * SLIP_S)
    assert value[:slip_ms].max() < LEVEL
    assert (value[slip_ms : slip_ms + within_ms] > LEVEL).any()


@pytest.mark.quick(7)
@pytest.mark.parametrize(
    ("rates", "on"), [(shrinking, dark), (faster, dark), (shrinking, all_turn), (faster, all_turn)]
)
@pytest.mark.parametrize("noise_hz", [3000.0, 60000.0])
@pytest.mark.parametrize("seed", range(3))
def test_what_unloads_all_alike_is_no_slip(
    rates: Rates, on: Rates, noise_hz: float, seed: int
) -> None:
    assert evidence(drawn(np.random.default_rng(seed), rates, noise_hz, on)).max() < LEVEL


def test_hot_pixels_that_go_out_are_no_slip() -> None:
    rng = np.random.default_rng(3)
    events = drawn(rng, moving)
    hot_us = np.sort(rng.integers(0, 800_000, 4000))
    places = rng.integers(0, 8, 4000)
    every = np.concatenate([events.t_us, hot_us])
    order = np.argsort(every, kind="stable")
    joined = EventChunk(
        np.concatenate([events.x, (40 + 70 * places).astype(np.uint16)])[order],
        np.concatenate([events.y, np.full(4000, 20, np.uint16)])[order],
        np.ones(len(every), np.uint8),
        every[order],
    )
    assert evidence(joined).max() < LEVEL


@pytest.mark.quick(3)
@pytest.mark.parametrize("chunk_us", [1000, 7300, 10_000, 333_333])
@pytest.mark.parametrize(("rates", "share"), [(one_stops, 1.0), (one_jumps, 0.02)])
def test_evidence_is_the_same_to_the_bit_in_any_chunks(
    chunk_us: int, rates: Rates, share: float
) -> None:
    events = drawn(np.random.default_rng(1), rates, on=lambda t: np.full((len(t), 19), share))
    whole = evidence(events)
    assert whole.max() > LEVEL
    assert np.array_equal(evidence(events, chunk_us), whole)


def test_a_scene_leaves_nothing_to_the_next() -> None:
    first, second = (drawn(np.random.default_rng(seed), one_stops) for seed in (1, 2))
    detector = Papillae()
    found = []
    for events in (first, second):
        detector.begin(WIDTH, HEIGHT)
        found.append(detector.push(events, round(1e6 * END_S)).value)
    assert np.array_equal(found[1], evidence(second))


def test_what_was_doubtful_when_it_came_stays_so() -> None:
    # the last of 12 places is silent for 40 ms, first while shares vary tenfold, then by chance
    counts = np.full((MEMORY_MS + GAP_MS + 40, 12), 4)
    counts[-40:, -1] = 0
    found = {}
    for scale in (100.0, 1.0):
        rest, value = np.zeros(12), np.zeros(40)
        zero, age = np.zeros(12), np.zeros(3, np.int64)
        _advance(counts, zero, rest, zero.copy(), age, scale, 10, value)
        found[scale] = rest[-1], value.max()
    assert found[1.0][1] > LEVEL > 0.0 == found[100.0][1]
    assert found[100.0][0] == pytest.approx(found[1.0][0] / 100.0)
    # all go on, and shares vary by chance again
    calm, value = np.full((MEMORY_MS + GAP_MS + 20, 12), 4), np.zeros(20)
    rest = np.zeros(12)
    rest[-1] = found[100.0][0]
    _advance(calm, zero, rest, zero.copy(), age, 1.0, 10, value)
    assert value.max() == 0.0


def test_a_step_of_pages_test_is_the_ratio_of_binomial_likelihoods() -> None:
    total, share, ratio = 40.0, 0.1, 0.25
    for n in (0.0, 3.0, 9.0):
        expected = binom.logpmf(n, total, ratio * share) - binom.logpmf(n, total, share)
        assert _log_ratio(ratio * share, share, n, total) == pytest.approx(expected, rel=1e-12)


def test_the_mean_of_the_remaining_squares_is_that_of_normal_deviates() -> None:
    most = chi2.ppf(0.5, 1)
    assert pytest.approx(chi2.expect(lambda x: x, (1,), ub=most) / 0.5, abs=1e-4) == REMAINING_MEAN
