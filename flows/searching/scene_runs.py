"""Trials on a simulated rig that nobody stores: what it costs to simulate one, and what came out.

The rig's own code runs the trial's own program; only the sink is memory, and no pictures are
taken. A run that is compared has perfect clocks, no noise, no faults and no read-out, so that what
two runs differ by is the scene. A run that is timed has all of that as the rig file says, but for
faults.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Literal

import numpy as np

from sliplab.analysis.sweeps.scene_error import Onsets, Seen
from sliplab.protocols import Plan, Trial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.program import Move
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.rig import Rig, TrialRun
from sliplab.rigs.levels import HIGHEST, expected_onsets, slides_of
from sliplab.rigs.mock.settings import Clocks
from sliplab.rigs.mock.skins import skin_of
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.scene.onsets import retraction_onsets
from sliplab.storage.streams import (
    EventChunk,
    Json,
    Unheeded,
)

MOTION = frozenset({"slide", "retract"})
PERFECT = Clocks(
    arm_ppm=0, event_camera_ppm=0, frame_camera_ppm=0, sync_box_ppm=0, offset_h=0,
    pulse_jitter_us=0, frame_jitter_us=0,
)  # fmt: skip
_SMALL_PX = 32


@dataclass(frozen=True)
class Variant:
    """One way to simulate a trial; level 0 is closed forms, without any run."""

    name: str
    level: int
    step_ms: int
    path: Literal["cubic", "chord"] = "cubic"
    other_seed: bool = False

    @property
    def rows_per_s(self) -> float | None:
        """Rows of the contact a second, which is how many segments a path has."""
        return 1000.0 / self.step_ms if self.level else None

    def of(self, rig: RigFile) -> RigFile:
        """The rig file that simulates like this."""
        scene = {"level": f"L{self.level}", "step_ms": self.step_ms}
        return changed(rig, {"scene": scene, "event_camera": {"path": self.path}, "faults": ()})

    def seed(self, trial: Trial) -> int:
        """The trial's seed, as a campaign's first attempt has it, or another one."""
        return hash_integer(trial.seed, "another seed" if self.other_seed else 0)


def changed(rig: RigFile, values: Mapping[str, Any]) -> RigFile:
    """A simulated rig's file with other settings: nested mappings under `mock`, not checked."""
    return rig.model_copy(update={"mock": _changed(rig.scene, values)})


def _changed(model: Any, values: Mapping[str, Any]) -> Any:
    update = {
        name: _changed(getattr(model, name), value) if isinstance(value, Mapping) else value
        for name, value in values.items()
    }
    return model.model_copy(update=update)


def ideal(rig: RigFile) -> RigFile:
    """The rig with true times and signal events only."""
    camera = {"noise_hz": 0.0, "hot_pixels": 0, "readout_hz": 0.0}
    return changed(rig, {"event_camera": camera, "clocks": PERFECT, "faults": ()})


def with_true_times(rig: RigFile) -> RigFile:
    """The rig with perfect clocks and no faults; its camera as it is."""
    return changed(rig, {"clocks": PERFECT, "faults": ()})


@dataclass
class _Memory(Unheeded):
    """A sink that keeps the events and lets the rest go."""

    events: list[EventChunk] = field(default_factory=list)

    def add_events(self, chunk: EventChunk) -> None:
        self.events.append(chunk)

    def joined(self) -> EventChunk:
        """All events in one chunk."""
        columns = (
            np.concatenate([getattr(chunk, name) for chunk in self.events])
            for name in ("x", "y", "p", "t_us")
        )
        return EventChunk(*columns)


def run(rig: RigFile, plan: Plan, trial: Trial, seed: int) -> Seen:
    """Simulate a trial and keep what it left, on a time line that begins with its motion.

    Args:
        rig: with perfect clocks (`ideal`, `with_true_times`): device times are true times then.

    Raises:
        RigError: the trial cannot be run on this rig.
    """
    sink = _Memory()
    built = _ready(rig, plan, trial)
    try:
        done = _run(built, plan, trial, seed, sink)
    finally:
        built.close()
    start_ns = next(step.start_ns for step, _ in done.steps if step.phase in MOTION)
    begin_us, end_us = ((t - start_ns) // 1000 for t in done.recorded_ns)
    events, truth = sink.joined(), done.truth or {}
    recorded = replace(events, t_us=events.t_us - start_ns // 1000)
    inside = slice(*np.searchsorted(recorded.t_us, (begin_us, end_us)))
    kept = EventChunk(
        recorded.x[inside], recorded.y[inside], recorded.p[inside], recorded.t_us[inside]
    )
    slips: Json = {"first": truth["first_slip_ns"], "centre": truth["slip_per_papilla_ns"][0]}

    def since(onset: int | None) -> int | None:
        """After the start of the motion; what came after the recording never came."""
        after = None if onset is None else onset - int(truth["reference_ns"])
        return after if after is not None and after <= end_us * 1000 else None

    return Seen(
        events=kept,
        size_px=(built.events.width, built.events.height),
        begin_us=begin_us,
        end_us=end_us,
        slips=(since(slips["first"]), since(slips["centre"])),
        markers=(since(truth["incipient_ns"]), since(truth["gross_ns"])),
    )


def timed(rig: RigFile, plan: Plan, trial: Trial, seed: int) -> float:
    """Seconds that simulating a trial takes, building the rig left out."""
    built = _ready(rig, plan, trial)
    try:
        start = perf_counter()
        _run(built, plan, trial, seed, _Memory())
        return perf_counter() - start
    finally:
        built.close()


def _ready(rig: RigFile, plan: Plan, trial: Trial) -> Rig:
    """The rig with what the trial needs mounted, as a session does it."""
    built = build_rig(rig)
    built.connect()
    built.frames.set_region(_SMALL_PX, _SMALL_PX)  # it is asked for frames and takes none
    for task in plan.changeovers(None, trial):
        built.operator.ask(task.kind, task.prompt, task.expected)
    return built


def _run(built: Rig, plan: Plan, trial: Trial, seed: int, sink: _Memory) -> TrialRun:
    rate_hz = plan.protocol.collection.recording.sync_rate
    return built.run_trial(plan.program(trial), sink, seed, None, rate_hz)


def closed_form(rig: RigFile, plan: Plan, trial: Trial) -> tuple[Onsets, float] | None:
    """First slip and the centre's (or the plate's fall) at level L0, ns, and seconds of reckoning.

    None where there is no closed form: a retraction that also goes sideways.
    """
    alone = replace(plan, trials=(trial,))
    start = perf_counter()
    slides = slides_of(alone)
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
    return (first, last), seconds


def sample_trials(plan: Plan, count: int) -> list[Trial]:
    """`count` measured trials spread over the conditions: levels are used as evenly as can be.

    Ties are decided by hashes of the protocol's seed and the trials' ids. All trials if there
    are not more.
    """
    seed = plan.protocol.collection.seed
    left = [trial for trial in plan if trial.role == "measured"]
    left.sort(key=lambda trial: hash_integer(seed, "trade-off", trial.id))
    chosen: list[Trial] = []
    while left and len(chosen) < count:
        used = [level for trial in chosen for level in trial.condition]
        best = min(left, key=lambda trial: sum(used.count(level) for level in trial.condition))
        chosen.append(best)
        left.remove(best)
    return chosen
