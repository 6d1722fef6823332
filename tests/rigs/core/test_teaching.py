"""Touches on the simulated rig, held against where its plate truly is; and every way to stop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sliplab.protocols.program import Position
from sliplab.rigs.core import teaching
from sliplab.rigs.core.capabilities import ArmFault, ArmState, RigError, Segment
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.rigs.core.surface_search import touch_off
from sliplab.rigs.core.teaching import Creep, grab_frames, jog_poses, press_in_circles, touch
from sliplab.rigs.core.touching import RateTouch
from sliplab.storage.streams import FrameChunk
from tests.patching import put
from tests.rigs.altered import depths
from tests.rigs.core.test_rig import after_the_stop, make_rig, watched

QUICK = Creep(clearance_mm=1.5, search_mm=1.0)
TRACKS = {"frame_camera": {"level": "tracks"}}


def find(chunk: FrameChunk) -> Any:
    return chunk.markers_px.astype(np.float64)


def off(rig: Rig, mm: float) -> Rig:
    """The rig with a plane that lies `mm` before the one it has."""
    origin, axes = rig.plate_frame.origin, rig.plate_frame.axes
    rig.plate_frame = PlateFrame(origin - mm * axes[2], axes)
    return rig


def depth(rig: Rig) -> float:
    return rig.position().depth_mm


@pytest.fixture
def rig() -> Rig:
    """The shipped mock rig."""
    return make_rig()


@pytest.mark.long
@pytest.mark.parametrize("wrong_mm", [0.0, 0.7, -0.6])
@pytest.mark.parametrize("way", [None, find], ids=["events", "markers"])
def test_the_surface_is_found_wherever_the_plane_is_assumed(wrong_mm: float, way: Any) -> None:
    rig = off(make_rig(**TRACKS), wrong_mm)
    found = touch(rig, 0.0, 0.0, QUICK, 3, way)
    assert found.depth_mm == pytest.approx(wrong_mm, abs=0.06 if way else 0.08)
    # no deeper than it takes to notice: by events the touch depth, by markers almost nothing
    assert found.deepest_mm < wrong_mm + (0.1 if way else 0.45)
    assert depth(rig) == pytest.approx(-1.5, abs=0.01)
    assert rig.arm.state() is ArmState.READY


@pytest.mark.long
def test_both_ways_agree_with_each_other_and_with_the_truth() -> None:
    rig = make_rig(**TRACKS)
    events, markers = (
        np.mean([touch(rig, 0.0, 0.0, QUICK, seed, way).depth_mm for seed in (1, 2, 3)])
        for way in (None, find)
    )
    assert abs(events) < 0.05
    assert abs(markers) < 0.05
    assert abs(events - markers) < 0.08


def test_without_tremor_and_aligned_the_markers_still_tell() -> None:
    rig = make_rig(arm={"vibration_um": 0}, **TRACKS)
    assert touch(rig, 0.0, 0.0, QUICK, 1, find).depth_mm == pytest.approx(0.0, abs=0.06)


def test_a_touch_that_never_comes_ends_at_the_hard_limit() -> None:
    rig = off(make_rig(), 5.0)
    deepest = depths(rig)
    with pytest.raises(RigError, match=r"hard limit of 1 mm .*--search"):
        touch(rig, 0.0, 0.0, QUICK, 1)
    assert max(deepest) == pytest.approx(1.0, abs=0.01)
    assert depth(rig) <= -1.5 + 1e-6


def test_an_arm_that_runs_on_is_stopped_at_the_limit() -> None:
    """Whatever the arm makes of its path, the rig looks where it is."""
    rig = off(make_rig(), 5.0)
    start = rig.arm.start

    def overshoots(path: Any) -> None:
        if path[-1].speed_mm_s == QUICK.speed_mm_s:
            far = rig.plate_frame.pose(Position(0.0, 0.0, 3.5))
            path = [type(path[-1])(far, path[-1].speed_mm_s)]
        start(path)

    put(rig.arm, "start", overshoots)
    notes = watched(rig)
    with pytest.raises(RigError, match="hard limit"):
        touch(rig, 0.0, 0.0, QUICK, 1)
    assert "arm.stop" in notes
    assert depth(rig) <= -1.5 + 1e-6


@pytest.mark.parametrize("when", [150, 300])
def test_an_arm_that_somebody_else_stops_is_not_blamed_on_the_plane(
    when: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = off(make_rig(), 5.0)
    looks = iter(range(10_000))

    def seen(rig: Rig) -> int:
        if next(looks) == when:
            rig.arm.stop()  # at the pendant, say
        return 0

    monkeypatch.setattr(teaching, "central_events", seen)
    with pytest.raises(ArmFault, match="stopped from outside, at -"):
        touch(rig, 0.0, 0.0, QUICK, 1)
    assert depth(rig) <= -1.5 + 1e-6


def test_what_is_met_before_creeping_stops_the_arm() -> None:
    rig = off(make_rig(), -4.0)  # the plate stands 4 mm before where it should be
    with pytest.raises(RigError, match=r"made contact .* before the plane .*--clearance"):
        touch(rig, 0.0, 0.0, QUICK, 1)
    assert depth(rig) <= -1.5
    assert rig.arm.state() is ArmState.READY


@pytest.mark.quick(4)
@pytest.mark.parametrize("looks", [0, 3, 60, 150, 400])
@pytest.mark.parametrize("way", [None, find], ids=["events", "markers"])
def test_a_stop_request_stops_the_arm_first(looks: int, way: Any) -> None:
    rig = make_rig(**TRACKS)
    asked = iter([False] * looks)
    rig.should_stop = lambda: next(asked, True)
    notes = watched(rig)
    with pytest.raises(StopRequested):
        touch(rig, 0.0, 0.0, QUICK, 1, way)
    assert notes.index("arm.stop") < notes.index("events.stop")
    assert notes.index("arm.stop") < notes.index("frames.stop")
    assert rig.arm.progress().done
    assert depth(rig) <= -1.5 + 1e-6


def test_ctrl_c_stops_the_arm_first(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    notes = watched(rig)
    count = teaching.central_events
    looks = iter(range(200))

    def interrupted(rig: Rig) -> int:
        if next(looks) == 120:
            raise KeyboardInterrupt
        return count(rig)

    monkeypatch.setattr(teaching, "central_events", interrupted)
    with pytest.raises(KeyboardInterrupt):
        touch(rig, 0.0, 0.0, QUICK, 1)
    assert notes.index("arm.stop") < notes.index("events.stop")
    assert depth(rig) <= -1.5 + 1e-6


@pytest.mark.parametrize("at_s", [0.2, 1.0, 4.0])
def test_a_protective_stop_leaves_the_arm_where_it_is(at_s: float) -> None:
    fault = {"kind": "arm_protective_stop", "trial": 1, "at_s": at_s, "since": "trial"}
    rig = make_rig(faults=[fault])
    notes = watched(rig)
    with pytest.raises(ArmFault, match="protective stop"):
        touch(rig, 0.0, 0.0, QUICK, 1)
    assert rig.arm.state() is ArmState.PROTECTIVE_STOP
    assert "arm.start" not in after_the_stop(notes)


def test_a_camera_that_is_gone_stops_the_arm() -> None:
    fault = {"kind": "device_gone", "device": "event_camera", "at_s": 2.0, "since": "trial"}
    rig = make_rig(faults=[fault])
    with pytest.raises(RigError, match="event camera: does not answer"):
        touch(rig, 0.0, 0.0, QUICK, 1)
    assert depth(rig) <= -1.5 + 1e-6


def test_markers_that_never_move_end_the_touch_soon_after_the_events() -> None:
    rig = make_rig(**TRACKS)
    still = find(FrameChunk(*([np.zeros(1, np.int64)] * 5), np.ones((1, 19, 2), np.float32)))
    with pytest.raises(RigError, match=r"frame camera: saw no marker move up to 0\.[56]"):
        touch(rig, 0.0, 0.0, QUICK, 1, lambda chunk: np.repeat(still, len(chunk), 0))


def test_events_that_are_looked_for_elsewhere_are_no_touch(rig: Rig) -> None:
    rig.centre_px = (60.0, 60.0)
    with pytest.raises(RigError, match="found no plate"):
        touch(rig, 0.0, 0.0, QUICK, 1)


@pytest.mark.parametrize(
    "wrong",
    [{"speed_mm_s": 5.0}, {"speed_mm_s": 0.0}, {"search_mm": -1.0}, {"clearance_mm": float("nan")}],
)
def test_a_creep_that_is_none_cannot_be_asked_for(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="creeping"):
        Creep(**wrong)


def test_the_rate_is_that_of_touching_off(rig: Rig) -> None:
    """A protocol's `rezero` and `teach zero` find the same surface with the same seed."""
    taught = touch(rig, 0.0, 0.0, Creep(clearance_mm=1.5, search_mm=1.5), 7).depth_mm
    assert touch_off(rig, 0.5, 1.5, 7) == pytest.approx(taught, abs=0.02)
    assert RateTouch(0).limit == 10


