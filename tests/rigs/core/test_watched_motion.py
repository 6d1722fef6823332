"""Motion of any kind: forces, poses, fingers and events are watched by the rig, not by callers."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.simulation.settings import MockSettings, scene_of
from sliplab.protocols.program import Dwell, Move, Position, Program, Twist
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.arm_settings import ArmLimits
from sliplab.rigs.core.capabilities import (
    ArmFault,
    GripperState,
    Mounting,
    Pose,
    PoseFault,
    RigError,
    Segment,
)
from sliplab.rigs.core.force_watch import SILENT_S, ForceLimitError
from sliplab.rigs.core.guard import DepthError, Guard, SpeedError, TiltError, WorkspaceError
from sliplab.rigs.core.motion_watch import MeasuredSpeedError
from sliplab.rigs.core.plate_frame import turned_about_z
from sliplab.rigs.core.pose import angle_deg
from sliplab.rigs.core.reacting import Reflex, SafeState, SenseLost, SlipDetected, run_watched
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.core.surface_search import measure_noise, touch_off
from sliplab.rigs.core.teaching import Creep, press_in_circles, touch
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_limits import RigLimits
from sliplab.storage.streams import Chunk, EventChunk, FrameChunk, NullSink, PoseChunk, WrenchChunk
from tests.conftest import ROOT
from tests.patching import loose, put
from tests.rigs.altered import alter, before, depths

LIMIT_N = 0.6
HOME = Position(0.0, 0.0, -2.0)
DEEP = Position(0.0, 0.0, 2.4)
PROGRAM = Program(
    HOME,
    (
        Move("press", DEEP, 2.0),
        Dwell("hold", 0.1, recorded=True),
        Move("slide", Position(3.0, 0.0, 2.4), 3.0, recorded=True),
        Move("release", HOME, 10.0),
    ),
)


def make_rig(name: str = "mock-force", limit_n: float | None = LIMIT_N, **scene: Any) -> Rig:
    """A simulated rig with a small event camera, that starts near the plate."""
    file, _ = load_rig_file(Path(name))
    data = scene_of(file).model_dump()
    data["arm"] |= {"start_xyz_mm": (395.0, 0.0, 300.0)}
    data["event_camera"] |= {"width": 64, "height": 64}
    data["frame_camera"] |= {"level": "tracks"}
    data["force"] = data["force"] or {}
    for key, change in scene.items():
        data[key] = {**(data[key] or {}), **change}
    file = file.model_copy(update={"mock": MockSettings.model_validate(data)})
    rig = build_rig(file)
    rig.force_limit_n = limit_n
    rig.connect()
    return rig


class Watcher(NullSink):
    """A watcher that says slip as soon as it is armed, or never."""

    def __init__(self, slip: bool = False) -> None:
        self.armed = self.guarded = False
        self._slip = slip

    def step(self, phase: str, acting: bool) -> None:
        """A step begins."""

    def add(self, device: str, chunk: Chunk) -> None:
        if isinstance(chunk, PoseChunk) and self.armed and self._slip:
            raise SlipDetected


def deaf(rig: Rig) -> Rig:
    """The rig, to which no touch shows in the events."""
    rig.centre_px = (-1000, -1000)
    return rig


def trial(rig: Rig) -> None:
    rig.run_trial(PROGRAM, NullSink(), 1, None, 100)


def watched_trial(rig: Rig) -> None:
    run_watched(rig, PROGRAM, Watcher(), 1, 100, None)


def warm_up(rig: Rig) -> None:
    rig.press(2.4, 2.0, 2.0, 2)


def touching_off(rig: Rig) -> None:
    touch_off(deaf(rig), 1.0, 2.4, 1)


def taught_touch(rig: Rig) -> None:
    touch(deaf(rig), 0.0, 0.0, Creep(1.0, 2.4, 1.0), 1)


def circles(rig: Rig) -> None:
    press_in_circles(rig, 2.4, 1.0, 2.0, 1)


def lone_move(rig: Rig) -> None:
    with rig.safely(HOME):
        rig.begin_clear(1)
        rig.move(Move("press", DEEP, 2.0), rig.position())


MOTIONS = [trial, watched_trial, warm_up, touching_off, taught_touch, circles, lone_move]
each_motion = pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.__name__)


def true_forces(rig: Rig) -> list[float]:
    """Keep the true normal force at every look at the arm's pose."""
    world, found = loose(rig.force)._world, [0.0]

    def look() -> None:
        if world.physics.wrench is not None:
            end_ns = world.advance()
            found.append(float(world.physics.wrench.at(np.array([end_ns], np.int64))[0, 2]))

    before(rig.arm, "pose", look)
    return found


# -- the limit of force ----------------------------------------------------------------------


@each_motion
def test_limit_of_force_stops_any_motion(motion: Callable[[Rig], None]) -> None:
    rig = make_rig()
    forces = true_forces(rig)
    with pytest.raises(ForceLimitError, match=r"above limits.force = 0.6 N of the rig"):
        motion(rig)
    assert LIMIT_N - 0.1 < max(forces) < LIMIT_N + 0.25  # two millimetres a second, every 20 ms
    assert rig.arm.progress().done
    assert rig.position().depth_mm < 0.0  # moved clear


@pytest.mark.quick(1)
@each_motion
def test_motion_below_the_limit_runs_to_its_end(motion: Callable[[Rig], None]) -> None:
    rig = make_rig(limit_n=30.0)
    if motion in (touching_off, taught_touch):  # a touch that does not show ends at its hard limit
        with pytest.raises(RigError, match="found no plate within"):
            motion(rig)
    else:
        motion(rig)
    assert rig._forces is None
    rig.close()


