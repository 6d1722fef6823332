"""Trials on a simulated rig that are not stored: their cost, and their data in memory.

The rig's own code runs the trial's own program; only the sink is memory, and no pictures are
taken. A run that is compared has perfect clocks, no noise, no faults and no read-out, so that two
runs differ by the scene alone. A run that is timed has all of that as the rig file says, but for
faults.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, TypeVar

import numpy as np

from sliplab.plugins.simulation.settings import ClockErrors, scene_of
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.program import ACTING
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.rig import Rig, TrialRun
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.streams import Chunk, EventChunk, NullSink

MOTION = frozenset(ACTING)
PERFECT = ClockErrors(
    arm_ppm=0,
    event_camera_ppm=0,
    frame_camera_ppm=0,
    sync_box_ppm=0,
    offset_h=0,
    pulse_jitter_us=0,
    frame_jitter_us=0,
)
_SMALL_PX = 32
ChunkT = TypeVar("ChunkT", bound=Chunk)


Onsets = tuple[int | None, int | None]
"""First of all papillae, and the centre's; ns after the start of the motion, None: never."""


@dataclass(frozen=True)
class SceneRun:
    """Events and onsets of one run, on a time line that begins with its slide or retraction.

    Attributes:
        events: times in µs of that line, negative in the hold; None where nothing was simulated.
        size_px: columns and rows of the event camera.
        begin_us, end_us: the recorded part.
        slips: when tips began to slide.
        markers: when markers were seen to have slipped: incipient and gross onset.
    """

    events: EventChunk | None
    size_px: tuple[int, int]
    begin_us: int
    end_us: int
    slips: Onsets
    markers: Onsets | None


def changed(rig: RigFile, values: Mapping[str, Any]) -> RigFile:
    """Return a simulated rig's file with other settings of `mock`, nested mappings, unchecked."""
    return rig.model_copy(update={"mock": _changed(scene_of(rig), values)})


def _changed(model: Any, values: Mapping[str, Any]) -> Any:
    update = {
        name: _changed(getattr(model, name), value) if isinstance(value, Mapping) else value
        for name, value in values.items()
    }
    return model.model_copy(update=update)


def with_true_times(rig: RigFile, with_faults: bool = False) -> RigFile:
    """Return the rig with perfect clocks and, by default, no faults."""
    return changed(rig, {"clocks": PERFECT, "faults": scene_of(rig).faults if with_faults else ()})


def ideal(rig: RigFile) -> RigFile:
    """Return the rig with true times and signal events only."""
    camera = {"noise_hz": 0.0, "hot_pixels": 0, "readout_hz": 0.0}
    return changed(with_true_times(rig), {"event_camera": camera})


class Memory(NullSink):
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self._chunks = defaultdict[tuple[str, type[Chunk]], list[Any]](list)

    def add(self, device: str, chunk: Chunk) -> None:
        if len(chunk):
            self._chunks[device, type(chunk)].append(chunk)

    def taken(self, device: str, chunk: type[ChunkT]) -> ChunkT:
        """Return all that a device sent in chunks of a type, as one."""
        return chunk.concatenate(self._chunks[device, chunk])


def run(rig: RigFile, plan: Plan, trial: PlannedTrial, seed: int) -> SceneRun:
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
    events, truth = sink.taken("events", EventChunk), done.truth
    assert truth is not None, "a simulated rig has a truth"
    t_us = events.t_us - start_ns // 1000
    inside = slice(*np.searchsorted(t_us, (begin_us, end_us)))

    def since(onset: int | None) -> int | None:
        """Return ns after the start of the motion; what came after the recording never came."""
        after = None if onset is None else onset - int(truth["reference_ns"])
        return after if after is not None and after <= end_us * 1000 else None

    return SceneRun(
        events=replace(events, t_us=t_us)[inside],
        size_px=(built.events.width, built.events.height),
        begin_us=begin_us,
        end_us=end_us,
        slips=(since(truth["first_slip_ns"]), since(truth["slip_per_papilla_ns"][0])),
        markers=(since(truth["incipient_ns"]), since(truth["gross_ns"])),
    )


def timed(
    rig: RigFile,
    plan: Plan,
    trial: PlannedTrial,
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


def _ready(rig: RigFile, plan: Plan, trial: PlannedTrial) -> Rig:
    """Return the rig with what the trial needs mounted, as a session does it."""
    built = build_rig(rig)
    built.connect()
    built.frames.set_region(_SMALL_PX, _SMALL_PX)  # frames are requested and none is taken
    for task in plan.changeovers(None, trial):
        built.operator.ask(task.request, task.prompt, task.expected)
    return built


def _run(built: Rig, plan: Plan, trial: PlannedTrial, seed: int, sink: Memory) -> TrialRun:
    rate_hz = plan.protocol.collection.recording.sync_rate
    return built.run_trial(plan.program(trial), sink, seed, None, rate_hz)
