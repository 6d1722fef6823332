"""Quality gates: limits beyond which a trial is rejected and retaken, and a campaign stops."""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated

from pydantic import Field

from sliplab.protocols.quantity import (
    PositiveMillimetres,
    PositiveNewtons,
    PositivePercent,
    PositivePixels,
    PositiveSeconds,
)
from sliplab.protocols.timing import SyncGates
from sliplab.protocols.yaml_file import StrictModel


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