@pytest.mark.parametrize("kind", ["press", "grip"])
def test_limit_of_force_stops_what_a_reflex_adds(kind: Any) -> None:
    """The press of 2.4 mm stays below the limit; 1.5 mm more do not."""
    rig = make_rig("mock-gripper", 4.0)
    reflex = Reflex(kind, 4.0, 1.5, 20.0 if kind == "grip" else 2.0, 50.0, 0.1)
    stopped: list[float] = []
    before(rig.gripper, "stop", lambda: stopped.append(rig.position().depth_mm))
    with pytest.raises(ForceLimitError):
        run_watched(rig, PROGRAM, Watcher(slip=True), 1, 100, reflex)
    assert stopped[0] > 2.0  # fingers are stopped before the arm moves clear
    assert rig.gripper.state().opening_mm > 40.0 - 1.5
    assert rig.position().depth_mm < 0.0


def test_limit_of_force_holds_while_the_arm_rests_after_a_reflex() -> None:
    rig, watcher = make_rig(limit_n=4.0), Watcher(slip=True)
    pushed = [0.0]
    alter(rig.force, "read", lambda chunk: replace(chunk, force_n=chunk.force_n + pushed[0]))
    put(
        watcher,
        "step",
        lambda phase, acting: pushed.append(pushed.pop() + 3.0 * (phase == "reflex")),
    )
    with pytest.raises(ForceLimitError):
        run_watched(rig, PROGRAM, watcher, 1, 100, Reflex("stop", 4.0, hold_s=1.0))
    assert pushed == [3.0]


def test_force_that_rises_while_the_arm_moves_clear_stops_it() -> None:
    rig = make_rig()
    stops: list[bool] = []

    def rising(chunk: WrenchChunk) -> WrenchChunk:
        if stops and len(chunk):
            stops.append(True)
            return replace(chunk, force_n=chunk.force_n + 0.5 * len(stops))
        return chunk

    alter(rig.force, "read", rising)
    before(rig.arm, "stop", lambda: stops.append(True))
    with pytest.raises(RigError, match=r"above limits\.force"):
        trial(rig)
    assert rig.position().depth_mm > 0.0
    assert rig.arm.progress().done


