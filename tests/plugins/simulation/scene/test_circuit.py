"""Pixels with bandwidth, leak and two thresholds against an integration of the same equations.

The reference steps the path itself in 50 us, a fortieth of the rows that the sensor gets, and finds
events on that grid.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from sliplab.plugins.simulation.scene.circuit import ON, SEEN
from sliplab.plugins.simulation.scene.edges import CUT
from sliplab.plugins.simulation.scene.events import EventOptics, Events, MarkerSensor
from tests.plugins.simulation.scene.steps import QUIET as IDEAL

QUIET = {**IDEAL, "width": 96, "height": 96}
ONE = np.zeros((1, 2))
MIDDLE = 47.5
RADIUS_PX = 14.0 * 1.2
Path = Callable[[float], tuple[float, float, float]]
"""Column and row (px, from the picture's centre) and growth (px) at a time in s."""


def there_and_back(t: float) -> tuple[float, float, float]:
    """Comes to 5 px and goes again, in 0.6 s, and grows a little."""
    return 5.0 * math.sin(math.pi * t / 0.6) ** 2, 1.5 * t, 0.3 * math.sin(7.0 * t)


def jump(t: float) -> tuple[float, float, float]:
    """Moves by 6 px within 40 ms, then stands still."""
    s = min(max((t - 0.096) / 0.04, 0.0), 1.0)
    return 6.0 * s * s * (3.0 - 2.0 * s), 0.0, 0.0


def shake(t: float) -> tuple[float, float, float]:
    """A tremor of 25 Hz and 0.8 px with a drift: about as fast as a slow pixel."""
    return 0.8 * math.sin(2 * math.pi * 25.0 * t) + 2.0 * t, 0.0, 0.0


def loads_on(path: Path, t_s: np.ndarray) -> np.ndarray:
    """Forces that put the marker there, (m, 3)."""
    optics = EventOptics()
    place = np.array([path(t) for t in t_s])
    drag = optics.px_per_mm * optics.shift_mm_per_n
    return place / np.array([-drag, drag, optics.px_per_mm * optics.growth_mm_per_n])


def sensed(path: Path, end_ms: int, **changes: object) -> tuple[MarkerSensor, Events]:
    sensor = MarkerSensor(EventOptics(**{**QUIET, **changes}), ONE, 1)
    t_ns = np.arange(0, end_ms + 1, 2, dtype=np.int64) * 1_000_000
    loads = loads_on(path, t_ns * 1e-9)
    sensor.reset(loads[0], 1)
    return sensor, sensor.sense(loads, t_ns)


PLACES = [(x, 47) for x in range(22, 76, 3)] + [(47, y) for y in range(24, 72, 5)]
"""Pixels on a cross through the rim."""
GRID_S = 5e-5


def level(optics: EventOptics, path: Path, t_s: np.ndarray) -> np.ndarray:
    """Log intensity of `PLACES` over the ground, (m, n)."""
    column, row, growth = np.array([path(t) for t in t_s]).T[:, :, None]
    x, y = np.array(PLACES).T
    gap = np.hypot(x - MIDDLE - column, y - MIDDLE - row) - RADIUS_PX - growth
    tail = 1 / (1 + math.exp(CUT))
    share = 1 / (1 + np.exp(np.clip(gap / optics.edge_px, -CUT, CUT)))
    result: np.ndarray = optics.contrast * (share - tail) / (1 - 2 * tail)
    return result


def seen(optics: EventOptics, path: Path, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and what `PLACES` see behind their low pass, from its variation of constants.

    v(t + h) = e^(-a h) v(t) + integral of a u e^(-a (t + h - s)): Gauss and Legendre's three points
    in steps of 50 us, in which a marker moves by a few thousandths of a pixel.
    """
    t = np.linspace(0.0, end_s, round(end_s / GRID_S) + 1)
    if optics.cutoff_hz == 0:
        return t, level(optics, path, t)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    inputs = [level(optics, path, t[:-1] + 0.5 * GRID_S * (1 + node)) for node in nodes]
    bright = (255.0 * np.exp(inputs[1] - optics.contrast) + 20.0) / 275.0
    pace = 2 * math.pi * optics.cutoff_hz * bright
    gain = sum(
        0.5 * GRID_S * weight * pace * u * np.exp(-pace * 0.5 * GRID_S * (1 - node))
        for node, weight, u in zip(nodes, weights, inputs, strict=True)
    )
    decay = np.exp(-pace * GRID_S)
    values = np.empty((len(t), len(PLACES)))
    values[0] = level(optics, path, t[:1])
    for k in range(len(t) - 1):
        values[k + 1] = decay[k] * values[k] + gain[k]
    return t, values


def events_on(t: np.ndarray, above: np.ndarray, on: float, off: float) -> list[tuple[float, int]]:
    """Times (s) and polarities of a pixel that sees `above`, (m,), over what it memorised first."""
    found, memory, k = [], 0.0, 0
    while True:
        # a flat level that is met again is met, whatever the rounding
        rest = above[k:] - memory
        hit = np.flatnonzero((rest >= on - 2e-9) | (rest <= 2e-9 - off))
        if not len(hit):
            return found
        k += int(hit[0])
        step = on if above[k] > memory else -off
        memory += step
        rise = above[k] - above[k - 1]
        share = (memory - above[k - 1]) / rise
        found.append((t[k - 1] + min(share, 1.0) * GRID_S, int(step > 0)))
        k -= 1  # this interval again: there may be more


def compare(
    sensor: MarkerSensor, events: Events, path: Path, end_s: float, leak_hz: float = 0.0
) -> np.ndarray:
    """Errors of event times in us; signs must agree where no threshold is grazed."""
    t_ns, x, y, p = events
    t, values = seen(sensor.optics, path, end_s)
    errors, sure, silent = [], 0, 0
    for j, (px, py) in enumerate(PLACES):
        on, off = sensor._circuit.cells[py, px, ON : ON + 2]
        above = values[:, j] - values[0, j] + leak_hz * on * t
        wanted, *others = (events_on(t, above, f * on, f * off) for f in (1.0, 0.999, 1.001))
        signs = [sign for _, sign in wanted]
        if any([sign for _, sign in other] != signs for other in others):
            continue
        here = (x == px) & (y == py)
        assert p[here].tolist() == signs, (px, py)
        errors.append(t_ns[here] * 1e-3 - np.array([t for t, _ in wanted]) * 1e6)
        sure, silent = sure + 1, silent + (not wanted)
    assert sure > 0.7 * len(PLACES)
    assert silent > 0
    return np.abs(np.concatenate(errors))


@pytest.mark.quick(1)
@pytest.mark.parametrize("path", [there_and_back, jump, shake])
@pytest.mark.parametrize("cutoff_hz", [5.0, 40.0, 1000.0])
def test_a_slow_pixel_follows_its_differential_equation(path: Path, cutoff_hz: float) -> None:
    sensor, events = sensed(path, 640, cutoff_hz=cutoff_hz)
    error = compare(sensor, events, path, 0.64)
    assert len(error) >= 5
    assert np.median(error) < 20.0
    assert np.percentile(error, 90) < 200.0


def test_negative_thresholds_of_their_own() -> None:
    sensor, events = sensed(there_and_back, 640, threshold_off=0.31, threshold_off_sigma=0.0)
    assert np.median(compare(sensor, events, there_and_back, 0.64)) < 2.0
    p = events[3]
    assert 0.55 < (p == 0).sum() / (p == 1).sum() < 0.75  # 0.2 / 0.31, and what is left over


def test_thresholds_of_both_signs_are_drawn_apart() -> None:
    optics = EventOptics(threshold_off=0.25, threshold_off_sigma=0.04)
    sensor = MarkerSensor(optics, ONE, 3)
    on, off = sensor._circuit.cells[..., ON], sensor._circuit.cells[..., ON + 1]
    assert np.array_equal(on, MarkerSensor(EventOptics(), ONE, 3).threshold)
    for values, mean, sigma in ((on, 0.2, 0.03), (off, 0.25, 0.04)):
        assert values.mean() == pytest.approx(mean, abs=4 * sigma / math.sqrt(values.size))
        assert values.std() == pytest.approx(sigma, rel=0.02)  # cut at three sigma
    assert abs(np.corrcoef(on.ravel(), off.ravel())[0, 1]) < 4 / math.sqrt(on.size)


def test_the_same_thresholds_give_the_events_of_pixels_without_memory() -> None:
    """Two ways to the same events: located on the path, and on parabolas through it."""
    changes = {"threshold_off_sigma": 0.0, "width": 160, "height": 120}
    _, slow = sensed(there_and_back, 640, **changes)
    _, fast = sensed(there_and_back, 640, width=160, height=120)
    assert len(slow[0]) == len(fast[0]) > 2000
    order = [np.lexsort((part[0], part[1], part[2])) for part in (slow, fast)]
    for column in (1, 2, 3):
        assert np.array_equal(slow[column][order[0]], fast[column][order[1]])
    late = np.abs(slow[0][order[0]] - fast[0][order[1]]) * 1e-3
    assert np.median(late) < 0.1
    assert np.percentile(late, 95) < 1.0  # the rest are where the marker turns round


def test_a_reference_that_leaks_moves_the_next_signal_events() -> None:
    """A leak brings positive events forward and puts negative ones off, against its closed form."""
    changes = {"leak": "reference", "noise_hz": 2.0, "leak_share": 1.0}
    sensor = MarkerSensor(EventOptics(**{**QUIET, **changes}), ONE, 1)
    cells = sensor._circuit.cells
    cells[..., 5] = 2.0 * cells[..., ON] * 1e-9  # every pixel at the mean rate
    t_ns = np.arange(0, 641, 2, dtype=np.int64) * 1_000_000
    loads = loads_on(there_and_back, t_ns * 1e-9)
    sensor.reset(loads[0], 1)
    cells[..., 2] = cells[..., SEEN]  # and none has leaked yet
    events = sensor.sense(loads, t_ns)
    assert np.median(compare(sensor, events, there_and_back, 0.64, 2.0)) < 2.0
    _, plain = sensed(there_and_back, 640)
    assert (events[3] == 0).sum() < 0.95 * (plain[3] == 0).sum()


@pytest.mark.parametrize("leak_share", [0.25, 1.0])
def test_pixels_at_rest_leak_at_their_rate(leak_share: float) -> None:
    """Of n pixels at rest each fires once in 1 / rate, wherever it stood at the begin."""
    leaking = {"noise_hz": 2.0, "leak_share": leak_share, "leak": "reference"}
    sensor = MarkerSensor(EventOptics(**{**QUIET, **leaking}), ONE, 1)
    t_ns = np.arange(0, 4001, 32, dtype=np.int64) * 1_000_000
    loads = np.zeros((len(t_ns), 3))
    sensor.reset(loads[0], 5)
    when, x, y, p = sensor.sense(loads, t_ns)
    rates = sensor._circuit.cells[..., 5] / sensor._circuit.cells[..., ON] * 1e9
    # the median of a lognormal is its mean rate; 0.1 decades between pixels
    assert np.median(rates) == pytest.approx(2.0 * leak_share, rel=0.02)
    assert np.log10(rates).std() == pytest.approx(0.1, rel=0.05)
    span_s = t_ns[-1] * 1e-9
    leaks = p == 1
    if leak_share < 1.0:
        # half of the shot noise is negative
        shots = 2.0 * (p == 0).sum()
        dark = 2.0 * (1.0 - leak_share) * 96 * 96 * span_s
        assert 0.6 * dark < shots < 1.05 * dark
    else:
        assert leaks.all()
        counts = np.zeros((96, 96))
        np.add.at(counts, (y, x), 1)
        assert np.abs(counts - rates * span_s).max() < 1.0
        gaps = np.diff(when[(x == 10) & (y == 10)])
        assert np.ptp(gaps) <= 2
        assert gaps.mean() == pytest.approx(1e9 / rates[10, 10], rel=1e-8)


def test_pixels_faster_than_all_motion_are_as_good_as_ideal() -> None:
    sensor, _ = sensed(there_and_back, 640, cutoff_hz=1e6)
    _, quick = sensed(there_and_back, 640, cutoff_hz=1e6)
    _, ideal = sensed(there_and_back, 640)
    assert sensor.optics.has_circuit
    assert abs(len(quick[0]) - len(ideal[0])) <= 0.002 * len(ideal[0])


def test_a_slow_pixel_fires_later_and_a_dark_one_is_slower() -> None:
    """Coming pixels brighten, so they lag less than going ones, which darken."""
    _, ideal = sensed(jump, 640)
    _, slow = sensed(jump, 640, cutoff_hz=20.0)
    lag = {}
    for sign in (0, 1):
        lag[sign] = np.median(slow[0][slow[3] == sign]) - np.median(ideal[0][ideal[3] == sign])
    assert lag[0] > lag[1] > 0
    assert len(slow[0]) == pytest.approx(len(ideal[0]), rel=0.05)


@pytest.mark.parametrize("cuts", [[32], [64, 128, 160, 320, 512], list(range(32, 640, 32))])
def test_chunks_do_not_matter_to_cells(cuts: list[int]) -> None:
    changes = {"leak": "reference", "noise_hz": 1.0, "cutoff_hz": 30.0, "threshold_sigma": 0.03}
    changes |= {"threshold_off_sigma": 0.05, "readout_hz": 5000.0, "refractory_us": 300.0}
    sensor, whole = sensed(there_and_back, 640, **changes)
    t_ns = np.arange(0, 641, 2, dtype=np.int64) * 1_000_000
    loads = loads_on(there_and_back, t_ns * 1e-9)
    sensor.reset(loads[0], 1)
    ends = np.searchsorted(t_ns, np.array([0, *cuts, 640]) * 1_000_000).tolist()
    parts = [sensor.sense(loads[a : b + 1], t_ns[a : b + 1]) for a, b in itertools.pairwise(ends)]
    assert len(whole[0]) > 3000
    for column, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        assert np.array_equal(column, np.concatenate(pieces))


def test_a_cell_that_is_left_settles_and_rests() -> None:
    """The low pass goes on after the rim has gone by; then the pixel costs nothing any more."""
    sensor, events = sensed(jump, 2048, cutoff_hz=2.0)
    assert events[0].max() > 200_000_000  # the marker stood still from 136 ms on
    sensor, _ = sensed(jump, 8000, cutoff_hz=40.0)
    assert sensor._circuit.awake[0] == 0
