"""Events of pixels side by side against the exact search of one pixel, and against Brent's roots.

On the same cubic path, so that what differs is the search alone.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from sliplab.plugins.simulation.scene.crossings import events_of_segment
from sliplab.plugins.simulation.scene.edges import CUT, dark_pixels, memorise_discs, rim_of
from sliplab.plugins.simulation.scene.marker_path import (
    SEGMENT,
    bound_rates,
    cut_block,
    fit_blocks,
    inner_weights,
    slope_weights,
)
from sliplab.plugins.simulation.scene.pixels import (
    FIRE_FIELDS,
    PIXEL_FIELDS,
    STEP_FIELDS,
    STRIDE,
    WAIT_FIELDS,
    events_of_pixels,
    pack_steps,
)
from sliplab.storage.kernels import njit

CONTRAST, EDGE, RADIUS = 2.08, 0.8, 8.0
HEIGHT, WIDTH, STEPS = 40, 44, 8
NS = 4_000_000


@dataclass
class Look:
    """A marker's way over three blocks of eight steps of 4 ms, and what its pixels begin with."""

    first: np.ndarray
    since: np.ndarray
    until: np.ndarray
    inverse: np.ndarray
    curve: np.ndarray
    segments: np.ndarray
    threshold: np.ndarray
    state: np.ndarray

    @property
    def rows(self) -> int:
        return int(self.first[-1])

    @property
    def path(self) -> tuple[np.ndarray, ...]:
        return self.segments, self.first, self.since, self.until, self.inverse, self.curve

    def place(self, k: int, tau: float) -> np.ndarray:
        """Column, row and radius `tau` ns after the begin of step k."""
        c = self.curve[:, k].reshape(3, 4)
        s = tau * self.inverse[k]
        place: np.ndarray = c[:, 0] + tau * (c[:, 1] + s * (c[:, 2] + s * c[:, 3]))
        return place


def look(seed: int, px: float, smooth: float) -> Look:
    """A random way of about `px` in all, of which a share `smooth` is a steady drift."""
    rng = np.random.default_rng(seed)
    total = 3 * STEPS
    kicks = (1 - smooth) * rng.standard_normal((3, total)) + smooth * rng.standard_normal((3, 1))
    kicks[2] *= 0.1
    way = np.concatenate([np.zeros((3, 1)), np.cumsum(kicks, axis=1)], axis=1) * px / total
    start = np.array([[WIDTH / 2 + 0.3], [HEIGHT / 2 - 0.4], [RADIUS]])
    path = np.ascontiguousarray((start + way)[None])
    t = np.arange(total + 1) * float(NS)
    first = np.arange(4) * STEPS
    inverse, weights, inner = np.empty(total + 1), np.empty((4, 2 * total)), np.empty((3, total))
    curve, segments = np.empty((12, total + 1)), np.empty(total, SEGMENT)
    spread = np.empty((4, total))
    for block in range(3):
        slope_weights(t, first[block], first[block + 1], block, inverse, weights)
    inner_weights(first, 3, weights, inner)
    fit_blocks(path, 0, 0, first, 3, False, inverse, weights, inner, curve)
    since = np.tile(np.arange(STEPS) * float(NS), 3)
    amount = 0
    for block in range(3):
        begin, end = first[block : block + 2]
        room = since, since + NS, curve, spread, segments
        amount = cut_block(begin, end, block, t[begin], CUT * EDGE, *room, amount)
    threshold = 0.2 + 0.03 * rng.uniform(-3, 3, (HEIGHT, WIDTH))
    state = dark_pixels(threshold, CONTRAST, EDGE)
    disc = path[:, :, 0]
    memorise_discs(disc, CONTRAST, EDGE, threshold, state, np.tile([np.inf, -np.inf] * 2, (1, 1)))
    return Look(first, since, since + NS, inverse, curve, segments[:amount], threshold, state)