def test_limit_passed_by_one_sample_between_two_readings_is_seen() -> None:
    rig = make_rig(limit_n=20.0)

    def spiked(chunk: WrenchChunk) -> WrenchChunk:
        if rig.position().x_mm > 1.0:
            chunk.force_n[len(chunk) // 2 : len(chunk) // 2 + 1, 0] = -21.0
        return chunk

    alter(rig.force, "read", spiked)
    with pytest.raises(ForceLimitError, match=r"21\.\d+ N on the plate"):
        watched_trial(rig)


def test_load_before_the_first_zero_is_no_fault_but_more_is() -> None:
    """A sensor that was never zeroed shows the weight of its tool."""
    rig = make_rig(limit_n=2.0)
    weight_n, hit_n = np.array([0.0, -5.0, 0.0]), [0.0]

    def weighed(chunk: WrenchChunk) -> WrenchChunk:
        hit_n[0] += 0.2 if len(hit_n) > 1 else 0.0
        return replace(chunk, force_n=chunk.force_n + weight_n + hit_n[0])

    alter(rig.force, "read", weighed)
    with rig.safely(HOME):
        rig.move(Move("home", Position(5.0, 0.0, -3.0), 10.0), rig.position())
    hit_n.append(1.0)
    with pytest.raises(ForceLimitError, match=r"more than at first \(the sensor is not zeroed yet"):
        rig.move(Move("home", Position(-5.0, 0.0, -3.0), 1.0), rig.position())


def test_listening_sees_a_sensor_that_is_dead() -> None:
    rig = make_rig()
    breaks(rig, "nan")
    with pytest.raises(RigError, match="force sensor: reads a force that is no number"):
        rig.listen(1.0, NullSink(), 100)


# -- force sensors that say nothing usable -----------------------------------------------------

FAULTS = {
    "nan": "no number",
    "one axis": "no number",
    "inf": "no number",
    "none": "not a WrenchChunk",
    "empty": "no (newer )?sample",
    "frozen": "no newer sample",
    "replayed": "no newer sample",
    "shape": r"of the shape \(\d+, 2\)",
    "zeros": "exactly the same",
    "stuck": "exactly the same",
}


def breaks(rig: Rig, how: str, broken: Callable[[], bool] = lambda: True) -> list[int]:
    """Break the force sensor while `broken`; return the rig's clock when it broke."""
    since: list[int] = []
    kept: list[WrenchChunk] = []
    values = {"nan": np.nan, "inf": -np.inf, "zeros": 0.0}

    def bad(chunk: WrenchChunk) -> Any:
        if not len(chunk):
            return chunk
        kept.append(chunk)
        if not broken():
            return chunk
        since.append(rig.clock.now_ns())
        force, first = chunk.force_n.copy(), kept[0]
        if how == "one axis":
            force[-1, 1] = np.nan
        elif how == "stuck":
            force[:] = first.force_n[0]
        elif how == "stuck normal":
            force[:, 2] = first.force_n[0, 2]
        elif how in values:
            force[:] = values[how]
        return {
            "none": lambda: None,
            "empty": WrenchChunk.empty,
            "replayed": lambda: first,
            "frozen": lambda: replace(chunk, t_ns=np.full_like(chunk.t_ns, first.t_ns[0])),
            "shape": lambda: replace(chunk, force_n=force[:, :2]),
            "list": lambda: replace(chunk, force_n=force.tolist()),
            "objects": lambda: replace(chunk, force_n=force.astype(object)),
        }.get(how, lambda: replace(chunk, force_n=force))()

    alter(rig.force, "read", bad)
    return since


@pytest.mark.parametrize("how", FAULTS)
def test_sensor_at_fault_before_a_trial_keeps_the_arm_out_of_contact(how: str) -> None:
    rig = make_rig()
    breaks(rig, how)
    deepest = depths(rig)
    with pytest.raises(RigError, match=rf"force sensor: .*{FAULTS[how]}"):
        trial(rig)
    assert max(deepest) < (1.1 if FAULTS[how] == "exactly the same" else 0.0)
    assert rig.arm.progress().done


@pytest.mark.quick(7)
@pytest.mark.parametrize("how", FAULTS)
@pytest.mark.parametrize("motion", [trial, watched_trial], ids=lambda motion: motion.__name__)
def test_sensor_that_dies_in_mid_slide_stops_the_arm(motion: Any, how: str) -> None:
    rig = make_rig(limit_n=30.0)
    x_mm = [0.0]
    since = breaks(rig, how, lambda: rig.arm.pose().xyz_mm != () and rig.position().x_mm > 1.0)

    def noted(found: Pose) -> Pose:
        x_mm[0] = max(x_mm[0], rig.plate_frame.position(found.xyz_mm).x_mm)
        return found

    alter(rig.arm, "pose", noted)
    with pytest.raises(RigError, match=rf"force sensor: .*{FAULTS[how]}"):
        motion(rig)
    assert since
    # at 3 mm/s, within its silence or a millimetre
    assert x_mm[0] < 1.0 + max(3.0 * (SILENT_S + 0.1), 1.2)
    assert rig.position().depth_mm < 0.0  # a dead sensor does not keep the arm in contact


@pytest.mark.quick(3)
@pytest.mark.parametrize("motion", [trial, watched_trial, warm_up, circles, lone_move])
@pytest.mark.parametrize("mounting", [Mounting(), Mounting(rotvec_deg=(180.0, 0.0, 0.0))])
def test_sensor_whose_normal_axis_is_dead_stops_a_press(motion: Any, mounting: Mounting) -> None:
    """Its other two axes are noisy, and show what acts on them."""
    rig = make_rig(limit_n=30.0)
    loose(rig.force).mounting = mounting
    breaks(rig, "stuck normal")
    deepest = depths(rig)
    with pytest.raises(RigError, match=r"force sensor: reads the same normal force since the arm"):
        motion(rig)
    assert max(deepest) < 1.2


@pytest.mark.parametrize("how", ["list", "objects"])
def test_forces_that_are_no_array_of_numbers_name_the_sensor(how: str) -> None:
    rig = make_rig(limit_n=30.0)
    breaks(rig, how)
    with pytest.raises(RigError, match=r"force sensor: returned force_n as .*no.* array of number"):
        lone_move(rig)


def test_force_samples_that_lag_more_and_more_stop_the_arm() -> None:
    """Each sample is newer than the one before, and later than that on its way."""
    rig = make_rig(limit_n=30.0)
    waiting: list[Any] = []
    ages_s = [0.0]

    def slow(new: WrenchChunk) -> WrenchChunk:
        now_ns = rig.clock.now_ns()
        rows = [*waiting, *zip(*vars(new).values(), strict=True)]
        sent, waiting[:] = rows[: (len(new) + 1) // 2], rows[(len(new) + 1) // 2 :]
        if not sent:
            return new
        t_ns, host_ns, force_n, torque_nm = map(np.array, zip(*sent, strict=True))
        ages_s.append((now_ns - int(host_ns[-1])) * 1e-9)
        return WrenchChunk(t_ns, np.full_like(host_ns, now_ns), force_n, torque_nm)

    alter(rig.force, "read", slow)
    before(rig.force, "start", waiting.clear)
    with pytest.raises(
        RigError, match=r"force sensor: no newer sample came for 0\.\d+ s.* is too busy"
    ):
        trial(rig)
    assert max(ages_s) < 2 * SILENT_S + 0.2
    assert rig.position().depth_mm < 0.0


@pytest.mark.parametrize("how", ["nan", "empty", "frozen", "zeros"])
def test_sensor_without_a_limit_is_held_where_a_press_ends_by_it(how: str) -> None:
    rig = make_rig(limit_n=None)
    breaks(rig, how)
    deepest = depths(rig)
    press = Move("press", Position(0.0, 0.0, 3.6), 2.0, until_force_n=1.5)
    with pytest.raises(RigError, match=rf"force sensor: .*{FAULTS[how]}"):
        rig.run_trial(Program(HOME, (press, *PROGRAM.steps[1:])), NullSink(), 1, None, 100)
    assert max(deepest) < 1.2


def test_ideal_sensor_without_noise_is_no_dead_one() -> None:
    ideal = dict.fromkeys(("noise_n", "noise_nm", "drift_n_per_min", "drift_nm_per_min"), 0)
    ideal["cross_talk_share"] = 0
    rig = make_rig(limit_n=30.0, force=ideal, arm={"vibration_um": 0, "pose_noise_um": 0})
    trial(rig)
    press, hold, _, release = PROGRAM.steps
    twist = Twist("twist", replace(DEEP, twist_deg=15.0), 5.0, recorded=True)
    twisted = Program(HOME, (press, hold, twist, release))
    rig.run_trial(twisted, NullSink(), 1, None, 100)


# -- poses -------------------------------------------------------------------------------------


class PlugInArm:
    """An arm of another driver, which checks nothing: a simulated one that is moved off its path.

    Args:
        lie: changes a pose on its way to the rig.
    """

    def __init__(self, arm: Any, lie: Callable[[Pose], Any] = lambda pose: pose) -> None:
        self._arm, self._lie = arm, lie
        self.started: list[Segment] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def start(self, path: Any) -> None:
        self.started += path
        self._arm.start(path)

    def pose(self) -> Any:
        return self._lie(self._arm.pose())


def with_arm(rig: Rig, lie: Callable[[Pose], Any] = lambda pose: pose) -> PlugInArm:
    rig.arm = arm = PlugInArm(rig.arm, lie)  # type: ignore[assignment]
    return arm


def plain_rig() -> Rig:
    """A rig without forces."""
    rig = make_rig("rehearsal", None)
    rig.force, rig.poll_s = None, 0.05
    return rig


def home_rig() -> Rig:
    """A rig without forces, above the middle of the plate."""
    rig = plain_rig()
    rig.move(Move("home", HOME, 10.0), rig.position())
    return rig


@pytest.mark.parametrize("number", [np.nan, np.inf])
@each_motion
def test_pose_that_is_not_finite_stops_any_motion(motion: Any, number: float) -> None:
    rig = plain_rig()
    looks = iter(range(100_000))

    def lie(pose: Pose) -> Pose:
        x, _, z = pose.xyz_mm
        return Pose((x, number, z), pose.rotvec_deg) if next(looks) > 12 else pose

    with_arm(rig, lie)
    with pytest.raises(ArmFault, match="which is no pose"):
        motion(rig)
    assert rig.arm.progress().done


def test_recorded_poses_that_are_not_finite_stop_the_arm() -> None:
    rig = plain_rig()

    def bad(chunk: PoseChunk) -> PoseChunk:
        chunk.xyz_mm[-1:, 2] = np.nan
        return chunk

    alter(rig.arm, "read_poses", bad)
    with pytest.raises(ArmFault, match="poses that are not finite"):
        trial(rig)


def test_pose_that_never_changes_stops_the_arm() -> None:
    rig = plain_rig()
    stood = rig.arm.pose()
    with_arm(rig, lambda pose: stood)
    with pytest.raises(ArmFault, match=r"has reported the same pose for 3\.\d s while it should"):
        rig.move(Move("slide", Position(0.0, 0.0, -50.0), 5.0), rig.position())


def test_path_that_ends_elsewhere_than_reported_is_a_fault() -> None:
    """The press takes 1.2 s, too short for a pose to count as frozen."""
    rig = home_rig()
    stood = rig.arm.pose()
    with_arm(rig, lambda pose: stood)
    with pytest.raises(ArmFault, match=r"phase 'press' as finished, and its pose is 4\.4 mm"):
        rig.move(Move("press", DEEP, 4.0), HOME)


def stands_still(now: Pose, held: Pose) -> Pose:
    return held


def jumps(now: Pose, held: Pose) -> Pose:
    x, y, z = now.xyz_mm
    return Pose((x + 20.0, y + 20.0, z), now.rotvec_deg)


@pytest.mark.parametrize(("lie", "fault"), [(stands_still, PoseFault), (jumps, MeasuredSpeedError)])
@pytest.mark.parametrize("seconds", [3.0, 8.0])
def test_arm_whose_poses_are_wrong_is_stopped_and_not_moved(
    lie: Callable[[Pose, Pose], Pose], fault: type[RigError], seconds: float
) -> None:
    """From a place where it is not, the way out would lead sideways over the skin."""
    rig = home_rig()
    rig.move(Move("press", DEEP, 10.0), HOME)
    true, held = rig.arm.pose, rig.arm.pose()
    since = rig.clock.now_ns() + 500_000_000
    arm = with_arm(rig, lambda pose: lie(pose, held) if rig.clock.now_ns() > since else pose)
    with pytest.raises(fault, match="stays where it is"), rig.safely(HOME):
        rig.move(Move("slide", Position(seconds, 0.0, 2.4), 1.0), DEEP)
    assert len(arm.started) == 1
    at = rig.plate_frame.position(true().xyz_mm)
    assert at.depth_mm == pytest.approx(2.4, abs=0.01)
    assert arm.progress().done


def drifting(rig: Rig, way: tuple[float, float, float], mm_s: float) -> None:
    """Let the true arm drift off its path in plate coordinates, from now on."""
    began = rig.clock.now_ns()
    axes = rig.plate_frame.axes

    def lie(pose: Pose) -> Pose:
        off = mm_s * (rig.clock.now_ns() - began) * 1e-9 * np.array(way) @ axes
        x, y, z = (np.array(pose.xyz_mm) + off).tolist()
        return Pose((x, y, z), pose.rotvec_deg)

    with_arm(rig, lie)


@pytest.mark.parametrize(
    ("way", "mm_s", "error", "said"),
    [
        ((0, 0, 1), 2.0, DepthError, r"depth in contact 4\.\d+ mm is beyond its limit 4 mm"),
        ((1, 0, 0), 8.0, WorkspaceError, r"centre 15\.\d+ mm is beyond its limit 15 mm"),
        ((0, -1, 0), 150.0, (SpeedError, WorkspaceError), "beyond its limit"),
    ],
)
def test_measured_pose_beyond_a_limit_stops(way: Any, mm_s: float, error: Any, said: str) -> None:
    rig = home_rig()
    rig.move(Move("press", DEEP, 10.0), HOME)
    drifting(rig, way, mm_s)
    with pytest.raises(error, match=said):
        rig.move(Move("slide", Position(5.0, 0.0, 2.4), 1.0), DEEP)


def test_arm_faster_than_the_limit_is_stopped_by_its_poses() -> None:
    rig = plain_rig()
    rig.guard = Guard(None, replace_limits(rig, speed_mm_s=10.0))
    start = rig.arm.start
    put(rig.arm, "start", lambda path: start([replace(path[0], speed_mm_s=60.0)]))
    with pytest.raises(SpeedError, match=r"speed 60 mm/s is beyond its limit 10 mm/s"):
        rig.move(Move("home", Position(0.0, 0.0, -50.0), 10.0), rig.position())


def test_turn_faster_than_the_limit_is_stopped_by_its_poses() -> None:
    rig = home_rig()
    rig.guard = Guard(None, replace_limits(rig, speed_mm_s=5.0))
    start = rig.arm.start
    put(rig.arm, "start", lambda path: start([replace(path[0], turn_deg_s=100.0)]))
    limit = f"{rig.guard.turn_deg_s:.4g}"
    with pytest.raises(SpeedError, match=rf"turn 100 deg/s is beyond its limit {limit} deg/s"):
        rig.twist(Twist("twist", replace(HOME, twist_deg=90.0), 20.0), HOME)


def test_turn_in_a_move_is_stopped_by_its_poses_too() -> None:
    rig = home_rig()
    rig.guard = Guard(None, replace_limits(rig, speed_mm_s=20.0))
    rig.guard._plate_limits = replace_limits(rig, depth_mm=99.0)
    began = rig.clock.now_ns()

    def lie(pose: Pose) -> Pose:
        turn_deg = (rig.clock.now_ns() - began) * 120e-9
        return Pose(pose.xyz_mm, turned_about_z(pose.rotvec_deg, turn_deg))

    with_arm(rig, lie)
    with pytest.raises(SpeedError, match=r"turn 120 deg/s is beyond its limit 86\.8\d? deg/s"):
        rig.move(Move("slide", Position(9.0, 0.0, -2.0), 5.0), HOME)


def test_way_out_keeps_the_rotation_that_the_tool_has() -> None:
    """It would turn its rim in contact."""
    rig = home_rig()
    rig.move(Move("press", DEEP, 10.0), HOME)
    arm = with_arm(rig, lambda pose: Pose(pose.xyz_mm, turned_about_z(pose.rotvec_deg, 10.0)))
    leaning = rig.pose().rotvec_deg
    with pytest.raises(RigError, match="a fault"), rig.safely(HOME):
        raise RigError("force sensor", "a fault")
    (out,) = arm.started
    assert out.to.rotvec_deg == leaning
    assert rig.position().depth_mm < 0.0


@pytest.mark.parametrize("motion", [trial, watched_trial, warm_up])
@pytest.mark.parametrize("off_mm", [0.0, 0.5])
def test_sensor_that_an_earlier_command_left_turned_turns_back(motion: Any, off_mm: float) -> None:
    """It was stopped in a twist, and moved clear as turned as it was; this is another process."""
    rig = home_rig()
    there = replace(HOME, x_mm=off_mm, twist_deg=60.0)
    rig.arm.start([Segment(rig.plate_frame.pose(replace(there, twist_deg=0.0)), 10.0)])
    rig.clock.wait(2.0)
    rig.arm.start([Segment(rig.plate_frame.pose(there), 10.0, 20.0)])
    rig.clock.wait(5.0)
    assert angle_deg(rig.pose(), rig.plate_frame.pose(HOME)) == pytest.approx(60.0, abs=0.5)
    arm = with_arm(rig)
    motion(rig)
    assert arm.started[0].turn_deg_s == 20.0
    assert arm.started[0].to.xyz_mm == pytest.approx(rig.plate_frame.pose(there).xyz_mm, abs=0.1)
    assert not any(segment.turn_deg_s for segment in arm.started[1:])


def replace_limits(rig: Rig, **change: float) -> Any:
    return replace(rig.guard._plate_limits, **change)  # type: ignore[type-var]


@pytest.mark.parametrize("way", [(0, 0, 1), (1, 0, 0)])
def test_arm_that_leaves_the_limits_at_rest_is_stopped(way: Any) -> None:
    """Another program or a person moves it in a hold, in which no motion was commanded."""
    rig = plain_rig()
    rig.simulation = None
    watcher = Watcher()
    watcher.step = lambda phase, acting: drifting(rig, way, 20.0) if phase == "hold" else None  # type: ignore[method-assign, assignment]
    deepest = depths(rig)
    program = Program(HOME, (PROGRAM.steps[0], Dwell("hold", 5.0), PROGRAM.steps[-1]))
    with pytest.raises(RigError, match=r"moved 1\.\d mm and 0\.0 deg while it should rest"):
        run_watched(rig, program, watcher, 1, 100, None)
    assert max(deepest) < 6.0


def test_tool_that_turns_on_its_way_beyond_the_limit_stops_the_arm() -> None:
    rig = plain_rig()
    rig.guard = Guard(ArmLimits(low_mm=(200, -99, 200), high_mm=(499, 99, 400), tilt_deg=10))
    rig.move(Move("home", HOME, 10.0), rig.position())
    began = rig.clock.now_ns()

    def lie(pose: Pose) -> Pose:
        turn_deg = (rig.clock.now_ns() - began) / 5e7
        return Pose(pose.xyz_mm, turned_about_z(pose.rotvec_deg, turn_deg))

    with_arm(rig, lie)
    with pytest.raises(TiltError, match=r"turn of the tool 1\d(\.\d+)? deg is beyond its limit 10"):
        rig.move(Move("slide", Position(9.0, 0.0, -2.0), 1.0), HOME)


# -- limits before anything is sent ------------------------------------------------------------


@pytest.mark.parametrize(
    ("to", "speed", "error"),
    [
        (Position(0.0, 0.0, 4.1), 2.0, DepthError),
        (Position(15.2, 0.0, -2.0), 2.0, WorkspaceError),
        (Position(11.0, -11.0, -2.0), 2.0, WorkspaceError),
        (DEEP, 101.0, SpeedError),
        (DEEP, float("nan"), RigError),
        (DEEP, float("inf"), RigError),
        (DEEP, 0.0, SpeedError),
        (DEEP, -2.0, SpeedError),
        (Position(0.0, float("nan"), 1.0), 2.0, RigError),
    ],
)
def test_move_beyond_the_limits_is_sent_to_no_driver(to: Any, speed: float, error: Any) -> None:
    rig = home_rig()
    arm = with_arm(rig)
    with pytest.raises(error):
        rig.move(Move("slide", to, speed), HOME)
    assert arm.started == []


@pytest.mark.parametrize("rate", [0.0, -5.0, float("nan"), float("inf"), 1000.0])
def test_turn_beyond_the_rigs_limits_is_sent_to_no_driver(rate: float) -> None:
    rig = home_rig()
    arm = with_arm(rig)
    to = replace(HOME, twist_deg=10.0)
    segment = Segment(rig.plate_frame.pose(to), 10.0, rate)
    with pytest.raises(RigError, match=r"turns at|sensor's rim at 1000 deg/s"), rig.moving(segment):
        pass
    if rate != 1000.0:
        with pytest.raises(RigError, match=r"arm: segment 1 of 1 turns at"):
            rig.twist(Twist("twist", to, rate), HOME)
    assert arm.started == []


@pytest.mark.parametrize("force_n", [0.0, -1.0, float("nan")])
def test_press_to_a_force_that_is_none_is_sent_to_no_driver(force_n: float) -> None:
    rig = make_rig()
    rig.begin_trial(HOME, 1)
    arm = with_arm(rig)
    with pytest.raises(RigError, match=r"force sensor: .*press to"):
        rig.take_step(0, Move("press", DEEP, 2.0, until_force_n=force_n), HOME, None)
    assert arm.started == []


def test_reflex_without_numbers_is_refused() -> None:
    for name in ("deepest_mm", "deeper_mm", "speed_mm_s", "force_n", "hold_s"):
        with pytest.raises(ValueError, match=name):
            replace(Reflex("press", 3.0, 0.5), **{name: float("nan")})


def test_touching_off_by_an_arm_that_never_arrives_ends() -> None:
    """Its measured pose scatters, so that it is never the same."""
    rig = deaf(plain_rig())
    looks = iter(range(1, 100_000))
    rig.should_stop = lambda: next(looks) > 20_000
    arm = with_arm(rig)
    start, progress = rig.arm.start, rig.arm.progress
    stood: list[Pose] = []

    def begin(path: Any) -> None:
        if path[0].speed_mm_s == 1.0:
            stood.append(arm._arm.pose())
            x, y, z = stood[0].xyz_mm
            noise = np.random.default_rng(1)
            arm._lie = lambda _: Pose((x + noise.normal(0, 1e-3), y, z), stood[0].rotvec_deg)
            put(arm, "progress", lambda: replace(progress(), done=False))
            put(arm, "stop", lambda: arm.__dict__.pop("progress", None))
        else:
            start(path)

    put(rig.arm, "start", begin)
    with pytest.raises(ArmFault, match="did not finish touching off in time"):
        touch_off(rig, 1.0, 2.4, 1)


def test_limits_of_the_arm_are_held_for_a_driver_that_holds_none() -> None:
    rig = plain_rig()
    box = ArmLimits(low_mm=(300, -50, 200), high_mm=(399, 50, 400), tilt_deg=10)
    rig.guard = Guard(box)
    arm = with_arm(rig)
    with pytest.raises(WorkspaceError, match="x in the base frame"):
        rig.move(Move("press", DEEP, 2.0), rig.position())
    assert arm.started == []


def test_depth_counts_from_the_touched_zero() -> None:
    rig = plain_rig()
    rig.plate_frame = rig.plate_frame.with_zero(-0.5)
    rig.move(Move("home", HOME, 10.0), rig.position())
    with pytest.raises(DepthError):
        rig.move(Move("press", Position(0.0, 0.0, 4.1), 2.0), HOME)
    rig.move(Move("press", Position(0.0, 0.0, 3.9), 2.0), HOME)


def test_jogged_arm_beyond_a_limit_may_return_and_go_no_farther() -> None:
    rig = home_rig()
    far = Position(14.0, 0.0, 3.0)
    rig.arm.start([Segment(rig.plate_frame.pose(replace(far, x_mm=18.0)), 20.0)])  # by a person
    while not rig.arm.progress().done:
        rig.clock.wait(0.05)
    here = rig.position()
    with pytest.raises(WorkspaceError):
        rig.move(Move("slide", replace(here, x_mm=18.5), 5.0), here)
    with pytest.raises(OSError, match="disk"), rig.safely(HOME):
        raise OSError("disk")
    assert rig.position().depth_mm == pytest.approx(-2.0)
    rig.move(Move("home", HOME, 10.0), rig.position())


def test_moves_that_no_protocol_names_keep_the_rigs_speed() -> None:
    rig = plain_rig()
    rig.guard = Guard(None, replace_limits(rig, speed_mm_s=4.0))
    arm = with_arm(rig)
    rig.press(1.0, 2.0, 2.0, 1)
    with pytest.raises(RigError):
        touch(deaf(rig), 0.0, 0.0, Creep(1.0, 0.5, 3.0), 1)
    assert max(segment.speed_mm_s for segment in arm.started) == 4.0


def test_shipped_rigs_hold_the_limits_of_their_files() -> None:
    for name in ("mock", "rehearsal", "mock-gripper"):
        file, _ = load_rig_file(Path(name))
        limits = build_rig(file).guard._plate_limits
        assert (limits.depth_mm, limits.reach_mm, limits.speed_mm_s) == (4.0, 15.0, 100.0)
        assert limits.rim_mm == pytest.approx(13.2)
    assert all(RigLimits.model_fields[name].is_required() for name in ("depth", "reach", "speed"))
    assert RigFile.model_fields["limits"].is_required()


SENDS = re.compile(r"\.arm\.start\(|gripper\.move\(")


def test_only_the_rig_sends_motion() -> None:
    """No caller reaches an arm or a gripper except by what checks and watches it."""
    found = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for folder in ("rigs/core", "flows", "analysis", "storage", "protocols")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for line in path.read_text(encoding="utf-8").splitlines()
        if SENDS.search(line)
    ]
    assert found == [
        "rigs/core/rig.py: self.arm.start([segment])",
        "rigs/core/rig.py: gripper.move(opening_mm, speed_mm_s, force_n)",
    ]


# -- fingers -----------------------------------------------------------------------------------


def test_fingers_close_no_deeper_than_the_rigs_limit() -> None:
    rig = make_rig("mock-gripper", None)
    rig.begin_trial(HOME, 1)
    rig.move(Move("press", Position(0.0, 0.0, 3.0), 5.0), HOME)
    assert rig.gripper is not None
    with pytest.raises(DepthError, match=r"gripper: depth in contact 4\.3"):
        rig.move_fingers(38.7, 20.0, 50.0)
    rig.move_fingers(39.2, 20.0, 50.0)
    rig.await_fingers(rig.gripper)
    with pytest.raises(DepthError):  # the arm's own move counts what the fingers add
        rig.move(Move("press", Position(0.0, 0.0, 3.5), 5.0), Position(0.0, 0.0, 3.0))
    for wrong in ((float("nan"), 20.0, 50.0), (39.0, 1e6, 50.0), (39.0, 20.0, float("nan"))):
        with pytest.raises(RigError, match=r"gripper: .* is out of its range"):
            rig.move_fingers(*wrong)


@pytest.mark.quick(2)
@pytest.mark.parametrize("motion", [warm_up, touching_off, taught_touch, circles])
def test_fingers_are_opened_before_any_contact(motion: Callable[[Rig], None]) -> None:
    """A gripper that was closed by hand holds the sensor deeper than the arm's depth shows."""
    rig = make_rig("mock-gripper", None)
    gripper = rig.gripper
    gripper.move(rig.grip_opening_mm - 9.0, 20.0, 50.0)
    while gripper.state().moving:
        rig.clock.wait(0.05)
    openings = []

    def noted(here: Pose) -> Pose:
        if rig.plate_frame.position(here.xyz_mm).depth_mm > -0.5:
            openings.append(gripper.state().opening_mm)
        return here

    alter(rig.arm, "pose", noted)
    with suppress(RigError):  # a deaf rig finds no plate
        motion(rig)
    assert openings
    assert min(openings) == pytest.approx(rig.grip_opening_mm, abs=0.1)


def test_fingers_that_were_closed_before_connecting_count_in_the_depth() -> None:
    """A grip, a crash or a person closed them: the first move is checked with it."""
    rig = make_rig("mock-gripper", None)
    gripper = rig.gripper
    gripper.move(rig.grip_opening_mm - 3.0, 20.0, 50.0)
    while gripper.state().moving:
        rig.clock.wait(0.05)
    rig.connect()
    with pytest.raises(DepthError, match=r"depth in contact 5\.4 mm is beyond its limit"):
        rig.move(Move("press", DEEP, 2.0), rig.position())
    assert rig.position().depth_mm < 0.0


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (GripperState(float("nan"), False, False), "reports an opening of nan mm"),
        (GripperState(-50.0, False, False), "reports an opening of -50"),
        (GripperState(31.0, False, True), "stalled at 31 mm, on its way to the 40 mm"),
        (GripperState(31.0, False, False), "ended at 31 mm, not at the 40 mm"),
        (GripperState(31.0, True, False), "still moves 10 s after"),
    ],
)
def test_gripper_whose_state_cannot_be_used_keeps_a_trial_from_its_start(
    state: GripperState, said: str
) -> None:
    rig = make_rig("mock-gripper", None)
    put(rig.gripper, "state", lambda: state)
    deepest = depths(rig)
    with pytest.raises(RigError, match=f"gripper: {said}"):
        trial(rig)
    assert max(deepest) < 0.0


