"""Faults in what the simulated devices send: frames, events, clocks and pulses."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.plugins.simulation.devices import build_mock
from tests.plugins.simulation.driving import SMALL, Trial, gravity, same, slide, with_faults


@pytest.fixture(scope="module")
def sound() -> Trial:
    return slide(build_mock(SMALL), seed=11)


# -- frames --------------------------------------------------------------------------------


def test_lost_frames_leave_a_gap_in_the_counter(sound: Trial) -> None:
    lost = slide(with_faults({"kind": "frames_lost", "at_s": 1.0, "count": 3}), seed=11)
    missing = set(range(int(lost.frames["number"][-1]) + 1)) - set(lost.frames["number"].tolist())
    assert missing in ({100, 101, 102}, {101, 102, 103})
    kept = np.isin(sound.frames["number"], lost.frames["number"])
    assert np.array_equal(sound.frames["images"][kept], lost.frames["images"])
    assert np.array_equal(sound.frames["sync"][kept], lost.frames["sync"])


def test_a_late_frame_holds_the_later_ones_up_and_keeps_its_stamp(sound: Trial) -> None:
    late = slide(
        with_faults({"kind": "frame_late", "at_s": 1.0, "count": 2, "seconds": 0.05}), seed=11
    )
    for name in ("images", "number", "t_ns", "sync"):
        assert np.array_equal(late.frames[name], sound.frames[name])
    delay_ms = (late.frames["host_ns"] - sound.frames["host_ns"]) / 1e6
    first = int(np.flatnonzero(delay_ms)[0])
    assert first in {100, 101}
    # both come 50 ms late; those behind them as soon as the second is there
    expected = [50.0, 50.0, 40.0, 30.0, 20.0, 10.0]
    assert delay_ms[first : first + 6] == pytest.approx(expected, abs=0.01)
    assert np.all(np.abs(delay_ms[first + 6 :]) < 0.01)
    assert np.all(np.diff(late.frames["host_ns"]) >= 0)


def test_a_frame_that_comes_after_the_end_never_comes() -> None:
    late = slide(with_faults({"kind": "frame_late", "at_s": 2.0, "seconds": 60.0}), seed=11)
    assert late.frames["number"][-1] in {199, 200}


@pytest.mark.parametrize("kind", ["papilla_torn", "marker_occluded"])
def test_a_hidden_marker_is_not_in_the_picture(kind: str, sound: Trial) -> None:
    devices = with_faults({"kind": kind, "papilla": 3, "at_s": 0.1})
    hidden = slide(devices, seed=11)
    x, y = devices.world.skin.layout_mm[3]
    column, row = round(89.5 + 4 * x), round(89.5 - 4 * y)
    spot = np.s_[:, row - 3 : row + 4, column - 3 : column + 4]
    seen, plain = (trial.frames["images"][spot].max((1, 2)) for trial in (hidden, sound))
    assert plain[:30].min() > 150  # before the slide carries it away
    assert seen[:10].min() > 150
    assert seen[12:30].max() < 60
    elsewhere = hidden.frames["images"][5:30], sound.frames["images"][5:30]
    assert np.count_nonzero(elsewhere[0] != elsewhere[1]) < 25 * 20 * 20


def test_an_occluded_plate_marker_comes_back() -> None:
    devices = with_faults({"kind": "marker_occluded", "plate": True, "at_s": 0.1, "seconds": 0.1})
    corner = gravity(devices, 5)["images"][:, 5:45, 130:175].max((1, 2))
    assert corner[:10].min() > 150
    assert corner[11:19].max() < 60
    assert corner[21:40].min() > 150


def test_a_torn_papilla_bears_no_force_and_its_loss_is_no_slip(sound: Trial) -> None:
    devices = with_faults({"kind": "papilla_torn", "papilla": 3, "at_s": 0.1})
    torn = slide(devices, seed=11)
    assert devices.world.physics.tips.normal[3] == 0.0
    assert np.count_nonzero(devices.world.physics.tips.normal) == 18
    assert torn.truth["per_papilla_ns"][3] is None
    assert torn.truth["slip_per_papilla_ns"][3] is None
    others = [i for i in range(19) if i != 3]
    for i in others:  # springs do not know of each other while the plate is held
        assert torn.truth["per_papilla_ns"][i] == sound.truth["per_papilla_ns"][i]


# -- events --------------------------------------------------------------------------------


def test_an_event_gap_is_silent(sound: Trial) -> None:
    gap = slide(with_faults({"kind": "event_gap", "at_s": 0.9, "seconds": 0.3}), seed=11)
    t_us = gap.events["t_us"]
    assert np.diff(t_us).max() >= 298_000  # less a scan of the read-out at either end
    assert np.all(np.isin(t_us, sound.events["t_us"]))
    assert len(gap.event_pulses) < len(sound.event_pulses)


def test_a_stall_that_ends_in_time_loses_nothing(sound: Trial) -> None:
    devices = with_faults({"kind": "event_stall", "at_s": 0.9, "seconds": 0.6})
    same(slide(devices, seed=11, chunk_s=0.05), sound)


def test_a_stall_until_the_end_loses_what_was_not_sent(sound: Trial) -> None:
    stall = slide(with_faults({"kind": "event_stall", "at_s": 0.9, "seconds": 60.0}), seed=11)
    n = len(stall.events["t_us"])
    assert 0 < n < len(sound.events["t_us"])
    assert np.array_equal(stall.events["t_us"], sound.events["t_us"][:n])
    assert np.array_equal(stall.event_pulses, sound.event_pulses[: len(stall.event_pulses)])


def test_a_burst_has_its_rate_and_covers_the_array(sound: Trial) -> None:
    burst = slide(
        with_faults({"kind": "event_burst", "at_s": 0.9, "seconds": 0.1, "million_per_s": 2.0}),
        seed=11,
    )
    more = len(burst.events["t_us"]) - len(sound.events["t_us"])
    assert more == pytest.approx(200_000, abs=5 * 200_000**0.5)  # Poisson
    begin = sound.events["t_us"][0] + 900_000
    inside = (burst.events["t_us"] > begin - 20_000) & (burst.events["t_us"] < begin + 120_000)
    x, y = burst.events["x"][inside], burst.events["y"][inside]
    quarters = np.histogram2d(x, y, bins=2, range=[[0, 640], [0, 480]])[0] / inside.sum()
    assert quarters == pytest.approx(np.full((2, 2), 0.25), abs=0.02)
    assert burst.events["p"][inside].mean() == pytest.approx(0.5, abs=0.03)
    assert np.all(np.diff(burst.events["t_us"]) >= 0)


# -- clocks and pulses ---------------------------------------------------------------------


@pytest.mark.quick(3)
@pytest.mark.parametrize("seconds", [0.25, -0.25])
@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera", "sync_box"])
def test_a_clock_jumps_on_one_device(device: str, seconds: float, sound: Trial) -> None:
    fault = {"kind": "clock_jump", "device": device, "at_s": 1.0, "seconds": seconds}
    jumped = slide(with_faults(fault), seed=11)
    streams = {
        "arm": [(sound.arm_pulses, jumped.arm_pulses), times(sound, jumped, "poses")],
        "event_camera": [(sound.event_pulses, jumped.event_pulses)],
        "frame_camera": [times(sound, jumped, "frames")],
        "sync_box": [(sound.sync_pulses, jumped.sync_pulses)],
    }
    for name, pairs in streams.items():
        for before, after in pairs:
            change = np.unique(after - before)
            expected = [0, round(seconds * 1e9)] if name == device else [0]
            assert len(change) == len(expected)
            assert change == pytest.approx(sorted(expected), abs=1000)  # a cut to microseconds


@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera"])
def test_a_clock_begins_again_at_0(device: str, sound: Trial) -> None:
    devices = with_faults(
        {"kind": "clock_restart", "device": device, "at_s": 1.0},
        {"kind": "clock_jump", "device": device, "at_s": 1.5, "seconds": 2.0},
    )
    hit = slide(devices, seed=11)
    stamps = {
        "arm": (sound.arm_pulses, hit.arm_pulses),
        "event_camera": (sound.event_pulses, hit.event_pulses),
        "frame_camera": times(sound, hit, "frames"),
    }
    for name, (before, after) in stamps.items():
        if name != device:
            assert np.array_equal(before, after)
            continue
        back = int(np.flatnonzero(np.diff(after) < 0)[0]) + 1
        assert np.array_equal(after[:back], before[:back])
        assert 0 <= after[back] < 170_000_000
        shift = before[back:] - after[back:]
        fell, jumped = shift[0], shift[-1]
        assert fell > 1e9
        assert fell - jumped == pytest.approx(2_000_000_000, abs=1000)
        assert set((shift == fell).tolist()) == {True, False}
    if device == "arm":
        assert np.array_equal(hit.poses["host_ns"], sound.poses["host_ns"])
        assert hit.poses["t_ns"][-1] < 10e9 < sound.poses["t_ns"][-1]
    if device == "event_camera":  # until the trial's end they carry the highest stamp
        held = hit.events["t_us"]
        assert len(held) == len(sound.events["t_us"])
        assert np.all(np.diff(held) >= 0)
        assert held[-1] - held[0] == pytest.approx(1e6, abs=200_000)


def test_the_true_time_of_a_clock_that_began_again() -> None:
    devices = with_faults(
        {"kind": "clock_drift", "device": "arm", "at_s": 0.2, "ppm": 900},
        {"kind": "clock_restart", "device": "arm", "at_s": 1.0},
    )
    devices.arm.connect()
    devices.begin_trial(3)
    devices.clock.wait(0.5)
    devices.sync.start(100.0, 1)
    clock = devices.world.clocks.arm
    assert clock.to_reference(1_500_000_000) == 0
    assert clock.to_reference(1_499_999_999) > 10**12
    for true_ns in (600_000_000, 1_499_999_000, 1_500_000_000, 1_700_000_000):
        assert clock.to_device(clock.to_reference(true_ns)) == pytest.approx(true_ns, abs=1)


def times(a: Trial, b: Trial, stream: str) -> tuple[np.ndarray, np.ndarray]:
    return getattr(a, stream)["t_ns"], getattr(b, stream)["t_ns"]


def test_event_times_never_run_backwards(sound: Trial) -> None:
    fault = {"kind": "clock_jump", "device": "event_camera", "at_s": 1.0, "seconds": -0.25}
    held = slide(with_faults(fault), seed=11).events["t_us"]
    plain = sound.events["t_us"]
    assert len(held) == len(plain)
    assert np.all(np.diff(held) >= 0)
    behind = (plain - held) / 1e6
    assert behind.max() == pytest.approx(0.25, abs=1e-5)
    assert np.all(held[behind > 0] >= plain[np.flatnonzero(behind > 0)[0] - 1])


@pytest.mark.parametrize("ppm", [400.0, -400.0])
@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera"])
def test_a_clock_drifts_from_a_moment_on(device: str, ppm: float, sound: Trial) -> None:
    fault = {"kind": "clock_drift", "device": device, "at_s": 1.0, "ppm": ppm}
    drifted = slide(with_faults(fault), seed=11)
    pairs = {
        "arm": (sound.arm_pulses, drifted.arm_pulses),
        "event_camera": (sound.event_pulses, drifted.event_pulses),
        "frame_camera": times(sound, drifted, "frames"),
    }
    for name, (before, after) in pairs.items():
        since_s = (before - before[0]) / 1e9 - 1.0
        expected = ppm * 1e3 * np.maximum(since_s, 0.0) if name == device else 0.0 * since_s
        # the first stamp is up to 0.16 s after the start of the recording
        assert after - before == pytest.approx(expected, abs=abs(ppm) * 170 + 1000)


def test_a_box_that_drifts_ticks_faster_for_everybody(sound: Trial) -> None:
    fault = {"kind": "clock_drift", "device": "sync_box", "at_s": 1.0, "ppm": 1000}
    drifted = slide(with_faults(fault), seed=11)
    n = min(len(drifted.arm_pulses), len(sound.arm_pulses))
    assert np.array_equal(drifted.sync_pulses[:n], sound.sync_pulses[:n])  # by its own clock
    since_s = sound.sync_pulses[:n] / 1e9 - 1.0
    for name in ("arm_pulses", "event_pulses"):
        early = getattr(sound, name)[:n] - getattr(drifted, name)[:n]
        expected = 1e9 * np.maximum(since_s, 0.0) * (1 - 1 / 1.001)
        assert early == pytest.approx(expected, abs=1200)  # cut to microseconds, and their drifts


@pytest.mark.quick(2)
@pytest.mark.parametrize("device", ["event_camera", "arm", "sync_box"])
def test_pulses_are_lost_doubled_and_late_on_one_device(device: str, sound: Trial) -> None:
    for kind, seconds in (("lost", None), ("duplicated", 0.004), ("late", 0.004)):
        fault = {"kind": f"pulses_{kind}", "at_s": 1.0, "count": 4, "device": device}
        hit = slide(with_faults(fault | ({"seconds": seconds} if seconds else {})), seed=11)
        pairs = {
            "event_camera": (sound.event_pulses, hit.event_pulses),
            "arm": (sound.arm_pulses, hit.arm_pulses),
            "sync_box": (sound.sync_pulses, hit.sync_pulses),
        }
        for name, (full, found) in pairs.items():
            if name != device:
                assert np.array_equal(full, found)
                continue
            assert len(found) - len(full) == {"lost": -4, "duplicated": 4, "late": 0}[kind]
            gone, new = np.setdiff1d(full, found), np.setdiff1d(found, full)
            assert len(gone) == (0 if kind == "duplicated" else 4)
            assert len(new) == (0 if kind == "lost" else 4)
            if kind == "duplicated":  # 4 ms on the device's clock, cut to microseconds
                distance = np.abs(full[:, None] + 4_000_000 - new).min(1)
            hit = full[distance <= 1200] if kind == "duplicated" else gone
            # the first four after a second; the first of all came up to 0.16 s after the start
            first = int(np.flatnonzero(full == hit[0])[0])
            assert np.array_equal(full[first : first + 4], hit)
            assert 0.84e9 <= hit[0] - full[0] <= 1.16e9
            assert np.all(np.diff(found) >= 0)
