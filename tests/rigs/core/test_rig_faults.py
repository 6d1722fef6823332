"""Devices that go in the middle of a trial: the arm is stopped first, and all others after it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.protocols import load_plan
from sliplab.protocols.program import Dwell, Move, PlateStep, Position, Program, Step
from sliplab.rigs.build import build_rig
from sliplab.rigs.core import rig as rig_module
from sliplab.rigs.core.capabilities import (
    ArmFault,
    ArmState,
    Pose,
    PoseFault,
    Progress,
    RigError,
    Segment,
)
from sliplab.rigs.core.motion_watch import RestWatch, seen_at_rest
from sliplab.rigs.core.plate_frame import turned_about_z
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.streams import NullSink
from tests.conftest import ROOT
from tests.patching import loose, put
from tests.rigs.core.test_rig import Memory, after_the_stop, make_rig, run, short_plan, watched

STOPS = ["arm.stop", "events.stop", "frames.stop", "sync.stop"]


def gone(device: str) -> dict[str, Any]:
    return {"kind": "device_gone", "device": device, "at_s": 0.8}


@pytest.fixture
def rig() -> Any:
    """The shipped mock rig."""
    return make_rig()


@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera", "sync_box"])
def test_whichever_device_goes_the_others_are_stopped_in_order(device: str) -> None:
    rig = make_rig(faults=[gone(device)])
    notes = watched(rig)
    with pytest.raises(RigError, match="does not answer") as caught:
        run(rig, short_plan(), Memory())
    assert caught.value.device == device.replace("_", " ")
    calls = after_the_stop(notes)
    assert [call for call in calls if call in STOPS] == STOPS
    assert ("arm.start" in calls) == (device != "arm")  # it retracts if it can
    notes.clear()
    rig.close()
    closed = [call for call in notes if call.endswith("close")]
    assert closed == ["arm.close", "events.close", "frames.close", "sync.close"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("disk full")])
def test_whoever_stops_the_rig_hears_that_the_arm_could_not_be(error: BaseException) -> None:
    """The arm goes while the third poll of the recording is written, which fails."""
    rig = make_rig(faults=[gone("arm")])
    sink = Memory(fail_after=3, error=error)
    wait = rig.clock.wait

    def slow_disk(chunk: Any) -> None:
        wait(1.0)
        raise error

    put(sink, "keep_events", slow_disk)
    notes = watched(rig)
    with pytest.raises(ArmFault, match="does not answer") as caught:
        run(rig, short_plan(), sink)
    assert caught.value.__cause__ is error
    assert [call for call in after_the_stop(notes) if call in STOPS] == STOPS


def test_a_device_that_comes_back_between_polls_has_lost_a_little() -> None:
    fault = {**gone("event_camera"), "seconds": 0.01, "at_s": 0.85}
    rig, sound = make_rig(faults=[fault]), Memory()
    run(rig, short_plan(), sound)
    plain = Memory()
    run(make_rig(), short_plan(), plain)
    lost = len(plain.all("events t_us")) - len(sound.all("events t_us"))
    assert 0 < lost < 0.1 * len(plain.all("events t_us"))


@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera"])
def test_a_clock_that_begins_again_does_not_stop_a_trial(device: str) -> None:
    rig = make_rig(faults=[{"kind": "clock_restart", "device": device, "at_s": 0.2}])
    sink, plain = Memory(), Memory()
    hit, sound = run(rig, short_plan(), sink), run(make_rig(), short_plan(), plain)
    assert hit.truth["per_papilla_ns"] == sound.truth["per_papilla_ns"]
    stamps = {"arm": "arm pulses", "event_camera": "event pulses", "frame_camera": "frame times"}
    for name, stream in stamps.items():
        assert np.any(np.diff(sink.all(stream)) < 0) == (name == device)
        assert len(sink.all(stream)) == len(plain.all(stream))


class Unstoppable:
    """An arm that takes a stop and is never seen to stand still."""

    TEXT = "does not stop: press its emergency stop"

    def __init__(self, arm: Any) -> None:
        self._arm = arm
        self.asked = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def stop(self) -> None:
        self.asked += 1
        raise ArmFault("arm", self.TEXT)


def test_closing_says_that_the_arm_was_not_seen_to_stand_and_closes_all(rig: Any) -> None:
    notes = watched(rig)
    rig.arm = Unstoppable(rig.arm)
    ended: list[bool] = []
    rig.on_close = (lambda: ended.append(True),)
    with pytest.raises(ArmFault, match=Unstoppable.TEXT):
        rig.close()
    closed = [call for call in notes if call.endswith("close")]
    assert closed == ["arm.close", "events.close", "frames.close", "sync.close"]
    assert ended == [True]


def closed_while(error: BaseException, rig: Any) -> None:
    """Fail as a command would, and close the rig on the way out."""
    try:
        raise error
    finally:
        rig.close()


def test_closing_after_a_failure_says_both(rig: Any) -> None:
    rig.arm = Unstoppable(rig.arm)
    with pytest.raises(ArmFault, match=rf"{Unstoppable.TEXT} \(before that: sync box: is gone\)"):
        closed_while(RigError("sync box", "is gone"), rig)


def test_closing_says_nothing_twice(rig: Any) -> None:
    rig.arm = Unstoppable(rig.arm)
    with pytest.raises(ArmFault, match=Unstoppable.TEXT) as caught:
        run(rig, short_plan(), Memory(fail_after=3, error=OSError("disk full")))
    assert isinstance(caught.value.__cause__, OSError)
    asked = rig.arm.asked
    with pytest.raises(ArmFault) as again:
        closed_while(caught.value, rig)
    assert again.value is caught.value
    assert rig.arm.asked > asked  # it was tried again


def test_a_second_ctrl_c_does_not_keep_the_arm_from_being_stopped(rig: Any) -> None:
    stop, pressed = rig.arm.stop, iter([True, True])

    def interrupted() -> None:
        if next(pressed, False):
            raise KeyboardInterrupt
        stop()

    put(rig.arm, "stop", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(rig, short_plan(), Memory(fail_after=3, error=KeyboardInterrupt()))
    assert rig.arm.state() is ArmState.READY
    assert rig.plate_frame.position(rig.arm.pose().xyz_mm).depth_mm == pytest.approx(-5.0, abs=1e-6)


def test_ctrl_c_while_the_arm_moves_clear_stops_it(rig: Any) -> None:
    start, wait, clearing = rig.arm.start, rig.clock.wait, [False]

    def noted(path: Any) -> None:
        start(path)
        clearing[0] = failed[0]

    def interrupted(seconds: float) -> None:
        wait(seconds)
        if clearing[0]:
            clearing[0] = False
            raise KeyboardInterrupt

    failed = [False]
    sink = Memory(fail_after=3, error=OSError("disk full"))
    keep = sink.keep_events

    def full(chunk: Any) -> None:
        failed[0] = sink.calls >= 3
        keep(chunk)

    put(sink, "keep_events", full)
    rig.arm.start, rig.clock.wait = noted, interrupted  # type: ignore[method-assign]
    with pytest.raises(ArmFault, match=r"way out was interrupted at a depth of \d\.\d+ mm"):
        run(rig, short_plan(), sink)
    assert rig.arm.state() is ArmState.READY  # it stands, half-way clear


def test_an_arm_that_does_not_come_clear_is_told_of(rig: Any) -> None:
    """It is stopped by somebody on its way out: healthy, and still in contact."""
    start, failed = rig.arm.start, [False]

    def hindered(path: Any) -> None:
        start(path)
        if failed[0]:
            rig.arm.stop()

    def full(chunk: Any) -> None:
        failed[0] = True
        raise OSError("disk full")

    sink = Memory()
    put(sink, "keep_events", full)
    put(rig.arm, "start", hindered)
    with pytest.raises(ArmFault, match="did not come clear of the plate"):
        run(rig, short_plan(), sink)


def test_a_device_with_a_fault_of_its_own_does_not_keep_the_others(rig: Any) -> None:
    """Not every driver's library raises what the rig's interface allows."""

    def broken() -> None:
        raise ValueError("a library's own")

    put(rig.events, "stop", broken)
    notes: list[str] = []
    stop = rig.sync.stop
    rig.sync.stop = lambda: (notes.append("sync.stop"), stop())[1]  # type: ignore[method-assign, func-returns-value]
    with pytest.raises(OSError, match="disk full"):
        run(rig, short_plan(), Memory(fail_after=3, error=OSError("disk full")))
    assert notes == ["sync.stop"]


@pytest.mark.parametrize("device", ["arm", "event_camera"])
def test_a_plate_that_nobody_has_caught_is_told_of(device: str) -> None:
    """It hangs on the sensor while the recording runs, and falls when the arm moves clear."""
    plan = load_plan(ROOT / "protocols" / "pilot_gravity.yaml")
    rig = make_rig(faults=[gone(device)])
    assert rig.plate is not None
    mass = plan.mass_kg(plan.trials[0])
    rig.operator.ask("changeover", "Mount the plate.", f"{mass} kg")
    with pytest.raises(RigError, match=r"does not answer .*\. The plate was released .* catch it"):
        run(rig, plan, Memory())


def test_a_plate_that_was_caught_or_never_let_go_is_not_told_of() -> None:
    rig = make_rig(faults=[gone("event_camera")])
    with pytest.raises(RigError, match="does not answer") as caught:
        run(rig, short_plan(), Memory())
    assert "plate" not in str(caught.value)


SLIDE = Program(
    HOME := Position(0.0, 0.0, -2.0),
    (
        Move("approach", Position(-6.0, 0.0, -2.0), 10.0),
        Move("press", Position(-6.0, 0.0, 2.4), 2.0),
        Dwell("hold", 1.0, recorded=True),
        Move("slide", Position(6.0, 0.0, 2.4), 1.0, recorded=True),
        Move("release", HOME, 5.0),
    ),
)


def real(fault: str = "") -> Rig:
    """A rig that is watched as a real one, whose driver's method `fault` does nothing from now."""
    rig: Rig = make_rig()
    rig.simulation = None
    if fault:
        put(rig.arm, fault, lambda: None)
    return rig