def test_reflex_press_stops_at_the_rigs_limit_of_depth() -> None:
    rig = make_rig("mock-gripper", None)
    arm = with_arm(rig)
    with pytest.raises(DepthError):
        run_watched(rig, PROGRAM, Watcher(slip=True), 1, 100, Reflex("press", 9.0, 3.0, 2.0))
    deepest = max(rig.plate_frame.position(s.to.xyz_mm).depth_mm for s in arm.started)
    assert deepest == pytest.approx(2.4)


class LostAfterReflex(Watcher):
    """A watcher that says slip, and can detect no more while the arm then rests."""

    def __init__(self) -> None:
        super().__init__(slip=True)
        self._phase = ""

    def step(self, phase: str, acting: bool) -> None:
        self._phase = phase

    def add(self, device: str, chunk: Chunk) -> None:
        super().add(device, chunk)
        if self._phase == "reflex" and not self.armed and self.guarded:
            raise SenseLost("event camera: silent")


@pytest.mark.parametrize(
    ("kind", "deepest_mm", "closed_mm"),
    [("grip", 4.0, 1.0), ("grip", 3.3, 0.9), ("grip", 3.2, 0.8), ("stop", 4.0, 0.8)],
)
def test_safe_state_after_a_grip_never_opens_the_fingers(
    kind: Any, deepest_mm: float, closed_mm: float
) -> None:
    """The grip of a reflex holds the object: the safe state closes further, up to the depth."""
    rig = make_rig("mock-gripper", None)
    wanted = Reflex("grip", 4.0, 0.8, 20.0, 50.0, 0.2)
    sent: list[float] = []
    move = rig.gripper.move

    def noted(opening_mm: float, *rest: float) -> None:
        sent.append(opening_mm)
        move(opening_mm, *rest)

    put(rig.gripper, "move", noted)
    with pytest.raises(SafeState) as safe:
        run_watched(
            rig,
            PROGRAM,
            LostAfterReflex(),
            1,
            100,
            wanted,
            Reflex(kind, deepest_mm, 0.2, 20.0, 50.0),
        )
    assert sent == sorted(sent, reverse=True)
    assert rig.gripper.state().opening_mm == pytest.approx(40.0 - closed_mm, abs=0.02)
    made = safe.value.reaction
    assert made.closed_mm == pytest.approx(closed_mm, abs=0.02)
    assert made.depth_mm == pytest.approx(2.4 + closed_mm, abs=0.03)


