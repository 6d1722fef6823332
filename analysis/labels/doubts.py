"""Reasons why an onset is ambiguous although a rule gives one, as text.

Labels are the reference of everything downstream: a wrong one costs more than a missing
one. An onset is in doubt where a marker that could have changed it was out of sight, where its
place was too uncertain to say when it crossed the line, where the camera moved while too few
markers were at rest to measure it, and where a marker slipped in the hold.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sliplab.analysis.labels.onsets import NO_ONSET, LabelOnsets
from sliplab.storage.schema.label import KINDS, OnsetDoubts

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_UNSEEN_NS = 30_000_000
"""A marker may be out of sight for this long without making its onset unknown: one window."""
MAX_OFF_FRAMES = 2
"""An onset that its markers' uncertainty can move by more frames than this is in doubt."""
_SIGMAS = 3.0


def first_doubts(*doubts: OnsetDoubts) -> OnsetDoubts:
    """Return the first doubt about each onset."""
    first = {kind: next(filter(None, (each.of(kind) for each in doubts)), None) for kind in KINDS}
    return OnsetDoubts(**first)


def unseen(
    frame_ns: Ints,
    displacement: Floats,
    onsets: LabelOnsets,
    centre: int,
    not_before_ns: int,
    motion_ns: int | None = None,
) -> OnsetDoubts:
    """Return the onsets that hidden, lost or never seen markers could have changed.

    A marker that is out of sight and comes back where it was has not slipped; one that comes back
    displaced, or not at all, slipped at some time in between. An onset is in doubt when such a
    time begins more than `MAX_UNSEEN_NS` before the onset that the seen markers give.

    Args:
        frame_ns: (n,) int64. displacement: (n, m) px, NaN where a marker was not seen.
        onsets: by whatever rule.
        not_before_ns: when slips begin to count; a marker never seen at rest is unseen from here
            on.
        motion_ns: start of the motion, from which the words count; by default the same.
    """
    origin_ns = not_before_ns if motion_ns is None else motion_ns
    if not len(frame_ns):
        return OnsetDoubts()
    last_ns = int(frame_ns[-1])
    incipient = last_ns if onsets.incipient_ns is None else onsets.incipient_ns
    found: list[tuple[int, int]] = []
    gross = None
    for marker in range(displacement.shape[1]):
        slipped = int(onsets.per_marker_ns[marker])
        until = last_ns if slipped == NO_ONSET else slipped
        at_rest = np.isfinite(displacement[:, marker])
        if slipped != NO_ONSET:
            at_rest &= frame_ns < slipped
        seen = max(int(frame_ns[at_rest][-1]), not_before_ns) if at_rest.any() else not_before_ns
        if marker == centre and until - seen > MAX_UNSEEN_NS:
            gross = (
                f"the centre marker could not be followed from {_s(seen - origin_ns)} "
                f"to {_s(until - origin_ns)} after the motion began"
            )
        if min(until, incipient) - seen > MAX_UNSEEN_NS:
            found.append((seen, marker))
    if not found:
        return OnsetDoubts(gross=gross)
    seen, marker = min(found)
    reason = (
        f"marker {marker} could not be followed from {_s(seen - origin_ns)} after the motion "
        "began, and may have slipped first"
    )
    return OnsetDoubts(incipient=reason, gross=gross)


def uncertain(
    frame_ns: Ints,
    displacement: Floats,
    sigma: Floats,
    onsets: LabelOnsets,
    centre: int,
    threshold_px: float,
    not_before_ns: int,
) -> OnsetDoubts:
    """Return the onsets whose threshold crossing the standard deviations leave ambiguous.

    Args:
        displacement, sigma: (n, m) px, the second of the first; NaN where unknown.
        onsets: the paper's, of the same displacements.
    """
    moving = frame_ns >= not_before_ns
    may = moving[:, None] & (displacement + _SIGMAS * sigma > threshold_px)
    must = moving[:, None] & (displacement - _SIGMAS * sigma > threshold_px)
    earliest = np.where(may.any(axis=0), may.argmax(axis=0), len(frame_ns))
    surely = np.where(must.any(axis=0), must.argmax(axis=0), len(frame_ns))
    gross = None
    if abs(surely[centre] - earliest[centre]) > 2 * MAX_OFF_FRAMES:
        gross = f"the centre marker's place is only known to {_worst(sigma, centre)} px"
    first, last = int(earliest.min()), int(surely.min())
    incipient = None
    if last - first > 2 * MAX_OFF_FRAMES:
        marker = int(earliest.argmin())
        incipient = f"marker {marker}'s place is only known to {_worst(sigma, marker)} px"
    return OnsetDoubts(incipient=incipient, gross=gross)


def slipped_in_hold(hold_slip_px: Floats, limit_px: float | None) -> OnsetDoubts:
    """Return doubts of both onsets where a marker moved too far during the hold.

    Args:
        hold_slip_px: (m,) displacement of each marker in the hold, NaN where unknown.
        limit_px: None for no limit.
    """
    known = np.nan_to_num(hold_slip_px)
    if limit_px is None or not (known > limit_px).any():
        return OnsetDoubts()
    marker = int(known.argmax())
    reason = f"marker {marker} moved by {known[marker]:.1f} px in the hold, before the motion"
    return OnsetDoubts(incipient=reason, gross=reason)


def _worst(sigma: Floats, marker: int) -> str:
    known = sigma[:, marker][np.isfinite(sigma[:, marker])]
    return f"{known.max():.2f}" if len(known) else "-"


def _s(ns: int) -> str:
    return f"{ns / 1e9:.2f} s"
