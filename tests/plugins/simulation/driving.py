"""Slides and falls on a simulated rig, for tests of its devices: driven without the rig's code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.settings import MockFrameCameraSettings as FrameSettings
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.protocols.nuisances import TrialNuisances
from sliplab.rigs.core.capabilities import Segment

SMALL = MockSettings(frame_camera=FrameSettings(width=640, height=640, px_per_mm=4.0))
CODE = 4321


@dataclass
class Trial:
    events: dict[str, np.ndarray]
    frames: dict[str, np.ndarray]
    poses: dict[str, np.ndarray]
    event_pulses: np.ndarray
    arm_pulses: np.ndarray
    sync_pulses: np.ndarray
    truth: dict[str, Any]
    slide_ns: int


def joined(chunks: list[Any]) -> dict[str, np.ndarray]:
    whole = type(chunks[0]).concatenate(chunks)
    return {name: values for name, values in vars(whole).items() if values is not None}


def go(
    devices: MockDevices, x: float, y: float, depth: float, speed: float, step_s: float, each: Any
) -> None:
    """Move in a straight line to a place on the plate; `each` is called after every step."""
    devices.arm.start([Segment(devices.world.plane.pose(x, y, depth), speed)])
    while not devices.arm.progress().done:
        devices.clock.wait(step_s)
        each()


def slide(
    devices: MockDevices,
    seed: int,
    *,
    chunk_s: float = 0.5,
    distance: float = 4.0,
    speed: float = 2.0,
    depth: float = 2.6,
    rest_s: float = 0.4,
    nuisances: TrialNuisances | None = None,
) -> Trial:
    """Press, hold, slide; streams are read every `chunk_s` seconds, whatever the motion does."""
    clock, arm, world = devices.clock, devices.arm, devices.world
    arm.connect()
    go(devices, 0, 0, -2, 50.0, 0.05, lambda: None)
    devices.begin_trial(seed, nuisances)
    go(devices, 0, 0, depth, 4.0, 0.05, lambda: None)
    clock.wait(0.5)
    devices.frames.set_region(180, 180)
    arm.read_poses()
    devices.frames.start()
    devices.events.start()
    devices.sync.start(100.0, CODE)
    events, frames, sync = devices.events, devices.frames, devices.sync
    reads = (events.read, frames.read, arm.read_poses)
    reads += (events.read_pulses, arm.read_pulses, sync.read_pulses)  # type: ignore[assignment]
    parts: list[list[Any]] = []

    def read() -> None:
        parts.append([each() for each in reads])

    def run(seconds: float) -> None:
        left = round(seconds * 1e9)
        while left > 0:
            now = min(left, round(chunk_s * 1e9))
            clock.wait(now / 1e9)
            left -= now
            read()

    run(rest_s)
    start = world.now_ns
    arm.start([Segment(world.plane.pose(distance, 0, depth), speed)])
    run(distance / speed + 0.2)
    devices.events.stop()
    devices.frames.stop()
    devices.sync.stop()
    read()
    clock.wait(0.05)
    read()
    found = [joined(list(chunks)) for chunks in zip(*parts, strict=True)]
    return Trial(*found[:3], *(pulses["t_ns"] for pulses in found[3:]), devices.truth(start), start)


def same(a: Trial, b: Trial) -> None:
    for stream in ("events", "frames", "poses"):
        first, second = getattr(a, stream), getattr(b, stream)
        for name, column in first.items():
            assert np.array_equal(column, second[name]), f"{stream}.{name}"
    for stream in ("event_pulses", "arm_pulses", "sync_pulses"):
        assert np.array_equal(getattr(a, stream), getattr(b, stream)), stream
    assert a.truth == b.truth


def with_faults(*faults: dict[str, Any]) -> MockDevices:
    """The small rig on which something goes wrong."""
    data = {**SMALL.model_dump(), "faults": list(faults)}
    return build_mock(MockSettings.model_validate(data))


def gravity(devices: MockDevices, seed: int) -> dict[str, Any]:
    """Hang 0.205 kg on the skin, retract until it falls; truth and what the camera saw."""
    clock, arm, world = devices.clock, devices.arm, devices.world
    arm.connect()
    go(devices, 0, 0, -5, 50.0, 0.5, lambda: None)
    devices.begin_trial(seed)
    devices.operator.ask("changeover", "Mount the plate.", "0.205 kg")
    devices.plate.act("raise", 0.5)
    clock.wait(0.5)
    go(devices, 0, 0, 3.4, 4.0, 0.5, lambda: None)
    devices.plate.act("release", 1.0)
    clock.wait(1.5)
    devices.frames.set_region(180, 180)
    devices.frames.start()
    devices.events.start()
    devices.sync.start(100.0, CODE)
    clock.wait(0.3)
    start = world.now_ns
    go(devices, 0, 0, 2.0, 0.5, 0.1, lambda: None)
    images = devices.frames.read().images
    events = devices.events.read()
    devices.plate.act("catch", 0.0)
    truth = devices.truth(start)
    go(devices, 0, 0, -5, 10.0, 0.5, lambda: None)
    return {**truth, "images": images, "events": events}
