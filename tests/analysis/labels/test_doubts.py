"""Onsets that hidden markers leave unknown."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.labels.doubts import MAX_UNSEEN_NS, uncertain, unseen
from sliplab.analysis.labels.onsets import paper_onsets
from sliplab.protocols.labelling import Labelling
from sliplab.storage.schema.label import OnsetDoubts

FRAME_NS = 10_000_000
RULE = Labelling(threshold_px=2.0)
START = 20 * FRAME_NS
SLIPS = np.array([90, 50, 60, 70])  # frames in which the markers first exceed the threshold


def moved() -> tuple[np.ndarray, np.ndarray]:
    """100 frames of four markers, the centre first; motion begins in frame 20."""
    frames = np.arange(100)
    return frames * FRAME_NS, np.where(frames[:, None] >= SLIPS, 3.0, 0.1)


def doubts(frame_ns: np.ndarray, distance: np.ndarray) -> OnsetDoubts:
    """Doubts about the onsets by the paper's rule."""
    onsets = paper_onsets(frame_ns, distance, 0, RULE, START)
    return unseen(frame_ns, distance, onsets, 0, START)


def hidden(marker: int, first: int, last: int) -> tuple[str | None, str | None]:
    """Doubts when a marker is unseen from one frame up to and without another."""
    frame_ns, distance = moved()
    distance[first:last, marker] = np.nan
    found = doubts(frame_ns, distance)
    return found.incipient, found.gross


def test_whatever_is_seen_is_not_doubted() -> None:
    assert hidden(0, 0, 0) == (None, None)


def test_hidden_and_back_where_it_was_is_no_slip() -> None:
    for marker in range(4):
        assert hidden(marker, 25, 45) == (None, None)


def test_hidden_when_it_slipped_first() -> None:
    incipient, gross = hidden(1, 40, 80)
    assert incipient == (
        "marker 1 could not be followed from 0.19 s after the motion began, "
        "and may have slipped first"
    )
    assert gross is None
    # three frames are no matter
    assert hidden(1, 48, 50) == (None, None)


def test_a_marker_that_never_comes_back() -> None:
    assert hidden(3, 40, 100)[0] is not None
    assert hidden(3, 55, 100) == (None, None)  # the first slip had been seen by then
    assert hidden(3, 0, 100)[0] is not None  # never seen at all


def test_without_the_centre_gross_slip_is_unknown() -> None:
    assert hidden(0, 80, 100) == (
        None,
        "the centre marker could not be followed from 0.59 s to 0.79 s after the motion began",
    )
    assert hidden(0, 80, 95)[1] is not None
    assert hidden(0, 89, 91) == (None, None)
    assert hidden(0, 95, 100) == (None, None)


def test_a_centre_that_did_not_slip_is_known_not_to_have() -> None:
    frame_ns, distance = moved()
    distance[:, 0] = 0.1
    assert doubts(frame_ns, distance).gross is None
    distance[-4:, 0] = np.nan
    assert doubts(frame_ns, distance).gross is not None


@given(
    marker=st.integers(0, 3),
    first=st.integers(0, 99),
    length=st.integers(1, 99),
)
def test_an_onset_is_right_within_three_frames_or_in_doubt(
    marker: int, first: int, length: int
) -> None:
    frame_ns, distance = moved()
    distance[first : first + length, marker] = np.nan
    onsets = paper_onsets(frame_ns, distance, 0, RULE, START)
    found = doubts(frame_ns, distance)
    if found.incipient is None:
        assert abs(onsets.incipient_ns - 50 * FRAME_NS) <= MAX_UNSEEN_NS
    if found.gross is None:
        assert abs(onsets.gross_ns - 90 * FRAME_NS) <= MAX_UNSEEN_NS


def test_places_that_are_not_known_leave_an_onset_open() -> None:
    frame_ns = np.arange(100) * FRAME_NS
    starts = np.array([60, 30, 40, 50])
    distance = 0.2 * np.maximum(0.0, np.arange(100)[:, None] - starts)
    onsets = paper_onsets(frame_ns, distance, 0, RULE, START)

    def doubted(marker: int, px: float) -> tuple[bool, bool]:
        sigma = np.full(distance.shape, 0.005)
        sigma[:, marker] = px
        found = uncertain(frame_ns, distance, sigma, onsets, 0, 2.0, START)
        return found.incipient is not None, found.gross is not None

    assert doubted(0, 0.005) == (False, False)
    assert doubted(0, 0.1) == (False, False)  # 3 sigma are a frame and a half either way
    assert doubted(0, 0.25) == (False, True)
    assert doubted(1, 0.25) == (True, False)
    assert doubted(3, 0.25) == (False, False)  # the first slip had been seen long before
