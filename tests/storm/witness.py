"""Watches the simulated arm from inside its world, which knows where it truly is."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sliplab.flows.collecting import preparation
from sliplab.flows.collecting.supervisor import CollectionSupervisor
from sliplab.flows.planning.disk_space import RESERVE
from sliplab.plugins.simulation.arm import MockArm
from sliplab.plugins.simulation.event_camera import MockEventCamera
from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.plugins.simulation.frame_camera import MockFrameCamera
from sliplab.plugins.simulation.sync import MockSyncBox
from sliplab.plugins.simulation.thermometer import MockThermometer
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.program import Move, Position
from sliplab.rigs.core import reacting
from sliplab.rigs.core.capabilities import ArmState, Segment
from sliplab.rigs.core.guard import MEASURED_MM
from sliplab.rigs.core.motion_watch import is_near
from sliplab.rigs.core.reacting import Reflex
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.streams import FrameChunk
from sliplab.storage.trials import control
from sliplab.storage.trials.context import SKIN, LoggedContext
from tests.patching import put
from tests.storm.lies import FALSE_PLACES, Lie
from tests.storm.sent import Tee
from tests.storm.virtual import Host, Notes

PLATE_MM = 1.0
"""How far the true plate may lie from the taught one, with its tilt over the reach."""
SLACK_S = 0.3
"""Beyond one poll, until a fault that the poses show has stopped the arm."""
STUCK_S, STUCK_MM = 3.0, 0.5
"""Time, and motion at the commanded speed, until a pose that does not change stops the arm."""
SILENT_S = 0.5
"""Until a force sensor that does not answer has stopped the arm."""
RATES_HZ = {"frames/t": 100.0, "poses/t": 500.0}
"""Rows a second while streams run, of those that nobody changes."""
FORCE_SHARE = 1.1
"""Times its limit that a true force may be, for noise, and until the next sample."""
ZERO_MM = 0.15
"""How far depth zero may be from the true plate where nothing disturbs it."""
WAIT_S = 0.05
"""By how much a wait may be longer or shorter than planned."""
PLACE_MM = 0.3
"""How far a step may end from where it was to, where nothing disturbs it."""
ENDS_MM = 1.5
"""How far from its end an arm may be that is said to have ended its path, with its motion since."""
BLIND_MM = 1.5
"""Motion in contact with unchanged readings until a force sensor is not believed any more."""
READS = {
    MockArm: ("read_poses", "read_pulses"),
    MockEventCamera: ("read", "read_pulses"),
    MockFrameCamera: ("read", "read_clock"),
    MockSyncBox: ("read_pulses", "read_clock"),
    MockForceSensor: ("read",),
    MockThermometer: ("read",),
}
"""Calls by which devices hand over their data."""


class Witness:
    """Notes each thing that the arm must not do.

    Args:
        file: whose limits hold.
        calm: no fault of a device disturbs where the arm is.

    Attributes:
        resumed: a session has begun, a pause ended, or another skin was logged, and depth zero was
            not found since.
        lie: what a device reports that is not so.
    """

    def __init__(self, file: RigFile, host: Host, notes: Notes, *, calm: bool) -> None:
        limits = file.limits
        self._calm = calm
        self.lie = Lie(lambda: host.passed_s)
        self._lied: tuple[str, Any] = "", None
        self._lied_s: float | None = None
        self._segment: Segment | None = None
        self._sent_from: Any = None
        self._misled = False
        self._world: SimulatedWorld | None = None
        self._pass_time: Callable[[SimulatedWorld, int], None]
        self._force_n = None if limits.force is None else float(limits.force)
        self._forced_s: float | None = None
        self._depth_mm, self._reach_mm = float(limits.depth), float(limits.reach)
        self._speed_mm_s, self._poll_s = float(limits.speed), float(file.poll)
        self._host, self._notes, self._streams_s = host, notes, 0.0
        self._asked_s: float | None = None
        self._starts = 0
        self._outside: tuple[float, float] | None = None
        self._began_over = 0.0
        self._handed: Counter[str] | None = None
        self._arrived: list[tuple[int, int]] = []
        self._zeroed = self._ever_zeroed = False
        self._corners: list[Any] = []
        self._blind: tuple[Any, float] | None = None
        self.resumed = True
        self._skin: str | None = None
        self._plan: Plan | None = None
        self._slot: int | None = None
        self._pressed = 0

    def wrong(self, invariant: str, what: str) -> None:
        """Note a fault."""
        self._notes.add(wrong=invariant, what=what)

    def stop_asked(self) -> None:
        """Take note that a person asked for a stop, now."""
        if self._asked_s is None:
            self._asked_s, self._starts = self._host.passed_s, 0

    def suspend(self, seconds: float) -> None:
        """Let time pass in which this process does nothing, and others and devices go on."""
        if self._world is None:
            return
        began_s = self._host.passed_s
        self._pass_time(self._world, round(seconds * 1e9))
        late_s = self._host.passed_s - began_s  # which no program can make up for
        self._asked_s = None if self._asked_s is None else self._asked_s + late_s
        self._lied_s = self._outside = self._forced_s = self._blind = None

    def watch_reflexes(self) -> None:
        """Hold each reflex against where the arm truly is."""
        react: Any = reacting._react

        def reacting_to(rig: Rig, phase: str, reflex: Reflex, *given: Any) -> Any:
            made = react(rig, phase, reflex, *given)
            world = self._world
            assert world is not None
            if world.path.moving(world.now_ns):
                self.wrong("a reflex stops the arm", f"it still moves after a {reflex.kind}")
            depth_mm = float(world.path.states(np.array([world.now_ns], np.int64))[0][8])
            if self._calm and not abs(depth_mm - made.depth_mm) <= ZERO_MM + PLACE_MM:
                what = f"it is {depth_mm:.2f} mm deep, reported are {made.depth_mm:.2f}"
                self.wrong("a reflex is as it says", what)
            deeper_mm = made.depth_mm - made.stopped_mm[2]
            most_mm = reflex.deeper_mm if reflex.kind == "press" else 0.0
            least_mm = min(most_mm, reflex.deepest_mm - made.stopped_mm[2])
            if self._calm and not least_mm - 0.1 <= deeper_mm <= most_mm + 0.1:
                self.wrong("a reflex is as it says", f"{reflex.kind} goes {deeper_mm:.2f} mm in")
            return made

        reacting._react = reacting_to

    def install(self) -> None:
        """Watch every arm of this process."""
        start, pass_time = MockArm.start, SimulatedWorld.pass_time
        run_trial: Any = Rig.run_trial
        rezero: Any = preparation.rezero
        take_step: Any = Rig.take_step
        start_streams: Any = Rig.start_streams
        stop_streams: Any = Rig.stop_streams
        press: Any = Rig.press
        retract: Any = Rig._retract
        zero = MockForceSensor.zero
        self.lie.install()
        self._count_reads()
        self._pass_time = pass_time

        def starting(arm: MockArm, path: Sequence[Segment]) -> None:
            self._look_at_path(arm._world, path)
            state = arm._world.arm_state
            self._corners.append(arm._world.path.states(_now(arm._world))[0][:3])
            start(arm, path)
            self._corners += [np.array(segment.to.xyz_mm) for segment in path]
            if state is ArmState.PROTECTIVE_STOP:
                self.wrong("no motion after a stop", f"it is sent on in {state.value}")
            self._segment, self._lied_s, self._blind = path[-1], None, None
            self._sent_from = _place(arm._world)  # an arm that strays is not where it was sent
            # what is sent from a false pose goes to a false place, which nothing here can know
            self._misled = self._is_false

        def zeroing(sensor: MockForceSensor) -> None:
            zero(sensor)
            self._zeroed = self._ever_zeroed = True
            deep_mm = float(_place(sensor._world)[2])
            if self._calm and not deep_mm < 0:
                self.wrong("forces are zeroed clear of the plate", f"{deep_mm:.2f} mm deep")

        def retracting(rig: Rig, *given: Any) -> Any:
            if self._asked_s is None:  # it is sent once, and straight, whatever made it stop
                self._asked_s, self._starts = self._host.passed_s, 0
            return retract(rig, *given)

        def pressing(rig: Rig, *given: Any) -> None:
            press(rig, *given)
            self._pressed += 1

        def passing(world: SimulatedWorld, ns: int) -> None:
            self._world = world
            pass_time(world, ns)
            self._look(world)

        def rezeroing(rig: Rig, *given: Any) -> Any:
            self.resumed, self._slot = False, None
            found = rezero(rig, *given)
            self._look_at_zero(rig)
            return found

        def stepping(rig: Rig, index: int, step: Any, at: Position, sink: Any) -> Any:
            began_s = self._host.passed_s
            times = take_step(rig, index, step, at, sink)
            self._look_at_step(rig, step, at, self._host.passed_s - began_s)
            return times

        def starting_streams(rig: Rig, *given: Any, **named: Any) -> None:
            start_streams(rig, *given, **named)
            self._streams_s, self._handed = self._host.passed_s, Counter()
            if rig.force is not None and rig.force.zeroing == "trial" and not self._zeroed:
                self.wrong("forces are zeroed clear of the plate", "not before this trial")
            self._zeroed = False

        def stopping_streams(rig: Rig, sink: Any) -> None:
            took_s = self._host.passed_s - self._streams_s
            stop_streams(rig, sink)
            handed, self._handed = self._handed, None
            for kind, rows in (handed or {}).items() if isinstance(sink, Tee) else ():
                if rows != sink.rows[kind]:
                    what = f"{rows} rows of {kind}, stored are {sink.rows[kind]}"
                    self.wrong("what is handed over is stored", what)
            for name, rate_hz in RATES_HZ.items() if isinstance(sink, Tee) and self._calm else ():
                by_itself = rig.timing.frames != "hardware trigger"
                if name == "frames/t" and (by_itself or rig.frame_camera is None):
                    continue
                rows = sink.columns[name][0]
                if not rows >= rate_hz * took_s - 2:
                    self.wrong("what happened is recorded", f"{rows} rows of {name} in {took_s} s")

        def running(rig: Rig, program: Any, sink: Any, *more: Any, **named: Any) -> Any:
            maintenance = None if self._plan is None else self._plan.protocol.collection.maintenance
            zeroes = maintenance and maintenance.rezero and rig.event_camera is not None
            if zeroes and (self.resumed or self._slot is not None):
                self.wrong("a rig is prepared", "depth zero is not found again")
            if maintenance and maintenance.warm_up and not self._pressed:
                self.wrong("a rig is prepared", "the skin is not warmed up")
            self.resumed = False
            tee, began_s = Tee(sink), self._host.wall_s
            self._corners.clear()
            self._arrived.clear()
            done = run_trial(rig, program, tee, *more, **named)
            about = {
                "sent": tee.columns,
                "lost": tee.frames_lost,
                "strayed_mm": _strayed_mm(np.concatenate(tee.poses), np.array(self._corners)),
                "times": [began_s, self._host.wall_s],
                "zero_mm": rig.plate_frame.zero_mm,
                "phases": [[step.phase, step.recorded] for step in program.steps],
                "arrived": self._on_box(rig) if self._calm else [],
            }
            self._notes.add(recorded=getattr(sink, "_sink", sink).folder.name, **about)
            return done

        put(MockArm, "start", starting)
        put(MockForceSensor, "zero", zeroing)
        put(Rig, "press", pressing)
        put(Rig, "_retract", retracting)
        put(SimulatedWorld, "pass_time", passing)
        put(Rig, "run_trial", running)
        put(preparation, "rezero", rezeroing)
        put(Rig, "start_streams", starting_streams)
        put(Rig, "stop_streams", stopping_streams)
        put(Rig, "take_step", stepping)

    def _count_reads(self) -> None:
        """Count the rows that devices hand over while their streams are recorded, by kind."""

        def counting(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
            def reading(device: Any) -> Any:
                chunk = read(device)
                if self._handed is not None:
                    self._handed[chunk.KIND.name] += len(chunk)
                    if isinstance(device, MockFrameCamera) and device.timed_by_host:
                        self._arrived += _exposed(device, chunk)
                return chunk

            return reading

        for kind, names in READS.items():
            for name in names:
                setattr(kind, name, counting(getattr(kind, name)))

    def _on_box(self, rig: Rig) -> list[tuple[int, int]]:
        """Return when some frames arrived, and when they were exposed by the box's clock, ns."""
        box = rig.sync
        assert isinstance(box, MockSyncBox)
        return [(arrived, int(box.clock.to_reference(true))) for arrived, true in self._arrived]

    def watch(self, supervisor: CollectionSupervisor, plan: Plan) -> None:
        """Watch what a collection is allowed between its trials."""
        self._plan = plan
        rezeroes = plan.protocol.collection.maintenance.rezero is not None
        may_take, slots = supervisor.may_take, list[int]()
        places = [each.id for each in plan]

        store, campaign = supervisor._store, supervisor._campaign
        until = supervisor._run_request.until
        last = max((each.number for each in control.requests(store)), default=0)

        def asked(trial: PlannedTrial, due_s: float = 0.0) -> bool:
            may = may_take(trial, due_s)
            if not may:
                return may
            self._notes.add(begins=trial.id, place=places.index(trial.id))
            if (pause := control.paused(store)) is not None:
                self.wrong("requests are carried out", f"continues in spite of a {pause.kind}")
            if trial.id in control.skipped(campaign):
                self.wrong("requests are carried out", f"takes {trial.id}, which is skipped")
            if any(each.kind == "stop" and each.number > last for each in control.requests(store)):
                self.wrong("requests are carried out", "continues in spite of a stop")
            skin = LoggedContext(store, campaign.name).read().get(SKIN)
            if self.resumed or skin != self._skin:
                self.resumed, self._skin, self._pressed = True, skin, 0
            if rezeroes and (slot := plan.rezero_task(trial).slot) not in slots[-1:]:
                slots.append(slot)
                self._slot = slot  # until depth zero is found for it
            if until is not None and self._host.wall_s > until:
                self.wrong("no trial begins outside its window", trial.id)
            folders = campaign.folders("trials")
            sizes = [sum(each.stat().st_size for each in path.iterdir()) for path in folders]
            if self._host.free < RESERVE + 0.5 * min(sizes, default=0):
                self.wrong("no trial begins on a full disk", f"{self._host.free} bytes are free")
            return may

        put(supervisor, "may_take", asked)

    def _look_at_zero(self, rig: Rig) -> None:
        """Hold depth zero, which was just found, against the true plate."""
        if not self._calm:  # a fault's arm stands before the simulated one
            return
        pose = rig.plate_frame.pose(Position(0.0, 0.0, 0.0))
        off = float(_world(rig).plane.sensor(pose)[2])
        if not abs(off) <= ZERO_MM:
            self.wrong("depth zero is the plate", f"it is {off:.3f} mm off")

    def _look_at_step(self, rig: Rig, step: Any, at: Position, took_s: float) -> None:
        """Hold where the arm truly is, and how long it took, against the step it has taken."""
        if not self._calm:
            return
        if not isinstance(step, Move):
            if not abs(took_s - step.seconds) <= WAIT_S:
                self.wrong("a trial is as planned", f"waits {took_s:.2f} s, not {step.seconds:.2f}")
            return
        world = _world(rig)
        true = _place(world)
        wanted = world.plane.sensor(rig.plate_frame.pose(step.to))
        if not math.dist(true[:3], wanted[:3]) <= PLACE_MM:
            off = math.dist(true[:3], wanted[:3])
            self.wrong("a trial is as planned", f"{step.phase} ends {off:.2f} mm off")
        planned_s = at.distance_mm(step.to) / step.speed_mm_s
        if not 0.95 * planned_s - WAIT_S <= took_s <= 1.05 * planned_s + WAIT_S:
            self.wrong("a trial is as planned", f"{step.phase} takes {took_s:.2f} s of {planned_s}")

    def _look_at_path(self, world: SimulatedWorld, path: Sequence[Segment]) -> None:
        here = _place(world)
        self._began_over = self._excess(here) + MEASURED_MM
        before = self._segment
        if before is not None and world.path.moving(world.now_ns):
            off_mm = math.dist(here, world.plane.sensor(before.to)[:3])
            if not off_mm <= ENDS_MM:
                what = f"it is sent on {off_mm:.2f} mm before the end of its path"
                self.wrong("a path begins where the last one ended", what)
        for segment in path:
            there = world.plane.sensor(segment.to)
            if self._asked_s is not None:
                self._starts += 1
                aside, deeper = math.dist(here[:2], there[:2]), there[2] - here[2]
                astray = not (aside <= 0.5 and deeper <= 0.01) and not self._is_false
                if self._starts > 1 or astray:
                    self.wrong(
                        "no motion after a stop",
                        f"move {self._starts} goes {aside:.2f} mm aside to {there[2]:.2f} mm deep",
                    )
            if not 0 < segment.speed_mm_s <= self._speed_mm_s + 1e-6:
                self.wrong("within limits", f"is sent at {segment.speed_mm_s} mm/s")
            if not self._is_false:
                self._check_place(there, here, "is sent")

    @property
    def _is_false(self) -> bool:
        """Whether the arm reports to be elsewhere, so that what is sent from there goes astray."""
        return self.lie.active in FALSE_PLACES

    def _excess(self, place: Any) -> float:
        """Return how far a place on the true plate is beyond the limits, mm."""
        return max(float(place[2]) - self._depth_mm, math.hypot(*place[:2]) - self._reach_mm)

    def _check_place(self, place: Any, before: Any, how: str) -> None:
        over = self._excess(place)
        if not over <= max(self._excess(before), 0.0) + PLATE_MM:
            self.wrong("within limits", f"{how} {over:.2f} mm beyond them")

    def _look_at_lie(self, now_s: float, moving: bool, place: Any, world: SimulatedWorld) -> None:
        """A device that reports what cannot be stops the arm."""
        kind, segment = self.lie.active, self._segment
        if kind == "path_done" or not (kind and moving and segment):
            self._lied_s = None
            return
        if kind in {"pose_away", "pose_creep"}:
            shown = self.lie.pose and world.plane.sensor(self.lie.pose)
            if self._misled or shown is None or not self._excess(shown) > PLATE_MM + ENDS_MM:
                self._lied_s = None
                return
        frozen = self.lie.frozen if kind == "pose_frozen" else None
        if self._lied_s is None or (kind, frozen) != self._lied:  # another pose is news
            self._lied, self._lied_s = (kind, frozen), now_s
        bound_s = self._poll_s + SLACK_S
        if kind == "pose_frozen":
            if frozen is None or is_near(frozen, segment.to):
                return
            bound_s += STUCK_S + STUCK_MM / segment.speed_mm_s + self._poll_s
        elif kind.startswith("force"):
            there = world.plane.sensor(segment.to)
            straight = self._misled or math.dist(self._sent_from[:2], there[:2]) < 0.5
            if straight and there[2] < place[2]:
                return  # it leaves the plate, whatever the sensor says
            bound_s = SILENT_S
            if kind == "force_frozen" and not self._is_blind(place):
                self._lied_s = now_s
                return
            if kind == "force_high" and not self._ever_zeroed:  # it may be the load's own zero
                return
        if now_s - self._lied_s > bound_s:
            self.wrong("no news and no number are a fault", f"moves on in spite of {kind}")

    def _is_blind(self, place: Any) -> bool:
        """Return whether the arm moved so far in contact that a force had to change."""
        begin, gone_mm = self._blind or (place, 0.0)
        if place[2] <= ZERO_MM or place[2] < begin[2] - 0.005:
            self._blind = None  # where contact ends, forces may stay as they are
            return False
        gone_mm = max(gone_mm, math.dist(begin, place))
        self._blind = begin, gone_mm
        return gone_mm > BLIND_MM

    def _look_at_force(self, now_s: float, moving: bool, place: Any, world: SimulatedWorld) -> None:
        """A force beyond the limit stops the arm, unless it leaves the plate."""
        wrench, segment = world.physics.wrench, self._segment
        if self._force_n is None or wrench is None or segment is None or not moving:
            self._forced_s = None
            return
        true_n = math.dist(wrench.at(np.array([wrench.end_ns]))[0][:3], (0.0, 0.0, 0.0))
        leaves = world.plane.sensor(segment.to)[2] < place[2] - 0.01
        if not true_n > FORCE_SHARE * self._force_n or leaves:
            self._forced_s = None
        elif self._forced_s is None:
            self._forced_s = now_s
        elif now_s - self._forced_s > SILENT_S and self.lie.active != "force_silent":
            self.wrong("within limits", f"moves on with {true_n:.1f} N on the plate")

    def _look(self, world: SimulatedWorld) -> None:
        """Look at the arm where it truly is now."""
        now_s, moving = self._host.passed_s, world.path.moving(world.now_ns)
        place = _place(world)
        self._look_at_lie(now_s, moving, place, world)
        self._look_at_force(now_s, moving, place, world)
        if self._asked_s is not None and moving and self._starts == 0:
            late = now_s - self._asked_s
            if late > self._poll_s + 1e-3:
                self.wrong("stops in time", f"still moves {late:.3f} s after it was asked to stop")
        over = self._excess(place)
        # a path that begins outside leads back, and may go as far again on its way
        if not (moving and over > max(PLATE_MM, self._began_over)) or self._misled:
            self._outside = None
        elif self._outside is None or over <= self._outside[1]:  # it may come back
            self._outside = now_s, over
        elif now_s - self._outside[0] > self._poll_s + SLACK_S:
            self.wrong("within limits", f"moves on {over:.2f} mm outside")


