"""Pilots: the slides of a collected campaign, or those that a simulated rig would have recorded."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.plugins.simulation.levels import choose_level
from sliplab.plugins.simulation.scene_runs import Memory, changed, with_true_times
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.contact_springs import Guess
from sliplab.plugins.twin.pilot import (
    Forces,
    PilotTrial,
    SlideEvents,
    base_at,
    pilot_trial,
    seconds_after,
    slide_of,
)
from sliplab.plugins.twin.statistics import SlideStatistics, statistics
from sliplab.protocols import Plan, PlannedTrial
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.rig import FORCE
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.streams import EventChunk, FrameChunk, PoseChunk, WrenchChunk
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore

LEVEL = "L3"
"""All physics: what a scene may leave out is not known before it was fitted."""
EVENT_TRIALS = 12
"""Slides whose events are simulated and read: events take most of the time, and their statistics
need few trials."""
POLL_S = 60.0
"""Nothing waits for the streams, so that they are read once a step; the data are the same."""
ZEROS_MM = (0.03, 0.06, 0.1)
"""Largest errors of depth zero that are distinguished: pilots with one share simulated worlds."""
TOUCH_DEPTH_MM = 0.02
"""Error of a rig's `touch_depth`, which a lab measures with a gauge."""
COARSE_MS = 4
"""Step of the contact without events: slips are exact at any step, and marker places that are seen
100 times a second change by less than their noise."""


@dataclass(frozen=True)
class PilotSlides:
    """The slides of a campaign.

    Attributes:
        fitted: trials for the fit. judged: test trials, which judge it.
        slides: all of them as arrays, by id.
        with_events: ids of the fitted trials whose events are read.
        checksum: of the fitted trials' files.
        zero_mm: largest error of their depth zero.
    """

    plan: Plan
    fitted: tuple[PlannedTrial, ...]
    judged: tuple[PlannedTrial, ...]
    slides: Mapping[str, PilotTrial]
    with_events: frozenset[str]
    checksum: str
    zero_mm: float

    @property
    def streams(self) -> frozenset[str]:
        """Streams that the fitted trials have."""
        first = self.slides[self.fitted[0].id]
        there = {"frames": True, "events": first.camera, "force": first.forces}
        return frozenset(name for name, found in there.items() if found is not None)

    def statistics(self, guess: Guess) -> SlideStatistics:
        """Return what the fitted trials show."""
        slides = [self.slides[trial.id] for trial in self.fitted]
        return statistics(slides, self.with_events, guess)


def read_pilot(store: TrialStore, item: Collected) -> PilotSlides:
    """Read the labelled slides of a campaign.

    Raises:
        StoreError: it has no slides, or they are not labelled.
    """
    check_level(item)
    labels = Derived.of(store, "labels", item.name)
    parts: dict[bool, list[PlannedTrial]] = {True: [], False: []}
    slides, sums = {}, hashlib.sha256()
    for trial, recording in item.trials:
        slide = read_slide(item, labels, trial, recording)
        if slide is None:
            continue
        slides[trial.id] = slide
        parts[trial.split == "test"].append(trial)
        if trial.split != "test":
            sums.update(recording.checksum.encode())
    if not parts[False]:
        raise StoreError(f"campaign '{item.name}': has no straight slides to fit a scene to")
    fitted = tuple(parts[False])
    return PilotSlides(
        item.plan,
        fitted,
        tuple(parts[True]),
        slides,
        event_trials(fitted),
        sums.hexdigest(),
        zero_error_mm(item),
    )


def zero_error_mm(item: Collected) -> float:
    """Return the largest error of a campaign's depth zero: one of `ZEROS_MM`.

    Of the mean of several touches: two standard errors, and the error of the touch depth.
    """
    rezero = item.plan.protocol.collection.maintenance.rezero
    scatter = [recording.record.depth_zero_sd_mm for _, recording in item.trials]
    known = [sd for sd in scatter if sd is not None]
    if rezero is None or len(known) < len(scatter):
        return ZEROS_MM[-1]
    scatter_mm = (float(np.mean(np.square(known))) / rezero.touches) ** 0.5
    most = math.hypot(2.0 * scatter_mm, TOUCH_DEPTH_MM)
    return next((limit for limit in ZEROS_MM if most <= limit), ZEROS_MM[-1])