def placed(rig: Rig, *way: Position) -> None:
    """Move the arm as a person does, without the program."""
    for place in way:
        rig.arm.start([Segment(rig.plate_frame.pose(place), 50.0)])
        while not rig.arm.progress().done:
            rig.clock.wait(0.01)


def sent_to(rig: Rig) -> list[Position]:
    """Note the places to which the arm is sent from now on."""
    places, start = list[Position](), rig.arm.start

    def noted(path: Any) -> None:
        places.append(rig.plate_frame.position(path[0].to.xyz_mm))
        start(path)

    put(rig.arm, "start", noted)
    return places


def in_slide(rig: Rig) -> bool:
    place = rig.position()
    return place.depth_mm > 2.39 and place.x_mm > -2.0


def interrupted_at(rig: Rig, *conditions: Callable[[], bool]) -> None:
    """Press Ctrl-C when each of the conditions holds, one after the other."""
    wait, left = rig.clock.wait, list(conditions)

    def interrupted(seconds: float) -> None:
        wait(seconds)
        if left and left[0]():
            left.pop(0)
            raise KeyboardInterrupt

    put(rig.clock, "wait", interrupted)


def test_an_arm_that_moves_on_after_its_stop_is_told_of() -> None:
    rig = real("stop")
    interrupted_at(rig, lambda: in_slide(rig))
    with pytest.raises(ArmFault, match="stopped twice, and moves on: press the emergency stop"):
        run_program(rig)


