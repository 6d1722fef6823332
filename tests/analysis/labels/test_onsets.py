"""The 2 pixel rule on motions whose onset is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sliplab.analysis.labels.onsets import (
    mean_positions,
    paper_onsets,
    relative_to_plate,
    rest_time,
)
from sliplab.protocols.labelling import Labelling
from tests.patching import loose

MS = 1_000_000
T0 = 2**62
PAPER = Labelling()

Floats = NDArray[np.float64]


def times(n: int) -> NDArray[np.int64]:
    return T0 + np.arange(n, dtype=np.int64) * 10 * MS


def ramps(n: int, starts: list[int], px_a_frame: float) -> Floats:
    """(n, m) displacements: at rest until `starts`, then steady."""
    frames = np.arange(n)[:, None] - np.array(starts)
    return np.maximum(0, frames) * px_a_frame


def moved(displacement: Floats) -> Floats:
    """Positions with these displacements, each marker in its own direction."""
    angle = np.arange(displacement.shape[1]) * 0.7
    direction = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    home = np.stack((300 + 67 * np.arange(len(angle)), 200 - 5 * np.arange(len(angle))), axis=-1)
    return home + displacement[:, :, None] * direction


def displacements(xy: Floats, rest: object, plate_xy: Floats | None = None) -> Floats:
    """Distance of each marker from its mean place over the frames at rest, (n, m) px."""
    xy = relative_to_plate(xy, plate_xy)
    return np.hypot(*np.moveaxis(xy - mean_positions(xy, rest), -1, 0))


def test_the_rule_read_literally() -> None:
    # 0.5 px a frame: exactly 2.0 px after 4 frames, over it after 5
    displacement = ramps(200, [100, 30, 60], 0.5)
    onsets = paper_onsets(times(200), displacement, 0, PAPER)
    assert onsets.per_marker_ns.tolist() == [T0 + i * 10 * MS for i in (105, 35, 65)]
    assert onsets.incipient_ns == T0 + 350 * MS
    assert onsets.gross_ns == T0 + 1_050 * MS
    assert onsets.first_marker == 1


def test_from_positions_to_onsets() -> None:
    truth = ramps(200, [100, 50, 60, 70], 0.3)
    found = displacements(moved(truth), slice(10, 30))
    np.testing.assert_allclose(found, truth, atol=1e-9)
    onsets = paper_onsets(times(200), found, 0, PAPER)
    assert onsets.per_marker_ns.tolist() == [T0 + i * 10 * MS for i in (107, 57, 67, 77)]


def test_the_reference_is_a_mean_over_what_was_seen() -> None:
    xy = np.zeros((6, 2, 2))
    xy[:4, 0, 0] = [1.0, 3.0, np.nan, 2.0]
    xy[:4, 1] = np.nan
    xy[4:, 0, 0] = [12.0, np.nan]
    found = displacements(xy, np.array([True, True, True, False, False, False]))
    np.testing.assert_array_equal(found[:, 0], [1, 1, np.nan, 0, 10, np.nan])
    assert np.isnan(found[:, 1]).all()  # never seen at rest: nothing can be said of it


def test_markers_that_stand_still_have_no_displacement_at_all() -> None:
    xy = np.broadcast_to(np.array([[0.1, 1e6 + 0.3], [33.3, 1 / 3]]), (1_000, 2, 2))
    assert not displacements(xy, slice(0, 333)).any()


def test_motion_with_the_plate_is_no_slip() -> None:
    truth = ramps(100, [60, 40], 0.45)
    fall = np.zeros((100, 2))
    fall[20:, 1] = 0.3 * np.arange(80) ** 1.5
    xy = moved(truth) + fall[:, None]
    plate = np.array([500.0, 80.0]) + fall
    found = displacements(xy, slice(0, 20), plate)
    np.testing.assert_allclose(found, truth, atol=1e-9)
    # left out, the plate's fall would be the onset
    alone = paper_onsets(times(100), displacements(xy, slice(0, 20)), 0, PAPER)
    relative = paper_onsets(times(100), found, 0, PAPER)
    assert relative.incipient_ns == T0 + 450 * MS
    assert alone.incipient_ns < T0 + 300 * MS
    plate[50:60] = np.nan
    held = paper_onsets(times(100), displacements(xy, slice(0, 20), plate), 0, PAPER)
    assert held.incipient_ns == T0 + 450 * MS
    assert held.gross_ns == T0 + 650 * MS


def test_frames_without_a_marker_never_count() -> None:
    displacement = ramps(100, [50, 200], 1.0)
    displacement[:55, 0] = np.nan
    displacement[:, 1] = np.nan
    onsets = paper_onsets(times(100), displacement, 0, PAPER)
    assert onsets.per_marker_ns.tolist() == [T0 + 550 * MS, -1]
    assert onsets.first_marker == 0


def test_nothing_before_the_motion_counts() -> None:
    displacement = ramps(100, [60, 70], 1.0)
    displacement[10] = 50.0
    for limit, first in [(None, 10), (T0 + 100 * MS, 10), (T0 + 100 * MS + 1, 63)]:
        onsets = paper_onsets(times(100), displacement, 1, PAPER, limit)
        assert onsets.incipient_ns == T0 + first * 10 * MS
    assert onsets.gross_ns == T0 + 730 * MS


def test_no_slip_and_no_gross_slip() -> None:
    onsets = paper_onsets(times(50), np.full((50, 3), 2.0), 0, PAPER)
    assert (onsets.incipient_ns, onsets.gross_ns, onsets.first_marker) == (None, None, None)
    assert onsets.per_marker_ns.tolist() == [-1, -1, -1]
    onsets = paper_onsets(times(50), ramps(50, [60, 10], 1.0), 0, PAPER)
    assert onsets.gross_ns is None
    assert onsets.incipient_ns == T0 + 130 * MS
    empty = paper_onsets(times(0), np.empty((0, 3)), 0, PAPER)
    assert empty.incipient_ns is None


def test_of_several_in_one_frame_the_farthest_is_first() -> None:
    displacement = np.zeros((5, 4))
    displacement[3] = [2.5, np.nan, 7.0, 3.0]
    assert paper_onsets(times(5), displacement, 0, PAPER).first_marker == 2


@given(
    frames=st.lists(st.integers(1, 90), min_size=1, max_size=19),
    threshold=st.floats(0.25, 20),
    slope=st.floats(0.05, 5),
)
def test_the_onset_is_the_first_frame_over_the_line(
    frames: list[int], threshold: float, slope: float
) -> None:
    displacement = ramps(600, frames, slope)
    onsets = paper_onsets(times(600), displacement, 0, Labelling(threshold_px=threshold))
    for marker, onset_ns in enumerate(onsets.per_marker_ns):
        column = displacement[:, marker]
        if onset_ns < 0:
            assert column.max() <= threshold
            continue
        i = int(onset_ns - T0) // (10 * MS)
        assert column[i] > threshold >= column[i - 1]
    if onsets.incipient_ns is not None:
        assert onsets.incipient_ns == onsets.per_marker_ns[onsets.per_marker_ns >= 0].min()
        assert onsets.gross_ns is None or onsets.incipient_ns <= onsets.gross_ns


def test_shapes_that_do_not_fit() -> None:
    xy = np.zeros((10, 3, 2))
    with pytest.raises(ValueError, match="xy has the shape"):
        displacements(xy[:, :, 0], slice(0, 5))
    with pytest.raises(ValueError, match="plate_xy"):
        displacements(xy, slice(0, 5), np.zeros((9, 2)))
    with pytest.raises(ValueError, match="no reference frame"):
        displacements(xy, slice(0, 0))
    with pytest.raises(ValueError, match="no reference frame"):
        displacements(xy, np.zeros(10, np.bool_))
    with pytest.raises(ValueError, match="mask of 10 frames"):
        displacements(xy, np.ones(9, np.bool_))
    with pytest.raises(ValueError, match=r"must be \(frames,\)"):
        paper_onsets(times(9), np.zeros((10, 3)), 0, PAPER)
    with pytest.raises(ValueError, match="one of 3 markers"):
        paper_onsets(times(10), np.zeros((10, 3)), 3, PAPER)
    with pytest.raises(ValueError, match="increase strictly"):
        paper_onsets(times(10)[::-1], np.zeros((10, 3)), 0, PAPER)
    with pytest.raises(ValueError, match="int64"):
        loose(paper_onsets)(times(10).astype(float), np.zeros((10, 3)), 0, PAPER)


def falling(stroke_px: float, n: int = 60) -> tuple[Floats, float]:
    """Free fall from frame 20 on, 49 px/s/ms, onto a stop; and when it lands, ms after T0."""
    t_ms = 10.0 * np.arange(n)
    down = 0.5 * 0.049 * np.maximum(0.0, t_ms - 200.0) ** 2
    landed = 200.0 + float(np.sqrt(2 * stroke_px / 0.049))
    return np.stack((np.full(n, 300.0), 100.0 + np.minimum(down, stroke_px)), axis=1), landed


@given(st.floats(3.0, 800.0))
def test_a_plate_rests_where_it_lands(stroke_px: float) -> None:
    xy, landed = falling(stroke_px)
    found = rest_time(times(60), xy, 2.0, 30 * MS)
    # it is within 2 px of its stop a little before it lands; frames come every 10 ms
    near = 200.0 + np.sqrt(2 * (stroke_px - 2.0) / 0.049)
    assert near - 1e-6 <= (found - T0) / MS <= landed + 10.0


def test_what_never_moved_or_went_out_of_sight_has_no_rest() -> None:
    xy, _ = falling(100.0)
    still = np.tile([300.0, 100.0], (60, 1))
    assert rest_time(times(60), still, 2.0, 30 * MS) is None
    out = xy.copy()
    out[-5:] = np.nan
    assert rest_time(times(60), out, 2.0, 30 * MS) is None
    assert rest_time(times(60), np.full_like(xy, np.nan), 2.0, 30 * MS) is None
    # a frame or two unseen at the end, or any in between, change nothing
    out = xy.copy()
    out[[-2, -1, 5, 22]] = np.nan
    assert rest_time(times(60), out, 2.0, 30 * MS) == rest_time(times(60), xy, 2.0, 30 * MS)


def test_what_still_moves_at_the_end_rests_there() -> None:
    xy, _ = falling(1e9, 30)
    assert rest_time(times(30), xy, 2.0, 30 * MS) == T0 + 290 * MS
