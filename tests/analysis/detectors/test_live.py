"""A stream cut anywhere gives the windows and decisions of the whole; and what else may happen."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors import detectors, network_detector
from sliplab.analysis.detectors import live as lives
from sliplab.analysis.detectors.detectors import (
    Cusum,
    DetectionRule,
    Levels,
    Predictions,
    StateChain,
    Tuned,
)
from sliplab.analysis.detectors.live import FreshestArrival, LiveDecision, LiveDetector
from sliplab.analysis.detectors.network_detector import NetworkDetector
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.analysis.metrics.classification import CLASSES, INCIPIENT, NO_SLIP
from sliplab.analysis.windows.windows import bin_events
from sliplab.protocols.detection import Detection
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk
from tests.patching import loose

TINY = Windows(length_ms=4, step_ms=1, crop_px=40, pool_px=20, polarity="both")
SIZE = {"width": 60, "height": 50}
LENGTH_US = 4000
ROW = np.array([[3, 9, 4]])
_MEANS = np.repeat([(9, 3, 3), ROW[0], (2, 4, 9)], 50, axis=0)
READING = detectors.Reading(
    detectors.fit_logistic(np.random.default_rng(0).poisson(_MEANS), np.repeat([0, 1, 2], 50), 3),
    False,
    1.0,
)
"""Of spike counts in the three states."""


class Network:
    """A stand-in for the network that sees every bit of a window, and keeps what it saw."""

    def __init__(self) -> None:
        self.seen: list[npt.NDArray[np.uint8]] = []

    def __call__(self, x: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
        self.seen.append(x.copy())
        return self.of(x)

    @staticmethod
    def of(x: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
        flat = x.reshape(len(x), -1).astype(np.int64)
        weights = 1 + np.arange(flat.shape[1])
        return np.stack([(flat * weights**k).sum(axis=1) % 7 for k in (0, 1, 2)], axis=1)


def detector(
    network: Network,
    rule: Detection | None = None,
    stride_us: int | None = None,
    **options: int,
) -> LiveDetector:
    windows = NetworkDetector(network, TINY, rule or Detection(smoothing=2), stride_us=stride_us)
    return LiveDetector(windows, **SIZE, **options)


def open_windows(live: LiveDetector) -> int:
    assert isinstance(live._detector, NetworkDetector)
    return len(live._detector._open)


def events(t_us: list[int] | npt.NDArray[np.int64], seed: int = 0) -> EventChunk:
    rng = np.random.default_rng(seed)
    n = len(t_us)
    return EventChunk(
        rng.integers(0, SIZE["width"], n).astype(np.uint16),
        rng.integers(0, SIZE["height"], n).astype(np.uint16),
        rng.integers(0, 2, n).astype(np.uint8),
        np.asarray(t_us, np.int64),
    )


def part(chunk: EventChunk, which: object) -> EventChunk:
    return chunk[which]


def offline(chunk: EventChunk, starts_us: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    return bin_events(chunk, starts_us, TINY, SIZE["width"], SIZE["height"])


streams = st.lists(st.integers(0, 2500), min_size=1, max_size=60)
cuts = st.lists(st.integers(0, 60), max_size=12)


@settings(max_examples=150)
@given(streams, cuts, st.integers(1, 4), st.sampled_from([0.0, 1.0, 2.0]), st.integers(0, 9))
def test_a_stream_cut_anywhere_gives_what_the_whole_gives(
    steps: list[int], cut: list[int], smoothing: int, margin: float, seed: int
) -> None:
    chunk = events(10**9 + np.cumsum(steps), seed)
    rule = Detection(smoothing=smoothing, margin=margin)
    network = Network()
    live = detector(network, rule)
    made: list[LiveDecision] = []
    edges = [0, *sorted(min(place, len(chunk)) for place in cut), len(chunk)]
    for begin, end in itertools.pairwise(edges):
        made += live.push(part(chunk, slice(begin, end)))
        if begin < end:
            made += live.advance(int(chunk.t_us[end - 1]))
        assert open_windows(live) <= 1
    last_us = int(chunk.t_us[-1])
    made += live.advance(last_us + LENGTH_US)

    starts = np.arange(int(chunk.t_us[0]), last_us + 1, LENGTH_US)
    x = offline(chunk, starts)
    np.testing.assert_array_equal(np.concatenate(network.seen), x)
    assert [item.start_us for item in made] == starts.tolist()
    assert sum(item.events for item in made) == len(chunk)
    counts = Network.of(x)
    whole = detect(counts, (starts + LENGTH_US) * 1000, rule)
    assert [item.counts for item in made] == [tuple(row) for row in counts.tolist()]
    assert [item.valid_class for item in made] == whole.valid_class.tolist()
    assert [item.smoothed for item in made] == [tuple(row) for row in whole.smoothed.tolist()]
    onsets = {item.onset: item.end_us * 1000 for item in made if item.onset}
    assert onsets.get("incipient") == whole.incipient_ns
    assert onsets.get("gross") == whole.gross_ns
    assert vars(live.losses) == {"late": 0, "disordered": 0, "gaps": 0, "longest_gap_us": 0}


@settings(max_examples=60)
@given(
    st.lists(st.tuples(*[st.integers(0, 4)] * 3), max_size=40),
    st.integers(1, 6),
    st.sampled_from([0.0, 0.5, 1.0, 2.0]),
)
def test_the_rule_step_by_step_is_the_rule(
    rows: list[tuple[int, int, int]], smoothing: int, margin: float
) -> None:
    rule = Detection(smoothing=smoothing, margin=margin)
    counts = np.array(rows, np.int64).reshape(-1, 3)
    ends = 30 * np.arange(1, len(counts) + 1, dtype=np.int64)
    whole = detect(counts, ends, rule)
    running = network_detector.RunningRule(rule)
    said = [running.step(row) for row in counts]
    assert [step.valid_class for step in said] == whole.valid_class.tolist()
    assert [step.smoothed for step in said] == [tuple(row) for row in whole.smoothed.tolist()]
    onsets = {step.onset: int(end) for step, end in zip(said, ends, strict=True) if step.onset}
    found = {"incipient": whole.incipient_ns, "gross": whole.gross_ns}
    assert onsets == {name: end for name, end in found.items() if end is not None}


@settings(max_examples=50)
@given(
    st.lists(st.tuples(*[st.integers(0, 30)] * 3), max_size=30),
    st.sampled_from(
        [
            detectors.Smoothing(2),
            Cusum(READING),
            detectors.Filter(StateChain(np.array([0.1, 0.2])), READING),
        ]
    ),
    st.floats(0.0, 6.0),
)
def test_a_detector_step_by_step_decides_as_on_the_whole(
    rows: list[tuple[int, ...]], detector: DetectionRule, level: float
) -> None:
    counts = np.array(rows, np.int64).reshape(-1, 3)
    seen = Predictions(counts, counts.sum(axis=1), np.arange(len(rows)))
    levels = Levels(level, level / 2)
    expected = detectors.decide(detector.evidence(seen), levels)
    running = network_detector.RunningRule(Tuned("", detector, levels))
    steps = [running.step(row, int(row.sum())) for row in counts]
    found = [next((k for k, it in enumerate(steps) if it.onset == name), None) for name in CLASSES]
    assert found == [None, expected.incipient_ns, expected.gross_ns]
    if expected.incipient_ns is not None:
        assert steps[expected.incipient_ns].valid_class == INCIPIENT
        assert all(it.valid_class == NO_SLIP for it in steps[: expected.incipient_ns])


def test_a_detector_begins_anew_after_a_gap() -> None:
    """Evidence of half the level, a gap, and the same again: no slip; without the gap there is."""
    ratio = float(np.diff(READING.log(Predictions(ROW, np.zeros(1), np.zeros(1)))[0])[0])
    assert ratio > 0
    level = 1.5 * ratio
    for gap, onset in ((False, "incipient"), (True, None)):
        running = network_detector.RunningRule(Tuned("", Cusum(READING), Levels(level, level)))
        assert running.step(ROW[0], 0).onset is None
        if gap:
            running.interrupt()
        assert running.step(ROW[0], 0).onset == onset


@settings(max_examples=40)
@given(streams, cuts, st.sampled_from([1000, 1500, 3999]))
def test_windows_that_overlap(steps: list[int], cut: list[int], stride_us: int) -> None:
    chunk = events(np.cumsum(steps))
    network = Network()
    live = detector(network, stride_us=stride_us)
    edges = [0, *sorted(min(place, len(chunk)) for place in cut), len(chunk)]
    for begin, end in itertools.pairwise(edges):
        live.push(part(chunk, slice(begin, end)))
        assert open_windows(live) <= -(-LENGTH_US // stride_us)
    last_us = int(chunk.t_us[-1])
    live.advance(last_us + LENGTH_US)
    starts = np.arange(int(chunk.t_us[0]), last_us + 1, stride_us)
    np.testing.assert_array_equal(np.concatenate(network.seen), offline(chunk, starts))


def test_a_quiet_scene_is_judged_by_the_clock() -> None:
    network = Network()
    live = detector(network)
    assert live.push(events([])) == []
    assert live.advance(5000) == []
    made = live.advance(5000 + 3 * LENGTH_US)
    found = [(item.start_us, item.events, item.by_event) for item in made]
    assert found == [(start_us, 0, False) for start_us in (5000, 9000, 13000)]
    assert not np.concatenate(network.seen).any()
    assert made[0].last_event_us is None
    assert live.advance(12000) == []  # time does not go back
    (made_by_event,) = live.push(events([17500, 21000]))
    assert (made_by_event.events, made_by_event.by_event) == (1, True)
    assert made_by_event.last_event_us == 17500


def test_out_of_order_counts_where_it_belongs_while_its_window_is_open() -> None:
    chunk = events(np.arange(100, 3900, 100))
    straight, mixed = Network(), Network()
    live = detector(straight, origin_us=0)
    live.push(chunk)
    live.advance(LENGTH_US)
    other = detector(mixed, origin_us=0)
    order = np.random.default_rng(1).permutation(len(chunk))
    other.push(part(chunk, order[:20]))
    other.push(part(chunk, order[20:]))
    other.advance(LENGTH_US)
    np.testing.assert_array_equal(mixed.seen[0], straight.seen[0])
    assert other.losses.disordered > 0
    assert other.losses.late == live.losses.disordered == 0


def test_an_event_that_comes_too_late_is_left_out_and_counted() -> None:
    network = Network()
    live = detector(network, origin_us=0)
    live.push(events([100, 4100]))
    assert live.push(events([3999, 4200])) == []
    (made,) = live.advance(2 * LENGTH_US)
    assert made.events == 2
    assert live.losses.late == 1


@pytest.mark.parametrize("inside", [False, True])
def test_a_gap_begins_the_sliding_window_anew(inside: bool) -> None:
    live = detector(Network(), Detection(smoothing=2, margin=0), gap_us=1_000_000)
    first, second = [0, 4100, 8100, 9000], [5_000_100, 5_004_100, 5_008_100, 5_012_100]
    if inside:
        made = live.push(events(first + second))
    else:
        made = live.push(events(first)) + live.push(events(second))
    # windows 0 and 1; number 2 is given up; the first whole one after the gap begins at 5,004,000
    assert [item.start_us for item in made] == [0, 4000, 5_004_000, 5_008_000]
    assert made[2].smoothed == tuple(map(float, made[2].counts))
    assert made[2].valid_class == -1
    assert (live.losses.gaps, live.losses.longest_gap_us) == (1, 5_000_100 - 9000)
    assert live.losses.late == 0


def test_a_clock_that_falls_back_is_another_clock() -> None:
    live = detector(Network())
    live.push(events([10_000_000]))
    with pytest.raises(lives.ClockFellBack, match="fell back"):
        live.push(events([8_000_000]))


def test_counts_stop_at_255_whatever_the_pieces() -> None:
    full = (np.full(400, 30, np.uint16), np.full(400, 20, np.uint16), np.ones(400, np.uint8))
    many = EventChunk(*full, np.arange(400, dtype=np.int64))
    network = Network()
    live = detector(network)
    for begin in range(0, 400, 90):
        live.push(part(many, slice(begin, begin + 90)))
    live.advance(LENGTH_US)
    np.testing.assert_array_equal(network.seen[0], offline(many, np.array([0])))
    assert network.seen[0].max() == 255


def test_what_is_wrong_is_refused() -> None:
    with pytest.raises(ValueError, match="larger than the sensor"):
        LiveDetector(NetworkDetector(Network(), TINY, Detection()), width=30, height=50)
    with pytest.raises(ValueError, match="positive"):
        detector(Network(), stride_us=0)
    with pytest.raises(ValueError, match="outside 60 x 50"):
        detector(Network()).push(EventChunk(*(np.array([value]) for value in (60, 0, 1, 0))))
    with pytest.raises(ValueError, match="expected integers"):
        loose(network_detector.RunningRule(Detection())).step(np.zeros(3))  # that is the point


@given(st.lists(st.integers(0, 5000), min_size=1, max_size=40), st.integers(-(10**12), 10**12))
def test_the_freshest_arrival_bounds_the_clock(delays_us: list[int], offset_us: int) -> None:
    clock = FreshestArrival()
    assert clock.camera_us(0) is None
    for number, delay in enumerate(delays_us):
        sent_us = number * 1000
        clock.observe(sent_us + offset_us, (sent_us + delay) * 1000)
    now_us = 10**6
    assert clock.camera_us(now_us * 1000) == now_us + offset_us - min(delays_us)
    assert clock.host_ns(offset_us) == min(delays_us) * 1000


def test_an_old_arrival_is_forgotten() -> None:
    clock = FreshestArrival()
    clock.observe(0, 0)
    for number in (1, 2):  # 1 ms later and later, as drift would have it
        at_ns = number * lives.SPAN_NS
        clock.observe(at_ns // 1000 - 1000 * number, at_ns)
    assert clock.camera_us(2 * lives.SPAN_NS) == 2 * lives.SPAN_NS // 1000 - 1000
