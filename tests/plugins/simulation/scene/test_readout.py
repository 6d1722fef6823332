"""The camera's scans against the true events that they carry, and the sort below them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.plugins.simulation.scene.events import EventOptics, Events, MarkerSensor
from sliplab.plugins.simulation.scene.readout import ScanTimes, sort_packed
from sliplab.plugins.simulation.settings import MockEventCameraSettings

ONE = np.zeros((1, 2))
BUSY = {"width": 160, "height": 120, "noise_hz": 5.0, "hot_hz": 900.0, "refractory_us": 50.0}


def moving(end_ms: int, step_ms: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Loads and times of a marker that circles at about 100 px/s."""
    t_ns = np.arange(0, end_ms + 1, step_ms, dtype=np.int64) * 1_000_000
    loads = np.zeros((len(t_ns), 3))
    loads[:, 0] = 0.2 * np.sin(8.0 * t_ns * 1e-9)
    loads[:, 1] = 0.2 * np.cos(8.0 * t_ns * 1e-9)
    return loads, t_ns


def sensed(readout_hz: float, seed: int = 3, end_ms: int = 640, **changes: float) -> Events:
    loads, t_ns = moving(end_ms)
    sensor = MarkerSensor(EventOptics(**{**BUSY, "readout_hz": readout_hz, **changes}), ONE, 1)
    sensor.reset(loads[0], seed)
    return sensor.sense(loads, t_ns)


def scans_of(readout_hz: float, **changes: float) -> ScanTimes:
    """When the camera of `sensed` scans."""
    sensor = MarkerSensor(EventOptics(**{**BUSY, "readout_hz": readout_hz, **changes}), ONE, 1)
    sensor.reset(np.zeros(3), 3)
    return sensor.scans


def scanned(true: Events, scans: ScanTimes, end_ns: int) -> Events:
    """The true events as scans would report them, one by one, in plain Python."""
    period_ns, phase_ns = scans.period_ns, scans.phase_ns
    first: dict[tuple[int, int, int], int] = {}
    for t, x, y, p in zip(*(column.tolist() for column in true), strict=True):
        begin = phase_ns - (phase_ns - t) // period_ns * period_ns
        if begin + int(160 * scans.column_ns) <= end_ns:
            first.setdefault((begin, x, y), p)
    rows = sorted((begin + int(x * scans.column_ns), x, y, p) for (begin, x, y), p in first.items())
    t_ns, x, y, p = (np.array(column) for column in zip(*rows, strict=True))
    return t_ns, x, y, p


@pytest.mark.quick(1)
@pytest.mark.parametrize("scan_us", [0.0, 192.0])
@pytest.mark.parametrize("readout_hz", [1000.0, 3000.0, 5000.0, 10_000.0])
def test_scans_carry_the_true_events(readout_hz: float, scan_us: float) -> None:
    """Every event in the next scan, of each pixel the first in it, when its column is read."""
    # without a dead time: what a dead time leaves depends on what a scan has already dropped
    true = sensed(0.0, refractory_us=0.0)
    read = sensed(readout_hz, refractory_us=0.0, scan_us=scan_us)
    scans = scans_of(readout_hz, scan_us=scan_us)
    assert scans.period_ns == round(1e9 / readout_hz)
    assert scans.reading_ns == pytest.approx(min(1e3 * scan_us, scans.period_ns), abs=1)
    expected = scanned(true, scans, 640_000_000)
    assert len(true[0]) > len(read[0]) > 10_000
    for got, wanted in zip(read, expected, strict=True):
        assert np.array_equal(got, wanted)


