"""Recordings of a simulated rig that stands still, for tests of when things are said to happen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.settings import (
    ClockErrors,
    MockArmSettings,
    MockFrameCameraSettings,
    MockSettings,
)
from sliplab.protocols.timing import Timing
from sliplab.storage.streams import FrameChunk, PoseChunk

CODE = 4321


def rig(
    timing: dict[str, Any],
    *faults: dict[str, Any],
    clocks: dict[str, Any] | None = None,
    camera: dict[str, Any] | None = None,
    arm: dict[str, Any] | None = None,
    seed: int = 7,
) -> MockDevices:
    """A rig that has no pictures, ready for a trial."""
    data = {
        "frame_camera": MockFrameCameraSettings(level="tracks", **(camera or {})).model_dump(),
        "arm": MockArmSettings(**(arm or {})).model_dump(),
        "clocks": ClockErrors(**(clocks or {})).model_dump(),
        "faults": list(faults),
    }
    devices = build_mock(MockSettings.model_validate(data), Timing(**timing))
    devices.arm.connect()
    devices.begin_trial(seed)
    return devices


@dataclass
class Streams:
    """Data of one recording, as complete arrays."""

    frames: dict[str, np.ndarray]
    poses: dict[str, np.ndarray]
    exposures: np.ndarray
    arm_pulses: np.ndarray
    truth: dict[str, Any]

    def true_clock(self, name: str) -> np.ndarray:
        """(n, 2): that clock and the box's, ns."""
        return np.array(self.truth["clocks"][name])


def record(devices: MockDevices, seconds: float = 3.0, chunk_s: float = 0.25) -> Streams:
    """Stand still and read all streams every so often."""
    frames: list[FrameChunk] = []
    poses: list[PoseChunk] = []
    exposures, arm_pulses = [], []

    def read() -> None:
        frames.append(devices.frames.read())
        poses.append(devices.arm.read_poses())
        exposures.append(devices.sync.read_exposures().t_ns)
        arm_pulses.append(devices.arm.read_pulses().t_ns)

    devices.arm.read_poses()
    devices.frames.start()
    devices.sync.start(100.0, CODE, devices.timing.code)
    end_ns = devices.world.now_ns + round(seconds * 1e9)
    while (left_ns := end_ns - devices.world.now_ns) > 0:
        devices.clock.wait(min(chunk_s, left_ns / 1e9))
        read()
    devices.frames.stop()
    devices.sync.stop()
    devices.clock.wait(0.1)
    read()

    def joined(chunks: list[Any], *names: str) -> dict[str, np.ndarray]:
        return {name: np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in names}

    return Streams(
        joined(frames, "number", "t_ns", "host_ns", "sync"),
        joined(poses, "t_ns", "host_ns"),
        np.concatenate(exposures),
        np.concatenate(arm_pulses),
        devices.truth(devices.world.now_ns),
    )


def on_box(pairs: np.ndarray, device_ns: np.ndarray) -> np.ndarray:
    """Device times on the box's clock by the true pairs, float ns; good to far below 1 us."""
    drift = (pairs[-1, 1] - pairs[0, 1]) / (pairs[-1, 0] - pairs[0, 0])
    return pairs[0, 1] + (device_ns - pairs[0, 0]) * drift


def same(one: Streams, other: Streams) -> None:
    for stream in ("frames", "poses"):
        for name, values in getattr(one, stream).items():
            assert np.array_equal(values, getattr(other, stream)[name]), f"{stream} {name}"
    for stream in ("exposures", "arm_pulses"):
        assert np.array_equal(getattr(one, stream), getattr(other, stream)), stream
    assert one.truth == other.truth
