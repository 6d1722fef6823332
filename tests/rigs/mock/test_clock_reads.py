"""Reads of a device's clock: between question and answer lies what it truly showed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sliplab.rigs.mock.devices import MockDevices
from sliplab.storage.streams import ClockReads
from tests.rigs.mock.standing import CODE, rig


def read_often(devices: MockDevices, device: Any, n: int = 400) -> ClockReads:
    """Reads 20 ms apart, in whole arrays."""
    reads = []
    for _ in range(n):
        devices.clock.wait(0.02)
        reads.append(device.read_clock())
        assert [len(reads[-1]), reads[-1].device_ns.dtype] == [1, np.int64]
    names = ("device_ns", "before_ns", "after_ns")
    return ClockReads(*(np.concatenate([getattr(r, name) for r in reads]) for name in names))


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
