"""Labels of trials without frames: onsets from the events of the markers and the arm's motion.

Markers are tracked inside the sensor (`event_tracking`), and what they lack behind the sensor's own
way is slip (`event_slips`). Displacements are in pixels of the frame camera's scale, so that a
threshold means what it means in frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sliplab.analysis.labels.camera_shift import no_shift
from sliplab.analysis.labels.doubts import first_doubts, slipped_in_hold, unseen
from sliplab.analysis.labels.event_slips import AT_REST_MM, PapillaSlips, slips
from sliplab.analysis.labels.event_tracking import (
    EventTracks,
    find_discs,
    track_discs,
    without_hot_pixels,
)
from sliplab.analysis.labels.force_onsets import onsets_by_force
from sliplab.analysis.labels.label import HoldEndOnsets, Label
from sliplab.analysis.labels.onsets import NO_ONSET, LabelOnsets, last_off_axis, paper_onsets
from sliplab.analysis.labels.places import Places
from sliplab.analysis.labels.slip_times import SlipTimes
from sliplab.protocols.labelling import Labelling
from sliplab.storage.schema.label import OnsetDoubts, OnsetIntervals
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.recording import Recording

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

VERSION = 1
SLICE_NS = 5_000_000
"""Displacements are given every 5 ms."""
FIRST_MM = 0.3
"""Travel of the sensor in which discs are searched: less than most need to slip."""
WIDEST_NS = 300_000_000
"""An onset whose 95 % interval is wider is in doubt."""
NEAR_LOST_NS = 1_000_000_000
"""So near to lost events an apparent slip may be motion that was not seen."""
TURNED_BACK_MM = 0.05
POSE_NS = 20_000_000
"""Poses are means over so long: an arm reports them with noise."""
PHASES = ("slide", "twist")
NO_PLATE = "the plate moves by itself, and the event camera does not see it"
NO_DISCS = "the markers were not found in the events of the first motion"
TURNED = "the sensor turned back on its way"
SOURCE = "events"
"""The source of these labels."""


def onsets_by_events(recording: Recording, settings: Labelling) -> Label:
    """Find the onsets of a trial.

    Its displacements are given at the ends of slices of time, and its places are those in the
    picture of the event camera. A trial that cannot be labelled so has onsets in doubt, and the
    reason.

    Raises:
        StoreError: it has no events, or the scale of the frame camera is unknown.
    """
    start_ns, stop_ns = recording.motion_ns
    size_px = recording.event_px
    events = without_hot_pixels(recording.events(), size_px)
    clock = recording.clock("events")
    begin_ns = int(clock.to_reference(int(events.t_us[0]) * 1000)) if len(events) else start_ns
    # slices end where the motion begins and go on from there
    before = max((start_ns - begin_ns) // SLICE_NS, 1)
    edges_ns = start_ns + SLICE_NS * np.arange(-before, (stop_ns - start_ns) // SLICE_NS + 1)
    t_ns = edges_ns[1:]
    layout_mm = recording.layout_px / (recording.record.geometry.px_per_mm or 1.0)
    if recording.motion_phase not in PHASES or recording.record.experiment != "kinematic":
        return _refused(recording, settings, t_ns, NO_PLATE)
    base = bases(recording, layout_mm, t_ns, start_ns)
    way = np.hypot(base[..., 0], base[..., 1])
    if (np.maximum.accumulate(way) - way).max() > TURNED_BACK_MM:
        return _refused(recording, settings, t_ns, TURNED)
    farthest = way.max(axis=1)
    settle = slice(int(before), int(np.searchsorted(farthest, FIRST_MM)) + 1)
    edges_us = np.asarray(clock.to_device(edges_ns)) // 1000
    first = _between(events, int(edges_us[settle.start]), int(edges_us[settle.stop]))
    discs = find_discs(first, layout_mm, size_px)
    if discs is None:
        return _refused(recording, settings, t_ns, NO_DISCS)
    tracks = track_discs(events, edges_us, discs, settle)
    along = _directions(base, way)
    moved = ((tracks.xy - tracks.rests.xy) * along).sum(axis=2)
    # what does not move makes no events, and needs none
    moved[:, way.max(axis=0) < AT_REST_MM] = 0.0
    moved[tracks.lost] = np.nan
    found = slips(way, moved, tracks.sigma, int(before), tracks.backlash_px)
    return _onsets(recording, settings, t_ns, found, tracks, way, moved)


def bases(recording: Recording, layout_mm: F64, t_ns: I64, start_ns: int) -> F64:
    """Motion of each papilla's stuck tip as the sensor sees it, mm, (n, m, 2).

    Columns count to the right and rows downwards; 0 before the motion.

    Args:
        layout_mm: (m, 2), likewise. t_ns: (n,) on the time line. start_ns: of the motion.
    """
    with recording.open() as reader:
        poses = reader.poses()
    pose_ns = np.asarray(recording.clock("arm").to_reference(poses.t_ns))
    turns = Rotation.from_rotvec(np.radians(poses.rotvec_deg))
    first = max(int(np.searchsorted(pose_ns, start_ns)) - 1, 0)
    rest = turns[first]
    held = (pose_ns >= start_ns - 10 * POSE_NS) & (pose_ns <= start_ns)
    origin = poses.xyz_mm[held].mean(axis=0) if held.any() else poses.xyz_mm[first]
    # the tool's axes are the plate's: right, up, into the plate
    shift = rest.inv().apply(poses.xyz_mm - origin)[:, :2] * [1.0, -1.0]
    turned = (rest.inv() * turns).as_rotvec()[:, 2]
    rows = np.column_stack([shift, turned])
    period = float(np.median(np.diff(pose_ns))) if len(pose_ns) > 1 else POSE_NS
    width = max(int(POSE_NS / max(period, 1.0)) // 2 * 2 + 1, 1)
    if 1 < width < len(rows):
        padded = np.pad(rows, ((width // 2, width // 2), (0, 0)), mode="edge")
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(padded, axis=0)])
        rows = (total[width:] - total[:-width]) / width
    x, y, angle = (np.interp(t_ns, pose_ns, column) for column in rows.T)
    # seen from above with rows downwards, the plate turns the same way as the sensor's angle
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    u, v = layout_mm[None, :, 0] - x[:, None], layout_mm[None, :, 1] - y[:, None]
    seen = np.stack([cosine * u - sine * v, sine * u + cosine * v], axis=2) - layout_mm[None]
    seen[t_ns <= start_ns] = 0.0
    return np.asarray(seen, np.float64)


def _between(events: EventChunk, begin_us: int, end_us: int) -> EventChunk:
    part = slice(*np.searchsorted(events.t_us, (begin_us, end_us)).tolist())
    return events[part]


def _directions(base: F64, way: F64) -> F64:
    """(n, m, 2) directions of the bases' motion; before it is one, the first that is."""
    along = base / np.maximum(way, 1e-9)[..., None]
    for marker in range(way.shape[1]):
        far = np.flatnonzero(way[:, marker] > TURNED_BACK_MM)
        along[: far[0] if len(far) else None, marker] = along[far[0], marker] if len(far) else 0.0
    return along


