"""Differences between two runs of a trial, on cases small enough to compute by hand."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.scene_tradeoff.error import (
    Onsets,
    SceneError,
    SceneRun,
    choose_by_windows,
    compare,
    flipped_share,
    label_windows,
    match_events,
    mean_error,
    tensor_l1,
)
from benchmarks.scene_tradeoff.windows import look, pooled
from sliplab.protocols.windows import SampleSettings, Windows
from sliplab.storage.streams import EventChunk

WINDOWS = Windows()
SIZE = (640, 480)
MS = 1_000_000


def events(*rows: tuple[int, int, int, int]) -> EventChunk:
    """From rows of column, row, polarity and time (µs)."""
    x, y, p, t = np.array(rows, np.int64).reshape(-1, 4).T
    return EventChunk(
        x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), t.astype(np.int64)
    )


def seen(
    chunk: EventChunk | None,
    markers: Onsets | None = (None, None),
    slips: Onsets = (None, None),
    begin_us: int = 0,
    end_us: int = 300_000,
) -> SceneRun:
    return SceneRun(chunk, SIZE, begin_us, end_us, slips, markers)


def test_the_nth_event_of_a_pixel_and_polarity_meets_the_nth() -> None:
    a = events((5, 6, 1, 10), (5, 6, 0, 20), (5, 6, 1, 30), (6, 5, 1, 40))
    b = events((6, 5, 1, 1), (5, 6, 1, 12), (5, 6, 1, 37), (5, 6, 1, 90))
    found = match_events(a, b)
    pairs = sorted(zip(a.t_us[found.first].tolist(), b.t_us[found.second].tolist(), strict=True))
    assert pairs == [(10, 12), (30, 37), (40, 1)]
    assert found.unmatched == pytest.approx(2 / 8)  # one of polarity 0, one third of its pixel


def test_the_largest_pixel_is_a_pixel_of_its_own() -> None:
    a = events((4095, 4095, 1, 1), (4095, 4095, 0, 2), (0, 4095, 1, 3), (4095, 0, 1, 4))
    b = events((4095, 0, 1, 14), (0, 4095, 1, 13), (4095, 4095, 0, 12), (4095, 4095, 1, 11))
    found = match_events(a, b)
    assert np.all(b.t_us[found.second] - a.t_us[found.first] == 10)
    assert found.unmatched == 0.0


def test_nothing_matches_nothing() -> None:
    one = events((1, 1, 1, 1))
    assert match_events(events(), events()).unmatched is None
    assert match_events(one, events()).unmatched == 1.0
    error = compare(seen(events()), seen(one), WINDOWS)
    assert (error.event_median_us, error.event_p95_us, error.tensor_l1) == (None, None, None)


EVENT = st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 1), st.integers(0, 10**6))


@given(st.lists(EVENT, max_size=40), st.lists(EVENT, max_size=40))
def test_matching_is_what_counting_by_hand_gives(
    first: list[tuple[int, int, int, int]], second: list[tuple[int, int, int, int]]
) -> None:
    a, b = (sorted(rows, key=lambda row: row[3]) for rows in (first, second))
    expected = []
    for place in {row[:3] for row in a + b}:
        expected += zip(
            [row for row in a if row[:3] == place],
            [row for row in b if row[:3] == place],
            strict=False,
        )
    found = match_events(events(*a), events(*b))
    pairs = [(a[i], b[j]) for i, j in zip(found.first, found.second, strict=True)]
    assert sorted(pairs) == sorted(expected)
    if a or b:
        assert found.unmatched == pytest.approx(1 - 2 * len(expected) / (len(a) + len(b)))


def test_a_window_has_the_class_of_its_middle() -> None:
    starts = np.array([0, 30_000, 60_000, 90_000], np.int64)
    labels = label_windows(starts, 30_000, (45 * MS, 105 * MS))
    assert labels.tolist() == [0, 1, 1, 2]
    assert label_windows(starts, 30_000, (45 * MS + 1, None)).tolist() == [0, 0, 1, 1]
    assert label_windows(starts, 30_000, (None, None)).tolist() == [0, 0, 0, 0]


def test_labels_flip_for_as_long_as_onsets_differ() -> None:
    # 271 windows begin in 300 ms; the onsets are 7 and 3 ms apart, none of their windows cut off
    share = flipped_share(0, 300_000, WINDOWS, (100 * MS, 200 * MS), (107 * MS, 197 * MS))
    assert share == pytest.approx(10 / 271)
    assert flipped_share(0, 300_000, WINDOWS, (100 * MS, None), (100 * MS, 200 * MS)) > 0.3
    assert flipped_share(0, 29_999, WINDOWS, (0, None), (None, None)) == 0.0


@given(st.integers(20, 250), st.integers(20, 250))
def test_labels_flip_as_often_either_way(a_ms: int, b_ms: int) -> None:
    a, b = (a_ms * MS, None), (b_ms * MS, None)
    share = flipped_share(0, 300_000, WINDOWS, a, b)
    assert share == flipped_share(0, 300_000, WINDOWS, b, a)
    assert share == pytest.approx(abs(a_ms - b_ms) / 271)


def test_the_distance_of_samples_counts_every_cell_and_step() -> None:
    # crop columns 120..519 and rows 40..439 in cells of 20: (130, 50) and (139, 59) share one
    reference = seen(events((130, 50, 1, 500), (300, 300, 1, 40_000), (10, 10, 1, 50_000)))
    near = seen(events((139, 59, 1, 900), (300, 300, 1, 40_000), (300, 300, 0, 41_000)))
    assert tensor_l1(reference, near, WINDOWS) == 0.0
    late = seen(events((130, 50, 1, 1000), (300, 300, 1, 40_000)))
    assert tensor_l1(reference, late, WINDOWS) == pytest.approx(2 / 2)
    assert tensor_l1(reference, seen(events()), WINDOWS) == 1.0
    more = seen(events(*[(130, 50, 1, 500)] * 300, (300, 300, 1, 40_000)))
    assert tensor_l1(reference, more, WINDOWS) == pytest.approx(254 / 2)  # counts stop at 255


def test_a_run_compared_with_itself_has_no_error() -> None:
    run = seen(events((130, 50, 1, 500), (300, 300, 1, 40_000)), (MS, 2 * MS), (0, MS))
    error = compare(run, run, WINDOWS)
    values = [getattr(error, field.name) for field in fields(SceneError)]
    assert values == [0.0] * len(values)


def test_event_times_are_told_for_all_and_until_gross_slip() -> None:
    rows = [(x, 100, 1, 1000 * x) for x in range(1, 101)]
    shifted = [(x, y, p, t + (5 if x <= 50 else 1000)) for x, y, p, t in rows]
    reference = seen(events(*rows), (MS, 50 * MS + 1))
    error = compare(reference, seen(events(*shifted), (MS, 50 * MS)), WINDOWS)
    assert error.early_p95_us == 5.0
    assert error.event_p95_us == 1000.0
    assert error.event_median_us == pytest.approx((5 + 1000) / 2)
    never = replace(reference, markers=(MS, None))
    assert compare(never, never, WINDOWS).early_p95_us == 0.0


def test_closed_forms_are_held_against_slips_and_have_no_events() -> None:
    reference = seen(events((1, 1, 1, 1)), (60 * MS, 160 * MS), (50 * MS, 150 * MS))
    found_error = seen(None, None, (52 * MS, 150 * MS))
    error = compare(reference, found_error, WINDOWS)
    assert (error.first_slip_ms, error.centre_slip_ms) == (2.0, 0.0)
    assert error.flipped == pytest.approx(2 / 271)
    assert (error.unmatched, error.tensor_l1, error.early_p95_us) == (None, None, None)


def an_error(l1: float | None, flipped: float | None) -> SceneError:
    return SceneError(1.0, None, None, None, None, None, flipped, l1)


def test_means_are_over_the_trials_that_have_a_figure() -> None:
    mean = mean_error([an_error(0.2, 0.1), an_error(None, 0.3)])
    assert (mean.tensor_l1, mean.flipped, mean.centre_slip_ms) == (0.2, pytest.approx(0.2), None)
    assert mean_error([]).flipped is None


@pytest.mark.parametrize(
    ("one", "two", "level"),
    [
        ((0.1, 0.01), (0.1, 0.01), 1),
        ((0.5, 0.01), (0.1, 0.01), 2),
        ((0.1, 0.05), (0.1, 0.01), 2),
        ((0.5, 0.05), (0.4, 0.01), 3),  # as much as two seeds is not less
        ((0.5, 0.05), (None, 0.01), 3),
    ],
)
def test_the_lowest_level_within_two_seeds(
    one: tuple[float, float], two: tuple[float | None, float], level: int
) -> None:
    steps = {1: an_error(*one), 2: an_error(*two)}
    choice = choose_by_windows(steps, an_error(0.4, 0.02))
    assert choice.level == level
    assert "simulated" in choice.reason


def test_what_the_samples_hold() -> None:
    # hold of 1.2 s, incipient onset at 0.6 s, gross at 2.0 s, end at 2.9 s: 30 gross windows
    chunk = events(
        (130, 50, 1, -1_000_000),
        (130, 50, 1, 15_000),
        (130, 50, 0, 100_000),
        (10, 10, 1, 200_000),
        (130, 50, 1, 700_000),
        (130, 50, 1, 2_010_000),
        (130, 50, 1, 2_020_000),
    )
    run = seen(chunk, (600 * MS, 2000 * MS), begin_us=-1_200_000, end_us=2_900_000)
    found = look(run, WINDOWS, SampleSettings(per_class=50), 0)
    assert found.samples == (50, 46, 30)
    assert found.in_hold == 30  # 50 windows of 30 ms end at 0.6 s: the first 30 before 0
    assert found.seconds == (1.2, 0.6, 1.4, 0.9)
    assert found.events == (1, 1, 1, 2)
    # no slip: only the event at 15 ms is in a window, of the right polarity and in the crop
    assert found.silent == (49, 45, 29)
    both = pooled([found, found])
    assert both["hold_share"] == 0.6
    assert both["ceiling"] == pytest.approx(0.8)
    assert both["silent_share"]["gross"] == pytest.approx(29 / 30)
    assert both["events_per_s"]["gross"] == pytest.approx(2 / 0.9)
    assert both["samples"] == {"no_slip": 100, "incipient": 92, "gross": 60}


def test_a_trial_that_never_slips_has_no_shares() -> None:
    found = look(seen(events((130, 50, 1, 15_000))), WINDOWS, SampleSettings(), 0)
    assert found.samples == (0, 0, 0)
    found_error = pooled([found])
    assert found_error["hold_share"] is None
    assert found_error["ceiling"] is None
    assert found_error["events_per_s"]["gross"] is None
    with pytest.raises(ValueError, match="no events"):
        look(seen(None), WINDOWS, SampleSettings(), 0)
