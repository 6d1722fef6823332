"""Event times on curved paths against roots of a pixel's own log intensity by Brent's method."""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import brentq

from sliplab.plugins.simulation.scene.edges import CUT
from sliplab.plugins.simulation.scene.events import EventOptics, Events, MarkerSensor
from sliplab.plugins.simulation.scene.marker_path import (
    excursion,
    fit_blocks,
    inner_weights,
    slope_weights,
)
from tests.plugins.simulation.scene.steps import QUIET

OPTICS = EventOptics(**QUIET)
ONE = np.zeros((1, 2))
RADIUS_PX = OPTICS.px_per_mm * OPTICS.radius_mm
Path = Callable[[float], tuple[float, float, float]]
"""Column and row (px, from the picture's centre) and growth (px) at a time in s."""


def vibrating(t: float) -> tuple[float, float, float]:
    """A ramp of 3 px/s with a vibration of 5 Hz and 0.05 px, across it and along it."""
    swing = 2 * math.pi * 5.0 * t
    along = 3.0 * t + 0.05 * math.sin(swing)
    return along, 0.4 * t + 0.03 * math.cos(swing), 0.02 * math.sin(0.7 * swing)


def there_and_back(t: float) -> tuple[float, float, float]:
    """Turns round in the middle of a block, at 0.25 s, and 0.0125 s later has passed it again."""
    return 4.0 * (t - 0.25) ** 2 / 0.05, 0.0, 0.0


def loads_on(path: Path, t_s: np.ndarray, optics: EventOptics = OPTICS) -> np.ndarray:
    """Forces that put the marker there, (m, 3)."""
    place = np.array([path(t) for t in t_s])
    drag = optics.px_per_mm * optics.shift_mm_per_n
    scale = np.array([-drag, drag, optics.px_per_mm * optics.growth_mm_per_n])
    return place / scale


def sensed(
    path: Path, end_ms: int, step_ms: int, kind: str = "cubic", block_ms: int = 32
) -> Events:
    optics = EventOptics(**{**QUIET, "path": kind, "block_ms": block_ms})
    t_ns = np.arange(0, end_ms + 1, step_ms, dtype=np.int64) * 1_000_000
    loads = loads_on(path, t_ns * 1e-9)
    sensor = MarkerSensor(optics, ONE, 1)
    sensor.reset(loads[0], 1)
    return sensor.sense(loads, t_ns)


def crossings(path: Path, x: int, y: int, end_s: float, grid_s: float) -> list[tuple[float, int]]:
    """Times (s) and polarities of one pixel: its log intensity against its last reference."""
    tail = 1 / (1 + math.exp(CUT))

    def level(t: float) -> float:
        column, row, growth = path(t)
        gap = math.hypot(x - 319.5 - column, y - 239.5 - row) - RADIUS_PX - growth
        if abs(gap) >= CUT * OPTICS.edge_px:
            return 0.0 if gap > 0 else OPTICS.contrast
        share = 1 / (1 + math.exp(gap / OPTICS.edge_px))
        return OPTICS.contrast * (share - tail) / (1 - 2 * tail)

    found: list[tuple[float, int]] = []
    reference, begin = level(0.0), 0.0
    grid = np.append(np.arange(0.0, end_s, grid_s)[1:], end_s)
    for end in grid:
        while True:
            sign = 1 if level(end) > reference else -1
            target = reference + sign * OPTICS.threshold
            # a flat level that is met again is met where the edge ends, whatever the rounding
            for flat, inwards in ((0.0, 1e-10), (OPTICS.contrast, -1e-10)):
                if abs(target - flat) < 1e-8:
                    target = flat + inwards
            if sign * (level(end) - target) < 0:
                break
            at = brentq(lambda t, aim=target: level(t) - aim, begin, end, xtol=1e-14, rtol=1e-14)
            found.append((at, int(sign > 0)))
            reference, begin = target, at
        begin = end
    return found


