"""Ground truth: slip onsets of the first marker and of the centre, and a plate's time of rest.

The rule is the paper's, taken literally: a marker slips in the first frame in which it is more than
2 pixels from its position when the recording began. Every accuracy and latency the project reports
depends on these two times, so the rule is a separate module over plain arrays. Nothing is smoothed
or interpolated: a frame in which a marker was not seen says nothing about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sliplab.protocols.labelling import Labelling

NO_ONSET = -1
"""Value in `LabelOnsets.per_marker_ns` of a marker that never slipped."""


@dataclass(frozen=True)
class LabelOnsets:
    """The onsets of one trial, on its time line.

    Attributes:
        incipient_ns: the first slip of any marker; None when none slipped.
        gross_ns: the slip of the centre marker; None when it did not slip.
        first_marker: the marker that slipped first, of several in one frame the one that moved
            farthest; None when none slipped.
        per_marker_ns: (m,) int64, each marker's slip, -1 for none.
    """

    incipient_ns: int | None
    gross_ns: int | None
    first_marker: int | None
    per_marker_ns: NDArray[np.int64]


def last_off_axis(onsets: LabelOnsets, centre: int) -> int:
    """The marker besides the centre that slips last, or one that never does: gross in a twist.

    About its own axis the centre marker turns on the spot, however far the others have slipped.
    """
    others = [marker for marker in range(len(onsets.per_marker_ns)) if marker != centre]
    latest = np.iinfo(np.int64).max
    return max(
        others,
        key=lambda m: latest if (t := int(onsets.per_marker_ns[m])) == NO_ONSET else t,
        default=centre,
    )


def mean_positions(
    xy: NDArray[np.float64], frames: slice | NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Mean place of each marker over the frames in which it was seen, (m, 2) pixels.

    Args:
        xy: (n, m, 2) marker positions, pixels, NaN where a marker was not seen.
        frames: a slice of frames or an (n,) mask.

    Returns:
        NaN for a marker that was seen in none of them.

    Raises:
        ValueError: shapes that do not fit, or no frame.
    """
    if xy.ndim != 3 or xy.shape[2] != 2:
        raise ValueError(f"xy has the shape {xy.shape}: must be (frames, markers, 2)")
    if not isinstance(frames, slice) and (frames.dtype != np.bool_ or frames.shape != xy.shape[:1]):
        raise ValueError(f"reference_frames must be a slice or a mask of {xy.shape[0]} frames")
    reference = xy[frames]
    if reference.shape[0] == 0:
        raise ValueError("no reference frame: the recording starts after the hold")
    seen = np.asarray(np.isfinite(reference).all(axis=2))
    count = seen.sum(axis=0)
    # sums about one frame's value: the mean of equal positions must be that position to the bit
    first = reference[seen.argmax(axis=0), np.arange(xy.shape[1])]
    total = np.where(seen[:, :, None], reference - first, 0.0).sum(axis=0)
    mean: NDArray[np.float64] = first + total / np.maximum(count, 1)[:, None]
    mean[count == 0] = np.nan
    return mean


def relative_to_plate(
    xy: NDArray[np.float64], plate_xy: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Markers relative to the plate's own marker, so that what remains is motion on the plate.

    Args:
        xy: (n, m, 2) pixels. plate_xy: (n, 2) pixels, or None where no plate slides.

    Raises:
        ValueError: shapes that do not fit.
    """
    if plate_xy is None:
        return xy
    if plate_xy.shape != (xy.shape[0], 2):
        raise ValueError(f"plate_xy has the shape {plate_xy.shape}, not {(xy.shape[0], 2)}")
    return xy - plate_xy[:, None, :]


def paper_onsets(
    frame_ns: NDArray[np.int64],
    displacement: NDArray[np.float64],
    centre: int,
    settings: Labelling,
    not_before_ns: int | None = None,
) -> LabelOnsets:
    """The paper's rule: the time of the first frame over the threshold, marker by marker.

    Args:
        frame_ns: (n,) int64, the frames' times on the trial's time line, strictly increasing.
        displacement: (n, m) pixels, NaN where unknown (never a slip).
        centre: index of the centre marker.
        settings: `threshold_px`; a displacement equal to it is not a slip.
        not_before_ns: frames earlier than this are ignored.

    Raises:
        ValueError: shapes that do not fit, times out of order, or no such marker.
    """
    if displacement.ndim != 2 or frame_ns.shape != displacement.shape[:1]:
        raise ValueError(
            f"frame_ns {frame_ns.shape} and displacement {displacement.shape}: "
            "must be (frames,) and (frames, markers)"
        )
    if frame_ns.dtype.kind not in "iu":
        raise ValueError(f"frame_ns must be int64, not {frame_ns.dtype}")
    if (np.diff(frame_ns) <= 0).any():
        raise ValueError("frame_ns must increase strictly; frames out of order have no onset")
    markers = displacement.shape[1]
    if not 0 <= centre < markers:
        raise ValueError(f"centre = {centre}: must be one of {markers} markers")
    # a comparison with NaN is False
    over: NDArray[np.bool_] = displacement > settings.threshold_px
    if not_before_ns is not None:
        over &= (frame_ns >= not_before_ns)[:, None]
    slipped = np.asarray(over.any(axis=0))
    if not slipped.any():
        return LabelOnsets(None, None, None, np.full(markers, NO_ONSET, np.int64))
    frame = over.argmax(axis=0)
    first = int(frame[slipped].min())
    in_first = np.where(over[first], displacement[first], -1.0)
    return LabelOnsets(
        incipient_ns=int(frame_ns[first]),
        gross_ns=int(frame_ns[frame[centre]]) if slipped[centre] else None,
        first_marker=int(in_first.argmax()),
        per_marker_ns=np.where(slipped, frame_ns[frame], NO_ONSET).astype(np.int64),
    )


def rest_time(
    frame_ns: NDArray[np.int64], xy: NDArray[np.float64], within_px: float, unseen_ns: int
) -> int | None:
    """Return the time of the first frame after which a point stays at its final position, ns.

    It stays within `within_px` of that position, the threshold that a slip's onset has as well. A
    point that still moves in the last frames comes to rest there.

    Args:
        frame_ns: (n,) int64, the frames' times, strictly increasing.
        xy: (n, 2) places, pixels, NaN where unknown.
        unseen_ns: with nothing seen for longer than this at the end, it may move out of sight.

    Returns:
        None where it never went farther, or where it was not seen at the end.
    """
    seen = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if not len(seen) or frame_ns[-1] - frame_ns[seen[-1]] > unseen_ns:
        return None
    away = np.flatnonzero(np.hypot(*(xy[seen] - xy[seen[-1]]).T) > within_px)
    return int(frame_ns[seen[away[-1] + 1]]) if len(away) else None
