"""Ticks of the sync box and of a camera that runs by itself, and reads of their clocks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.plugins.simulation.devices import MockDevices
from sliplab.plugins.simulation.settings import ClockErrors, MockFrameCameraSettings, MockSettings
from sliplab.plugins.simulation.sync import FreeRun
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.storage.streams import ClockReads
from tests.plugins.simulation.standing import CODE, rig

CASES: tuple[list[dict[str, Any]], ...] = (
    [],
    [{"kind": "clock_drift", "ppm": 9000, "since": "trial", "at_s": 1.0}],
    [
        {"kind": "clock_drift", "ppm": -9000, "since": "trial", "at_s": 0.0},
        {"kind": "clock_jump", "seconds": -3.0, "since": "trial", "at_s": 0.4},
        {"kind": "clock_drift", "ppm": 500, "since": "trial", "at_s": 2.5},
        {"kind": "clock_restart", "since": "trial", "at_s": 3.0},
    ],
)


def running(faults: list[dict[str, Any]], rate_hz: float = 100.0, after_s: float = 0.7) -> FreeRun:
    """A camera that was started some time into a trial."""
    data: dict[str, Any] = {"clocks": ClockErrors(frame_camera_ppm=20_000).model_dump()}
    data["frame_camera"] = MockFrameCameraSettings(rate_hz=rate_hz).model_dump()
    data["faults"] = [{**fault, "device": "frame_camera"} for fault in faults]
    world = SimulatedWorld(MockSettings.model_validate(data))
    camera = FreeRun(world)
    world.begin_trial(5)
    world.pass_time(round(after_s * 1e9))
    camera.start()
    return camera


@pytest.mark.parametrize("faults", CASES)
@settings(max_examples=20, deadline=None)
@given(tick=st.integers(0, 1000), rate_hz=st.sampled_from([24.0, 100.0, 997.3]))
def test_a_tick_is_where_its_time_is(faults: Any, tick: int, rate_hz: float) -> None:
    camera = running(faults, rate_hz)
    at = int(camera.true_ns(np.array([tick]))[0])
    assert camera.tick_at(at) == tick
    assert camera.tick_at(at + 1) == tick + 1
    assert camera.ticks(0, at).tolist() == list(range(tick + 1))
    assert camera.ticks(tick, at - 1).tolist() == []


@pytest.mark.parametrize("faults", CASES)
def test_cycles_are_counted_by_the_cameras_own_clock(faults: list[dict[str, Any]]) -> None:
    camera = running(faults)
    true_ns = camera.true_ns(np.arange(600))
    assert 700_000_000 <= true_ns[0] < 710_300_000
    world = camera._world
    clock = world.clocks.frame_camera
    shown = clock.to_reference(true_ns)
    jumps = np.abs(np.diff(shown) - 10_000_000) > 1_000_000
    assert jumps.sum() == sum(fault["kind"] == "clock_restart" for fault in faults)
    # two drifts in one second are a product in the cycles and a sum in what the clock shows
    assert np.diff(shown)[~jumps] == pytest.approx(10_000_000, abs=2500)


def test_nothing_comes_before_a_start_or_after_a_stop() -> None:
    camera = running([])
    camera._world.pass_time(1_000_000_000)
    camera.stop()
    assert camera.ticks(0, 9_000_000_000).size == pytest.approx(100, abs=3)
    camera._world.begin_trial(6)
    assert camera.ticks(0, 9_000_000_000).size == 0
    assert camera.tick_at(5) == 0
    assert not camera.bits(np.arange(3)).any()


def read_often(devices: MockDevices, device: Any, n: int = 400) -> ClockReads:
    """Reads 20 ms apart, in whole arrays."""
    reads = []
    for _ in range(n):
        devices.clock.wait(0.02)
        reads.append(device.read_clock())
        assert [len(reads[-1]), reads[-1].device_ns.dtype] == [1, np.int64]
    return ClockReads.concatenate(reads)


@pytest.mark.parametrize("name", ["sync_box", "frame_camera"])
def test_a_read_brackets_the_truth(name: str) -> None:
    devices = rig({"frames": "device time stamps"})
    devices.clock.wait(0.3)
    devices.frames.start()
    devices.sync.start(100.0, CODE)
    device = devices.sync if name == "sync_box" else devices.frames
    reads = read_often(devices, device)
    box = devices.sync.clock
    clock = box if name == "sync_box" else devices.world.clocks.frame_camera
    unit = 1000 if name == "sync_box" else 1
    assert np.all(clock.to_reference(reads.before_ns) // unit * unit <= reads.device_ns)
    assert np.all(reads.device_ns <= clock.to_reference(reads.after_ns))
    question = clock.to_device(reads.device_ns) - reads.before_ns
    whole = reads.after_ns - reads.before_ns
    assert question.min() >= 200_000 - 1000
    assert whole.min() >= 400_000
    assert whole.max() <= 10_000_000
    assert whole.mean() == pytest.approx(600_000, rel=0.1)
    assert np.all(reads.before_ns[1:] >= reads.after_ns[:-1])
    assert np.all(reads.device_ns % unit == 0)


def test_the_host_asks_again_only_after_an_answer() -> None:
    clocks = {"read_shortest_us": 3000.0, "read_spread_us": 0.0}
    devices = rig({"frames": "device time stamps"}, clocks=clocks)
    devices.sync.start(100.0, CODE)
    first, second = devices.sync.read_clock(), devices.sync.read_clock()
    assert second.before_ns[0] == first.after_ns[0] == 6_000_000
    assert second.device_ns[0] - first.device_ns[0] == pytest.approx(6_000_000, abs=2000)


def test_reads_belong_to_the_trials_seed() -> None:
    found = []
    for seed in (3, 3, 4):
        devices = rig({"frames": "device time stamps"}, seed=99)
        devices.frames.read_clock()
        devices.begin_trial(seed)
        found.append(read_often(devices, devices.frames, 10))
    assert np.array_equal(found[0].after_ns, found[1].after_ns)
    assert np.array_equal(found[0].device_ns, found[1].device_ns)
    assert not np.array_equal(found[0].after_ns, found[2].after_ns)