def errors_us(events: Events, path: Path, end_s: float, pixels: int) -> np.ndarray:
    """Errors of the times of every so many-th pixel that fired; numbers and signs must agree."""
    t_ns, x, y, p = events
    fired = sorted(set(zip(x.tolist(), y.tolist(), strict=True)))
    errors = []
    for px, py in fired[:: max(len(fired) // pixels, 1)]:
        here = (x == px) & (y == py)
        expected = crossings(path, px, py, end_s, 1e-3)
        assert p[here].tolist() == [sign for _, sign in expected]
        errors.append(t_ns[here] * 1e-3 - np.array([t for t, _ in expected]) * 1e6)
    return np.concatenate(errors)


@pytest.mark.long
def test_a_vibrating_marker_fires_within_a_microsecond() -> None:
    events = sensed(vibrating, 1600, 4)
    error = np.abs(errors_us(events, vibrating, 1.6, 120))
    assert len(error) > 300
    assert np.percentile(error, 95) < 1.0
    assert np.median(error) < 0.1


def test_no_pixel_is_missed_on_a_curved_path() -> None:
    """Also pixels that should stay silent: all round the rim, not only those that fired."""
    _, x, y, p = sensed(vibrating, 640, 4)
    rows, columns = np.mgrid[215:265:3, 295:345:3]
    counted = 0
    for px, py in zip(columns.ravel().tolist(), rows.ravel().tolist(), strict=True):
        expected = crossings(vibrating, px, py, 0.64, 2e-3)
        assert p[(x == px) & (y == py)].tolist() == [sign for _, sign in expected]
        counted += len(expected)
    assert counted > 100


def test_a_reversal_inside_a_block_is_found() -> None:
    events = sensed(there_and_back, 480, 4)
    # the path is a parabola, which cubics through rows give exactly: only rounding is left
    error = np.abs(errors_us(events, there_and_back, 0.48, 60))
    assert len(error) > 200
    assert error.max() < 0.01


def test_a_reversal_between_two_rows_is_found() -> None:
    """Rows 32 ms apart: a pixel is reached and left again between two of them."""

    def turn(t: float) -> tuple[float, float, float]:
        return 30.0 * (t - 0.048) ** 2 / 0.048**2, 0.0, 0.0

    optics = EventOptics(**{**QUIET, "threshold": 0.02, "block_ms": 64})
    t_ns = np.arange(4, dtype=np.int64) * 32_000_000
    loads = loads_on(turn, t_ns * 1e-9)
    sensor = MarkerSensor(optics, ONE, 1)
    sensor.reset(loads[0], 1)
    t_ns, x, y, p = sensor.sense(loads[:3], t_ns[:3])
    # to the left of the marker, which comes to 0 at 48 ms and goes away again
    row = y == 239
    between = row & (t_ns > 32_000_000) & (x < 319)
    assert set(p[between].tolist()) == {0, 1}
    last_on, first_off = t_ns[between & (p == 1)].max(), t_ns[between & (p == 0)].min()
    assert last_on < 48_000_000 < first_off


@pytest.mark.quick(1)
@pytest.mark.parametrize(("kind", "least", "most"), [("chord", 1.7, 2.3), ("cubic", 3.7, 5.0)])
def test_the_order_of_event_times(kind: str, least: float, most: float) -> None:
    """Five swings of a marker; medians of errors of times against Brent's roots."""

    def path(t: float) -> tuple[float, float, float]:
        return 12.0 * t + 0.4 * math.sin(31.4 * t), 3.0 * math.sin(15.0 * t), 0.0

    errors = []
    for step_ms in (16, 8, 4):
        t_ns, x, y, p = sensed(path, 960, step_ms, kind, 64)
        found, pixels = [], sorted(set(zip(x.tolist(), y.tolist(), strict=True)))[::20]
        for px, py in pixels:
            here = (x == px) & (y == py)
            expected = crossings(path, px, py, 0.96, 1e-3)
            # on a coarse path a pixel near a reversal may just meet or just miss a threshold
            if p[here].tolist() == [sign for _, sign in expected]:
                found.append(t_ns[here] * 1e-9 - np.array([t for t, _ in expected]))
        assert len(found) > 0.6 * len(pixels) > 30
        errors.append(float(np.median(np.abs(np.concatenate(found)))))
    assert least < math.log2(errors[0] / errors[2]) / 2 < most


@pytest.mark.parametrize("rows", [2, 3, 4, 5, 9])
def test_a_block_follows_a_polynomial_that_it_can_hold(rows: int) -> None:
    """On uneven rows: lines through two, parabolas through three, cubics through more."""
    rng = np.random.default_rng(rows)
    t = np.concatenate([[0.0], np.cumsum(rng.choice([1.0, 2.0, 4.0], rows - 1))])
    order = min(rows, 4)
    polynomial = np.polynomial.Polynomial(rng.standard_normal(order) / 4.0 ** np.arange(order))
    curve = fitted(t, polynomial(t))
    for k in range(rows - 1):
        for s in (0.0, 0.3, 0.5, 1.0):
            tau = s * (t[k + 1] - t[k])
            c = curve[:4, k]
            value = c[0] + tau * (c[1] + s * (c[2] + s * c[3]))
            assert value == pytest.approx(polynomial(t[k] + tau), abs=1e-12)
    fine = np.linspace(0.0, t[-1], 2001)
    strays, off_chord = excursion(t, curve, rows - 1, np.empty((4, rows)))
    assert strays >= np.abs(polynomial(fine) - polynomial(0.0)).max() - 1e-12
    chord = sorted((polynomial(0.0), polynomial(t[-1])))
    outside = np.maximum(chord[0] - polynomial(fine), polynomial(fine) - chord[1]).max()
    assert off_chord >= outside - 1e-12


def fitted(t: npt.NDArray[np.float64], place: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the cubics of a column's places in one block, see `fit_blocks`."""
    rows = len(t)
    path = np.zeros((1, 3, rows))
    path[0, 0] = place
    curve, inverse, weights = np.empty((12, rows)), np.empty(rows), np.empty((4, rows + 1))
    inner, first = np.empty((3, rows)), np.array([0, rows - 1])
    slope_weights(t, 0, rows - 1, 0, inverse, weights)
    inner_weights(first, 1, weights, inner)
    fit_blocks(path, 0, 0, first, 1, False, inverse, weights, inner, curve)
    return curve


@pytest.mark.parametrize("at", range(8))
@pytest.mark.parametrize("gap", [1e-1, 3e-3, 1e-6])
def test_a_leap_between_rows_that_nearly_coincide_stays_a_leap(at: int, gap: float) -> None:
    """A plate lands just before a row, and a tip springs by 1 px: the curve goes no further.

    Slopes of a cubic through these rows would take it out by 1 px times the ratio of the steps.
    """
    t = np.sort(np.append(np.arange(9.0), at + 1 - gap))
    place = np.where(t > at + 1 - gap / 2, 1.0, 0.0)
    curve = fitted(t, place)
    strays, off_chord = excursion(t, curve, len(t) - 1, np.empty((4, len(t))))
    assert 1.0 <= strays < 1.5
    assert off_chord < 0.5
    for k in range(len(t) - 1):
        tau = np.linspace(0.0, t[k + 1] - t[k], 50)
        s = tau / (t[k + 1] - t[k])
        value = curve[0, k] + tau * (curve[1, k] + s * (curve[2, k] + s * curve[3, k]))
        assert value.min() > -0.2
        assert value.max() < 1.2


def test_a_row_that_nearly_coincides_with_another_bends_no_smooth_path() -> None:
    """Steps of 1 ms, and a row 3 us before one of them: the error stays of third order."""
    errors = []
    for step in (2.0, 1.0, 0.5):
        t = np.sort(np.append(np.arange(0.0, 16.5, step), 8.0 - 3e-3 * step))
        curve, wave = fitted(t, np.sin(0.3 * t)), 0.0
        for k in range(len(t) - 1):
            s = np.linspace(0.0, 1.0, 20)
            tau = s * (t[k + 1] - t[k])
            value = curve[0, k] + tau * (curve[1, k] + s * (curve[2, k] + s * curve[3, k]))
            wave = max(wave, float(np.abs(value - np.sin(0.3 * (t[k] + tau))).max()))
        errors.append(wave)
    assert errors[0] < 0.02
    assert np.log2(errors[0] / errors[2]) / 2 > 2.7