def after_reflex(kind: Any, steps: tuple[Any, ...]) -> tuple[Rig, list[Segment]]:
    """A rig and what its arm was sent after a reflex in the first motion in contact."""
    rig = make_rig("mock-gripper", None)
    rig.poll_s = 0.02
    watcher, sent = Watcher(slip=True), []
    arm = with_arm(rig)

    def step(phase: str, acting: bool) -> None:
        if phase == "reflex" and not sent:
            sent.append(len(arm.started))
            watcher._slip = False

    put(watcher, "step", step)
    reflex = Reflex(kind, 4.0, 0.3, 20.0 if kind == "grip" else 2.0, 50.0, 0.1)
    assert run_watched(rig, Program(HOME, steps), watcher, 1, 100, reflex) is not None
    return rig, arm.started[sent[0] + (kind == "press") :]


@pytest.mark.parametrize("kind", ["stop", "press", "grip"])
@pytest.mark.parametrize("leaving", ["release", "retract"])
def test_after_a_reflex_the_arm_only_leaves_straight_out(kind: Any, leaving: str) -> None:
    """What was planned in contact would drag what is held, or press it deeper."""
    turned = Position(0.0, 0.0, 3.2, twist_deg=20.0)
    out = Position(2.0, 0.0, -0.5)
    rig, sent = after_reflex(
        kind,
        (
            *PROGRAM.steps[:3],
            Move("slide", Position(0.0, 0.0, 3.2), 3.0, recorded=True),
            Twist("twist", turned, 20.0, recorded=True),
            Dwell("hold", 0.1, recorded=True),
            *([Move("retract", out, 10.0, recorded=True)] if leaving == "retract" else []),
            Move("release", HOME, 10.0),
            Move("return", HOME, 10.0),
        ),
    )
    places = [rig.plate_frame.position(segment.to.xyz_mm) for segment in sent]
    depths_mm = [place.depth_mm for place in places]
    straight = [-0.5, -2.0, -2.0] if leaving == "retract" else [-2.0, -2.0]
    assert depths_mm == pytest.approx(straight, abs=1e-6)
    assert all(0.0 < place.x_mm < 0.5 for place in places[:-1])  # the slide was to 3 mm
    assert len({round(place.x_mm, 9) for place in places[:-1]}) == 1
    assert places[-1].x_mm == pytest.approx(0.0)
    assert [segment.turn_deg_s for segment in sent] == [None] * len(sent)
    assert rig.position().depth_mm == pytest.approx(-2.0, abs=0.05)


