"""Detections worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.protocols.detection import Detection

MS = 1_000_000
N, I, G, Q = (9, 0, 0), (0, 9, 0), (0, 0, 9), (0, 0, 0)  # noqa: E741


def ends(n: int, first: int = 30 * MS) -> np.ndarray:
    return first + 30 * MS * np.arange(n, dtype=np.int64)


def test_onsets_are_dated_by_the_end_of_the_window() -> None:
    counts = np.array([N] * 4 + [I] * 5 + [G] * 5)
    found = detect(counts, ends(14), Detection(smoothing=1, margin=2))
    assert found.incipient_ns == 5 * 30 * MS
    assert found.gross_ns == 10 * 30 * MS
    assert found.valid_class.tolist() == [0] * 4 + [1] * 5 + [2] * 5


def test_a_full_window_is_needed_and_a_mean_lead_of_the_margin() -> None:
    counts = np.array([N] * 4 + [I] * 5)
    found = detect(counts, ends(9), Detection(smoothing=4, margin=2))
    # 4 windows: after k of class I the sums are 9(4-k) and 9k: a tie at 2, a lead of 18/4 at 3
    assert found.valid_class.tolist() == [-1, -1, -1, 0, 0, -1, 1, 1, 1]
    assert found.incipient_ns == 7 * 30 * MS
    np.testing.assert_allclose(found.smoothed[6], [9 / 4, 27 / 4, 0])
    np.testing.assert_allclose(found.smoothed[0], [9, 0, 0])  # a mean over what there is


def test_incipient_at_once_is_not_seen_before_the_window_is_full() -> None:
    found = detect(np.array([I] * 6), ends(6), Detection(smoothing=4))
    assert found.incipient_ns == 4 * 30 * MS


def test_the_margin_is_reached_exactly_in_thirds() -> None:
    # sums 10 and 4 over 3 windows: the means differ by 2 exactly, in floating point by less
    counts = np.array([(0, 4, 2), (0, 3, 1), (0, 3, 1)])
    assert detect(counts, ends(3), Detection(smoothing=3, margin=2)).incipient_ns == 90 * MS
    counts[2, 1] -= 1
    assert detect(counts, ends(3), Detection(smoothing=3, margin=2)).incipient_ns is None


def test_gross_before_incipient_does_not_count() -> None:
    counts = np.array([G, G, I, Q, G])
    found = detect(counts, ends(5), Detection(smoothing=1))
    assert (found.incipient_ns, found.gross_ns) == (90 * MS, 150 * MS)
    found = detect(counts[:4], ends(4), Detection(smoothing=1))
    assert (found.incipient_ns, found.gross_ns) == (90 * MS, None)
    found = detect(counts[:2], ends(2), Detection(smoothing=1))
    assert (found.incipient_ns, found.gross_ns) == (None, None)


@pytest.mark.parametrize("margin", [0.0, 2.0])
def test_a_silent_network_detects_nothing(margin: float) -> None:
    found = detect(np.array([Q] * 20), ends(20), Detection(smoothing=4, margin=margin))
    assert (found.incipient_ns, found.gross_ns) == (None, None)
    assert (found.valid_class == -1).all()


@pytest.mark.parametrize("n", [0, 1, 3])
def test_fewer_windows_than_the_average_takes(n: int) -> None:
    found = detect(np.array([I] * n, int).reshape(n, 3), ends(n), Detection(smoothing=4))
    assert found.incipient_ns is None
    assert found.smoothed.shape == (n, 3)
    assert found.valid_class.tolist() == [-1] * n


def test_times_since_1970_stay_exact() -> None:
    first = 1_800_000_000_000_000_001
    found = detect(np.array([I, G]), ends(2, first), Detection(smoothing=1))
    assert (found.incipient_ns, found.gross_ns) == (first, first + 30 * MS)


@given(
    st.lists(st.tuples(*[st.integers(0, 30)] * 3), min_size=1, max_size=40),
    st.integers(1, 6),
)
def test_smoothing_is_a_mean_of_the_last_windows(rows: list[tuple[int, ...]], width: int) -> None:
    counts = np.array(rows)
    found = detect(counts, ends(len(rows)), Detection(smoothing=width))
    for k in range(len(rows)):
        np.testing.assert_allclose(
            found.smoothed[k], counts[max(0, k - width + 1) : k + 1].mean(axis=0)
        )
    if found.incipient_ns is not None and found.gross_ns is not None:
        assert found.incipient_ns < found.gross_ns


@pytest.mark.parametrize(
    ("counts", "end_ns", "message"),
    [
        (np.zeros((2, 2), int), ends(2), "expected"),
        (np.zeros((2, 3), int), ends(3), "window ends for 2 windows"),
        (np.zeros((2, 3)), ends(2), "expected integers"),
        (np.zeros((2, 3), int), ends(2).astype(float), "expected integers"),
        (np.zeros((2, 3), int), ends(2)[::-1], "do not increase"),
        (np.zeros((2, 3), int), ends(2) * 0, "do not increase"),
    ],
)
def test_wrong_input_is_named(counts: np.ndarray, end_ns: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        detect(counts, end_ns, Detection())
