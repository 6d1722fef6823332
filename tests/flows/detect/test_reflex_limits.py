"""Stops and grips in seeded trials with faults: force, speed and depth stay within their limits.

Contact physics without cameras: slip, faults and losses come at drawn times. The limits are held
against the simulation's own truth: depth of the sensor, speeds of arm and fingers, normal force.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, Literal

import numpy as np
import pytest

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.path import SENSOR
from sliplab.plugins.simulation.rig import simulated_rig
from sliplab.plugins.simulation.settings import MockSettings, scene_of
from sliplab.plugins.simulation.truth import COURSE, plate_course, watch_plate
from sliplab.protocols.program import Dwell, Move, PlateStep, Position, Program
from sliplab.rigs.core import reacting
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.reacting import Reaction, Reflex, SenseLost, SlipDetected, run_watched
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.streams import Chunk, NullSink, PoseChunk
from tests.conftest import ROOT

FILE = load_rig_file(ROOT / "rigs" / "mock_gripper.yaml")[0]
TREMOR_MM, TREMOR_N = 0.03, 0.05
"""By how much the arm's tremor (15 um), pose noise and a tip that unbends may pass a limit."""
ARM_MM_S = 20.0
"""Largest speed of the arm in contact."""
Kind = Literal["stop", "press", "grip"]
KINDS: tuple[Kind, ...] = ("stop", "press", "grip")
SAFE_MS = 300.0
"""Longest time from the loss of a sense to the safe state: the slowest grip, and polls."""


class Drawn(NullSink):
    """Says slip, or that a sense is lost, at a drawn time of the recorded steps."""

    def __init__(self, devices: MockDevices, due_s: float, says: type[Exception]) -> None:
        self.armed = self.guarded = False
        self._devices, self._due_s, self._says = devices, due_s, says
        self.began_ns: int | None = None

    def step(self, phase: str, acting: bool) -> None:
        """Keep the plate's course from the recorded hold on."""
        if phase == "hold" and self.began_ns is None:
            watch_plate(self._devices.world)
            self.began_ns = self._devices.clock.now_ns()

    def add(self, device: str, chunk: Chunk) -> None:
        """Raise what is due."""
        if not isinstance(chunk, PoseChunk):
            return
        passed_s = (self._devices.clock.now_ns() - self.began_ns) / 1e9
        if passed_s < self._due_s:
            return
        if self._says is SlipDetected and self.armed:
            raise SlipDetected
        if self._says is SenseLost and self.guarded:
            raise SenseLost("the stream is lost")


def fault(rng: np.random.Generator) -> dict[str, Any] | None:
    """Draw a fault of the rig, or none."""
    kinds: tuple[dict[str, Any] | None, ...] = (
        None,
        None,
        {"kind": "arm_protective_stop"},
        {"kind": "device_gone", "device": "gripper"},
        {"kind": "device_gone", "device": "arm"},
        {"kind": "plate_stuck"},
        {"kind": "arm_off_path", "mm": 0.3, "seconds": 0.1},
        {"kind": "papilla_sticky", "papilla": 0, "factor": 2.0},
    )
    found = kinds[rng.integers(len(kinds))]
    if found is None or found["kind"] in ("plate_stuck", "papilla_sticky"):
        return found
    return {**found, "at_s": float(rng.uniform(0.0, 0.6)), "since": "recording"}


def program(rng: np.random.Generator, deepest_mm: float) -> Program:
    """Draw a retraction or a slide with a plate that hangs on the sensor."""
    home = Position(0.0, 0.0, -0.5)
    depth = float(rng.uniform(0.5 * deepest_mm, deepest_mm))
    speed = float(np.exp(rng.uniform(np.log(0.5), np.log(ARM_MM_S))))
    way = speed * float(rng.uniform(0.1, 0.3))
    deep = Position(0.0, 0.0, depth)
    acting = Move("retract", Position(0.0, 0.0, max(depth - way, 0.1)), speed, recorded=True)
    if rng.random() < 0.3:
        acting = Move("slide", Position(min(way, 5.0), 0.0, depth), speed, recorded=True)
    return Program(
        home,
        (
            PlateStep("plate", "raise", 0.0),
            Move("press", deep, ARM_MM_S),
            PlateStep("plate", "release", 0.02),
            Dwell("hold", 0.05, recorded=True),
            acting,
            Move("release", home, ARM_MM_S),
            PlateStep("plate", "catch", 0.0),
        ),
    )


def reflex(
    rng: np.random.Generator, deepest_mm: float, kind: Literal["stop", "press", "grip"]
) -> Reflex:
    """Draw a reflex within the rig's ranges; what is over the depth is for the rig to cut off."""
    gripper = FILE.gripper_range
    press = kind == "press"
    return Reflex(
        kind,
        deepest_mm,
        float(rng.uniform(0.05, 1.5)),
        float(rng.uniform(1.0, ARM_MM_S) if press else rng.uniform(*gripper.speed_mm_s)),
        float(rng.uniform(gripper.force_n[0], 9.0)),
        0.05,
    )