def _onsets(
    recording: Recording,
    settings: Labelling,
    t_ns: I64,
    found: PapillaSlips,
    tracks: EventTracks,
    way: F64,
    moved: F64,
) -> Label:
    """Apply both rules to the slips."""
    start_ns, geometry = recording.motion_ns[0], recording.record.geometry
    centre, scale = geometry.centre, geometry.px_per_mm or 1.0
    moved_px, sigma = np.abs(found.distance_mm) * scale, found.sigma_mm * scale
    still = int(np.searchsorted(t_ns, start_ns))
    hold = np.abs(moved[max(still, 1) - 1] - moved[0]) / found.gain * scale
    if recording.motion_phase == "twist":
        centre = last_off_axis(paper_onsets(t_ns, moved_px, centre, settings, start_ns), centre)
    paper = paper_onsets(t_ns, moved_px, centre, settings, start_ns)
    times = [
        _times(t_ns, way[:, k], knees)
        for k, knees in enumerate(zip(found.low_mm, found.knee_mm, found.high_mm, strict=True))
    ]
    low, at, high = np.array(times, np.int64).reshape(-1, 3).T
    # like the paper's rule: what never gets far enough has not slipped
    crept = paper.per_marker_ns == NO_ONSET
    low, at, high = (np.where(crept, NO_ONSET, column) for column in (low, at, high))
    slip_times = SlipTimes(at, low, high, centre, WIDEST_NS // 2)
    known = np.isfinite(moved_px)
    xy = np.where(known[..., None], tracks.xy, np.nan)
    held = slipped_in_hold(hold, settings.hold_slip_px)
    lost_ns = t_ns[tracks.lost & (t_ns > start_ns)]
    intervals = crossing_intervals(
        t_ns, moved_px, sigma, paper, centre, settings.threshold_px, start_ns
    )

    def doubts(onsets: LabelOnsets) -> OnsetDoubts:
        hidden = unseen(t_ns, moved_px, onsets, centre, start_ns)
        return first_doubts(held, hidden, _near_lost(onsets, lost_ns))

    return _label(
        recording,
        settings,
        t_ns,
        HoldEndOnsets(paper, first_doubts(doubts(paper), _wide(intervals)), moved_px),
        intervals,
        slip_times,
        first_doubts(doubts(slip_times.onsets), slip_times.doubts()),
        hold,
        Places(xy, sigma, known.astype(np.float64)),
    )


def _times(t_ns: I64, way: F64, places_mm: tuple[float, ...]) -> list[int]:
    """Return the times at which a base passed some places, -1 for one that is unknown."""
    forwards = np.maximum.accumulate(way)
    return [
        NO_ONSET
        if np.isnan(place)
        else round(float(np.interp(place, forwards, t_ns - t_ns[0]))) + int(t_ns[0])
        for place in places_mm
    ]


def crossing_intervals(
    t_ns: I64,
    moved_px: F64,
    sigma_px: F64,
    paper: LabelOnsets,
    centre: int,
    threshold_px: float,
    start_ns: int,
) -> OnsetIntervals:
    """Return when the displacements, give or take two deviations, cross the threshold.

    Args:
        t_ns: (n,) int64. moved_px, sigma_px: (n, m), NaN where unknown.
        paper: onsets by the paper's rule of the same displacements.
        start_ns: crossings after it count.
    """
    moving = (t_ns > start_ns)[:, None]
    end = len(t_ns) - 1
    bounds = []
    for limit in (moved_px + 2.0 * sigma_px, moved_px - 2.0 * sigma_px):
        over = moving & (limit > threshold_px)
        bounds.append(np.where(over.any(axis=0), over.argmax(axis=0), end))
    may, must = bounds
    # a marker that never crosses cannot be late
    crosses = paper.per_marker_ns != NO_ONSET
    incipient = gross = None
    if paper.incipient_ns is not None:
        incipient = int(t_ns[may[crosses].min()]), int(t_ns[must[crosses].min()])
    if paper.gross_ns is not None:
        gross = int(t_ns[may[centre]]), int(t_ns[must[centre]])
    return OnsetIntervals(incipient_ns=incipient, gross_ns=gross)


def _wide(intervals: OnsetIntervals) -> OnsetDoubts:
    def of(known: tuple[int, int] | None) -> str | None:
        width_ns = 0 if known is None else known[1] - known[0]
        wide = width_ns > WIDEST_NS
        return f"the crossing is only known to {width_ns / 1e6:.0f} ms" if wide else None

    return OnsetDoubts(incipient=of(intervals.incipient_ns), gross=of(intervals.gross_ns))


def _near_lost(onsets: LabelOnsets, lost_ns: I64) -> OnsetDoubts:
    """Return doubts about onsets near lost events."""

    def of(onset: int | None) -> str | None:
        near = onset is not None and bool((np.abs(lost_ns - onset) < NEAR_LOST_NS).any())
        return "events were lost close to it" if near else None

    return OnsetDoubts(incipient=of(onsets.incipient_ns), gross=of(onsets.gross_ns))


def _refused(recording: Recording, settings: Labelling, t_ns: I64, reason: str) -> Label:
    """Return the label of a trial that cannot be labelled, with the reason."""
    markers = len(recording.layout_px)
    none = np.full(markers, NO_ONSET, np.int64)
    unknown = np.full((len(t_ns), markers), np.nan)
    doubts = OnsetDoubts(incipient=reason, gross=reason)
    return _label(
        recording,
        settings,
        t_ns,
        HoldEndOnsets(LabelOnsets(None, None, None, none), doubts, unknown),
        OnsetIntervals(incipient_ns=None, gross_ns=None),
        SlipTimes(none, none, none, recording.record.geometry.centre),
        doubts,
        np.full(markers, np.nan),
        Places(np.stack([unknown, unknown], axis=2), unknown, np.zeros_like(unknown)),
    )


def _label(
    recording: Recording,
    settings: Labelling,
    t_ns: I64,
    counted: HoldEndOnsets,
    intervals: OnsetIntervals,
    slip_times: SlipTimes,
    slip_doubts: OnsetDoubts,
    hold_slip_px: F64,
    places: Places,
) -> Label:
    start_ns, stop_ns = recording.motion_ns
    return Label(
        settings.rule,
        settings.reference,
        # nothing is seen of markers that rest: what moves in the hold is in doubt from either end
        {"hold_start": counted, "hold_end": counted},
        slip_times,
        slip_doubts,
        t_ns,
        hold_slip_px,
        places,
        no_shift(len(t_ns)),
        start_ns,
        stop_ns,
        None,
        SOURCE,
        onsets_by_force(recording),
        intervals,
    )