def side_by_side(a: Look, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Packed events of all pixels, sorted, and the pixels' distances at the end."""
    pixels = np.array([x << 12 | y for y in range(HEIGHT) for x in range(WIDTH)])
    steps, tree = np.empty((a.rows, STEP_FIELDS)), np.empty((4 * a.rows, 7))
    pack_steps(a.rows, a.since, a.inverse, a.curve, steps)
    gaps, out = np.empty(len(pixels)), np.empty(400_000, np.int64)
    scratch = [np.empty(STRIDE * count) for count in (PIXEL_FIELDS, FIRE_FIELDS, WAIT_FIELDS)]
    sensor = a.threshold, CONTRAST, EDGE, 0, np.empty((160, 3))
    room = *scratch, state, gaps, out, 0
    n = events_of_pixels(pixels, len(pixels), *a.path, steps, tree, *sensor, *room)
    return np.sort(out[:n]), gaps


def one_by_one(a: Look, state: np.ndarray) -> np.ndarray:
    """The same by the exact search alone, piece by piece."""
    tree, stack, out = np.empty((4 * a.rows, 7)), np.empty((160, 3)), np.empty(400_000, int)
    for block in range(3):
        bound_rates(a.curve, a.first[block], a.first[block + 1], 4 * a.first[block], tree)
    n = search_all(*a.path, tree, a.threshold, state, stack, out)
    return np.sort(out[:n])


@njit()
def search_all(  # type: ignore[no-untyped-def]
    segments, first, since, until, inverse, curve, tree, threshold, state, stack, out
):
    """Count the events that the exact search finds, pixel by pixel and piece by piece."""
    n = 0
    for y in range(HEIGHT):
        for x in range(WIDTH):
            on, off, last_one, level = state[y, x]
            for segment in segments:
                begin = int(first[segment.block])
                gap = np.hypot(x - segment.x0, y - segment.y0) - segment.r0
                head = int(segment.zero) << 25 | x << 13 | y << 1
                pixel = float(x), float(y), on, off, last_one, level, threshold[y, x], gap
                steps = 4 * begin, begin, begin + STEPS, since, until, inverse, curve, tree
                sensor = CONTRAST, EDGE, head, stack, out, n
                on, off, last_one, level, n = events_of_segment(*pixel, segment, *steps, *sensor)
            kept = state[y, x]
            kept[0], kept[1], kept[2], kept[3] = on, off, last_one, level
    return n


def by_pixel(events: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels with polarity, sorted by pixel and then by time, and these times, ns."""
    order = np.lexsort((events >> 25, (events >> 1) & 0xFFFFFF))
    return (events & 0x1FFFFFF)[order], (events >> 25)[order]


def near(found: np.ndarray, expected: np.ndarray, *, rel: float, abs: float) -> bool:
    """As `pytest.approx` has it, which takes a while for thousands of numbers."""
    close = np.isclose(found, expected, rtol=rel, atol=0.0)
    return bool(np.all(close | np.isclose(found, expected, rtol=0.0, atol=abs)))


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    px=st.sampled_from([0.1, 1.0, 4.0, 20.0]),
    smooth=st.sampled_from([0.0, 0.5, 0.95, 1.0]),
)
def test_side_by_side_is_as_one_by_one(seed: int, px: float, smooth: float) -> None:
    a = look(seed, px, smooth)
    states = a.state.copy(), a.state.copy()
    fast, gaps = side_by_side(a, states[0])
    exact = one_by_one(a, states[1])
    pixels, times = by_pixel(fast)
    expected, at = by_pixel(exact)
    assert np.array_equal(pixels, expected)
    # near a reversal a distance hardly changes: there a time is less exact
    assert np.percentile(np.abs(times - at), 99) <= 20 if len(at) else True
    assert np.abs(times - at).max(initial=0) < 5000
    assert near(states[0], states[1], rel=1e-9, abs=1e-9)
    end = a.place(a.rows - 1, float(NS))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    expected_gaps = (np.hypot(columns - end[0], rows - end[1]) - end[2]).ravel()
    assert near(gaps, expected_gaps, rel=1e-6, abs=1e-12)


@pytest.mark.quick(1)
@pytest.mark.parametrize(("seed", "px"), [(1, 0.6), (2, 2.0), (3, 6.0)])
def test_times_are_roots_on_the_path(seed: int, px: float) -> None:
    a = look(seed, px, 0.9)
    fast, _ = side_by_side(a, a.state.copy())
    pixels, times = by_pixel(fast)
    counted = 0
    for place in np.unique(pixels >> 1)[::4].tolist():
        here = pixels >> 1 == place
        expected = roots_of(a, place >> 12, place & 4095)
        assert (pixels[here] & 1).tolist() == [p for _, p in expected]
        assert times[here] == pytest.approx([t for t, _ in expected], abs=10.0)
        counted += len(expected)
    assert counted > 10


def roots_of(a: Look, x: int, y: int) -> list[tuple[float, int]]:
    """Times (ns) and polarities of a pixel by sign changes on a fine grid and Brent's method."""
    on, off, _, level = a.state[y, x].tolist()
    step, found = float(a.threshold[y, x]), []

    def gap(tau: float, k: int, target: float) -> float:
        column, row, radius = a.place(k, tau)
        return float(np.hypot(x - column, y - row) - radius - target)

    for k in range(a.rows):
        grid = np.linspace(0.0, NS, 33)
        for begin, end in zip(grid[:-1].tolist(), grid[1:].tolist(), strict=True):
            now = begin
            while True:
                comes, goes = gap(end, k, on) <= 0.0, gap(end, k, off) >= 0.0
                if not (comes or goes):
                    break
                target = on if comes else off
                if gap(now, k, target) * gap(end, k, target) < 0.0:
                    now = brentq(gap, now, end, args=(k, target), xtol=1e-3, rtol=1e-14)
                found.append((k * NS + now, int(comes)))
                level += step if comes else -step
                on, off = (rim_of(level + sign * step, CONTRAST, EDGE) for sign in (1, -1))
    return found