def test_an_arm_that_moves_while_it_should_rest_is_stopped() -> None:
    """Another program moves it within its limits while it rests in the hold."""
    rig = real()

    def intruder(step: Step) -> None:
        if step.phase == "hold":
            rig.arm.start([Segment(rig.plate_frame.pose(HOME), 50.0)])

    with pytest.raises(PoseFault, match=r"moved \d\.\d mm and 0\.0 deg while it should rest"):
        rig.run_trial(SLIDE, NullSink(), 1, None, 100, on_step=intruder)


def test_the_second_ctrl_c_during_the_stop_prevents_the_way_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = real()
    interrupted_at(rig, lambda: in_slide(rig), lambda: True)
    monkeypatch.setattr(rig_module, "_SAME_SIGNAL_S", 0.0)
    notes = watched(rig)
    with pytest.raises(ArmFault, match=r"at a depth of 2\.40 mm.*committed trial is kept"):
        run_program(rig)
    assert "arm.start" not in after_the_stop(notes)


def test_a_signal_that_is_passed_on_twice_does_not_prevent_the_way_out() -> None:
    rig = real()
    interrupted_at(rig, lambda: in_slide(rig), lambda: True)
    with pytest.raises(KeyboardInterrupt):
        run_program(rig)
    assert rig.position().depth_mm == pytest.approx(-2.0, abs=0.01)


