"""Trials on a simulated rig that are not stored: their cost, and their data in memory.

The rig's own code runs the trial's own program; only the sink is memory, and no pictures are
taken. A run that is compared has perfect clocks, no noise, no faults and no read-out, so that two
runs differ by the scene alone. A run that is timed has all of that as the rig file says, but for
faults.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from sliplab.analysis.sweeps.scene_error import Seen
from sliplab.analysis.sweeps.scene_tradeoff import (
    ClosedForm,
    Compared,
    Families,
    Variant,
    compare_variants,
    variants,
)
from sliplab.protocols import Plan, Trial
from sliplab.protocols.program import ACTING, Move
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.rig import Rig, TrialRun
from sliplab.rigs.levels import HIGHEST, expected_onsets, slides_of
from sliplab.rigs.mock.settings import Clocks, skin_of
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.scene.onsets import retraction_onsets
from sliplab.storage.streams import EventChunk, FrameChunk, NullSink, PoseChunk, WrenchChunk

MOTION = frozenset(ACTING)
PERFECT = Clocks(
    arm_ppm=0, event_camera_ppm=0, frame_camera_ppm=0, sync_box_ppm=0, offset_h=0,
    pulse_jitter_us=0, frame_jitter_us=0,
)  # fmt: skip
_SMALL_PX = 32


def changed(rig: RigFile, values: Mapping[str, Any]) -> RigFile:
    """Return a simulated rig's file with other settings of `mock`, nested mappings, unchecked."""
    return rig.model_copy(update={"mock": _changed(rig.scene, values)})


def _changed(model: Any, values: Mapping[str, Any]) -> Any:
    update = {
        name: _changed(getattr(model, name), value) if isinstance(value, Mapping) else value
        for name, value in values.items()
    }
    return model.model_copy(update=update)


def with_true_times(rig: RigFile, with_faults: bool = False) -> RigFile:
    """Return the rig with perfect clocks and, if not said otherwise, no faults."""
    return changed(rig, {"clocks": PERFECT, "faults": rig.scene.faults if with_faults else ()})


def ideal(rig: RigFile) -> RigFile:
    """Return the rig with true times and signal events only."""
    camera = {"noise_hz": 0.0, "hot_pixels": 0, "readout_hz": 0.0}
    return changed(with_true_times(rig), {"event_camera": camera})


@dataclass
class Memory(NullSink):
    """A sink that keeps what analyses of simulated trials need."""

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


def run(rig: RigFile, plan: Plan, trial: Trial, seed: int) -> Seen:
    """Simulate a trial; return its data, on a time line that begins with its motion.

    Args:
        rig: with perfect clocks (`ideal`, `with_true_times`): device times are true times then.

    Raises:
        RigError: the trial cannot be run on this rig.
    """
    sink = Memory()
    built = _ready(rig, plan, trial)
    try:
        done = _run(built, plan, trial, seed, sink)
    finally:
        built.close()
    start_ns = next(step.start_ns for step, _ in done.steps if step.phase in MOTION)
    begin_us, end_us = ((t - start_ns) // 1000 for t in done.recorded_ns)
    events, truth = EventChunk.joined(sink.events), done.truth
    assert truth is not None, "a simulated rig has a truth"
    t_us = events.t_us - start_ns // 1000
    inside = slice(*np.searchsorted(t_us, (begin_us, end_us)))

    def since(onset: int | None) -> int | None:
        """Return ns after the start of the motion; what came after the recording never came."""
        after = None if onset is None else onset - int(truth["reference_ns"])
        return after if after is not None and after <= end_us * 1000 else None

    return Seen(
        events=EventChunk(events.x[inside], events.y[inside], events.p[inside], t_us[inside]),
        size_px=(built.events.width, built.events.height),
        begin_us=begin_us,
        end_us=end_us,
        slips=(since(truth["first_slip_ns"]), since(truth["slip_per_papilla_ns"][0])),
        markers=(since(truth["incipient_ns"]), since(truth["gross_ns"])),
    )


def timed(
    rig: RigFile,
    plan: Plan,
    trial: Trial,
    seed: int,
    clock: Callable[[], float] = perf_counter,
) -> float:
    """Return the seconds that simulating a trial takes; building the rig is left out."""
    built = _ready(rig, plan, trial)
    try:
        start = clock()
        _run(built, plan, trial, seed, Memory())
        return clock() - start
    finally:
        built.close()


def _ready(rig: RigFile, plan: Plan, trial: Trial) -> Rig:
    """Return the rig with what the trial needs mounted, as a session does it."""
    built = build_rig(rig)
    built.connect()
    built.frames.set_region(_SMALL_PX, _SMALL_PX)  # it is asked for frames and takes none
    for task in plan.changeovers(None, trial):
        built.operator.ask(task.request, task.prompt, task.expected)
    return built


def _run(built: Rig, plan: Plan, trial: Trial, seed: int, sink: Memory) -> TrialRun:
    rate_hz = plan.protocol.collection.recording.sync_rate
    return built.run_trial(plan.program(trial), sink, seed, None, rate_hz)


def closed_form(rig: RigFile, plan: Plan, trial: Trial) -> ClosedForm | None:
    """Return first slip and the centre's (or the plate's fall) at level L0.

    None if there is no closed form: a retraction that also goes sideways.
    """
    start = perf_counter()
    slides = slides_of(replace(plan, trials=(trial,)))
    if slides:
        onsets = expected_onsets(rig.scene, slides, HIGHEST)[0]
    else:
        mass_kg, steps = plan.mass_kg(trial), plan.program(trial).steps
        moves = [step for step in steps if isinstance(step, Move)]
        pressed = next(step.to for step in moves if step.phase == "press")
        pulled = next((step for step in moves if step.phase == "retract"), None)
        if mass_kg is None or pulled is None or pulled.to.x_mm != pressed.x_mm:
            return None
        onsets = np.array(
            retraction_onsets(
                skin_of(rig.scene), rig.scene.scene.friction.kinetic, mass_kg, pressed.depth_mm,
                pulled.speed_mm_s, rig.scene.scene.plate.gravity_m_s2,
            )
        )  # fmt: skip
    seconds = perf_counter() - start
    first, last = (round(float(t) * 1e9) if np.isfinite(t) else None for t in onsets)
    return ClosedForm((first, last), seconds)


@dataclass(frozen=True)
class VariantJob:
    """One trial whose variants are timed and compared."""

    rig: RigFile
    plan: Plan
    trial: Trial
    families: Families


def compare_trial(job: VariantJob, advance: Callable[[], None] | None = None) -> Compared:
    """Run every variant of a trial once and compare it with the reference.

    What two runs differ by is the same on any machine, so this may go to a Dask cluster.

    Args:
        advance: called after each run.
    """

    def seen(variant: Variant) -> Seen:
        rig, seed = ideal(changed(job.rig, variant.change)), variant.seed(job.trial)
        found = run(rig, job.plan, job.trial, seed)
        if advance is not None:
            advance()
        return found

    return compare_variants(seen, job.families, job.plan.protocol.analysis, job.trial.seed)


def wall_seconds(job: VariantJob, rounds: int, advance: Callable[[], None]) -> dict[Variant, float]:
    """Return seconds of each variant: the fastest of some rounds, which other work rarely meets."""
    found = dict.fromkeys(variants(job.families), math.inf)
    for _ in range(rounds):
        for variant in found:
            rig, seed = changed(job.rig, variant.change), variant.seed(job.trial)
            found[variant] = min(found[variant], timed(rig, job.plan, job.trial, seed))
            advance()
    return found
