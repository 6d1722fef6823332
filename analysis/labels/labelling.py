"""Ground truth of one recorded trial: its markers' places, and its onsets by both rules.

The positions come from the trial's video, tracked once, or from a camera that provides tracks; of
a trial without frames, from the events of its markers. The onsets by the paper's rule and by change
points are both stored; the protocol selects one of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.labels.camera_shift import CameraShift
from sliplab.analysis.labels.doubts import (
    MAX_UNSEEN_NS,
    first_doubts,
    slipped_in_hold,
    uncertain,
    unseen,
)
from sliplab.analysis.labels.event_labels import onsets_by_events
from sliplab.analysis.labels.force_onsets import onsets_by_force
from sliplab.analysis.labels.given_labels import given_label
from sliplab.analysis.labels.label import HoldEndOnsets, Label
from sliplab.analysis.labels.onsets import LabelOnsets, last_off_axis, paper_onsets, rest_time
from sliplab.analysis.labels.places import Places, places_of
from sliplab.analysis.labels.rest import Reference, offsets
from sliplab.analysis.labels.slip_times import slip_times
from sliplab.protocols.labelling import Labelling
from sliplab.storage.schema.label import OnsetDoubts, RuleOnsets, TrialLabel
from sliplab.storage.trials.recording import Recording

__all__ = [
    "VERSION",
    "HoldEndOnsets",
    "Label",
    "label_places",
    "label_recording",
    "label_results",
]

VERSION = 5


def label_results(
    recording: Recording, settings: Labelling
) -> tuple[TrialLabel, dict[str, npt.NDArray[Any]]]:
    """Label a trial; return the document and the arrays to store."""
    if settings.rule == "given":
        return given_label(recording), {}
    label = label_recording(recording, settings)
    return label.document(), label.as_arrays()


def label_recording(recording: Recording, settings: Labelling) -> Label:
    """Find a trial's onsets in its video, in its tracks where there is no video, or in its events.

    Raises:
        ValueError: the trial has none of them, or its markers cannot be distinguished.
    """
    if recording.frame_source == "none" and recording.record.counts.events:
        return onsets_by_events(recording, settings)
    frame_ns = recording.frame_times()
    motion_ns = recording.motion_ns
    timing = recording.record.timing
    return label_places(
        places_of(recording),
        frame_ns,
        motion_ns,
        settings,
        centre=recording.record.geometry.centre,
        twists=recording.motion_phase == "twist",
        exposure_ns=0 if timing is None else 2 * (timing.mid_exposure_ns or 0),
        source=recording.frame_source,
        force=onsets_by_force(recording),
    )


def label_places(
    places: Places,
    frame_ns: npt.NDArray[np.int64],
    motion_ns: tuple[int, int],
    settings: Labelling,
    *,
    centre: int,
    exposure_ns: int,
    source: str,
    twists: bool = False,
    force: RuleOnsets | None = None,
) -> Label:
    """Apply both rules to a trial's positions.

    Displacements count from the markers' mean positions over the first part of the hold, with
    which the recording begins, or over its last; in trials with a sliding plate they are taken
    relative to the plate's own marker. A marker that is hidden there counts from the other part.

    Args:
        frame_ns: (n,) int64 on the time line. motion_ns: start and end of slide or retraction.
        exposure_ns: how long the shutter was open.
        twists: the sensor turned about its centre, which does not slip: gross slip begins with the
            last of the other markers.
        force: onsets by the force along the plate, if the trial has forces.

    Raises:
        ValueError: there is no frame in the hold.
    """
    start_ns, stop_ns = motion_ns
    found = offsets(places, frame_ns, start_ns, settings.reference_ms)
    if twists:
        away = found.counted_from("hold_end")
        moved = np.hypot(away[..., 0], away[..., 1])
        centre = last_off_axis(paper_onsets(frame_ns, moved, centre, settings, start_ns), centre)
    held = slipped_in_hold(found.hold_slip_px, settings.hold_slip_px)
    knocked = _knocked(frame_ns, found.camera)

    def counted(reference: Reference, from_ns: int) -> HoldEndOnsets:
        away = found.counted_from(reference)
        moved = np.hypot(away[..., 0], away[..., 1])
        paper = paper_onsets(frame_ns, moved, centre, settings, from_ns)
        lost = unseen(frame_ns, moved, paper, centre, from_ns, start_ns)
        vague = uncertain(
            frame_ns, moved, found.sigma, paper, centre, settings.threshold_px, from_ns
        )
        return HoldEndOnsets(paper, first_doubts(held, lost, vague, knocked(paper)), moved)

    references: dict[Reference, HoldEndOnsets] = {
        "hold_start": counted("hold_start", int(frame_ns[0])),
        "hold_end": counted("hold_end", start_ns),
    }
    rest_ns, moving = None, frame_ns >= start_ns
    if (plate := places.flat_plate) is not None and moving.any():
        rest_ns = rest_time(frame_ns[moving], plate[moving], settings.threshold_px, MAX_UNSEEN_NS)
    # change points are found near the slip, and so count from just before the motion
    slips = slip_times(
        frame_ns,
        found.counted_from("hold_end"),
        found.sigma,
        centre,
        start_ns,
        exposure_ns,
        settings.threshold_px,
    )
    moved = references["hold_end"].displacement_px
    hidden = unseen(frame_ns, moved, slips.onsets, centre, start_ns)
    slip_doubts = first_doubts(held, hidden, slips.doubts(), knocked(slips.onsets))
    return Label(
        settings.rule,
        settings.reference,
        references,
        slips,
        slip_doubts,
        frame_ns,
        found.hold_slip_px,
        places,
        found.camera,
        start_ns,
        stop_ns,
        rest_ns,
        source,
        force,
    )


def _knocked(frame_ns: npt.NDArray[np.int64], camera: CameraShift) -> Any:
    """Return doubts about onsets after the camera moved while too few markers were at rest."""
    moved = frame_ns[camera.unsure]

    def doubts(onsets: LabelOnsets) -> OnsetDoubts:
        reason = "the camera moved while too few markers stood still to tell how far"

        def of(onset: int | None) -> str | None:
            late = onset is None or (len(moved) and int(moved[0]) <= onset)
            return reason if len(moved) and late else None

        return OnsetDoubts(incipient=of(onsets.incipient_ns), gross=of(onsets.gross_ns))

    return doubts
