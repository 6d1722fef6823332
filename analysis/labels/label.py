"""A trial's label while it is made: its onsets by every rule, and what they were read from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.labels.camera_shift import CameraShift
from sliplab.analysis.labels.onsets import NO_ONSET, LabelOnsets
from sliplab.analysis.labels.places import Places
from sliplab.analysis.labels.rest import Reference
from sliplab.analysis.labels.slip_times import SlipTimes
from sliplab.protocols.shown import plural
from sliplab.storage.schema.label import (
    ChangePoints,
    OnsetDoubts,
    OnsetIntervals,
    Rule,
    RuleOnsets,
    TrialLabel,
)

F64 = npt.NDArray[np.float64]

LOST_SHARE = 0.05
"""A marker that is lost in more of the frames than this is named in the flags."""
HOLD_SLIP_PX = 1.0
"""One that moved further than this in the hold is counted there."""


@dataclass(frozen=True)
class HoldEndOnsets:
    """Onsets by the paper's rule, with displacements counted from one end of the hold.

    Attributes:
        onsets: on the trial's time line. doubts: why one is not known although the seen markers
            give one.
        displacement_px: (n, m) float64, NaN where a marker was lost.
    """

    onsets: LabelOnsets
    doubts: OnsetDoubts
    displacement_px: F64


@dataclass(frozen=True)
class Label:
    """Onsets of one trial, and the data that they were read from.

    Attributes:
        rule: which onsets rule.
        reference: from where the paper's rule counts.
        references: by the paper's rule, counted from either end of the hold. slips: by change
            points, with slip_doubts.
        frame_ns: (n,) int64, middle of exposure of every frame on the time line.
        hold_slip_px: (m,) float64, how far each marker moved in the hold, from its first to its
            last part; NaN where unknown.
        start_ns, stop_ns: of the slide or retraction.
        force: by the force along the plate; None where the trial has none.
        intervals: central 95 % of the paper's onsets, of labels from events.
        rest_ns: where the plate came to rest after that began; None where none moved, or it was
            not seen to rest.
    """

    rule: Rule
    reference: Reference
    references: dict[Reference, HoldEndOnsets]
    slips: SlipTimes
    slip_doubts: OnsetDoubts
    frame_ns: npt.NDArray[np.int64]
    hold_slip_px: F64
    places: Places
    camera: CameraShift
    start_ns: int
    stop_ns: int
    rest_ns: int | None
    source: str
    force: RuleOnsets | None = None
    intervals: OnsetIntervals | None = None

    @property
    def paper(self) -> LabelOnsets:
        """Onsets by the paper's rule, counted from the reference."""
        return self.references[self.reference].onsets

    @property
    def paper_doubts(self) -> OnsetDoubts:
        """Doubts of the paper's onsets."""
        return self.references[self.reference].doubts

    @property
    def displacement_px(self) -> F64:
        """(n, m) float64 from the reference, NaN where a marker was lost."""
        return self.references[self.reference].displacement_px

    @property
    def onsets(self) -> LabelOnsets:
        """Onsets by the protocol's rule."""
        if self.rule == "force":
            found, none = self.force, np.full_like(self.paper.per_marker_ns, NO_ONSET)
            known = (None, None) if found is None else (found.incipient_ns, found.gross_ns)
            return LabelOnsets(*known, None, none)
        return self.paper if self.rule == "paper" else self.slips.onsets

    @property
    def doubts(self) -> OnsetDoubts:
        """Doubts of the onsets by the protocol's rule."""
        if self.rule == "force":
            reason = None if self.force is not None else "the trial has no forces of a slide"
            return OnsetDoubts(incipient=reason, gross=reason)
        return self.paper_doubts if self.rule == "paper" else self.slip_doubts

    @property
    def end_ns(self) -> int:
        """End of the slip: the plate came to rest after gross onset, or the motion ended."""
        gross = self.onsets.gross_ns
        if self.rest_ns is not None and (gross is None or self.rest_ns > gross):
            return min(self.rest_ns, self.stop_ns)
        return self.stop_ns

    @property
    def markers_lost(self) -> int:
        """Marker-frames without a measurement."""
        return int(np.count_nonzero(np.isnan(self.places.xy).any(axis=2)))

    def quality(self) -> F64:
        """(m,) each marker's lowest quality from the motion's start to its slip; see Places."""
        times, until = self.frame_ns[:, None], self.paper.per_marker_ns
        counts = (times >= self.start_ns) & ((until < 0) | (times <= until))
        lowest = np.where(counts, self.places.quality, np.inf).min(axis=0, initial=np.inf)
        return np.where(np.isfinite(lowest), lowest, 0.0)

    def flags(self) -> list[str]:
        """Return warnings that a reviewer should check first."""
        found = []
        if self.camera.largest_px:
            found.append(f"the camera moved by up to {self.camera.largest_px:.1f} px")
        lost = np.isnan(self.places.xy).any(axis=2).mean(axis=0)
        found += [
            f"marker {marker} was lost in {lost[marker]:.0%} of the frames"
            for marker in np.flatnonzero(lost > LOST_SHARE)
        ]
        slipped = self.hold_slip_px[self.hold_slip_px > HOLD_SLIP_PX]
        if len(slipped):
            most = slipped.max()
            found.append(f"markers that moved in the hold: {len(slipped)}, by {most:.1f} px")
        if self.places.plate_lost:
            found.append(
                f"the plate's marker was not seen in {plural(self.places.plate_lost, 'frame')}"
            )
        if self.places.plate is not None and self.onsets.gross_ns is not None and not self.rest_ns:
            found.append("the plate was not seen to rest: its slip ends with the motion")
        if self.places.tilted:
            found.append("the plate is seen askew: displacements are in its plane")
        return found

    def document(self) -> TrialLabel:
        """Return the stored label: an onset in doubt is null, with its reason in `doubts`."""
        onsets, doubts = self.onsets, self.doubts
        label = TrialLabel(
            rule=self.rule,
            reference=self.reference,
            incipient_ns=None if doubts.incipient else onsets.incipient_ns,
            # without the first slip nothing is made of the second
            gross_ns=None if doubts.incipient or doubts.gross else onsets.gross_ns,
            end_ns=self.end_ns,
            doubts=_doubts(doubts),
            first_marker=onsets.first_marker,
            per_marker_ns=onsets.per_marker_ns.tolist(),
            paper=RuleOnsets(**_onsets(self.paper, self.paper_doubts)),
            references={
                name: RuleOnsets(**_onsets(counted.onsets, counted.doubts))
                for name, counted in self.references.items()
            },
            change_point=ChangePoints(
                **_onsets(self.slips.onsets, self.slip_doubts),
                low_ns=self.slips.low_ns.tolist(),
                high_ns=self.slips.high_ns.tolist(),
            ),
            hold_slip_px=tuple(
                None if np.isnan(px) else round(px, 3) for px in self.hold_slip_px.tolist()
            ),
            markers_lost=self.markers_lost,
            plate_lost=self.places.plate_lost,
            camera_moved_px=round(self.camera.largest_px, 3),
            flags=tuple(self.flags()),
            quality=np.round(self.quality(), 3).tolist(),
            source=self.source,
        )
        only_some: dict[str, Any] = {}
        if self.force is not None:
            only_some["force"] = self.force
        if self.intervals is not None:
            only_some["intervals"] = self.intervals
        return label.model_copy(update=only_some) if only_some else label

    def as_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays to store; displacements to a thousandth of a pixel."""
        places = self.places
        arrays: dict[str, npt.NDArray[Any]] = {
            "frame_ns": self.frame_ns,
            "displacement_px": _thousandths(self.displacement_px),
            "xy_px": _thousandths(places.xy),
            "sigma_px": places.sigma.astype(np.float32),
            "quality": np.round(100 * places.quality).astype(np.uint8),
            "camera_px": _thousandths(self.camera.px),
        }
        if places.plate is not None:
            arrays["plate_px"] = _thousandths(places.plate.xy)
            arrays["plate_corners_px"] = _thousandths(places.plate.corners)
            arrays["plate_seen"] = places.plate.ok
        return arrays


def _thousandths(values: F64) -> npt.NDArray[np.float32]:
    return np.round(values, 3).astype(np.float32)


def _doubts(doubts: OnsetDoubts) -> OnsetDoubts:
    """A gross onset after an incipient one that is not known is not known either."""
    return OnsetDoubts(incipient=doubts.incipient, gross=doubts.gross or doubts.incipient)


def _onsets(onsets: LabelOnsets, doubts: OnsetDoubts) -> dict[str, Any]:
    return {
        "incipient_ns": onsets.incipient_ns,
        "gross_ns": onsets.gross_ns,
        "first_marker": onsets.first_marker,
        "per_marker_ns": onsets.per_marker_ns.tolist(),
        "doubts": _doubts(doubts),
    }
