"""What each timing grade's devices say, held against the simulation's true clocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from protocols.timing import FrameGrade, Timing
from rigs.mock.clocks import trial_clocks
from rigs.mock.devices import MockDevices, build_mock
from rigs.mock.settings import Arm, Clocks, FrameCamera, MockSettings
from rigs.pulse_code import code_bits
from storage.streams import ClockReads, FrameChunk, PoseChunk

CODE = 4321
EXPOSURE_NS = 2_000_000
FREE: tuple[FrameGrade, ...] = ("exposure line", "device time stamps", "host arrival")


def rig(
    timing: dict[str, Any], *faults: dict[str, Any], clocks: dict[str, Any] | None = None,
    camera: dict[str, Any] | None = None, arm: dict[str, Any] | None = None, seed: int = 7,
) -> MockDevices:  # fmt: skip
    """A rig that has no pictures, ready for a trial."""
    data = {
        "frame_camera": FrameCamera(level="tracks", **(camera or {})).model_dump(),
        "arm": Arm(**(arm or {})).model_dump(),
        "clocks": Clocks(**(clocks or {})).model_dump(),
        "faults": list(faults),
    }
    devices = build_mock(MockSettings.model_validate(data), Timing(**timing))
    devices.arm.connect()
    devices.begin_trial(seed)
    return devices


@dataclass
class Streams:
    """What came in one recording, in whole arrays."""

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


# -- a camera that runs by itself ----------------------------------------------------------


@pytest.mark.parametrize("grade", FREE)
def test_a_free_running_camera_is_the_same_in_any_pieces(grade: FrameGrade) -> None:
    timing = {"frames": grade, "arm": "host time"}
    faults = (
        {"kind": "clock_drift", "device": "frame_camera", "ppm": 800, "at_s": 1.1},
        {"kind": "frame_late", "count": 2, "seconds": 0.13, "at_s": 0.7},
        {"kind": "frames_lost", "count": 3, "at_s": 1.5},
    )
    whole = record(rig(timing, *faults), 2.0, 2.0)
    same(record(rig(timing, *faults), 2.0, 0.0337), whole)
    again = rig(timing, *faults)
    record(again, 0.5)
    again.begin_trial(7)
    same(record(again, 2.0, 2.0), whole)


@pytest.mark.parametrize("grade", FREE)
def test_it_sees_no_sync_line_and_begins_within_a_period(grade: FrameGrade) -> None:
    firsts = []
    for seed in range(1, 6):
        devices = rig({"frames": grade}, seed=seed)
        devices.clock.wait(0.35)
        found = record(devices, 0.5)
        assert not found.frames["sync"].any()
        assert found.frames["number"].tolist() == list(range(50))
        firsts.append(int(found.frames["host_ns"][0]) - 350_000_000 - EXPOSURE_NS - 4_000_000)
    assert len(set(firsts)) == 5
    assert min(firsts) >= 0
    assert max(firsts) < 10_000_000 + (5_000_000 if grade == "host arrival" else 0)


def test_it_drifts_against_the_box_by_its_ppm() -> None:
    clocks = {"frame_camera_ppm": 15_000.0, "sync_box_ppm": 5_000.0}
    devices = rig({"frames": "exposure line"}, clocks=clocks)
    found = record(devices, 4.0)
    true = trial_clocks(Clocks(**clocks), 1, 7)
    # a clock that gains has more cycles in a second
    rates = 1 + np.array([true.frame_camera.drift_ppm(), true.sync_box_ppb / 1000]) * 1e-6
    assert abs(rates[0] / rates[1] - 1) > 1e-4
    spacing = np.polyfit(np.arange(len(found.exposures)), found.exposures, 1)[0]
    assert spacing == pytest.approx(1e7 * rates[1] / rates[0], abs=20)
    own = np.polyfit(found.frames["number"], found.frames["t_ns"] - found.frames["t_ns"][0], 1)[0]
    assert own == pytest.approx(1e7, abs=20)  # by its own clock they are 10 ms


def test_its_rate_is_its_own() -> None:
    found = record(rig({"frames": "exposure line"}, camera={"rate_hz": 60.0}), 2.0)
    assert abs(len(found.frames["number"]) - 120) <= 1
    assert np.diff(found.exposures).mean() == pytest.approx(1e9 / 60, rel=1e-3)


def test_a_clock_that_drifts_at_once_does_not_expose_before_the_start() -> None:
    for ppm in (10_000, -10_000):
        fault = {"kind": "clock_drift", "device": "frame_camera", "ppm": ppm, "since": "trial",
                 "at_s": 0.0}  # fmt: skip
        devices = rig({"frames": "exposure line"}, fault)
        devices.clock.wait(20.0)
        found = record(devices, 1.0)
        assert 0 <= found.exposures[0] < 10_200_000
        assert np.diff(found.exposures).mean() == pytest.approx(1e7 / (1 + ppm * 1e-6), rel=1e-4)


# -- exposure line -------------------------------------------------------------------------


def test_edges_and_frame_stamps_are_the_same_instants() -> None:
    found = record(rig({"frames": "exposure line"}))
    mid = on_box(found.true_clock("frame_camera"), found.frames["t_ns"])
    edges = found.exposures[found.frames["number"]]
    difference = mid - edges - EXPOSURE_NS / 2
    # two jitters of 1 us, and the box cuts to whole microseconds
    assert difference.mean() == pytest.approx(500, abs=300)
    assert difference.std() == pytest.approx(np.hypot(1000 * 2**0.5, 1000 / 12**0.5), rel=0.2)
    assert np.all(found.exposures % 1000 == 0)
    assert found.exposures.dtype == np.int64


def test_a_lost_frame_was_exposed_all_the_same() -> None:
    lost = record(
        rig({"frames": "exposure line"}, {"kind": "frames_lost", "at_s": 1.0, "count": 4})
    )
    plain = record(rig({"frames": "exposure line"}))
    assert np.array_equal(lost.exposures, plain.exposures)
    assert len(lost.frames["number"]) == len(plain.frames["number"]) - 4


def test_a_camera_without_power_exposes_nothing() -> None:
    gone = {"kind": "device_gone", "device": "frame_camera", "at_s": 1.0, "seconds": 0.5}
    devices = rig({"frames": "exposure line"}, gone)
    devices.frames.start()
    devices.sync.start(100.0, CODE)
    devices.clock.wait(2.0)
    edges = devices.sync.read_exposures().t_ns
    assert len(edges) == pytest.approx(150, abs=2)
    assert not np.any((edges > 1_001_000_000) & (edges < 1_499_000_000))


def test_the_box_sees_exposures_from_its_start_on_and_none_without_power() -> None:
    gone = {"kind": "device_gone", "device": "sync_box", "at_s": 1.0, "seconds": 0.5}
    devices = rig({"frames": "exposure line"}, gone)
    devices.frames.start()
    devices.clock.wait(0.5)
    assert len(devices.sync.read_exposures()) == 0
    devices.sync.start(100.0, CODE)
    devices.clock.wait(2.0)
    edges = devices.sync.read_exposures().t_ns
    assert edges.min() >= -4000
    assert edges.max() < 1_000_100_000
    assert len(edges) == pytest.approx(100, abs=1)


@pytest.mark.parametrize("grade", ["hardware trigger", "device time stamps", "host arrival"])
def test_without_the_line_the_box_sees_no_exposure(grade: str) -> None:
    assert len(record(rig({"frames": grade}), 0.5).exposures) == 0


# -- host arrival --------------------------------------------------------------------------


def test_by_arrival_a_frame_has_the_hosts_time_only() -> None:
    devices = rig({"frames": "host arrival"})
    found = record(devices, 10.0)
    assert np.array_equal(found.frames["t_ns"], found.frames["host_ns"])
    wired = record(rig({"frames": "exposure line"}), 10.0)
    assert np.array_equal(found.frames["number"], wired.frames["number"])
    later_us = (found.frames["host_ns"] - wired.frames["host_ns"]) / 1e3
    assert later_us.min() >= 0.0
    assert later_us.max() <= 5000.0
    assert later_us.max() > 3000.0
    assert 700.0 < later_us.mean() < 1300.0  # of a normal number's size, 1.25 ms standard deviation
    pairs = found.true_clock("frame_camera")
    assert pairs[0].tolist() == [0, 0]
    assert np.diff(pairs[:, 0])[:-1].tolist() == [1_000_000_000] * (len(pairs) - 2)


def test_late_messages_hold_up_the_next_ones() -> None:
    for chunk_s in (0.5, 0.011):
        found = record(
            rig(
                {"frames": "host arrival", "arm": "host time"},
                camera={"arrival_jitter_us": 60_000},
                arm={"arrival_jitter_us": 15_000},
            ),
            1.0,
            chunk_s,
        )
        for stream in (found.frames, found.poses):
            assert np.all(np.diff(stream["host_ns"]) >= 0)
            assert np.any(np.diff(stream["host_ns"]) == 0)
        assert np.all(np.diff(found.frames["number"]) == 1)
        assert np.all(np.diff(found.poses["t_ns"]) == 2_000_000)


# -- reads of clocks -----------------------------------------------------------------------


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


# -- the arm -------------------------------------------------------------------------------


def test_an_arm_that_is_not_wired_sees_no_pulse_and_keeps_its_poses() -> None:
    plain, bare = record(rig({})), record(rig({"arm": "host time"}))
    assert len(plain.arm_pulses) > 100
    assert len(bare.arm_pulses) == 0
    for name in ("t_ns", "host_ns"):
        assert np.array_equal(plain.poses[name], bare.poses[name])
    host = on_box(bare.true_clock("arm"), bare.poses["t_ns"])
    late_us = (bare.poses["host_ns"] - host) / 1e3  # the box started at true time 0
    # the box gains or loses up to 10 us a second
    assert late_us.min() > 1000.0 - 32.0
    assert late_us.max() < 1200.0 + 32.0


# -- the box's codes -----------------------------------------------------------------------


@pytest.mark.parametrize("code", ["lfsr", "irregular", "regular"])
def test_the_box_sends_the_code_that_it_was_told(code: Any) -> None:
    devices = rig({"code": code})
    devices.events.start()
    devices.sync.start(1000.0, CODE, code)
    sent, seen = [], []
    for _ in range(20):  # more ticks than the code is made for at once
        devices.clock.wait(0.5)
        sent.append(devices.sync.read_pulses().t_ns)
        seen.append(devices.events.read_pulses().t_ns)
    pulses = np.concatenate(sent)
    expected = np.flatnonzero(code_bits(CODE, 10_001, code)) * 1_000_000
    assert np.array_equal(pulses, expected[: len(pulses)])
    assert len(expected) - len(pulses) <= 2
    assert abs(len(np.concatenate(seen)) - len(pulses)) <= 1


# -- truth ---------------------------------------------------------------------------------


def test_the_true_clocks_are_those_of_the_pulses() -> None:
    found = record(rig({}))
    pairs = found.true_clock("arm")
    assert pairs.shape == (4, 2)
    assert pairs[0, 1] == 0
    assert np.diff(pairs[:, 1]) == pytest.approx(1e9, rel=2e-5)
    ticks = np.flatnonzero(code_bits(CODE, 301))[: len(found.arm_pulses)] * 1e7
    late = on_box(pairs, found.arm_pulses) - ticks
    assert late == pytest.approx(np.zeros(len(late)), abs=9000)
    frames = on_box(found.true_clock("frame_camera"), found.frames["t_ns"])
    assert frames - found.frames["number"] * 1e7 == pytest.approx(1e6, abs=5000)
    assert all(type(t) is int for pair in found.truth["clocks"]["event_camera"] for t in pair)