@pytest.mark.parametrize("begin", ["begin_trial", "press"])
def test_an_arm_in_contact_leaves_the_plate_straight_out_first(begin: str) -> None:
    rig = real()
    placed(rig, Position(-8.0, 0.0, -3.0), Position(-8.0, 0.0, 2.4))
    places = sent_to(rig)
    if begin == "begin_trial":
        rig.begin_trial(HOME, 1)
    else:
        rig.press(1.0, 2.0, 2.0, 1)
    assert [round(number, 6) for number in (places[0].x_mm, places[0].depth_mm)] == [-8.0, -2.0]
    assert [round(number, 6) for number in (places[1].x_mm, places[1].depth_mm)] == [0.0, -2.0]


def test_the_way_out_keeps_the_turn_of_the_tool() -> None:
    rig = real()
    leaning = rig.plate_frame.pose(Position(0.0, 0.0, 1.0))
    leaning = replace(leaning, rotvec_deg=turned_about_z(leaning.rotvec_deg, 20.0))
    rig.arm.start([Segment(leaning, 50.0)])
    while not rig.arm.progress().done:
        rig.clock.wait(0.01)
    with pytest.raises(RuntimeError), rig.safely(HOME):
        raise RuntimeError
    assert rig.pose().rotvec_deg == pytest.approx(leaning.rotvec_deg, abs=1e-6)
    assert rig.position().depth_mm == pytest.approx(-2.0, abs=1e-6)


def test_the_arm_is_watched_while_a_person_moves_the_plate() -> None:
    rig = real()
    answered, moved, threads = threading.Event(), [], threading.active_count()

    class SlowPerson:
        def act(self, action: str, seconds: float) -> None:
            assert answered.wait(20.0)

        def mass_kg(self) -> float:
            return 0.2

    def pushed() -> bool:
        if threading.active_count() > threads and not moved:
            moved.append(True)
            rig.arm.start([Segment(rig.plate_frame.pose(HOME), 50.0)])
        return False

    rig.plate = SlowPerson()
    interrupted_at(rig, pushed)
    steps = (*SLIDE.steps[:2], PlateStep("plate", "release", 1.0), *SLIDE.steps[2:])
    try:
        with pytest.raises(ArmFault, match=r"while it should rest.*The plate was released"):
            rig.run_trial(Program(HOME, steps), NullSink(), 1, None, 100)
    finally:
        answered.set()


def test_what_the_plate_raises_in_its_thread_ends_the_trial() -> None:
    rig = real()

    class Refusing:
        def act(self, action: str, seconds: float) -> None:
            raise RigError("plate", "was not confirmed")

    rig.plate = loose(Refusing())
    steps = (*SLIDE.steps[:2], PlateStep("plate", "raise", 1.0), *SLIDE.steps[2:])
    with pytest.raises(RigError, match="plate: was not confirmed"):
        rig.run_trial(Program(HOME, steps), NullSink(), 1, None, 100)


def test_a_disk_that_blocks_while_the_arm_moves_ends_the_trial() -> None:
    rig = real()

    class Blocking(NullSink):
        def add(self, device: str, chunk: Any) -> None:
            if rig.position().x_mm > 0.0:
                rig.clock.wait(3.0)

    with pytest.raises(RigError, match=r"did not look at the moving arm for \d+\.\d s"):
        rig.run_trial(SLIDE, Blocking(), 1, None, 100)


def test_a_move_from_elsewhere_than_was_said_is_not_done() -> None:
    rig = real()
    placed(rig, Position(-5.0, 0.0, -2.0))
    with pytest.raises(PoseFault, match="reports the phase 'home' as finished"):
        rig.move(Move("home", HOME, 10.0), HOME)


def test_ctrl_c_while_a_device_is_closed_closes_the_others() -> None:
    rig, ended = real(), []

    def interrupted() -> None:
        raise KeyboardInterrupt

    put(rig.arm, "close", interrupted)
    rig.on_close = (lambda: ended.append("files"),)
    notes = watched(rig)
    with pytest.raises(KeyboardInterrupt):
        rig.close()
    closed = [call for call in notes if call.endswith("close")]
    assert closed == ["arm.close", "events.close", "frames.close", "sync.close"]
    assert ended == ["files"]