def check_level(item: Collected) -> None:
    """Check that a simulated campaign has all physics that is fitted.

    Raises:
        InputError: it was imported.
        StoreError: it was simulated with less.
    """
    plan = item.plan
    rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
    choice = choose_level(rig, plan) if rig.simulated else None
    if choice is not None and choice.name != LEVEL:
        raise StoreError(
            f"campaign '{item.name}': was simulated at level {choice.name}, without all physics "
            f"that is fitted; collect it on a rig with mock.scene.level: {LEVEL}"
        )


def read_slide(
    item: Collected, labels: Derived, trial: PlannedTrial, recording: Recording
) -> PilotTrial | None:
    """Read a trial as arrays; None where its motion is no straight slide.

    Raises:
        StoreError: it is not labelled.
    """
    slide = slide_of(item.plan.program(trial))
    if slide is None:
        return None
    try:
        places = labels.arrays(trial.id)
    except FileNotFoundError:
        raise StoreError(
            f"{item.name}/{trial.id}: has no label yet; run `sliplab label` first"
        ) from None
    return pilot_trial(slide, recording, places)


def event_trials(fitted: Sequence[PlannedTrial]) -> frozenset[str]:
    """Return ids of trials, spread over all, whose events are read."""
    chosen = np.unique(np.linspace(0, len(fitted) - 1, EVENT_TRIALS).round().astype(int))
    return frozenset(fitted[k].id for k in chosen)


def simulate_pilot(
    rig: RigFile,
    plan: Plan,
    trials: Sequence[PlannedTrial],
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
        step_ms = max(scene_of(rig).scene.step_ms, COARSE_MS)
        tracked = changed(tracked, {"scene": {"step_ms": step_ms}})
    size = tracked.frame_px(plan)
    assert size is not None
    rate_hz = plan.protocol.collection.recording.sync_rate
    built = build_rig(tracked)
    built.poll_s, built.force_limit_n = POLL_S, None
    found = []
    try:
        built.connect()
        scale = built.frames.px_per_mm
        for trial in trials:
            program = plan.program(trial)
            slide = slide_of(program)
            if slide is None:
                continue
            sink = Memory()
            chance = (trial.seed * 1_000_003 + seed) % 2**63
            done = built.run_trial(program, sink, chance, size, rate_hz, with_events)
            steps = {step.phase: step for step, _ in done.steps}
            start_ns = steps["slide"].start_ns
            frames, poses = sink.taken("frames", FrameChunk), sink.taken("arm", PoseChunk)
            assert frames.markers_px is not None  # the camera returns tracks
            frame_s = seconds_after(start_ns, frames.t_ns)
            middle = (np.array(size) - 1) / 2
            pose_s = seconds_after(start_ns, poses.t_ns)
            camera = forces = None
            if with_events and built.event_camera is not None:
                events = sink.taken("events", EventChunk)
                events = replace(events, t_us=events.t_us - start_ns // 1000)
                camera = SlideEvents(events, (built.events.width, built.events.height))
            if len(loads := sink.taken(FORCE, WrenchChunk)):
                forces = Forces(seconds_after(start_ns, loads.t_ns), loads.force_n)
            found.append(
                PilotTrial(
                    trial.id,
                    slide,
                    (steps["hold"].start_ns - start_ns) * 1e-9,
                    (steps["slide"].end_ns - start_ns) * 1e-9,
                    frame_s,
                    (frames.markers_px - middle) * [1.0, -1.0] / scale,
                    base_at(pose_s, poses.xyz_mm, poses.rotvec_deg, frame_s),
                    camera,
                    forces,
                )
            )
    finally:
        built.close()
    return found