@pytest.mark.parametrize("rate_hz", [2e4, 1e5, 4e5])
def test_columns_of_the_default_read_out_have_stamps_of_their_own(rate_hz: float) -> None:
    """Share of distinct microseconds, delay and order of noise against closed forms.

    A recording of a real DVXplorer has 243,501 distinct stamps of 255,283 events, 95.4 %: what a
    scan of 5000 Hz over 192 us gives at about 90,000 even events a second.
    """
    settings = MockEventCameraSettings().model_dump()
    optics = EventOptics(
        **{**settings, "noise_hz": rate_hz / (640 * 480), "hot_pixels": 0, "radius_mm": 1e-3}
    )
    sensor, t_ns = MarkerSensor(optics, ONE, 1), np.arange(0, 641, 32, dtype=np.int64) * 1_000_000
    own = MarkerSensor(EventOptics(**{**vars(optics), "readout_hz": 0.0}), ONE, 1)
    sensor.reset(np.zeros(3), 3)
    own.reset(np.zeros(3), 3)
    stamp, x, y, _ = sensor.sense(np.zeros((len(t_ns), 3)), t_ns)
    true = own.sense(np.zeros((len(t_ns), 3)), t_ns)
    assert len(stamp) > 10_000
    # columns that are read in the same microsecond share a stamp; phases of scans stay as they are
    phase = sensor.scans.phase_ns
    columns = np.bincount((phase % 1000 + np.arange(640) * 300) // 1000)
    mean = rate_hz * 200e-6
    expected = np.sum(1.0 - np.exp(-mean * columns / 640)) / mean
    share = len(np.unique(stamp // 1000)) / len(stamp)
    assert share == pytest.approx(expected, abs=0.01)
    if rate_hz == 1e5:
        assert share == pytest.approx(0.954, abs=0.015)
    # each event waits for its scan, evenly up to 200 us, and then for its column
    place = set(zip(stamp.tolist(), x.tolist(), y.tolist(), strict=True))
    scan = sensor.scans.begin(true[0])
    read = sensor.scans.stamp(scan, true[1])
    kept = np.array(
        [
            key in place
            for key in zip(read.tolist(), true[1].tolist(), true[2].tolist(), strict=True)
        ]
    )
    assert kept.mean() > 0.99
    wait = np.sort((scan - true[0])[kept]) / 200_000
    ranks = (np.arange(len(wait)) + 0.5) / len(wait)
    assert np.abs(wait - ranks).max() < 1.95 / math.sqrt(len(wait))  # Kolmogorov, 1 in 1000
    assert (read - scan == (true[1] * 300.0).astype(np.int64)).all()
    # from left to right, and in a column from top to bottom
    assert (np.diff(stamp) >= 0).all()
    same = np.diff(stamp) == 0
    assert (np.diff(x.astype(int))[same] == 0).all()
    assert (np.diff(y.astype(int))[same] > 0).all()


def test_a_scan_has_one_event_a_pixel_at_most_and_stamps_on_its_grid() -> None:
    t_ns, x, y, _ = sensed(1000.0, scan_us=0.0)
    key = (t_ns // 1000) * 160 * 120 + x.astype(np.int64) * 120 + y
    assert np.all(np.diff(key) > 0)  # in order of scan, column and row, none twice
    assert len(np.unique(t_ns % 1_000_000)) == 1
    late = t_ns - np.roll(t_ns, 1)
    assert set(np.unique(late[1:] % 1_000_000).tolist()) == {0}


def test_the_phase_of_the_scans_belongs_to_the_trial() -> None:
    phases = set()
    for seed in range(20):
        sensor = MarkerSensor(EventOptics(**BUSY), ONE, 1)
        sensor.reset(np.zeros(3), seed)
        assert 0 <= sensor.scans.phase_ns < sensor.scans.period_ns == 200_000
        phases.add(sensor.scans.phase_ns)
    assert len(phases) == 20
    assert max(phases) - min(phases) > 100_000


def test_a_scan_that_a_stop_cuts_off_is_never_read() -> None:
    whole = sensed(1000.0, end_ms=640)
    short = sensed(1000.0, end_ms=636)
    n = len(short[0])
    # the last scan is read before the end, and up to it all is as if there were no stop; only the
    # last block's curve may differ, which ends elsewhere
    assert short[0][-1] <= 636_000_000
    assert short[0][-1] > 634_800_000
    before = short[0] < 608_000_000
    for a, b in zip(short, whole, strict=True):
        assert np.array_equal(a[before], b[:n][before])


def test_a_scan_over_the_border_of_two_calls_comes_once_and_whole() -> None:
    loads, t_ns = moving(640)
    sensor = MarkerSensor(EventOptics(**{**BUSY, "readout_hz": 1000.0}), ONE, 1)
    sensor.reset(loads[0], 3)
    parts = [sensor.sense(loads[a : a + 9], t_ns[a : a + 9]) for a in range(0, 160, 8)]
    for k, part in enumerate(parts):
        assert np.all(part[0] > 32_000_000 * k - 1_192_000)
        assert np.all(part[0] <= 32_000_000 * (k + 1))
    whole = sensed(1000.0)
    for column, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        assert np.array_equal(column, np.concatenate(pieces))


def test_times_off_the_scans_are_their_own() -> None:
    t_ns, *_ = sensed(0.0)
    assert len(np.unique(t_ns % 1_000_000)) > 0.9 * len(t_ns)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 1000),
    n=st.sampled_from([0, 1, 2, 24, 25, 300, 4000]),
    low=st.integers(0, 30),
    width=st.integers(0, 30),
    span=st.integers(0, 20),
)
def test_the_sort_sorts(seed: int, n: int, low: int, width: int, span: int) -> None:
    """Whatever bits are counted: also none, also where many keys are equal in them."""
    rng = np.random.default_rng(seed)
    keys = rng.integers(0, 1 << (low + width), n) >> (width - min(width, span))
    expected = np.sort(keys)
    behind = np.append(keys, [-7, -8])
    sort_packed(behind, n, np.empty(n, np.int64), low, low + width)
    assert np.array_equal(behind[:n], expected)
    assert behind[n:].tolist() == [-7, -8]