def one_trial(number: int) -> str:
    """Run a trial, hold its truth against the limits, and return how it ended."""
    rng = np.random.default_rng([20260, number])
    deepest_mm = float(rng.uniform(2.0, 4.0))
    found = fault(rng)
    scene = scene_of(FILE).model_dump()
    scene["arm"]["start_xyz_mm"] = (399.5, 0.0, 300.0)  # near, for the way takes time
    scene["event_camera"] |= {"width": 64, "height": 64}  # it sees nothing, and is made each time
    scene["faults"] = [] if found is None else [found]
    file = FILE.model_copy(update={"mock": MockSettings.model_validate(scene)})
    devices = build_mock(scene_of(file), file.timing)
    rig = simulated_rig(file, devices)
    rig.event_camera = rig.frame_camera = None
    rig.poll_s = float(rng.choice([0.005, 0.01, 0.02]))
    devices.world.mass_kg = float(rng.choice([0.165, 0.205, 0.245]))
    wanted = reflex(rng, deepest_mm, KINDS[rng.integers(3)])
    safe = reflex(rng, deepest_mm, KINDS[2 * rng.integers(2)])
    says = (SlipDetected, SlipDetected, SlipDetected, SenseLost)[rng.integers(4)]
    watcher = Drawn(devices, float(rng.uniform(0.0, 0.25)), says)
    made: Reaction | None = None
    try:
        rig.connect()
        made = run_watched(rig, program(rng, deepest_mm), watcher, number, 100, wanted, safe)
        ended = "no reflex" if made is None else wanted.kind
    except reacting.SafeState as lost:
        made, ended = lost.reaction, "safe state"
        assert made.command_ms + made.actuator_ms <= SAFE_MS, number
        assert not devices.world.path.moving(devices.world.now_ns), number
        assert rig.position().depth_mm > 0.0, number  # it stays
    except RigError:
        ended = "failed"
        assert not devices.world.path.moving(devices.world.now_ns + 10**9), number
    check_limits(devices, watcher, max(wanted.speed_mm_s, safe.speed_mm_s), deepest_mm, number)
    if made is not None:
        assert made.depth_mm <= deepest_mm + TREMOR_MM, number
    return ended


def check_limits(
    devices: MockDevices, watcher: Drawn, finger_mm_s: float, deepest_mm: float, number: int
) -> None:
    """Hold the simulation's truth of a trial against the limits."""
    world = devices.world
    if watcher.began_ns is None:
        return
    course = plate_course(world, watcher.began_ns)
    assert max(course["depth_mm"]) <= deepest_mm + TREMOR_MM, number
    t_ns = watcher.began_ns + np.round(np.array(course["t_ms"]) * 1e6).astype(np.int64)
    sensor = world.path.commanded(t_ns, SENSOR)[:, :3]  # a fault moves the tool besides
    speed = np.linalg.norm(np.diff(sensor, axis=0), axis=1) * 1e3
    assert speed.max(initial=0.0) <= ARM_MM_S * (1 + 1e-6), number
    opening = world.fingers.opening_mm(t_ns)
    closing = -np.diff(opening) * 1e3
    assert closing.max(initial=0.0) <= finger_mm_s * (1 + 1e-6), number
    normal = np.array(course["normal_n"])
    moves = np.flatnonzero(closing > 1e-9)
    if len(moves):
        at_command = float(normal[moves[0]])
        limit = world.fingers.last_force_n
        assert normal[moves + 1].max() <= max(limit, at_command) + TREMOR_N, number


def many(count: int, first: int = 0) -> Counter[str]:
    """Run trials and count how they ended."""
    ended: Counter[str] = Counter()
    for number in range(first, first + count):
        ended[one_trial(number)] += 1
    return ended


def test_no_limit_is_passed_in_many_trials_with_faults() -> None:
    ended = many(60)
    assert set(ended) == {"stop", "press", "grip", "no reflex", "safe state", "failed"}


@pytest.mark.long
def test_no_limit_is_passed_in_ten_thousand_trials_with_faults() -> None:
    ended = many(10_000)
    print(f"simulated: {dict(ended)}")
    assert ended["grip"] > 500
    assert ended["safe state"] > 500


def test_the_checks_see_a_limit_that_is_passed() -> None:
    """The same trials with limits that are lower than what was asked for."""
    rng = np.random.default_rng(1)
    devices = build_mock(scene_of(FILE), FILE.timing)
    rig = simulated_rig(FILE, devices)
    rig.event_camera = rig.frame_camera = None
    watcher = Drawn(devices, 0.1, SlipDetected)
    rig.connect()
    grip = Reflex("grip", 4.0, 0.8, 150.0, 50.0, 0.05)
    run_watched(rig, program(rng, 3.0), watcher, 1, 100, grip)
    assert COURSE in devices.world.physics.more_wrenches
    check_limits(devices, watcher, 150.0, 4.0, 0)
    for finger_mm_s, deepest_mm in ((10.0, 4.0), (150.0, 2.0)):
        with pytest.raises(AssertionError):
            check_limits(devices, watcher, finger_mm_s, deepest_mm, 0)
