"""Estimate of a plan's bytes on disk from the measured data rates of the streams."""

from __future__ import annotations

import math

from sliplab.protocols import Move, Plan, PlannedTrial, Twist
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.stream_settings import EventStream, FrameStream

TWIST_ARM_MM = 8.0
"""Mean distance of the papillae from the axis of a twist."""


def trial_bytes(rig: RigFile, plan: Plan, trial: PlannedTrial) -> float:
    """Estimate the bytes of one committed trial."""
    known = rig.estimates
    seconds = plan.seconds(trial, recorded_only=True)
    moved, at = 0.0, plan.program(trial).home
    for step in plan.program(trial).steps:
        if isinstance(step, Move):
            moved += at.distance_mm(step.to) if step.recorded else 0.0
            at = step.to
        elif isinstance(step, Twist):
            turn = abs(math.radians(step.to.twist_deg - at.twist_deg))
            moved += TWIST_ARM_MM * turn if step.recorded else 0.0
            at = step.to
    plate = plan.protocol.collection.plate is not None
    events = known.noise_events_per_s * seconds + known.signal_events_per_mm * moved
    events += known.events_per_fall if plate else 0.0
    cameras = 1 + sum(isinstance(stream, EventStream) for stream in rig.streams.values())
    total = known.fixed_bytes + cameras * events * known.bytes_per_event
    rate_hz, frame_px = plan.protocol.collection.recording.sync_rate, rig.frame_px(plan)
    if frame_px is not None:
        total += rig.frame_bytes(plate) * seconds * rig.frame_rate_hz(plan)
    for stream in rig.streams.values():
        if isinstance(stream, FrameStream):
            total += (
                _frame_bytes(rig, stream, frame_px, plate) * seconds * (stream.rate_hz or rate_hz)
            )
    return total


def _frame_bytes(
    rig: RigFile, stream: FrameStream, frame_px: tuple[int, int] | None, plate: bool
) -> float:
    """Estimate one frame of a further camera: the first one's, by its number of pixels."""
    if stream.mock is not None and stream.mock.frame_source == "tracks":
        return rig.estimates.bytes_per_tracked_frame
    first = rig.estimates.bytes_per_plate_frame if plate else rig.estimates.bytes_per_frame
    if frame_px is None:
        return first
    return first * stream.region_px[0] * stream.region_px[1] / (frame_px[0] * frame_px[1])


def plan_bytes(rig: RigFile, plan: Plan, skip: set[str] | None = None) -> float:
    """Estimate the bytes of all trials except those in `skip`."""
    return sum(trial_bytes(rig, plan, t) for t in plan if not skip or t.id not in skip)
