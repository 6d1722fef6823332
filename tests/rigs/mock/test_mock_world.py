"""The devices together: one world, one virtual time, and bytes that only the trial decides."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest

from rigs.capabilities import (
    Arm,
    ArmFault,
    ArmState,
    Clock,
    EventCamera,
    FrameCamera,
    Operator,
    Plate,
    RigError,
    Segment,
    SyncBox,
)
from rigs.mock.devices import MockDevices, build_mock
from rigs.mock.settings import Fault, MockSettings
from rigs.mock.settings import FrameCamera as FrameSettings
from rigs.pulse_code import code_bits
from storage.clockmap import ClockMap

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
    return {
        field.name: np.concatenate([getattr(chunk, field.name) for chunk in chunks])
        for field in fields(chunks[0])
    }


def go(devices: MockDevices, x: float, y: float, depth: float, speed: float, step_s: float, each):
    devices.arm.start([Segment(devices.world.plane.pose(x, y, depth), speed)])
    while not devices.arm.progress().done:
        devices.clock.wait(step_s)
        each()


def slide(
    devices: MockDevices, seed: int, *, chunk_s: float = 0.5, distance: float = 4.0,
    speed: float = 2.0, depth: float = 2.6, rest_s: float = 0.4,
) -> Trial:  # fmt: skip
    """Press, hold, slide; streams are read every `chunk_s` seconds, whatever the motion does."""
    clock, arm, world = devices.clock, devices.arm, devices.world
    arm.connect()
    go(devices, 0, 0, -2, 50.0, 0.05, lambda: None)
    devices.begin_trial(seed)
    go(devices, 0, 0, depth, 4.0, 0.05, lambda: None)
    clock.wait(0.5)
    devices.frames.set_region(180, 180)
    arm.read_poses()
    devices.frames.start()
    devices.events.start()
    devices.sync.start(100.0, CODE)
    parts: dict[str, list[Any]] = {name: [] for name in ("e", "f", "p", "ep", "ap", "sp")}

    def read() -> None:
        parts["e"].append(devices.events.read())
        parts["f"].append(devices.frames.read())
        parts["p"].append(arm.read_poses())
        parts["ep"].append(devices.events.read_pulses())
        parts["ap"].append(arm.read_pulses())
        parts["sp"].append(devices.sync.read_pulses())

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
    return Trial(
        joined(parts["e"]), joined(parts["f"]), joined(parts["p"]),
        joined(parts["ep"])["t_ns"], joined(parts["ap"])["t_ns"], joined(parts["sp"])["t_ns"],
        devices.truth(start), start,
    )  # fmt: skip


def same(a: Trial, b: Trial) -> None:
    for stream in ("events", "frames", "poses"):
        first, second = getattr(a, stream), getattr(b, stream)
        for name, column in first.items():
            assert np.array_equal(column, second[name]), f"{stream}.{name}"
    for stream in ("event_pulses", "arm_pulses", "sync_pulses"):
        assert np.array_equal(getattr(a, stream), getattr(b, stream)), stream
    assert a.truth == b.truth


@pytest.fixture(scope="module")
def devices() -> MockDevices:
    return build_mock(SMALL)


@pytest.fixture(scope="module")
def trial(devices: MockDevices) -> Trial:
    return slide(devices, seed=11)


def test_devices_can_do_what_a_rig_needs(devices: MockDevices) -> None:
    for device, capability in (
        (devices.clock, Clock), (devices.arm, Arm), (devices.events, EventCamera),
        (devices.frames, FrameCamera), (devices.sync, SyncBox), (devices.plate, Plate),
        (devices.operator, Operator),
    ):  # fmt: skip
        assert isinstance(device, capability)


def test_a_trial_depends_on_settings_seed_and_program_alone(trial: Trial) -> None:
    fresh = build_mock(SMALL)
    slide(fresh, seed=5, distance=1.0)
    slide(fresh, seed=6, distance=0.5, depth=3.0)
    same(slide(fresh, seed=11), trial)


@pytest.mark.parametrize("chunk_s", [0.0021, 0.033, 30.0])
def test_chunks_do_not_matter(devices: MockDevices, trial: Trial, chunk_s: float) -> None:
    same(slide(devices, seed=11, chunk_s=chunk_s), trial)


def test_another_seed_is_another_trial_on_the_same_rig(devices: MockDevices, trial: Trial) -> None:
    other = slide(devices, seed=12)
    assert other.truth["incipient_ns"] != trial.truth["incipient_ns"]
    assert abs(other.events["t_us"][0] - trial.events["t_us"][0]) > 1_000_000
    assert len(other.frames["number"]) == len(trial.frames["number"])


def test_another_rig_has_another_skin(trial: Trial) -> None:
    other = build_mock(SMALL.model_copy(update={"seed": 2}))
    assert not np.array_equal(other.world.skin.gap_mm, build_mock(SMALL).world.skin.gap_mm)


def test_streams_have_the_shapes_and_types_of_the_contract(trial: Trial) -> None:
    n = len(trial.events["t_us"])
    assert n > 10_000
    assert [trial.events[k].dtype for k in ("x", "y", "p", "t_us")] == [
        np.uint16, np.uint16, np.uint8, np.int64,
    ]  # fmt: skip
    assert np.all(np.diff(trial.events["t_us"]) >= 0)
    assert trial.events["x"].max() < 640
    assert trial.events["y"].max() < 480
    assert set(trial.events["p"].tolist()) == {0, 1}
    images = trial.frames["images"]
    assert images.shape == (len(trial.frames["number"]), 180, 180)
    assert images.dtype == np.uint8
    assert trial.frames["number"].tolist() == list(range(len(images)))
    assert trial.poses["xyz_mm"].shape == (len(trial.poses["t_ns"]), 3)
    assert np.all(np.diff(trial.poses["t_ns"]) == 2_000_000)
    assert np.all(trial.poses["t_ns"] % 2_000_000 == 0)
    assert np.all(trial.event_pulses % 1000 == 0)


def test_frames_carry_the_code_of_their_tick(trial: Trial) -> None:
    assert np.array_equal(trial.frames["sync"], code_bits(CODE, len(trial.frames["sync"])))
    spacing = np.diff(trial.frames["t_ns"])
    assert spacing.mean() == pytest.approx(10_000_000, rel=1e-4)
    assert spacing.std() < 5_000


def test_every_device_sees_the_same_pulses_on_its_own_clock(
    devices: MockDevices, trial: Trial
) -> None:
    bits = code_bits(CODE, len(trial.frames["sync"]))
    count = int(bits.sum())
    expected = np.flatnonzero(bits) * 10_000_000
    assert np.array_equal(trial.sync_pulses[:count], expected)
    for pulses, limit_ppm in ((trial.event_pulses, 45), (trial.arm_pulses, 65)):
        assert len(pulses) == len(trial.sync_pulses)
        drift = np.polyfit(expected, (pulses - pulses[0])[:count] - expected, 1)[0]
        assert abs(drift) < limit_ppm * 1e-6
        residual = (pulses - pulses[0])[:count] - expected * (1 + drift)
        assert residual.std() == pytest.approx(2_000, rel=0.4)


def test_clocks_count_from_other_days(trial: Trial) -> None:
    starts = [
        trial.events["t_us"][0] * 1000, trial.frames["t_ns"][0], trial.poses["t_ns"][0],
    ]  # fmt: skip
    assert min(starts) > 1_000_000_000
    assert min(abs(a - b) for a in starts for b in starts if a is not b) > 1_000_000_000


def test_poses_say_where_the_arm_was(devices: MockDevices, trial: Trial) -> None:
    xyz = trial.poses["xyz_mm"]
    way = np.linalg.norm(xyz[-1] - xyz[0])
    assert way == pytest.approx(4.0, abs=0.02)
    speed = np.linalg.norm(xyz[500:1000:100] - xyz[400:900:100], axis=1) / 0.2
    assert speed == pytest.approx(np.full(5, 2.0), rel=1e-2)
    assert np.all(trial.poses["host_ns"] > 0)
    assert np.all(np.diff(trial.poses["host_ns"]) > 0)


def test_the_picture_shows_slip_when_the_truth_says_so(devices: MockDevices, trial: Trial) -> None:
    images = trial.frames["images"].astype(float) - 25
    images[images < 40] = 0
    limit = trial.truth["threshold_mm"] * 4.0
    times = np.arange(len(images)) * 10_000_000 + 1_000_000
    first = int(np.searchsorted(times, trial.truth["reference_ns"]))
    found = []
    for place in devices.world.skin.layout_mm[7:]:
        # an outer tip's slip at first stays within a window that its neighbours do not reach
        column, row = 89.5 + 4 * place[0], 89.5 - 4 * place[1]
        ys, xs = np.mgrid[int(row) - 10 : int(row) + 12, int(column) - 10 : int(column) + 12]
        window = images[:, ys, xs]
        centre = (window * xs).sum((1, 2)) / window.sum((1, 2))
        moved = centre - centre[first - 3 : first + 1].mean()
        found.append(times[np.argmax(moved > limit)])
    assert min(found) == pytest.approx(trial.truth["incipient_ns"], abs=15_000_000)


def test_truth_is_in_order_and_on_the_sync_clock(trial: Trial) -> None:
    truth = trial.truth
    assert truth["simulated"] is True
    assert truth["reference_ns"] == pytest.approx(400_000_000, rel=1e-4)
    assert truth["first_slip_ns"] < truth["incipient_ns"] <= min(truth["per_papilla_ns"][1:])
    assert truth["gross_ns"] == truth["per_papilla_ns"][0]
    for slip, seen in zip(truth["slip_per_papilla_ns"], truth["per_papilla_ns"], strict=True):
        assert slip is None or seen is None or slip < seen


def test_waiting_backwards_is_refused(devices: MockDevices) -> None:
    for seconds in (-1.0, float("nan")):
        with pytest.raises(ValueError, match="seconds"):
            devices.clock.wait(seconds)


def test_the_arm_reports_its_segments_as_they_end() -> None:
    devices = build_mock(SMALL)
    with pytest.raises(ArmFault, match="disconnected"):
        devices.arm.start([])
    devices.arm.connect()
    pose = devices.world.plane.pose
    devices.arm.start([Segment(pose(0, 0, -50), 10.0), Segment(pose(5, 0, -50), 5.0)])
    assert devices.arm.state() is ArmState.MOVING
    with pytest.raises(RigError, match="moving"):
        devices.arm.start([])
    devices.clock.wait(1.5)
    progress = devices.arm.progress()
    assert len(progress.finished) == 1
    assert not progress.done
    start, end = progress.finished[0]
    assert end - start == pytest.approx(1e9, rel=1e-4)
    devices.clock.wait(0.5)
    progress = devices.arm.progress()
    assert progress.done
    assert progress.finished[1][0] == progress.finished[0][1]
    assert devices.arm.now_ns() == progress.finished[1][1]
    assert devices.arm.pose().xyz_mm == pytest.approx(pose(5, 0, -50).xyz_mm)
    devices.arm.start([Segment(pose(0, 0, -50), 5.0)])
    devices.clock.wait(0.5)
    devices.arm.stop()
    devices.arm.stop()
    assert devices.arm.state() is ArmState.READY
    assert devices.arm.pose().xyz_mm == pytest.approx(pose(2.5, 0, -50).xyz_mm)
    assert devices.arm.progress().finished == ()


def test_a_tool_that_looks_away_is_refused_near_the_plate() -> None:
    devices = build_mock(SMALL)
    devices.arm.connect()
    place = devices.world.plane.pose(0, 0, 0)
    with pytest.raises(ArmFault, match="turned"):
        devices.arm.start([Segment(type(place)(place.xyz_mm, (0.0, 0.0, 0.0)), 5.0)])


def test_a_trial_does_not_begin_in_motion() -> None:
    devices = build_mock(SMALL)
    devices.arm.connect()
    devices.arm.start([Segment(devices.world.plane.pose(0, 0, -50), 1.0)])
    with pytest.raises(RigError, match="moving"):
        devices.begin_trial(1)


def test_the_operator_mounts_a_mass_and_clears_a_stop() -> None:
    devices = build_mock(SMALL)
    assert devices.operator.ask("changeover", "Mount the plate.", "0.245 kg")
    assert devices.plate.mass_kg() == 0.245
    assert devices.operator.ask("clean", "Clean the skin.", "")
    assert devices.plate.mass_kg() == 0.245
    with pytest.raises(RigError, match="expected such as"):
        devices.operator.ask("changeover", "Mount the plate.", "heavy")
    assert [asked.task for asked in devices.operator.asked] == ["changeover", "clean", "changeover"]


def fault(**settings: Any) -> MockDevices:
    return build_mock(SMALL.model_copy(update={"faults": (Fault(**settings),)}))


def test_a_protective_stop_holds_the_arm_until_a_person_clears_it() -> None:
    devices = fault(kind="arm_protective_stop", trial=1, at_s=0.7)
    trial = slide(devices, seed=11)
    assert devices.arm.state() is ArmState.PROTECTIVE_STOP
    # 0.3 s of sliding at 2 mm/s after 0.4 s of rest
    where = devices.world.plane.sensor(devices.arm.pose())
    assert where[0] == pytest.approx(0.6, abs=1e-6)
    assert len(trial.frames["number"]) > 250
    pose = devices.world.plane.pose(0, 0, -5)
    devices.arm.stop()
    with pytest.raises(ArmFault, match="protective stop"):
        devices.arm.start([Segment(pose, 5.0)])
    devices.operator.ask("protective_stop", "Clear it.", "")
    devices.arm.start([Segment(pose, 5.0)])
    devices.clock.wait(5.0)
    slide(devices, seed=11)
    assert devices.arm.state() is ArmState.READY


def test_lost_frames_leave_a_gap_in_the_counter(trial: Trial) -> None:
    lost = slide(fault(kind="frames_lost", at_s=1.0, count=3), seed=11)
    missing = set(range(int(lost.frames["number"][-1]) + 1)) - set(lost.frames["number"].tolist())
    assert missing == {100, 101, 102} or missing == {101, 102, 103}
    kept = np.isin(trial.frames["number"], lost.frames["number"])
    assert np.array_equal(trial.frames["images"][kept], lost.frames["images"])
    assert np.array_equal(trial.frames["sync"][kept], lost.frames["sync"])


@pytest.mark.parametrize("device", ["event_camera", "arm"])
def test_lost_pulses_are_lost_on_one_device(trial: Trial, device: Any) -> None:
    lost = slide(fault(kind="pulses_lost", at_s=1.0, count=4, device=device), seed=11)
    pairs = {
        "event_camera": (trial.event_pulses, lost.event_pulses),
        "arm": (trial.arm_pulses, lost.arm_pulses),
    }
    for name, (full, less) in pairs.items():
        assert len(full) - len(less) == (4 if name == device else 0)
        assert np.all(np.isin(less, full))


def test_an_event_gap_is_silent(trial: Trial) -> None:
    gap = slide(fault(kind="event_gap", at_s=0.9, seconds=0.3), seed=11)
    t_us = gap.events["t_us"]
    assert np.diff(t_us).max() >= 299_000
    assert np.all(np.isin(t_us, trial.events["t_us"]))


def test_faults_belong_to_their_trial() -> None:
    devices = fault(kind="frames_lost", trial=2, at_s=1.0, count=3)
    first, second, third = (slide(devices, seed=3) for _ in range(3))
    assert len(second.frames["number"]) == len(first.frames["number"]) - 3
    assert len(third.frames["number"]) == len(first.frames["number"])


def test_times_near_2_to_the_53_stay_distinct() -> None:
    clock = ClockMap(0, (1 << 53) - 2, 50_000)
    times = clock.to_reference(np.arange(5, dtype=np.int64))
    assert np.diff(times).tolist() == [1, 1, 1, 1]


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


def test_a_gravity_trial_slips_then_falls_and_comes_again_the_same() -> None:
    devices = build_mock(SMALL)
    first = gravity(devices, 5)
    assert first["first_slip_ns"] < first["incipient_ns"] < first["gross_ns"]
    lead_s = (first["gross_ns"] - first["incipient_ns"]) * 1e-9
    assert 0.4 < lead_s < 2.0
    marker = first["images"][:, 5:45, 130:175]
    assert marker[0].max() > 150  # the ArUco marker stands in its corner
    assert not np.array_equal(marker[0] > 100, marker[-1] > 100)
    height = devices.world.track.rows(0, devices.world.track.end)[:, 57]
    assert height.min() == pytest.approx(-25.0)
    again = gravity(devices, 5)
    assert np.array_equal(first["images"], again["images"])
    assert np.array_equal(first["events"].t_us, again["events"].t_us)
    assert first["per_papilla_ns"] == again["per_papilla_ns"]


def test_catching_stops_the_plate_where_it_is() -> None:
    devices = build_mock(SMALL)
    devices.begin_trial(1)
    devices.plate.act("raise", 0.0)
    devices.plate.act("release", 0.0)
    devices.clock.wait(0.03)
    devices.plate.act("catch", 0.0)
    devices.clock.wait(1.0)
    devices.world.advance()
    height = devices.world.track.rows(0, devices.world.track.end)[:, 57]
    assert height[-1] == height[31]
    assert height[-1] == pytest.approx(-0.5 * 9810 * 0.03**2, rel=0.1)
    devices.plate.act("raise", 0.5)
    devices.clock.wait(1.0)
    devices.world.advance()
    assert devices.world.track.rows(0, devices.world.track.end)[-1, 57] == 0.0
