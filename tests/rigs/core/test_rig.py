"""The rig runs a trial, and stops in order: arm first, then cameras."""

from __future__ import annotations

import copy
import gc
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.protocols import Plan, Protocol, load_plan, make_plan
from sliplab.protocols.maintenance import Rezero
from sliplab.protocols.yaml_file import parse_yaml, validate
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, RigError
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.pose import angle_deg
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.rigs.core.surface_search import rezero, touch_off
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.streams import (
    Chunk,
    EventChunk,
    FrameChunk,
    NullSink,
    PoseChunk,
    WrenchChunk,
)
from tests.conftest import ROOT, SMALL

RIG: dict[str, Any] = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
FRAME_PX = (256, 256)


NAMES = {
    ("events", "pulses"): "event pulses",
    ("arm", "pulses"): "arm pulses",
    ("sync_box", "pulses"): "sync pulses",
    ("sync_box", "exposures"): "exposures",
    ("sync_box", "reads"): "box reads",
    ("frames", "reads"): "frame camera reads",
}


class Memory:
    """A sink that keeps everything, and can be asked to fail."""

    def __init__(self, fail_after: int | None = None, error: BaseException | None = None) -> None:
        self.parts: dict[str, list[np.ndarray]] = {}
        self.calls = 0
        self.fail_after, self.error = fail_after, error

    def _keep(self, name: str, values: np.ndarray) -> None:
        self.parts.setdefault(name, []).append(values)

    def add(self, device: str, chunk: Chunk) -> None:
        if isinstance(chunk, EventChunk):
            self.keep_events(chunk)
        elif isinstance(chunk, PoseChunk):
            self._keep("pose times", chunk.t_ns)
            self._keep("poses", chunk.xyz_mm)
        elif isinstance(chunk, FrameChunk):
            self._keep("frame numbers", chunk.number)
            self._keep("frame times", chunk.t_ns)
            self._keep("frames", chunk.images)
        elif isinstance(chunk, WrenchChunk):
            self._keep(f"{device} times", chunk.t_ns)
            self._keep(f"{device} forces", chunk.force_n)
        else:
            self._keep(NAMES[device, chunk.KIND.name], chunk.times)

    def keep_events(self, chunk: EventChunk) -> None:
        self.calls += 1
        if self.fail_after is not None and self.calls > self.fail_after:
            assert self.error is not None
            raise self.error
        for name in ("x", "y", "p", "t_us"):
            self._keep(f"events {name}", getattr(chunk, name))

    def all(self, name: str) -> np.ndarray:
        return np.concatenate(self.parts[name])


def short_plan() -> Plan:
    """Slides of 2 mm after half a second of holding."""
    data = copy.deepcopy(SMALL)
    data["collection"]["motion"][2] = {"phase": "hold", "settle": "0.2 s", "duration": "0.5 s"}
    data["collection"]["motion"][3]["distance"] = "2 mm"
    return make_plan(validate(Protocol, data, "test"), "test")


def make_rig(**mock: Any) -> Rig:
    """The shipped mock rig with other mock settings."""
    rig = build_rig(validate(RigFile, {**RIG, "mock": {**RIG["mock"], **mock}}, "test"))
    rig.connect()
    return rig


def run(rig: Rig, plan: Plan, sink: Memory, seed: int = 7) -> Any:
    """The first trial of a plan."""
    return rig.run_trial(plan.program(plan.trials[0]), sink, seed, FRAME_PX, 100)


@pytest.fixture
def rig() -> Rig:
    """The shipped mock rig."""
    return make_rig()


