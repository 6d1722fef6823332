"""Samples against a naive histogram, and at every edge where an event may fall on either side."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sliplab.analysis.windows.windows import bin_events, first_pixel, list_events
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk

PAPER = Windows()


def one(x: int, y: int, p: int, t: int, start: int = 0, how: Windows = PAPER) -> NDArray[np.uint8]:
    columns = (np.array([v]) for v in (x, y, p, t))
    return bin_events(EventChunk(*columns), np.array([start]), how)


def naive(
    events: NDArray[Any], starts: NDArray[np.int64], how: Windows, width: int, height: int
) -> NDArray[np.int64]:
    left, top = (width - how.crop_px) // 2, (height - how.crop_px) // 2
    edges = np.arange(how.cells + 1) * how.pool_px
    shape = (len(starts), how.steps, how.channels, how.cells, how.cells)
    counts = np.zeros(shape, np.int64)
    for n, start in enumerate(starts):
        for step in range(how.steps):
            low = start + step * how.step_ms * 1000
            inside = (events["t"] >= low) & (events["t"] < low + how.step_ms * 1000)
            for channel in range(how.channels):
                sign = {"positive": [1], "negative": [0], "both": [0, 1]}[how.polarity][channel]
                chosen = events[inside & (events["p"] == sign)]
                # half-open on the right too, as np.histogram is not
                fits = (chosen["x"] < left + how.crop_px) & (chosen["y"] < top + how.crop_px)
                chosen = chosen[fits]
                counts[n, step, channel] = np.histogram2d(
                    chosen["y"], chosen["x"], bins=(top + edges, left + edges)
                )[0].astype(np.int64)
    return counts


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 3_000),
    steps=st.integers(1, 6),
    step_ms=st.integers(1, 3),
    pool=st.integers(1, 20),
    cells=st.integers(4, 8),
    polarity=st.sampled_from(["positive", "negative", "both"]),
    spare=st.tuples(st.integers(0, 9), st.integers(0, 9)),
    base=st.sampled_from([0, -5_000, 2**53 // 1000, 2**62]),
)
def test_counts_are_the_naive_histogram(
    seed: int,
    count: int,
    steps: int,
    step_ms: int,
    pool: int,
    cells: int,
    polarity: Any,
    spare: tuple[int, int],
    base: int,
) -> None:
    crop = max(20, pool * cells) // pool * pool
    if crop < 20:
        crop += pool
    how = Windows(
        length_ms=steps * step_ms, step_ms=step_ms, crop_px=crop, pool_px=pool, polarity=polarity
    )
    width, height = crop + spare[0], crop + spare[1]
    rng = np.random.default_rng(seed)
    events = np.zeros(count, [("x", np.uint16), ("y", np.uint16), ("p", np.uint8), ("t", np.int64)])
    events["x"], events["y"] = rng.integers(0, width, count), rng.integers(0, height, count)
    events["p"] = rng.integers(0, 2, count)
    # few distinct times, many of them on the edges
    events["t"] = np.sort(rng.integers(0, 40, count)) * 500 + base
    starts = rng.integers(-4, 44, 5) * 500 + base
    columns = (events["x"], events["y"], events["p"], events["t"])
    expected = naive(events, starts, how, width, height)
    got = bin_events(EventChunk(*columns), starts, how, width, height)
    assert got.shape == (5, how.steps, how.channels, how.cells, how.cells)
    assert got.dtype == np.uint8
    np.testing.assert_array_equal(got, np.minimum(expected, 255))


@pytest.mark.parametrize(
    ("t", "step"), [(-1, None), (0, 0), (999, 0), (1000, 1), (29_999, 29), (30_000, None)]
)
def test_a_window_is_half_open(t: int, step: int | None) -> None:
    for start in (0, 2**53, 2**62):
        sample = one(320, 240, 1, start + t, start)
        assert sample.sum() == (step is not None)
        if step is not None:
            assert sample[0, step, 0, 10, 10] == 1


@pytest.mark.parametrize(
    ("x", "y", "cell"),
    [
        (119, 240, None),
        (120, 40, (0, 0)),
        (139, 59, (0, 0)),
        (140, 59, (0, 1)),
        (139, 60, (1, 0)),
        (519, 439, (19, 19)),
        (520, 439, None),
        (519, 440, None),
        (320, 39, None),
        (0, 0, None),
        (639, 479, None),
    ],
)
def test_the_crop_is_centred_and_half_open(x: int, y: int, cell: tuple[int, int] | None) -> None:
    sample = one(x, y, 1, 0)
    assert sample.sum() == (cell is not None)
    if cell is not None:
        assert sample[0, 0, 0][cell] == 1


def test_an_odd_crop_keeps_the_floor_of_the_margin() -> None:
    how = Windows(crop_px=63, pool_px=9)
    columns = (np.array([0, 63]), np.array([0, 63]), np.array([1, 1]), np.array([0, 0]))
    sample = bin_events(EventChunk(*columns), np.array([0]), how, 64, 64)
    assert sample.sum() == sample[0, 0, 0, 0, 0] == 1


def test_polarities() -> None:
    for p, positive in [(1, True), (0, False), (-1, False)]:
        assert one(320, 240, p, 0).sum() == positive
        assert one(320, 240, p, 0, 0, Windows(polarity="negative")).sum() != positive
        both = one(320, 240, p, 0, 0, Windows(polarity="both"))
        assert both.shape[2] == 2
        assert both[0, 0, int(positive), 10, 10] == both.sum() == 1
    flags = np.array([True, False])
    two = np.array([320, 320]), np.array([240, 240]), flags, np.array([0, 0])
    assert bin_events(EventChunk(*two), np.array([0]), PAPER).sum() == 1


def test_counts_saturate() -> None:
    k = 1_000
    columns = (np.full(k, 320), np.full(k, 240), np.ones(k, np.int8), np.zeros(k, np.int64))
    assert bin_events(EventChunk(*columns), np.array([0]), PAPER).max() == 255


def test_no_events_and_no_windows() -> None:
    none = (np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8))
    times = np.empty(0, np.int64)
    assert bin_events(EventChunk(*none, times), np.array([0, 5]), PAPER).shape == (2, 30, 1, 20, 20)
    assert not bin_events(EventChunk(*none, times), np.array([0]), PAPER).any()
    assert bin_events(EventChunk(*none, times), times, PAPER).shape[0] == 0


def test_read_only_and_strided_columns() -> None:
    rng = np.random.default_rng(0)
    table = rng.integers(130, 400, (2_000, 2)).astype(np.uint16)
    p, t = np.ones(2_000, np.uint8), np.arange(2_000, dtype=np.int64) * 15
    for column in (table, p, t):
        column.flags.writeable = False
    got = bin_events(EventChunk(table[:, 0], table[:, 1], p, t), np.array([0]), PAPER)
    copies = (table[:, 0].copy(), table[:, 1].copy(), p.copy(), t.copy())
    np.testing.assert_array_equal(got, bin_events(EventChunk(*copies), np.array([0]), PAPER))
    assert got.sum() == 2_000


def test_bad_columns_are_named() -> None:
    x, y, p, t = (np.array([300, 300]) for _ in range(4))
    start = np.array([0])
    for columns, said in (
        ((x, y, p, np.array([5, 4])), "event 0 at 5 us, then 4"),
        ((x, np.array([480, 2]), p, t), "event 0 at pixel"),
        ((np.array([-1, 2]), y, p, t), "not pixels"),
        ((x[:1], y, p, t), "unequal length"),
    ):
        with pytest.raises(ValueError, match=said):
            bin_events(EventChunk(*columns), start, PAPER)
    with pytest.raises(ValueError, match=r"event 1 at pixel \(640, 300\): outside 640 x 480"):
        bin_events(EventChunk(np.array([300, 640]), y, p, t), start, PAPER)
    with pytest.raises(ValueError, match="larger than the sensor"):
        bin_events(EventChunk(x, y, p, t), start, PAPER, 300, 300)
    for bad in (t.astype(float), t.reshape(2, 1)):
        with pytest.raises(TypeError, match="1-D int64"):
            bin_events(EventChunk(x, y, p, bad), start, PAPER)
        with pytest.raises(TypeError, match="p must"):
            bin_events(EventChunk(x, y, bad, t), start, PAPER)
    with pytest.raises(TypeError, match="x must"):
        bin_events(EventChunk(x.astype(float), y, p, t), start, PAPER)


@pytest.mark.parametrize(
    ("centre", "expected"),
    [(None, 120), (319.5, 120), (329.5, 130), (0.0, 0), (639.0, 240), (319.4, 120)],
)
def test_a_crop_is_as_near_to_its_centre_as_the_sensor_allows(
    centre: float | None, expected: int
) -> None:
    assert first_pixel(640, 400, centre) == expected


def test_events_are_counted_about_the_centre_that_is_told() -> None:
    columns = [np.array([v]) for v in (450, 250, 1, 0)]
    start = np.array([0])
    middle = bin_events(EventChunk(*columns), start, PAPER)
    # 20 px right and down
    moved = bin_events(EventChunk(*columns), start, PAPER, centre_px=(339.5, 259.5))
    assert np.argwhere(middle[0, 0, 0]).tolist() == [[(250 - 40) // 20, (450 - 120) // 20]]
    assert np.argwhere(moved[0, 0, 0]).tolist() == [[(250 - 60) // 20, (450 - 140) // 20]]


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 2_000),
    steps=st.integers(1, 6),
    step_ms=st.integers(1, 3),
    size=st.tuples(st.integers(1, 40), st.integers(1, 5)),
    polarity=st.sampled_from(["positive", "negative", "both"]),
)
def test_taxels_are_counted_one_by_one(
    seed: int, count: int, steps: int, step_ms: int, size: tuple[int, int], polarity: Any
) -> None:
    width, height = size
    taxels = width * height
    how = Windows(length_ms=steps * step_ms, step_ms=step_ms, taxels=taxels, polarity=polarity)
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, width, count), rng.integers(0, height, count)
    p = rng.integers(0, 2, count)
    t = np.sort(rng.integers(0, 40, count)) * 500
    starts = rng.integers(-4, 44, 5) * 500

    expected = np.zeros((5, steps, how.channels), np.int64)
    kept = np.ones(count, bool) if polarity == "both" else p == (polarity == "positive")
    sign = p if polarity == "both" else np.zeros(count, np.int64)
    channel = sign * taxels + y * width + x
    step = (t - starts[:, None]) // (step_ms * 1000)
    window, event = np.nonzero(kept & (step >= 0) & (step < steps))
    np.add.at(expected, (window, step[window, event], channel[event]), 1)

    events = EventChunk(x, y, p, t)
    got = bin_events(events, starts, how, width, height)
    assert got.shape == (5, steps, how.channels, 1, 1)
    assert got.dtype == np.uint8
    np.testing.assert_array_equal(got[..., 0, 0], np.minimum(expected, 255))
    listed = list_events(events, starts, how, width, height)
    assert listed.shape == got.shape[1:]
    np.testing.assert_array_equal(listed.dense(), got)
    for a, b in zip(listed.offsets[:-1], listed.offsets[1:], strict=True):
        assert (np.diff(listed.cell[a:b].astype(int)) > 0).all()
    # the same in parts: every step has the channels of its part
    parted = how.model_copy(update={"parts": min(3, steps)})
    split = list_events(events, starts, parted, width, height)
    np.testing.assert_array_equal(split.dense(), bin_events(events, starts, parted, width, height))
    by_part = split.dense()[..., 0, 0].reshape(5, steps, parted.parts, how.channels)
    np.testing.assert_array_equal(by_part.sum(axis=2), got[..., 0, 0])
    for number in range(steps):
        others = np.delete(by_part[:, number], number * parted.parts // steps, axis=1)
        assert not others.any()
    # a sample of taxels has no sides to be mirrored along
    mirrored = listed.mirrored(np.arange(5) % 4)
    np.testing.assert_array_equal(mirrored.dense(), got)


@pytest.mark.parametrize("counted", [bin_events, list_events])
@pytest.mark.parametrize("size", [(38, 1), (40, 1), (39, 2)])
def test_a_sensor_has_as_many_taxels_as_its_windows(counted: Any, size: tuple[int, int]) -> None:
    one = np.array([0])
    with pytest.raises(ValueError, match=rf"taxels = 39: the sensor has {size[0]} x {size[1]} = "):
        counted(EventChunk(one, one, one, one), one, Windows(taxels=39), *size)
