"""Time stamps of each timing grade, compared with the simulation's true clocks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sliplab.plugins.simulation.clocks import trial_clocks
from sliplab.plugins.simulation.settings import ClockErrors
from sliplab.protocols.timing import FrameGrade
from sliplab.rigs.core.pulse_code import code_bits
from tests.plugins.simulation.standing import CODE, on_box, record, rig, same

EXPOSURE_NS = 2_000_000
FREE: tuple[FrameGrade, ...] = ("exposure line", "device time stamps", "host arrival")


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
    true = trial_clocks(ClockErrors(**clocks), 1, 7)
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
        fault = {"kind": "clock_drift", "device": "frame_camera", "since": "trial", "at_s": 0.0}
        fault["ppm"] = ppm
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
    fault = {"kind": "frames_lost", "at_s": 1.0, "count": 4}
    lost = record(rig({"frames": "exposure line"}, fault))
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
    timing = {"frames": "host arrival", "arm": "host time"}
    camera, arm = ({"arrival_jitter_us": us} for us in (60_000, 15_000))
    for chunk_s in (0.5, 0.011):
        found = record(rig(timing, camera=camera, arm=arm), 1.0, chunk_s)
        for stream in (found.frames, found.poses):
            assert np.all(np.diff(stream["host_ns"]) >= 0)
            assert np.any(np.diff(stream["host_ns"]) == 0)
        assert np.all(np.diff(found.frames["number"]) == 1)
        assert np.all(np.diff(found.poses["t_ns"]) == 2_000_000)


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