def test_a_person_jogs_and_confirms(rig: Rig) -> None:
    poses = jog_poses(rig, [("", "touched centre"), ("", "touched right"), ("", "touched above")])
    places = [rig.plate_frame.position(pose.xyz_mm) for pose in poses]
    assert [round(p.x_mm) for p in places] == [0, 12, 0]
    assert all(abs(p.depth_mm) < 0.15 for p in places)


def test_a_person_who_says_stop_is_heard(rig: Rig) -> None:
    put(rig.operator, "ask", lambda task, prompt, expected: False)
    with pytest.raises(StopRequested):
        jog_poses(rig, [("", "touched centre")])


def test_an_arm_that_was_stopped_or_still_moves_gives_no_pose(rig: Rig) -> None:
    put(rig.operator, "ask", lambda task, prompt, expected: True)
    rig.arm.start([Segment(rig.plate_frame.pose(Position(0.0, 0.0, -20.0)), 5.0)])
    with pytest.raises(RigError, match="is still moving"):
        jog_poses(rig, [("", "touched centre")])
    fault = {"kind": "arm_protective_stop", "at_s": 0.1, "since": "trial"}
    rig = make_rig(faults=[fault])
    rig.simulation.begin_trial(1)
    rig.clock.wait(0.5)
    with pytest.raises(ArmFault, match="protective stop"):
        jog_poses(rig, [("", "elsewhere")])


def test_looking_gives_frames_and_moves_nothing(rig: Rig) -> None:
    rig.frames.set_region(64, 64)
    notes = watched(rig)
    chunk = grab_frames(rig)
    assert chunk.images.shape[1:] == (64, 64)
    assert "arm.start" not in notes


def test_stirring_shows_the_whole_skin(rig: Rig) -> None:
    counts = press_in_circles(rig, 2.4, 1.0, 2.0, 1)
    assert counts.shape == (2, 480, 640)
    assert counts.sum(axis=(1, 2)).min() > 10_000
    rows, columns = np.nonzero(counts.sum(axis=0) > 3)
    assert np.ptp(rows) > 250
    assert np.ptp(columns) > 250
    assert depth(rig) == pytest.approx(-5.0, abs=0.01)


def test_a_stop_while_stirring_stops_the_arm(rig: Rig) -> None:
    asked = iter([False] * 30)
    rig.should_stop = lambda: next(asked, True)
    notes = watched(rig)
    with pytest.raises(StopRequested):
        press_in_circles(rig, 2.4, 1.0, 2.0, 1)
    assert notes.index("arm.stop") < notes.index("events.stop")
    assert depth(rig) <= -5.0 + 1e-6