@pytest.mark.parametrize("kind", ["stop", "press"])
def test_after_a_reflex_a_turned_sensor_turns_back_once_clear(kind: Any) -> None:
    turned = replace(DEEP, twist_deg=20.0)
    away = replace(turned, x_mm=3.0)
    rig, sent = after_reflex(
        kind,
        (
            PROGRAM.steps[0],
            Dwell("hold", 0.1, recorded=True),
            Twist("twist", turned, 20.0, recorded=True),
            Move("move", away, 3.0, recorded=True),
            Move("release", replace(away, depth_mm=-2.0), 10.0),
            Twist("untwist", Position(3.0, 0.0, -2.0), 20.0),
            Move("return", HOME, 10.0),
        ),
    )
    release, untwist, back = sent
    straight = rig.plate_frame.pose(HOME).rotvec_deg
    assert release.to.rotvec_deg == turned_about_z(straight, 20.0)
    assert untwist.to.xyz_mm == release.to.xyz_mm
    assert untwist.turn_deg_s == 20.0
    assert untwist.to.rotvec_deg == back.to.rotvec_deg == straight
    assert not rig._twisted


# -- events and frames that stop ---------------------------------------------------------------


def stops_at(rig: Rig, depth_mm: float, then: Callable[[EventChunk], EventChunk]) -> None:
    here = rig.position
    alter(rig.events, "read", lambda chunk: then(chunk) if here().depth_mm > depth_mm else chunk)