def noisy(rig: Rig, sd_mm: float) -> None:
    """Give poses the noise of a measurement."""
    rng, pose = np.random.default_rng(1), rig.arm.pose

    def measured() -> Pose:
        true = pose()
        x, y, z = (np.array(true.xyz_mm) + rng.normal(0.0, sd_mm, 3)).tolist()
        return Pose((x, y, z), true.rotvec_deg)

    put(rig.arm, "pose", measured)


@pytest.mark.parametrize("sd_mm", [0.0, 0.05, 0.08])
def test_noise_of_poses_is_no_motion_of_a_stopped_arm(sd_mm: float) -> None:
    for _ in range(5):
        rig = real()
        interrupted_at(rig, lambda rig=rig: in_slide(rig))
        noisy(rig, sd_mm)
        with pytest.raises(KeyboardInterrupt):
            run_program(rig)
        assert rig.position().depth_mm == pytest.approx(-2.0, abs=0.5)


def test_slow_motion_is_seen_after_a_stop_that_does_nothing() -> None:
    rig = real("stop")
    rig.arm.start([Segment(rig.plate_frame.pose(Position(5.0, 0.0, -2.0)), 0.3)])
    assert not seen_at_rest(rig.arm, rig.clock)


def test_an_arm_in_protective_stop_rests_whatever_its_path_says() -> None:
    rig = real()
    put(rig.arm, "progress", lambda: Progress(ArmState.PROTECTIVE_STOP, (), False))
    assert seen_at_rest(rig.arm, rig.clock)


def test_an_arm_may_brake_after_its_stop_and_then_has_to_rest() -> None:
    now_ns, away = [0], Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    watch = RestWatch(away, lambda: now_ns[0], coasts_mm=2.0)
    watch.look(replace(away, xyz_mm=(2.9, 0.0, 0.0)))
    now_ns[0] = 2_000_000_000
    watch.look(replace(away, xyz_mm=(2.9, 0.0, 0.0)))
    watch.look(replace(away, xyz_mm=(3.8, 0.0, 0.0)))
    with pytest.raises(PoseFault, match=r"moved 1\.1 mm and 0\.0 deg while it should rest"):
        watch.look(replace(away, xyz_mm=(4.0, 0.0, 0.0)))


def test_whoever_stops_a_trial_is_told_of_the_plate_that_hangs() -> None:
    rig = real()
    steps = (*SLIDE.steps[:2], PlateStep("plate", "release", 1.0), *SLIDE.steps[2:])
    interrupted_at(rig, lambda: rig.holds_plate)
    with pytest.raises(RigError, match=r"plate: the trial was stopped\. The plate was released"):
        rig.run_trial(Program(HOME, steps), NullSink(), 1, None, 100)


def test_a_small_clearance_is_not_clear() -> None:
    """The arm turns and slides only where the sensor cannot touch."""
    rig = real()
    placed(rig, Position(-8.0, 0.0, -3.0), Position(-8.0, 0.0, 1.0))
    places = sent_to(rig)
    rig.begin_trial(Position(0.0, 0.0, -0.05), 1)
    assert [round(place.depth_mm, 6) for place in places] == [-1.0, -0.05]
    assert [round(place.x_mm, 6) for place in places] == [-8.0, 0.0]


def test_closed_fingers_are_opened_before_the_way_home() -> None:
    rig = build_rig(load_rig_file(Path("mock-gripper"))[0])
    rig.connect()
    allowed = loose(rig.gripper).range
    loose(rig.gripper).move(rig.grip_opening_mm - 8.0, allowed.speed_mm_s[1], allowed.force_n[0])
    rig.clock.wait(5.0)
    rig.connect()
    placed(rig, Position(0.0, 0.0, -60.0))
    rig.begin_trial(HOME, 1)
    assert loose(rig.gripper).state().opening_mm == pytest.approx(rig.grip_opening_mm, abs=0.6)


def run_program(rig: Rig) -> None:
    rig.run_trial(SLIDE, NullSink(), 1, None, 100)
