"""Recording, limits, quality gates and maintenance of a protocol."""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Literal

from pydantic import Field, field_validator

from sliplab.protocols.factors import MAX_TRIALS, ContextLevel
from sliplab.protocols.quantity import (
    KilogramsOrRef,
    Millimetres,
    PositiveDegrees,
    PositiveDegreesPerSecond,
    PositiveMillimetres,
    PositiveNewtons,
    PositivePercent,
    PositivePixels,
    PositiveSeconds,
    PositiveSpeed,
)
from sliplab.protocols.timing import SyncGates
from sliplab.protocols.yaml_file import StrictModel, rule


class Region(StrictModel):
    """The part of the plate that the outside camera reads out, centred."""

    width: PositiveMillimetres
    height: PositiveMillimetres


class RecordingSettings(StrictModel):
    """Streams kept of each trial, from the end of settling to the end of the motion."""

    region: Region
    sync_rate: Annotated[Literal[100], Field()] = 100
    """Ticks of the sync box a second, Hz: frames are taken on them."""
    streams: tuple[Literal["events", "frames", "poses"], ...] = ("events", "frames", "poses")

    @field_validator("streams")
    @classmethod
    def _needed(cls, streams: tuple[str, ...]) -> tuple[str, ...]:
        seen = {"events", "frames"} & set(streams)
        if len(set(streams)) != len(streams) or not seen or "poses" not in streams:
            raise ValueError("must hold 'poses', and 'events' or 'frames' or both, none twice")
        return streams


class AxisLimits(StrictModel):
    """Allowed interval of one coordinate, in plate coordinates."""

    low: Millimetres
    high: Millimetres

    @rule
    def _ordered(self) -> AxisLimits:
        if not self.low < self.high:
            raise ValueError("'low' must be below 'high'")
        return self


class Workspace(StrictModel):
    """The box that the sensor's centre must stay in, in plate coordinates."""

    x: AxisLimits
    y: AxisLimits


class ProtocolLimits(StrictModel):
    """Limits that no trial of this protocol may exceed, checked before anything moves."""

    depth: PositiveMillimetres
    speed: PositiveSpeed
    clearance: PositiveMillimetres
    workspace: Workspace
    duration: PositiveSeconds
    twist: PositiveDegrees | None = None
    """Largest angle about the plate's normal; needed where the motion has a twist."""
    twist_speed: PositiveDegreesPerSecond | None = None
    """The same of its speed."""


class ReferenceGate(StrictModel):
    """Largest drift of reference trials from the campaign's first one before it stops."""

    event_rate: PositivePercent
    """Of the events a second while the arm holds still in contact."""
    friction: PositivePercent | None = None
    """Of friction force over normal force in the last quarter of the slide, on a rig with a force
    sensor. Left out, it is not compared."""


class Gates(StrictModel):
    """Quality gates: limits beyond which a trial is rejected and retaken."""

    sync_uncertainty: SyncGates = SyncGates()
    """95 % uncertainty of events against frames and poses, by grade."""
    frames_lost: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    event_gap: PositiveSeconds = Decimal("0.05")
    """Longest silence of the event camera while the arm moves in contact, if it should have sent
    something: a sync pulse is missing, or 15 events were to be expected at its rate in the hold."""
    event_burst: Annotated[int, Field(ge=1, le=1_000_000_000)] = 50_000
    """Most events in any 10 ms: more is flicker, not skin."""
    path_deviation: PositiveMillimetres = Decimal("0.1")
    """Largest distance of the tool from the commanded path; depth steps are 0.2 mm."""
    speed_deviation: PositivePercent = Decimal(10)
    """Largest deviation of the speed from the commanded one, anywhere along the path."""
    hold_slip: PositivePixels | None = None
    """Largest motion of a papilla's marker in the recorded hold, on a plate that slides relative to
    the plate; looked at where the rig provides tracks. Videos are only tracked by `label`, which
    doubts the trial by `analysis.labelling.hold_slip_px`. Left out, it is ignored."""
    normal_force: PositiveNewtons | None = None
    """Largest normal force on the plate in the recording, on a rig with a force sensor. Left out,
    it is ignored."""
    hold_force: PositiveNewtons | None = None
    """Least mean normal force in the recorded hold, on such a rig: less is no contact."""
    retakes: Annotated[int, Field(ge=0, le=10)] = 2
    """Retakes of a trial before it is quarantined for good."""
    reference: ReferenceGate | None = None
    """Left out, reference trials are taken and not compared while collecting."""


class ReferenceSettings(StrictModel):
    """One condition taken again and again, to see the skin wear and the rig drift."""

    every: Annotated[int, Field(ge=1, le=MAX_TRIALS)]
    condition: dict[str, ContextLevel]


class WarmUp(StrictModel):
    """Presses before the first trial of every stretch of work."""

    presses: Annotated[int, Field(ge=1, le=100)]
    depth: PositiveMillimetres
    speed: PositiveSpeed
    clearance: PositiveMillimetres


class Rezero(StrictModel):
    """Depth zero found again by touching off, before every so many trials."""

    every: Annotated[int, Field(ge=1, le=MAX_TRIALS)]
    speed: PositiveSpeed
    search: PositiveMillimetres
    """Largest search distance beyond the taught plane for the touch; a hard limit."""
    touches: Annotated[int, Field(ge=1, le=100)] = 1
    """Touches whose mean is depth zero. Where few pixels see the first contact, single touches
    differ by up to a tenth of a millimetre."""


class Cleaning(StrictModel):
    """A person cleans skin and plate before every so many trials."""

    every: Annotated[int, Field(ge=1, le=MAX_TRIALS)]
    prompt: Annotated[str, Field(min_length=1, max_length=400)]


class Maintenance(StrictModel):
    """Maintenance that keeps a long campaign comparable from its first trial to its last."""

    warm_up: WarmUp | None = None
    rezero: Rezero | None = None
    clean: Cleaning | None = None


class PlateSetup(StrictModel):
    """The plate that hangs on the slider in gravity and disturbance trials."""

    mass: KilogramsOrRef