def test_streams_hold_the_recorded_part_in_order() -> None:
    rig, plan, sink = make_rig(), short_plan(), Memory()
    done = run(rig, plan, sink)
    recorded = plan.seconds(plan.trials[0], recorded_only=True)
    start, end = done.recorded_ns
    assert (end - start) / 1e9 == pytest.approx(recorded, rel=2e-3)
    for name in ("events t_us", "event pulses", "arm pulses", "sync pulses", "pose times"):
        times = sink.all(name)
        assert len(times)
        assert np.all(np.diff(times) >= 0)
    numbers = sink.all("frame numbers")
    assert np.array_equal(numbers, np.arange(len(numbers)))
    assert abs(len(numbers) - recorded * 100) <= 2
    assert sink.all("frames").shape == (len(numbers), 256, 256)
    span = np.ptp(sink.all("events t_us")) / 1e6
    assert span >= recorded - 0.01
    assert [step.phase for step, kept in done.steps if kept] == ["hold", "slide"]


def test_a_trial_depends_on_nothing_that_ran_before() -> None:
    plan = short_plan()
    first, second = Memory(), Memory()
    run(make_rig(), plan, first)
    other = make_rig()
    other.press(2.0, 2.0, 5.0, 2)
    run(other, plan, Memory(), seed=99)
    other.plate_frame = other.plate_frame.with_zero(0.0)
    run(other, plan, second)
    for name in first.parts:
        assert np.array_equal(first.all(name), second.all(name)), name


@pytest.mark.parametrize(
    ("timing", "streams"),
    [
        ({}, set()),
        ({"frames": "exposure line"}, {"exposures"}),
        ({"frames": "device time stamps"}, {"box reads", "frame camera reads"}),
        ({"frames": "host arrival"}, {"box reads"}),
        ({"arm": "host time"}, {"box reads"}),
    ],
)
def test_what_is_read_besides_is_what_the_timing_needs(timing: Any, streams: set[str]) -> None:
    data = {**RIG, "timing": timing, "mock": {"frame_camera": {"level": "tracks"}}}
    rig = build_rig(validate(RigFile, data, "test"))
    rig.connect()
    sink = Memory()
    run(rig, short_plan(), sink)
    possible = {"exposures", "box reads", "frame camera reads"}
    assert possible & set(sink.parts) == streams
    for name in streams & {"box reads", "frame camera reads"}:
        times = sink.all(name)
        assert len(times) >= 8  # one a poll
        assert np.all(np.diff(times) > 0)
    assert (len(sink.all("arm pulses")) > 0) == ("arm" not in timing)
    if "exposures" in streams:
        assert len(sink.all("exposures")) >= len(sink.all("frame numbers"))


def test_the_box_is_started_with_the_rigs_code() -> None:
    rig = build_rig(validate(RigFile, {**RIG, "timing": {"code": "regular"}}, "test"))
    rig.connect()
    sink = Memory()
    rig.listen(0.6, sink, 100)
    gaps = np.diff(sink.all("sync pulses"))
    assert gaps[0] == 160_000_000
    assert np.all(gaps[1:] == 20_000_000)


class Journal:
    """Notes every call of a device, and hands it on."""

    def __init__(self, name: str, device: Any, notes: list[str]) -> None:
        self._name, self._device, self._notes = name, device, notes

    def __getattr__(self, attribute: str) -> Any:
        found = getattr(self._device, attribute)
        if not callable(found):
            return found

        def call(*args: Any) -> Any:
            self._notes.append(f"{self._name}.{attribute}")
            return found(*args)

        return call


def watched(rig: Rig) -> list[str]:
    """Replace the rig's devices by journals; returns the notes."""
    notes: list[str] = []
    for name in ("arm", "event_camera", "frame_camera", "sync"):
        said = {"event_camera": "events", "frame_camera": "frames"}.get(name, name)
        setattr(rig, name, Journal(said, getattr(rig, name), notes))
    return notes


def after_the_stop(notes: list[str]) -> list[str]:
    """The calls from the last arm.stop on."""
    return notes[len(notes) - 1 - notes[::-1].index("arm.stop") :]


