"""One slide of a pilot as plain arrays, the same from a recording and from a simulated run.

Everything that is estimated of a scene is computed from these arrays, so that what a simulated
world would have shown is computed in the same way as what the real rig did show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sliplab.analysis.force import has_forces, plate_forces
from sliplab.protocols.program import Move, Program
from sliplab.storage.streams import F64, I64, EventChunk
from sliplab.storage.trials.recording import Recording

SURE_PX = 0.25
"""A marker whose place is less certain than this was not seen in that frame."""


@dataclass(frozen=True)
class SlideMotion:
    """The motion of a trial that presses and then slides straight.

    Attributes:
        depth_mm: of the press. speed_mm_s: of the slide. direction: unit vector, (2,).
    """

    depth_mm: float
    speed_mm_s: float
    direction: F64


@dataclass(frozen=True)
class Forces:
    """Forces on the plate in its axes, n samples.

    Attributes:
        t_s: seconds after the start of the slide, (n,).
        force_n: x, y and normal force, N, (n, 3).
    """

    t_s: F64
    force_n: F64


@dataclass(frozen=True)
class SlideEvents:
    """Recording of a slide by the event camera.

    Attributes:
        events: times in microseconds after the start of the slide, negative in the hold.
        size_px: columns and rows.
    """

    events: EventChunk
    size_px: tuple[int, int]


@dataclass(frozen=True)
class PilotTrial:
    """A straight slide: n frames of m markers, in the plate's axes (x right, y up).

    Attributes:
        trial: its id.
        hold_s: start of the recorded hold, negative. slide_s: end of the slide. Both in seconds
            after the start of the slide, as all times here.
        frame_s: middle of exposure of every frame, (n,).
        tips_mm: places of the markers from the picture's centre, (n, m, 2), NaN where not seen.
        base_mm: displacement of the sensor from where its slide began, as the arm reported it, at
            the frames' times, (n, 2).
        camera: None without an event camera. forces: None without a force sensor.
        zero_mm: the measurement of depth zero that its depth counts from: slides with another
            number may differ by an error of it.
    """

    trial: str
    slide: SlideMotion
    hold_s: float
    slide_s: float
    frame_s: F64
    tips_mm: F64
    base_mm: F64
    camera: SlideEvents | None = None
    forces: Forces | None = None
    zero_mm: float = 0.0

    @property
    def moved_mm(self) -> F64:
        """Displacement of each marker from its place in the last 0.5 s of the hold, (n, m, 2)."""
        held = (self.frame_s < 0.0) & (self.frame_s >= -0.5)
        rest = np.nanmean(self.tips_mm[held], axis=0)
        moved: F64 = self.tips_mm - rest
        return moved


def slide_of(program: Program) -> SlideMotion | None:
    """Return the slide of a trial's program; None where it is another motion."""
    moves = [step for step in program.steps if isinstance(step, Move)]
    for before, step in pairwise(moves):
        if step.phase == "slide" and step.to.depth_mm == before.to.depth_mm:
            path = np.array([step.to.x_mm - before.to.x_mm, step.to.y_mm - before.to.y_mm])
            if np.hypot(*path) > 0.0:
                return SlideMotion(step.to.depth_mm, step.speed_mm_s, path / np.hypot(*path))
    return None


def pilot_trial(slide: SlideMotion, recording: Recording, places: Mapping[str, Any]) -> PilotTrial:
    """Return a labelled recording of a slide as arrays.

    Args:
        places: arrays of its label (`xy_px`, `sigma_px`, `camera_px`, `frame_ns`).

    Raises:
        KeyError: the trial has no slide.
        StoreError: the recording is damaged, or the scale of its frames is unknown.
    """
    start_ns, stop_ns = recording.step("slide")
    begin_ns, _ = recording.step("hold")
    frame_ns: I64 = places["frame_ns"]
    sure = places["sigma_px"] <= SURE_PX
    xy_px = np.where(sure[..., None], places["xy_px"], np.nan) - places["camera_px"][:, None, :]
    scale = np.linalg.norm(recording.layout_px[1]) / np.linalg.norm(
        recording.record.geometry.skin_mm[1]
    )
    middle = (np.array(recording.frame_px) - 1) / 2
    with recording.open() as reader:
        poses = reader.poses()
    pose_ns = np.asarray(recording.clock("arm").to_reference(poses.t_ns))
    camera = forces = None
    if recording.record.counts.events:
        found = recording.events()
        line_us = np.asarray(recording.clock("events").to_reference(found.t_us * 1000))
        t_us = (line_us - start_ns) // 1000
        camera = SlideEvents(EventChunk(found.x, found.y, found.p, t_us), recording.event_px)
    if has_forces(recording):
        plate = plate_forces(recording)
        forces = Forces(seconds_after(start_ns, plate.t_ns), plate.force_n)
    frame_s = seconds_after(start_ns, frame_ns)
    return PilotTrial(
        recording.trial_id,
        slide,
        hold_s=(begin_ns - start_ns) * 1e-9,
        slide_s=(stop_ns - start_ns) * 1e-9,
        frame_s=frame_s,
        tips_mm=(xy_px - middle) * [1.0, -1.0] / scale,
        base_mm=base_at(seconds_after(start_ns, pose_ns), poses.xyz_mm, poses.rotvec_deg, frame_s),
        camera=camera,
        forces=forces,
        zero_mm=recording.record.depth_zero_mm or 0.0,
    )


def seconds_after(start_ns: int, t_ns: I64) -> F64:
    """Return times in seconds after another one, which float64 holds to the nanosecond."""
    result: F64 = (t_ns - start_ns).astype(np.float64) * 1e-9
    return result


def base_at(pose_s: F64, xyz_mm: F64, rotvec_deg: F64, t_s: F64) -> F64:
    """Displacement of the sensor along the plate since the start of its slide, mm, (n, 2).

    The tool's axes are the plate's: x right, y up, z into the plate.

    Args:
        pose_s: times of the poses, (k,). xyz_mm, rotvec_deg: of the tool, (k, 3).
        t_s: times of interest, (n,).
    """
    first = max(int(np.searchsorted(pose_s, 0.0)) - 1, 0)
    held = (pose_s >= -0.1) & (pose_s <= 0.0)
    origin = xyz_mm[held].mean(axis=0) if held.any() else xyz_mm[first]
    rest = Rotation.from_rotvec(np.radians(rotvec_deg[first]))
    moved = rest.inv().apply(xyz_mm - origin)
    result: F64 = np.column_stack([np.interp(t_s, pose_s, moved[:, k]) for k in (0, 1)])
    return result
