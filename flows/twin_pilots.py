"""Pilots of simulated worlds, in memory: what a rig with other parameters would have recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sliplab.analysis.twin.pilot import (
    Camera,
    Forces,
    PilotTrial,
    base_at,
    seconds_after,
    slide_of,
)
from sliplab.flows.scene_runs import changed, with_true_times
from sliplab.protocols import Plan, Trial
from sliplab.rigs.build import build_rig
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.streams import (
    EventChunk,
    FrameChunk,
    NullSink,
    PoseChunk,
    WrenchChunk,
)

POLL_S = 60.0
"""Nothing waits for the streams, so that they are read once a step; the data are the same."""
COARSE_MS = 4
"""Step of the contact without events: slips are exact at any step, and marker places that are seen
100 times a second change by less than their noise."""


@dataclass
class _Memory(NullSink):
    """A sink that keeps what a pilot is made of."""

    events: list[EventChunk] = field(default_factory=list)
    frames: list[FrameChunk] = field(default_factory=list)
    poses: list[PoseChunk] = field(default_factory=list)
    forces: list[WrenchChunk] = field(default_factory=list)

    def add_events(self, chunk: EventChunk) -> None:
        self.events.append(chunk)

    def add_frames(self, chunk: FrameChunk) -> None:
        self.frames.append(chunk)

    def add_poses(self, chunk: PoseChunk) -> None:
        self.poses.append(chunk)

    def add_stream(self, name: str, chunk: Any) -> None:
        if name == "force" and isinstance(chunk, WrenchChunk):
            self.forces.append(chunk)


def simulate_pilot(
    rig: RigFile,
    plan: Plan,
    trials: Sequence[Trial],
    seed: int,
    with_events: bool = True,
    with_faults: bool = False,
) -> list[PilotTrial]:
    """Return the slides among `trials` as a simulated rig records them.

    Args:
        seed: of the trials' own chance: friction along the paths, vibration, noise. That of
            fabrication is the rig's.
        with_events: simulate the event camera too, which takes most of the time.
        with_faults: keep the rig's faults; none of them may end a trial.

    Raises:
        RigError: a trial cannot be run on this rig.
    """
    tracked = changed(with_true_times(rig, with_faults), {"frame_camera": {"level": "tracks"}})
    if not with_events:
        step_ms = max(rig.scene.scene.step_ms, COARSE_MS)
        tracked = changed(tracked, {"scene": {"step_ms": step_ms}})
    size = tracked.frame_px(plan)
    assert size is not None
    rate_hz = plan.protocol.collection.recording.sync_rate
    built = build_rig(tracked)
    built.poll_s = built.force_poll_s = POLL_S
    found = []
    try:
        built.connect()
        scale = built.frames.px_per_mm
        for trial in trials:
            program = plan.program(trial)
            slide = slide_of(program)
            if slide is None:
                continue
            sink = _Memory()
            chance = (trial.seed * 1_000_003 + seed) % 2**63
            done = built.run_trial(program, sink, chance, size, rate_hz, with_events)
            steps = {step.phase: step for step, _ in done.steps}
            start_ns = steps["slide"].start_ns
            frame_s = seconds_after(start_ns, np.concatenate([c.t_ns for c in sink.frames]))
            xy_px = np.concatenate([c.markers_px for c in sink.frames if c.markers_px is not None])
            middle = (np.array(size) - 1) / 2
            pose_s = seconds_after(start_ns, np.concatenate([c.t_ns for c in sink.poses]))
            xyz, turn = (
                np.concatenate([getattr(c, name) for c in sink.poses])
                for name in ("xyz_mm", "rotvec_deg")
            )
            camera = forces = None
            if with_events and sink.events:
                events = EventChunk.joined(sink.events)
                t_us = events.t_us - start_ns // 1000
                camera = Camera(
                    EventChunk(events.x, events.y, events.p, t_us),
                    (built.events.width, built.events.height),
                )
            if sink.forces:
                t_ns = np.concatenate([c.t_ns for c in sink.forces])
                forces = Forces(
                    seconds_after(start_ns, t_ns), np.concatenate([c.force_n for c in sink.forces])
                )
            found.append(
                PilotTrial(
                    trial.id, slide, (steps["hold"].start_ns - start_ns) * 1e-9,
                    (steps["slide"].end_ns - start_ns) * 1e-9, frame_s,
                    (xy_px - middle) * [1.0, -1.0] / scale, base_at(pose_s, xyz, turn, frame_s),
                    camera, forces,
                )
            )  # fmt: skip
    finally:
        built.close()
    return found