def test_a_protective_stop_leaves_the_arm_where_it_is() -> None:
    rig = make_rig(faults=[{"kind": "arm_protective_stop", "at_s": 1.0}])
    notes = watched(rig)
    with pytest.raises(ArmFault, match="protective stop in the phase 'slide'"):
        run(rig, short_plan(), Memory())
    calls = after_the_stop(notes)
    assert "arm.start" not in calls
    assert calls.index("arm.stop") < calls.index("events.stop") < calls.index("sync.stop")
    assert rig.arm.state() is ArmState.PROTECTIVE_STOP
    with pytest.raises(ArmFault, match="protective stop"):
        run(rig, short_plan(), Memory())
    assert rig.arm.state() is ArmState.PROTECTIVE_STOP


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("disk full")])
def test_on_any_failure_the_arm_stops_first_and_a_healthy_one_retracts(error: Any) -> None:
    rig = make_rig()
    notes = watched(rig)
    with pytest.raises(type(error)):
        run(rig, short_plan(), Memory(fail_after=3, error=error))
    calls = after_the_stop(notes)
    assert calls.index("arm.start") < calls.index("events.stop")
    assert rig.plate_frame.position(rig.arm.pose().xyz_mm).depth_mm == pytest.approx(-5.0, abs=1e-6)
    assert rig.arm.state() is ArmState.READY


def test_a_stop_request_is_looked_at_in_the_motion(rig: Rig) -> None:
    looks = iter([False] * 12)
    rig.should_stop = lambda: next(looks, True)
    with pytest.raises(StopRequested):
        run(rig, short_plan(), Memory())
    rig.should_stop = lambda: False
    assert rig.plate_frame.position(rig.arm.pose().xyz_mm).depth_mm <= -5.0 + 1e-6


def test_touching_off_finds_the_surface(rig: Rig) -> None:
    found = [touch_off(rig, 0.5, 1.5, seed) for seed in range(1, 5)]
    assert np.abs(found).max() < 0.06  # the taught plane is the true one; depth steps are 0.2 mm
    assert rig.plate_frame.zero_mm == found[-1]


def test_touching_off_finds_a_surface_that_was_taught_wrong(rig: Rig) -> None:
    origin, axes = rig.plate_frame.origin - 0.5 * rig.plate_frame.axes[2], rig.plate_frame.axes
    rig.plate_frame = PlateFrame(origin, axes)
    assert touch_off(rig, 0.5, 1.5, 1) == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("speed", [1.01, 50.0, float("nan")])
def test_touching_off_creeps(rig: Rig, speed: float) -> None:
    notes = watched(rig)
    with pytest.raises(RigError, match="touches off at 1 mm/s at most"):
        touch_off(rig, speed, 1.5, 1)
    assert notes == []


FAR_CAMERA: dict[str, Any] = {
    "event_camera": {"px_per_mm": 11.0, "growth_mm_per_n": 0.31, "contrast": 1.74, "edge_px": 0.68},
    "scene": {"skin": {"youngs_modulus_mpa": 0.57, "base_normal_n_per_m": 144.0}},
}
"""A soft skin, faint markers and a camera so far off that a touch makes a third of the events."""


REZERO = {"every": 48, "speed": "0.5 mm/s", "search": "1.5 mm"}


@pytest.mark.long
def test_touching_off_finds_a_touch_that_shows_in_few_events() -> None:
    rig = make_rig(**FAR_CAMERA)
    found = [touch_off(rig, 0.5, 1.5, seed) for seed in range(1, 7)]
    assert min(found) > 0.0  # such a skin is noticed deeper than at the shipped `touch_depth`
    assert max(found) < 0.4


@pytest.mark.long
def test_depth_zero_is_the_mean_of_as_many_touches_as_asked_for() -> None:
    """Of three touches it is within four standard errors of the mean of 9 others."""
    rig = make_rig(**FAR_CAMERA)
    others = [touch_off(rig, 0.5, 1.5, seed) for seed in range(100, 109)]
    asked = Rezero.model_validate({**REZERO, "touches": 3})
    found = rezero(rig, asked, 1)
    assert rig.plate_frame.zero_mm == found.mm
    assert found.sd_mm == pytest.approx(np.std(others, ddof=1), rel=1.0)
    error = float(np.std(others, ddof=1)) * (1 / 3 + 1 / 9) ** 0.5
    assert found.mm == pytest.approx(np.mean(others), abs=4 * error)
    assert rezero(rig, asked, 1) == found  # by its seed
    assert rezero(rig, asked, 2) != found