def nothing(chunk: EventChunk) -> EventChunk:
    return chunk[:0]


def frozen(chunk: EventChunk) -> EventChunk:
    return replace(chunk, t_us=np.zeros_like(chunk.t_us))


@pytest.mark.quick(2)
@pytest.mark.parametrize("then", [nothing, frozen])
@pytest.mark.parametrize(
    "seek",
    [
        lambda rig: touch_off(rig, 0.5, 1.5, 1),
        lambda rig: touch(rig, 0.0, 0.0, Creep(0.5, 1.5, 1.0), 1),
    ],
    ids=["touch_off", "touch"],
)
def test_events_that_stop_while_the_plate_is_sought_stop_the_arm(then: Any, seek: Any) -> None:
    rig = make_rig("rehearsal", None, event_camera={"width": 640, "height": 480})
    stops_at(rig, -0.5, then)
    deepest = depths(rig)
    with pytest.raises(RigError, match=r"event camera: sent no newer event for 0\.2\d s"):
        seek(rig)
    assert max(deepest) < -0.3
    assert rig.arm.progress().done


def test_real_camera_without_any_noise_is_refused_before_the_approach() -> None:
    rig = plain_rig()
    rig.simulation = None
    rig.events.start()
    put(rig.events, "read", lambda: nothing(EventChunk(*[np.zeros(1, np.int64)] * 4)))
    with pytest.raises(RigError, match=r"event camera: sent no event within 0\.5 s, not even"):
        measure_noise(rig)


@pytest.mark.parametrize("how", ["empty", "frozen"])
def test_frames_that_never_change_stop_a_touch_by_markers(how: str) -> None:
    rig = make_rig("rehearsal", None, event_camera={"width": 640, "height": 480})
    kept: list[Any] = []

    def bad(chunk: FrameChunk) -> FrameChunk:
        if rig.position().depth_mm < -1.5 or not len(chunk):
            return chunk
        kept.append(chunk.markers_px[-1])
        if how == "empty":
            columns = {name: part for name, part in vars(chunk).items() if part is not None}
            return replace(chunk, **{name: column[:0] for name, column in columns.items()})
        return replace(chunk, markers_px=np.repeat(kept[0][None], len(chunk), 0))

    alter(rig.frames, "read", bad)

    def find(chunk: FrameChunk) -> Any:
        return chunk.markers_px.astype(np.float64)

    with pytest.raises(RigError, match=r"frame camera: sent no new image for 1\.0.* is too busy"):
        touch(rig, 0.0, 0.0, Creep(0.5, 1.5, 2.0), 1, find)
    assert rig.arm.progress().done