def _exposed(camera: MockFrameCamera, chunk: FrameChunk) -> list[tuple[int, int]]:
    """Return when the first and the last frame of a chunk arrived, and when they were exposed."""
    if not len(chunk):
        return []
    some = np.array([0, -1])
    ticks = chunk.number[some] + camera._next_tick - camera._number
    mid_ns = camera._trigger.true_ns(ticks) + camera.mid_exposure_ns
    return [*zip(chunk.t_ns[some].tolist(), mid_ns.tolist(), strict=True)]


def _world(rig: Rig) -> SimulatedWorld:
    assert isinstance(rig.arm, MockArm)
    return rig.arm._world


def _now(world: SimulatedWorld) -> Any:
    return np.array([world.now_ns], np.int64)


def _place(world: SimulatedWorld) -> Any:
    """Return where the sensor truly is on the true plate, x, y and depth, mm."""
    return world.path.states(_now(world))[0][6:9]


def _strayed_mm(places: Any, corners: Any) -> float:
    """Return the largest distance of places (n, 3) from the lines between corners (m, 3)."""
    nearest = np.full(len(places), np.inf)
    for begin, end in pairwise(corners):
        way = end - begin
        share = np.clip((places - begin) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
        away = np.linalg.norm(places - begin - share[:, None] * way, axis=1)
        nearest = np.minimum(nearest, away)
    return float(nearest.max(initial=0.0))