def test_one_touch_is_what_it_was(rig: Rig) -> None:
    found = rezero(rig, Rezero.model_validate(REZERO), 3)
    assert (found.mm, found.sd_mm) == (touch_off(rig, 0.5, 1.5, 3), None)


@pytest.mark.long
def test_touching_off_in_much_noise_finds_the_surface_nevertheless() -> None:
    """In 50 ms nothing shows with the first of these seeds, and too late with the others."""
    rig = make_rig(event_camera={"noise_hz": 0.1})
    assert np.abs([touch_off(rig, 0.5, 1.5, seed) for seed in (1037, 1064, 1128)]).max() < 0.1


def test_touching_off_goes_no_deeper_than_its_limit(rig: Rig) -> None:
    rig.plate_frame = PlateFrame(
        rig.plate_frame.origin - 5.0 * rig.plate_frame.axes[2], rig.plate_frame.axes
    )
    with pytest.raises(RigError, match=r"within 1.5 mm of the taught plane; teach"):
        touch_off(rig, 0.5, 1.5, 1)
    assert rig.plate_frame.position(rig.arm.pose().xyz_mm).depth_mm <= -1.5 + 1e-6


def test_a_stop_while_touching_off_is_not_blamed_on_the_plane() -> None:
    rig = make_rig(
        faults=[{"kind": "arm_protective_stop", "trial": 1, "at_s": 1.0, "since": "trial"}]
    )
    notes = watched(rig)
    with pytest.raises(ArmFault, match="protective stop in the phase 'touching off'"):
        touch_off(rig, 0.5, 1.5, 1)
    assert notes.index("arm.stop") < notes.index("events.stop")
    assert rig.plate_frame.zero_mm == 0.0


def test_a_plate_that_is_not_there_cannot_be_moved() -> None:
    from sliplab.protocols import load_plan

    rig = make_rig()
    rig.plate = None
    plan = load_plan(ROOT / "protocols" / "pilot_gravity.yaml")
    with pytest.raises(RigError, match="no sliding plate to raise"):
        run(rig, plan, Memory())


def test_a_twist_that_is_stopped_comes_straight_out_and_turns_back_in_the_next_trial() -> None:
    plan, rig = load_plan(Path("press_twist")), make_rig()
    program = plan.program(plan.trials[0])
    straight = rig.plate_frame.pose(program.home).rotvec_deg
    rig.should_stop = lambda: rig._twisted and rig.position().depth_mm > 0
    with pytest.raises(StopRequested):
        rig.run_trial(program, Memory(), 7, None, 100)
    rig.should_stop = lambda: False
    stood = rig.arm.pose()
    assert rig.position().depth_mm == pytest.approx(program.home.depth_mm, abs=1e-6)
    begun = angle_deg(stood, Pose(stood.xyz_mm, straight))
    assert 0 < begun < 40
    done = rig.run_trial(program, Memory(), 7, None, 100)
    assert [step.phase for step, kept in done.steps if kept] == ["hold", "twist"]
    assert angle_deg(rig.arm.pose(), Pose(stood.xyz_mm, straight)) < 1e-6


@pytest.mark.quick(1)
@pytest.mark.parametrize("name", [name for name in shipped_rigs() if name.startswith("mock")])
def test_a_simulated_rig_is_freed_once_nobody_has_it(name: str) -> None:
    """Without the garbage collector, which sees few objects and not their megabytes."""
    file, plan = load_rig_file(shipped_rigs()[name])[0], short_plan()
    gc.collect()
    gc.disable()
    try:
        rig = build_rig(file)
        rig.connect()
        rig.run_trial(
            plan.program(plan.trials[0]),
            NullSink(),
            7,
            file.frame_px(plan),
            100,
            file.with_events(plan),
        )
        rig.close()
        parts = [weakref.ref(part) for part in (rig, *rig._devices())]
        del rig
        assert [part() for part in parts if part() is not None] == []
    finally:
        gc.enable()
