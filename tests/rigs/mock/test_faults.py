"""Each fault at the level where it happens: what the device then says, in any pieces."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocols import InputError
from protocols.yaml_file import parse_yaml, validate
from rigs.capabilities import ArmFault, ArmState, RigError
from rigs.mock.devices import MockDevices, build_mock
from rigs.mock.fault_settings import KINDS
from rigs.rig_file import RigFile
from tests.conftest import ROOT
from tests.rigs.mock.driving import SMALL, Trial, go, gravity, same, slide, with_faults

MOMENTS: list[dict[str, Any]] = [
    {"kind": "frames_lost", "count": 3},
    {"kind": "frame_late", "count": 2, "seconds": 0.13},
    {"kind": "event_gap", "seconds": 0.1},
    {"kind": "event_stall", "seconds": 60.0},
    {"kind": "event_burst", "seconds": 0.02, "million_per_s": 5},
    {"kind": "clock_drift", "device": "arm", "ppm": 500},
    {"kind": "clock_drift", "device": "sync_box", "ppm": -500},
    {"kind": "clock_jump", "device": "event_camera", "seconds": -0.25},
    {"kind": "clock_jump", "device": "sync_box", "seconds": 0.5},
    {"kind": "pulses_lost", "count": 4, "device": "sync_box"},
    {"kind": "pulses_duplicated", "count": 4, "device": "arm", "seconds": 0.0137},
    {"kind": "pulses_late", "count": 4, "device": "event_camera", "seconds": 0.031},
    {"kind": "papilla_torn", "papilla": 9},
    {"kind": "marker_occluded", "papilla": 0, "seconds": 0.2},
    {"kind": "arm_off_path", "mm": 0.5, "seconds": 0.4},
    {"kind": "arm_protective_stop"},
]


@pytest.fixture(scope="module")
def sound() -> Trial:
    return slide(build_mock(SMALL), seed=11)


@pytest.mark.parametrize("fault", MOMENTS, ids=lambda f: f"{f['kind']} {f.get('device', '')}")
def test_a_fault_is_the_same_in_any_pieces(fault: dict[str, Any], sound: Trial) -> None:
    devices = with_faults({**fault, "at_s": 0.7213})
    whole = slide(devices, seed=11)
    devices.operator.ask("protective_stop", "Clear it.", "")
    same(slide(devices, seed=11, chunk_s=0.0331), whole)
    with pytest.raises(AssertionError):
        same(whole, sound)


# -- the arm -------------------------------------------------------------------------------


def test_a_protective_stop_holds_the_arm_until_a_person_clears_it() -> None:
    devices = with_faults({"kind": "arm_protective_stop", "trial": 1, "at_s": 0.7})
    trial = slide(devices, seed=11)
    assert devices.arm.state() is ArmState.PROTECTIVE_STOP
    # 0.3 s of sliding at 2 mm/s after 0.4 s of rest
    assert devices.world.plane.sensor(devices.arm.pose())[0] == pytest.approx(0.6, abs=1e-6)
    assert len(trial.frames["number"]) > 250
    devices.arm.stop()
    with pytest.raises(ArmFault, match="protective stop"):
        go(devices, 0, 0, -5, 5.0, 0.5, lambda: None)
    devices.operator.ask("protective_stop", "Clear it.", "")
    go(devices, 0, 0, -5, 5.0, 0.5, lambda: None)
    slide(devices, seed=11)
    assert devices.arm.state() is ArmState.READY


@pytest.mark.parametrize("chunk_s", [0.0331, 0.5])
@pytest.mark.parametrize(
    ("since", "at_mm", "place"),
    [("recording", 1.2345, (1.2345, 2.6)), ("trial", 3.1, (0.0, 1.1)), ("trial", 5.0, (0.4, 2.6))],
)
def test_a_protective_stop_at_a_point_of_the_way(
    since: str, at_mm: float, place: tuple[float, float], chunk_s: float
) -> None:
    devices = with_faults({"kind": "arm_protective_stop", "since": since, "at_mm": at_mm})
    if place[1] < 2.6:  # while it presses, so that it cannot slide
        with pytest.raises(ArmFault):
            slide(devices, seed=11, chunk_s=chunk_s)
    else:
        slide(devices, seed=11, chunk_s=chunk_s)
    where = devices.world.plane.sensor(devices.arm.pose())
    # to the microsecond in which it got there, at 2 mm/s along the plate and 4 into it
    assert (where[0], where[2]) == pytest.approx(place, abs=1e-5)


@pytest.mark.parametrize(("direction", "turned"), [(None, 90.0), (0.0, 0.0), (-30.0, -30.0)])
def test_an_arm_off_its_path_says_so_in_its_poses(
    direction: float | None, turned: float, sound: Trial
) -> None:
    fault = {"kind": "arm_off_path", "mm": 0.8, "seconds": 1.0, "at_s": 0.9}
    devices = with_faults(fault | ({} if direction is None else {"direction_deg": direction}))
    off = slide(devices, seed=11)
    aside = (off.poses["xyz_mm"] - sound.poses["xyz_mm"]) @ devices.world.plane.rotation
    angle = np.radians(turned)
    seconds = np.arange(len(aside)) * 0.002  # poses begin with the recording
    way = 0.8 * np.clip(seconds - 0.9, 0.0, 1.0)
    expected = way[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])
    assert aside == pytest.approx(expected, abs=0.8 * 0.004)  # a cycle or two
    # the skin feels it: it is where the arm really is
    assert off.truth["per_papilla_ns"] != sound.truth["per_papilla_ns"]


def test_an_arm_off_its_path_is_set_right_between_trials(sound: Trial) -> None:
    devices = with_faults({"kind": "arm_off_path", "mm": 0.5, "trial": 1})
    slide(devices, seed=12)
    same(slide(devices, seed=11), sound)


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


# -- what stands still ---------------------------------------------------------------------


def test_a_stuck_plate_does_not_fall() -> None:
    devices = with_faults({"kind": "plate_stuck"})
    stuck = gravity(devices, 5)
    track = devices.world.physics.track
    assert np.all(track.between(1_500_000_000, track.end_ns)[1][:, -1] == 0.0)
    assert stuck["gross_ns"] is None


# -- devices that go -----------------------------------------------------------------------


def calls(devices: MockDevices, device: str) -> list[Any]:
    return {
        "arm": [
            devices.arm.state, devices.arm.pose, devices.arm.now_ns, devices.arm.progress,
            devices.arm.read_poses, devices.arm.read_pulses, devices.arm.stop, devices.arm.close,
            devices.arm.connect, lambda: devices.arm.start([]),
        ],
        "event_camera": [
            devices.events.start, devices.events.read, devices.events.read_pulses,
            devices.events.stop, devices.events.close,
        ],
        "frame_camera": [
            devices.frames.start, devices.frames.read, devices.frames.stop, devices.frames.close,
            lambda: devices.frames.set_region(64, 64),
        ],
        "sync_box": [
            devices.sync.read_pulses, devices.sync.stop, devices.sync.close,
            lambda: devices.sync.start(100.0, 1),
        ],
    }[device]  # fmt: skip


@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera", "sync_box"])
def test_a_device_that_is_gone_fails_every_call_and_no_other(device: str) -> None:
    devices = with_faults(
        {"kind": "device_gone", "device": device, "since": "trial", "at_s": 1.0, "seconds": 2.0}
    )
    devices.arm.connect()
    devices.begin_trial(1)
    devices.clock.wait(1.0)
    words = device.replace("_", " ")
    for call in calls(devices, device):
        with pytest.raises(RigError, match=f"{words}: does not answer") as caught:
            call()
        assert isinstance(caught.value, ArmFault) == (device == "arm")
    for other in {"arm", "event_camera", "frame_camera", "sync_box"} - {device}:
        for call in calls(devices, other):
            call()
    devices.clock.wait(2.0)
    for call in calls(devices, device):
        call()


def test_an_arm_without_its_cable_stands_still() -> None:
    devices = with_faults(
        {"kind": "device_gone", "device": "arm", "since": "trial", "at_s": 1.0, "seconds": 0.5}
    )
    devices.arm.connect()
    devices.begin_trial(1)
    with pytest.raises(ArmFault, match="does not answer"):
        go(devices, 0, 0, -50, 5.0, 0.3, lambda: None)
    devices.clock.wait(1.0)
    assert devices.world.plane.sensor(devices.arm.pose())[2] == pytest.approx(-55.0)
    assert devices.arm.state() is ArmState.READY


def test_a_box_without_power_does_not_tick() -> None:
    devices = with_faults(
        {"kind": "device_gone", "device": "sync_box", "at_s": 1.0, "seconds": 0.5}
    )
    devices.begin_trial(1)
    devices.frames.start()
    devices.sync.start(100.0, 1)
    devices.clock.wait(2.0)
    assert len(devices.frames.read().number) == 100
    assert devices.sync.read_pulses().t_ns.max() < 1_000_000_000
    devices.sync.start(100.0, 1)
    devices.clock.wait(1.0)
    assert len(devices.frames.read().number) > 95


def test_a_full_disk_stays_full_for_the_trial() -> None:
    class Sink:
        written = 0

        def add_frames(self, chunk: Any) -> None:
            self.written += 1

    devices = with_faults({"kind": "disk_full", "since": "trial", "at_s": 1.0, "trial": 1})
    devices.begin_trial(1)
    bare = Sink()
    sink: Any = devices.sink(bare)  # type: ignore[arg-type]
    sink.add_frames(None)
    devices.clock.wait(1.0)
    for _ in range(2):
        with pytest.raises(OSError, match="No space left") as caught:
            sink.add_frames(None)
        assert caught.value.errno == errno.ENOSPC
    assert bare.written == 1
    devices.begin_trial(2)
    assert devices.sink(bare) is bare  # type: ignore[arg-type]


# -- how they are written ------------------------------------------------------------------


def test_faults_belong_to_their_trial() -> None:
    devices = with_faults({"kind": "frames_lost", "trial": 2, "at_s": 1.0, "count": 3})
    first, second, third = (slide(devices, seed=3, distance=1.5) for _ in range(3))
    assert len(second.frames["number"]) == len(first.frames["number"]) - 3
    assert len(third.frames["number"]) == len(first.frames["number"])


@pytest.mark.parametrize(
    ("fault", "key", "said"),
    [
        ({"kind": "frames_lots"}, "mock.faults[1].kind", "must be one of"),
        ({"count": 3}, "mock.faults[1].kind", "must be one of"),
        ({"kind": "frames_lost", "seconds": 3}, "mock.faults[1].seconds", "known here: trial"),
        ({"kind": "frames_lost", "cuont": 3}, "mock.faults[1].cuont", "did you mean 'count'"),
        ({"kind": "pulses_late", "device": "frame_camera"}, "mock.faults[1].device", "'sync_box'"),
        ({"kind": "clock_drift", "device": "arm"}, "mock.faults[1].ppm", "is missing"),
        ({"kind": "event_gap", "seconds": 0}, "mock.faults[1].seconds", "greater than 0"),
        ({"kind": "papilla_torn", "papilla": 19}, "mock.faults[1].papilla", "from 0 (the centre)"),
        ({"kind": "marker_occluded"}, "mock.faults[1]", "needs either a papilla"),
        (
            {"kind": "arm_protective_stop", "at_s": 1, "at_mm": 2}, "mock.faults[1]",
            "needs a time (at_s) or a point (at_mm)",
        ),
        ({"kind": "plate_stuck", "at_s": 1}, "mock.faults[1].at_s", "unknown key"),
    ],
)  # fmt: skip
def test_a_wrong_fault_is_said_as_any_wrong_input(fault: Any, key: str, said: str) -> None:
    data = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
    data["mock"]["faults"] = [{"kind": "event_gap"}, fault]
    with pytest.raises(InputError) as caught:
        validate(RigFile, data, "mock.yaml")
    assert caught.value.file == "mock.yaml"
    assert caught.value.key == key
    assert said in caught.value.expected


def test_every_kind_is_documented_with_its_parameters() -> None:
    from typing import get_args

    from rigs.mock.fault_settings import AnyFault

    text = Path(ROOT / "docs" / "faults.md").read_text()
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    assert set(rows) == set(KINDS)
    common = {"kind", "trial", "at_s", "since"}
    for model in get_args(AnyFault):
        kind = get_args(model.model_fields["kind"].annotation)[0]
        for name in set(model.model_fields) - common:
            assert f"`{name}`" in rows[kind], f"{kind}: {name}"
