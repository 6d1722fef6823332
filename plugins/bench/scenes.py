"""Scenes of the bench: drawn worlds and motions, simulated. None is stored, since they repeat."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.analysis.detectors.detector import Scene, Slip
from sliplab.plugins.bench.definition import (
    DEFINITION,
    EFFECTS,
    VERSION,
    WORLDS,
    ScenePart,
    Size,
    Span,
)
from sliplab.plugins.bench.nuisances import NUISANCES, nuisance_faults
from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.rig import simulated_rig
from sliplab.plugins.simulation.scene_runs import Memory, changed, with_true_times
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.plugins.twin.worlds import ZERO_MM, Prior, other_specimen
from sliplab.protocols import Plan
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.rigs.core.capabilities import Truth
from sliplab.rigs.core.faults import AnyFault
from sliplab.rigs.core.rig import TrialRun
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.streams import EventChunk

FRAMES_PX = 32
SYNC_HZ = 100
POLL_S = 2.0
"""Nothing waits for the streams; all that is read at once is in memory several times."""
LONG_US = 60_000_000
"""Scenes with a longer hold are left out where they would take most of the time."""
AFTER_GROSS_US = 1_500_000
"""A scene ends so long after gross slip: later alarms say nothing, and training needs no more."""


@dataclass(frozen=True)
class SceneDraw:
    """A scene before it is simulated.

    Attributes:
        rig: a drawn world. world: its name, which scenes in the same one share.
        seed: of the trial's chance. faults: of the rig in this scene.
    """

    name: str
    world: str
    rig: RigFile
    hold_s: float
    depth_mm: float
    speed_mm_s: float
    direction_deg: float
    seed: int
    faults: tuple[AnyFault, ...] = ()


def training_scenes(size: Size, worlds: str = "usual") -> tuple[list[SceneDraw], list[SceneDraw]]:
    """Return the scenes that train and that choose, the same for everybody.

    Args:
        worlds: one of `WORLDS`.
    """
    train = list(_part("train", size.train, DEFINITION.train_seed, worlds))
    return train, list(_part("validation", size.validation, DEFINITION.validation_seed, worlds))


def test_scenes(size: Size, seed: int, worlds: str) -> list[SceneDraw]:
    """Return test scenes in worlds that a seed draws."""
    return list(_part("test", size.test, hash_integer("bench test", VERSION, seed), worlds))


def other_validation(size: Size, seed: int, number: int, worlds: str) -> list[SceneDraw]:
    """Return scenes as those that choose, in a numbered set of worlds that a seed draws."""
    drawn_by = hash_integer("promise", VERSION, seed, number)
    return list(_part("validation", size.validation, drawn_by, worlds))


def nuisance_scenes(size: Size, seed: int, worlds: str = "usual") -> dict[str, list[SceneDraw]]:
    """Return scenes with each nuisance, in worlds that a seed draws."""
    drawn_by = hash_integer("bench nuisances", VERSION, seed)
    found: dict[str, list[SceneDraw]] = {}
    for place, name in enumerate(NUISANCES):
        found[name] = []
        for number in range(size.nuisance):
            rng = np.random.default_rng([drawn_by, place, number])
            hold_s = _value(DEFINITION.nuisance_hold_s, rng)
            chance = np.random.default_rng([drawn_by, number, hash_integer(name)])
            rig = _world(drawn_by, place * size.nuisance + number, worlds)
            faults = nuisance_faults(name, hold_s, scene_of(rig), chance)
            world = f"{name} {number + 1}"
            found[name].append(_drawn(world, world, rig, hold_s, rng, faults))
    return found


def _part(name: str, part: ScenePart, seed: int, worlds: str) -> Iterator[SceneDraw]:
    rigs = [_world(seed, number, worlds) for number in range(part.worlds)]
    for number, rig in enumerate(rigs):
        for slide in range(part.slides):
            rng = np.random.default_rng([seed, number, slide])
            hold_s = _value(DEFINITION.hold_s, rng)
            world = f"{name} {number + 1}"
            yield _drawn(f"{world}.{slide + 1}", world, rig, hold_s, rng)
    for hold in range(part.holds):
        rng = np.random.default_rng([seed, hold, hash_integer("hold")])
        hold_s = _value(DEFINITION.long_hold_s, rng)
        world = f"{name} hold {hold + 1}"
        yield _drawn(world, world, _world(seed, part.worlds + hold, worlds), hold_s, rng)


def _world(seed: int, number: int, worlds: str) -> RigFile:
    """Return a simulated rig with other parameters, another skin and an error of depth zero."""
    rig, _ = load_rig_file(shipped_rigs()[DEFINITION.rig])
    values = Prior(rig, DEFINITION.spread, seed).values(number)
    rng = np.random.default_rng([seed, number, hash_integer("specimen")])
    zero_mm = float(rng.uniform(-ZERO_MM, ZERO_MM))
    made = with_true_times(other_specimen(rig, values, int(rng.integers(2**31)), zero_mm))
    for effect in WORLDS[worlds]:
        drawn_by = np.random.default_rng([seed, number, hash_integer(effect)])
        for (*sections, key), span in EFFECTS[effect].items():
            settings: dict[str, Any] = {
                key: _value(span, drawn_by) if isinstance(span, Span) else span
            }
            for section in reversed(sections):
                settings = {section: settings}
            made = changed(made, settings)
    return made


def _drawn(
    name: str,
    world: str,
    rig: RigFile,
    hold_s: float,
    rng: np.random.Generator,
    faults: tuple[AnyFault, ...] = (),
) -> SceneDraw:
    heights_mm = scene_of(rig).scene.skin.heights_mm
    touching_mm = max(heights_mm) - min(heights_mm)
    return SceneDraw(
        name,
        world,
        rig,
        hold_s,
        round(touching_mm + _value(DEFINITION.beyond_mm, rng), 2),
        _value(DEFINITION.speed_mm_s, rng),
        _value(DEFINITION.direction_deg, rng),
        int(rng.integers(2**31)),
        faults,
    )


def _value(span: Span, rng: np.random.Generator) -> float:
    """Draw a number of a motion, in hundredths."""
    if span.logarithmic:
        return round(math.exp(rng.uniform(math.log(span.low), math.log(span.high))), 2)
    return round(float(rng.uniform(span.low, span.high)), 2)


@dataclass(frozen=True)
class SimulatedTrial:
    """A simulated trial: its devices, what they sent, and the truth."""

    devices: MockDevices
    sink: Memory
    done: TrialRun

    @property
    def truth(self) -> Truth:
        """When tips slid and markers moved."""
        assert self.done.truth is not None, "a simulated rig has a truth"
        return self.done.truth


def take(drawn: SceneDraw, watch: Callable[[SimulatedWorld], None] | None = None) -> SimulatedTrial:
    """Simulate the trial of a scene.

    Args:
        watch: is given the world before the trial.

    Raises:
        RigError: nothing slips in it.
    """
    file = changed(drawn.rig, {"faults": drawn.faults})
    devices = build_mock(scene_of(file), file.timing, file.streams)
    rig = simulated_rig(file, devices)
    rig.poll_s = POLL_S
    sink, plan = Memory(), _plan(drawn)
    try:
        rig.connect()
        rig.frames.set_region(FRAMES_PX, FRAMES_PX)
        if watch is not None:
            watch(devices.world)
        done = rig.run_trial(plan.program(plan.trials[0]), sink, drawn.seed, None, SYNC_HZ)
    finally:
        rig.close()
    return SimulatedTrial(devices, sink, done)


def simulated(drawn: SceneDraw) -> Scene:
    """Simulate a scene.

    Raises:
        RigError: nothing slips in it.
    """
    return scene_of_trial(drawn, take(drawn))


def since_us(taken: SimulatedTrial, onset_ns: int) -> int:
    """Return microseconds from the begin of a scene to an onset of its truth."""
    moved_ns = next(step.start_ns for step, _ in taken.done.steps if step.phase == "slide")
    return (onset_ns - taken.truth["reference_ns"] + moved_ns - taken.done.recorded_ns[0]) // 1000


def scene_of_trial(drawn: SceneDraw, taken: SimulatedTrial) -> Scene:
    """Return the scene that a simulated trial is."""
    truth = taken.truth
    begin_ns, end_ns = taken.done.recorded_ns
    end_us = (end_ns - begin_ns) // 1000
    onsets = (truth[key] for key in ("first_slip_ns", "incipient_ns", "gross_ns"))
    # what never came has the end
    slip = Slip(*(end_us if ns is None else min(since_us(taken, ns), end_us) for ns in onsets))
    end_us = min(end_us, slip.gross_us + AFTER_GROSS_US)
    events = taken.sink.taken("events", EventChunk)
    t_us = events.t_us - begin_ns // 1000
    inside = slice(*np.searchsorted(t_us, (0, end_us)))
    # copies: views would keep what follows in memory
    retained = EventChunk(
        events.x[inside].copy(),
        events.y[inside].copy(),
        events.p[inside].copy(),
        t_us[inside].copy(),
    )
    camera = taken.devices.events
    size = camera.width, camera.height
    return Scene(drawn.name, retained, *size, int(end_us), slip, drawn.world)


def _plan(drawn: SceneDraw) -> Plan:
    """Return a plan of one slide after a hold."""
    protocol = {
        "protocol": 1,
        "name": "bench",
        "title": "A slide of the bench",
        "collection": {
            "experiment": "kinematic",
            "seed": 1,
            "factors": {"direction": {"unit": "deg", "values": [drawn.direction_deg]}},
            "repetitions": 1,
            "motion": [
                {"phase": "approach", "clearance": "5 mm", "speed": "20 mm/s"},
                {"phase": "press", "depth": f"{drawn.depth_mm} mm", "speed": "2 mm/s"},
                {"phase": "hold", "settle": "1 s", "duration": f"{drawn.hold_s} s"},
                {
                    "phase": "slide",
                    "distance": f"{DEFINITION.distance_mm} mm",
                    "speed": f"{drawn.speed_mm_s} mm/s",
                    "direction": "$direction",
                },
                {"phase": "release", "clearance": "5 mm", "speed": "10 mm/s"},
                {"phase": "return", "speed": "20 mm/s"},
            ],
            "recording": {"region": {"width": "41.6 mm", "height": "41.6 mm"}},
            "limits": {
                "depth": "4.5 mm",
                "speed": "50 mm/s",
                "clearance": "20 mm",
                "workspace": {
                    "x": {"low": "-10 mm", "high": "10 mm"},
                    "y": {"low": "-10 mm", "high": "10 mm"},
                },
                "duration": "300 s",
            },
            "gates": {
                "sync_uncertainty": {"hardware_trigger": "1 ms"},
                "frames_lost": 0,
                "event_gap": "50 ms",
                "retakes": 0,
            },
        },
        "analysis": {},
    }
    return make_plan(Protocol.model_validate(protocol), "the bench's scenes")
