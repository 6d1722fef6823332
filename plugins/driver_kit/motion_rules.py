"""Rules of arms about magnitudes: speeds, lengths, turns, poses, times and limits in their units.

Each compares what the driver commands and reports with the true motion of its fake, on the true
clock of the controller.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sliplab.plugins.driver_kit.arm_bench import PULSE_EVERY_S, PULSE_S, ArmBench, pulse_s
from sliplab.plugins.driver_kit.arm_report import (
    STEP_S,
    Report,
    TrueMotion,
    ask,
    clock_offset_ns,
    follow,
    true_course,
)
from sliplab.plugins.driver_kit.arm_rules import ARRIVED_MM, CLOCK_S, check_order
from sliplab.plugins.driver_kit.bench import QUIET_S
from sliplab.plugins.driver_kit.rule import NotTried, Rules, RuleViolation
from sliplab.rigs.core.arm_settings import ArmLimits, PlaneSettings
from sliplab.rigs.core.capabilities import ArmState, Pose, RigError, Segment, StoppingArm
from sliplab.rigs.core.pose import F64, angle_deg, distance_mm

RULES = Rules[ArmBench]()
SHARE = 0.1
"""Largest deviation of a speed or a length, as a share."""
MEAN_SHARE = 0.25
"""Largest relative deviation of a mean speed: an arm may slow down between segments of a path."""
PART = 0.3, 0.7
"""Part of a segment in which its speed is measured, between its ramps."""
LONG_MM, SHORT_SHARE, SLOW_SHARE = 40.0, 0.2, 0.4
"""Length of the first segment, and of length and speed of the second one as shares of it."""
WAYS = (0.6, -0.64, 0.48), (-0.48, 0.6, 0.64)
"""Directions of two segments; no two axes have the same share."""
SLOW_MM, SLOW_MM_S = 3.0, 2.0
"""Distance and speed of a slow move, as in a trial."""
TURN_DEG, TURN_DEG_S = 30.0, 20.0
OFF_LINE_MM, OFF_SPOT_MM, ORIENTED_DEG = 0.2, 0.1, 0.2
LAG_S = 0.25
"""Longest delay of a reported pose, s, besides twice the time that a stop takes."""
STALL_S = 1.0
"""Longest delay on a busy computer, s."""
STALE_SHARE = 0.2
"""Share of answers that a busy computer may delay for longer than `LAG_S`."""
SPAN_S = 0.25
"""Largest error of begin and end of a segment, s; a busy network loses samples."""
STAMP_S = 0.05
"""Largest error of a pose's time, s."""
AT_ONCE_S = 0.25
"""Longest duration of a call that does not wait for a motion, s."""
FEWEST_STEPS, LOST_SHARE = 10, 1.5
"""Steps of time that are compared within and between reads, and how much longer the latter are
where samples are lost."""
WATCH_S, PAUSE_S = 1.0, 0.4
PULSES, ROUNDS = 4, 5
EDGE_S = 0.03
"""Largest error of an edge's time, s."""
TILT_DEG, DEPTH_MM = 20.0, 1.0


@RULES.add(
    "speed and length",
    "each segment of a path is followed straight, to its own end and at its own speed, within "
    "10 %, and its times are those of its motion",
)
def _speed(bench: ArmBench) -> None:
    bench.connect()
    path = _corner(bench)
    report = follow(bench, *path)
    if not report.chunks and not report.progress.finished:
        raise RuleViolation("neither poses nor finished segments were reported")
    course = true_course(bench, report.begin_s, report.end_s)
    begin, since = report.before, 0
    for number, segment in enumerate(path, 1):
        begin, since = _check_segment(report, course, number, begin, segment, since)
    to = replace(path[1].to, xyz_mm=_moved(path[1].to.xyz_mm, WAYS[1], -SLOW_MM))
    slow = Segment(to, min(SLOW_MM_S, bench.speed_mm_s))
    report = follow(bench, slow)
    course = true_course(bench, report.begin_s, report.end_s)
    _check_segment(report, course, 1, report.before, slow, 0)


@RULES.add(
    "turn",
    "a turn on the spot ends at its orientation, at its own speed within 10 %, and the tool centre "
    "point stays; an arm that does not twist refuses it before it moves",
)
def _turn(bench: ArmBench) -> None:
    bench.connect()
    segment = Segment(_turned(bench, bench.place()), bench.speed_mm_s, TURN_DEG_S)
    if not bench.twists:
        if bench.refusal("start", lambda: bench.arm.start([segment])) is None:
            raise RuleViolation(
                "start took a turn, though the driver declares that it does not twist"
            )
        bench.check_at_rest(QUIET_S)
        return
    report = follow(bench, segment)
    course = true_course(bench, report.begin_s, report.end_s)
    away = max(distance_mm(report.before, pose) for pose in course.poses)
    if away > OFF_SPOT_MM:
        raise RuleViolation(f"the tool centre point moved by {away:.2f} mm in a turn on the spot")
    _check_oriented(bench, segment.to)
    _check_segment(report, course, 1, report.before, segment, 0)


@RULES.add(
    "orientation",
    "a move to another orientation ends there, and the same rotation vector, in degrees, is "
    "reported",
)
def _orientation(bench: ArmBench) -> None:
    bench.connect()
    x, y, z = bench.home.xyz_mm
    away = 0.25 * _long_mm(bench)
    to = Pose((x, y + away, z), _turned(bench, bench.place()).rotvec_deg)
    try:
        bench.arrive(Segment(to, bench.speed_mm_s))
    except RigError as error:
        if bench.twists:
            raise
        raise NotTried(f"the arm does not turn its tool: {error}") from None
    _check_oriented(bench, to)


@RULES.add(
    "poses",
    "pose and read_poses report where the arm truly is, in mm of the base frame: x, y and z in "
    "their order and sign, each sample once and at its own time; all since the last read",
)
def _poses(bench: ArmBench) -> None:
    bench.connect()
    segment = _corner(bench)[0]
    report = follow(bench, segment)
    lag_s = _lag_s(bench)
    answers = report.of("pose")
    wrong = [
        answer
        for answer in answers
        if not _nearest_mm(bench, answer.value, answer.begin_s - lag_s, answer.end_s) <= OFF_LINE_MM
    ]
    if len(wrong) > STALE_SHARE * len(answers):
        raise RuleViolation(
            f"pose returned {_xyz(wrong[0].value)} mm, the arm was at "
            f"{_xyz(bench.true_pose(wrong[0].end_s))} mm and not there in the {lag_s:g} s before"
        )
    _check_samples(bench, report)
    if not bench.host_clock:
        _check_kept(bench)
    report = Report(bench.clock_s(), bench.place(), clock_offset_ns(bench))
    bench.arrive(bench.to(0.0))
    report.answers.append(ask(bench, "read_poses", bench.arm.read_poses))
    _check_samples(bench, report)
    at_rest = ask(bench, "pose", bench.arm.pose).value
    if not distance_mm(at_rest, bench.place()) <= ARRIVED_MM:
        raise RuleViolation(
            f"at rest at {_xyz(bench.place())} mm, pose returned {_xyz(at_rest)} mm"
        )


@RULES.add(
    "calls while moving",
    "start, state, pose, progress and read_poses return at once while the arm moves; the state is "
    "moving until it has arrived, and ready then",
)
def _calls(bench: ArmBench) -> None:
    bench.connect()
    segment = bench.to(_long_mm(bench))
    report = follow(bench, segment)
    course = true_course(bench, report.begin_s, report.end_s)
    assert report.start is not None
    done = np.interp(report.start.end_s, course.t_s, course.shares(report.before, segment))
    if done > 0.5:
        raise RuleViolation(f"start returned after {done:.0%} of the way")
    for name in ("state", "pose", "progress", "read_poses"):
        while_moving = [answer.seconds for answer in report.of(name) if answer.moving]
        if not while_moving:
            raise RuleViolation(f"{name} had not returned before the arm was at rest")
        if min(while_moving) > AT_ONCE_S:
            raise RuleViolation(
                f"{name} took {min(while_moving):.2f} s or more while the arm moved"
            )
    for answer in report.of("state"):
        if answer.moving and answer.value is not ArmState.MOVING:
            raise RuleViolation(f"while the arm moved its state was {answer.value}")
    for answer in report.of("progress"):
        if answer.moving and answer.value.done:
            raise RuleViolation("progress was done while the arm moved")
        if answer.moving and answer.value.state is not ArmState.MOVING:
            raise RuleViolation(
                f"while the arm moved the state of its progress was {answer.value.state}"
            )
    if bench.state() is not ArmState.READY:
        raise RuleViolation(f"after the path its state was {bench.state()}")


@RULES.add(
    "clock", "now_ns is the clock of the poses, in ns: it runs as the controller's clock does"
)
def _clock(bench: ArmBench) -> None:
    bench.connect()
    bench.read_times()
    offset_ns = clock_offset_ns(bench)
    begin_s = read_s = bench.clock_s()
    delays_s: list[float] = []

    def read() -> bool:
        nonlocal read_s
        since_s, times = read_s, bench.read_times()[0]
        read_s = bench.clock_s()
        for t_ns in times:
            at_s = (t_ns - offset_ns) / 1e9
            if not since_s - STALL_S <= at_s <= read_s + CLOCK_S:
                raise RuleViolation(
                    f"a pose of {t_ns} ns came when now_ns was about "
                    f"{round(read_s * 1e9) + offset_ns} ns"
                )
            delays_s.append(read_s - at_s)
        return False

    bench.until(read, WATCH_S)
    passed_s = bench.clock_s() - begin_s
    went_s = (clock_offset_ns(bench) - offset_ns) / 1e9 + passed_s
    if not abs(went_s - passed_s) <= SHARE * passed_s:
        raise RuleViolation(
            f"now_ns went on by {went_s:.3f} s in {passed_s:.3f} s of the controller"
        )
    if not delays_s or not min(delays_s) <= LAG_S + CLOCK_S:
        raise RuleViolation(f"no pose came within {LAG_S + CLOCK_S:.2f} s of its time")


@RULES.add(
    "host times",
    "host_ns of a pose is the host's monotonic clock when it was received, in ns; not when it was "
    "read",
)
def _host_times(bench: ArmBench) -> None:
    bench.connect()
    bench.read_times()
    stall_ns = round(STALL_S * 1e9)
    ages_s: list[float] = []
    apart = False
    for _ in range(ROUNDS):
        since_ns = bench.host_ns()
        bench.wait(QUIET_S)
        times, arrivals = bench.read_times()
        apart |= len(times) < 2 or times[0] == times[-1] or arrivals[0] != arrivals[-1]
        now_ns = bench.host_ns()
        check_arrivals(arrivals, since_ns - stall_ns, now_ns)
        if arrivals:
            ages_s.append((now_ns - arrivals[-1]) / 1e9)
    if not ages_s:
        raise RuleViolation("read_poses returned no poses")
    if not apart:
        raise RuleViolation(
            "host_ns of all poses of a read was the same, though they came one by one"
        )
    if np.median(ages_s) > LAG_S:
        raise RuleViolation(
            f"host_ns of the newest pose was {np.median(ages_s):.2f} s old when it was read"
        )
    bench.start(bench.to(0.25 * _long_mm(bench)))
    bench.end(bench.bounds.news_s + 1.0)
    check_arrivals(bench.read_times()[1], now_ns - stall_ns, bench.host_ns())


@RULES.add(
    "counter wraps", "times go on where a counter of the controller wraps, as one of 32 bits does"
)
def _wraps(bench: ArmBench) -> None:
    began_s = bench.clock_s()
    bench.connect()
    before_s = bench.clock_s() - began_s + 2 * QUIET_S
    for wrap_s in bench.wraps_s:
        bench.restart(wrap_s - before_s)
        bench.connect()
        _check_wrap(bench, wrap_s)


@RULES.add(
    "sync input",
    "each rising edge of the sync line is one pulse, read once, at its time on the controller's "
    "clock",
)
def _sync_input(bench: ArmBench) -> None:
    bench.connect()
    offset_ns = clock_offset_ns(bench)
    bench.call("read_pulses", bench.arm.read_pulses)
    begin_s = bench.clock_s()
    pulses: list[int] = []

    def read() -> bool:
        pulses.extend(bench.call("read_pulses", bench.arm.read_pulses).t_ns.tolist())
        return False

    bench.until(read, PULSES * PULSE_EVERY_S)
    if not bench.sync_read:
        raise NotTried("the fake has no sync input")
    numbers = range(int(begin_s / PULSE_EVERY_S) - 1, int(bench.clock_s() / PULSE_EVERY_S) + 1)
    edges_s = np.array([pulse_s(number) for number in numbers])
    seen: set[int] = set()
    least_s = 0.0 if not pulses else math.inf
    for t_ns in pulses:
        at_s = (t_ns - offset_ns) / 1e9
        nearest = int(np.abs(edges_s + 0.5 * PULSE_S - at_s).argmin())
        # a busy computer sees an edge late, while the level is still high
        if not -EDGE_S <= at_s - edges_s[nearest] <= PULSE_S - EDGE_S:
            raise RuleViolation(
                f"a pulse was reported {at_s - edges_s[nearest]:+.3f} s from the nearest rising "
                f"edge; pulses last {PULSE_S:g} s"
            )
        if nearest in seen:
            raise RuleViolation(f"the pulse of {t_ns} ns was read twice")
        seen.add(nearest)
        least_s = min(least_s, abs(at_s - edges_s[nearest]))
    if least_s > EDGE_S:
        raise RuleViolation(f"each pulse was reported {least_s:.3f} s or more from its rising edge")
    if len(seen) < PULSES // 2:
        raise RuleViolation(f"{len(seen)} of about {PULSES} pulses were reported")


@RULES.add("close while moving", "close of an arm that moves stops it before it returns")
def _close_moving(bench: ArmBench) -> None:
    bench.connect()
    segment = bench.start_long()
    bench.refusal("close", bench.arm.close)
    bench.until(lambda: not bench.moving(), QUIET_S)  # a controller stops when its client is gone
    bench.check_at_rest(QUIET_S)
    if distance_mm(bench.place(), segment.to) < ARRIVED_MM:
        raise RuleViolation("the arm went on to the end of the path")


@RULES.add(
    "limits of turn and depth",
    "a path that turns the tool by more than tilt_deg, passes the plate by more than depth_mm, or "
    "has a speed that is none, is refused before the arm moves",
)
def _turn_and_depth(bench: ArmBench) -> None:
    x, y, z = bench.home.xyz_mm
    # z into the plate is z of the base frame
    plate = PlaneSettings(centre_mm=(x, y, z), right_mm=(x + 10.0, y, z), above_mm=(x, y + 10.0, z))
    bench.restart(limits=_with(bench.limits, plate=plate, depth_mm=DEPTH_MM, tilt_deg=TILT_DEG))
    bench.connect()
    near, speed = bench.to(ARRIVED_MM), bench.speed_mm_s
    here = bench.call("pose", bench.arm.pose)
    tilted = _turned(bench, here, 1.5 * TILT_DEG)
    sides = bench.limits.low_mm, bench.limits.high_mm
    beyond = [
        Pose(_put(bench.home, axis, side[axis] + step), here.rotvec_deg)
        for side, step in zip(sides, (-10.0, 10.0), strict=True)
        for axis in range(3)
    ]
    paths: list[tuple[str, list[Segment]]] = [
        (f"to {_xyz(pose)} mm, out of the box", [Segment(pose, speed)]) for pose in beyond
    ]
    paths += [
        ("that turns the tool too far", [Segment(tilted, speed)]),
        ("that turns the tool too far in its second segment", [near, Segment(tilted, speed)]),
        ("that turns too far on the spot", [Segment(tilted, speed, TURN_DEG_S)]),
        (
            "too deep into the plate",
            [Segment(Pose((x, y, z + 3 * DEPTH_MM), here.rotvec_deg), speed)],
        ),
        ("at a speed of 0", [Segment(near.to, 0.0)]),
        ("at a speed below 0", [Segment(near.to, -speed)]),
        ("at a speed that is no number", [Segment(near.to, float("nan"))]),
        ("with a turn at no speed", [Segment(here, speed, 0.0)]),
        ("with a turn at a speed that is no number", [Segment(here, speed, float("nan"))]),
    ]
    for what, path in paths:
        error = bench.refusal("start", lambda path=path: bench.arm.start(path))  # type: ignore[misc]
        moved = max(distance_mm(bench.home, bench.place()), angle_deg(bench.home, bench.place()))
        if error is None or moved > ARRIVED_MM or bench.moving():
            raise RuleViolation(f"start took a path {what}")
    bench.check_at_rest(QUIET_S)


# ---------------------------------------------------------------------------------------------


def check_arrivals(arrivals: list[int], since_ns: int, now_ns: int) -> None:
    """Raise Seen if arrivals, ns, are not of the host's clock between two of its times."""
    check_order("arrivals", arrivals)
    for host_ns in arrivals:
        if not since_ns <= host_ns <= now_ns:
            raise RuleViolation(
                f"host_ns was {host_ns}, received between {since_ns} and {now_ns} ns of the host's "
                "monotonic clock"
            )


def _long_mm(bench: ArmBench) -> float:
    sides = np.array(bench.limits.high_mm) - np.array(bench.limits.low_mm)
    return min(LONG_MM, 0.4 * float(sides.min()))


def _corner(bench: ArmBench) -> tuple[Segment, Segment]:
    """Return a path of a long segment and a short, slower one, in other directions."""
    long_mm, place = _long_mm(bench), bench.place()
    speed = min(bench.speed_mm_s, long_mm)
    turn = bench.call("pose", bench.arm.pose).rotvec_deg
    corner = _moved(place.xyz_mm, WAYS[0], long_mm)
    end = _moved(corner, WAYS[1], SHORT_SHARE * long_mm)
    return Segment(Pose(corner, turn), speed), Segment(Pose(end, turn), SLOW_SHARE * speed)


def _moved(
    xyz: tuple[float, float, float], way: tuple[float, float, float], mm: float
) -> tuple[float, float, float]:
    x, y, z = (a + mm * b for a, b in zip(xyz, way, strict=True))
    return x, y, z


def _put(pose: Pose, axis: int, value: float) -> tuple[float, float, float]:
    x, y, z = (value if number == axis else old for number, old in enumerate(pose.xyz_mm))
    return x, y, z


def _turned(bench: ArmBench, pose: Pose, degrees: float | None = None) -> Pose:
    """Return a pose turned about the bench's axis, by less than the limits allow if left out."""
    if degrees is None:
        degrees = min(TURN_DEG, 0.8 * bench.limits.tilt_deg)
    turn = Rotation.from_rotvec(degrees * np.array(bench.axis), degrees=True)
    rotation = turn * Rotation.from_rotvec(pose.rotvec_deg, degrees=True)
    a, b, c = rotation.as_rotvec(degrees=True).tolist()
    return Pose(pose.xyz_mm, (a, b, c))


def _with(limits: ArmLimits, **changes: Any) -> ArmLimits:
    return limits.model_copy(update=changes)


def _lag_s(bench: ArmBench) -> float:
    arm = bench.arm
    stopping = arm.stopping_s(bench.speed_mm_s) if isinstance(arm, StoppingArm) else 0.0
    return LAG_S + 2 * stopping


def _nearest_mm(bench: ArmBench, pose: Pose, begin_s: float, end_s: float) -> float:
    """Return the least distance of a pose from the true one between two times."""
    found = distance_mm(pose, bench.true_pose(end_s))
    if found <= OFF_LINE_MM:
        return found
    course = true_course(bench, begin_s, end_s)
    return min([found, *(distance_mm(pose, true) for true in course.poses)])


def _check_segment(
    report: Report, course: TrueMotion, number: int, begin: Pose, segment: Segment, since: int
) -> tuple[Pose, int]:
    """Check the true motion in a segment; return its end, and the row at which it was reached."""
    turns = segment.turn_deg_s is not None
    asked = segment.turn_deg_s if segment.turn_deg_s is not None else segment.speed_mm_s
    measure, unit, near = (angle_deg, "deg", 0.2) if turns else (distance_mm, "mm", ARRIVED_MM)
    whole = measure(begin, segment.to)
    left = np.array([measure(pose, segment.to) for pose in course.poses[since:]])
    reached = np.flatnonzero(left <= near)
    if not len(reached):
        raise RuleViolation(
            f"the arm came no nearer to the end of segment {number}, {whole:.1f} {unit} away, than "
            f"{left.min():.2f} {unit}"
        )
    end = since + int(reached[0])
    poses = course.poses[since : end + 1]
    way = sum(measure(a, b) for a, b in itertools.pairwise(poses)) + float(left[reached[0]])
    if not abs(way - whole) <= SHARE * whole:
        raise RuleViolation(f"segment {number} of {whole:.1f} {unit} was a way of {way:.1f} {unit}")
    if not turns and (off := _off_line_mm(begin, segment.to, poses)) > OFF_LINE_MM:
        raise RuleViolation(f"the arm left the straight line of segment {number} by {off:.2f} mm")
    shares = TrueMotion(course.t_s[since : end + 1], poses).shares(begin, segment)
    for speed, share in zip(_speeds(shares, whole), (SHARE, MEAN_SHARE), strict=True):
        if not abs(speed - asked) <= share * asked:
            raise RuleViolation(
                f"segment {number} was followed at {speed:.1f} {unit}/s instead of {asked:g} "
                f"{unit}/s"
            )
    left_at = int(np.flatnonzero(shares * whole > near)[0]) if (shares * whole > near).any() else 0
    _check_span(report, number, float(course.t_s[since + left_at]), float(course.t_s[end]))
    return segment.to, end


def _speeds(shares: F64, whole: float) -> tuple[float, float]:
    """Return median and mean speed between the ramps of a segment."""
    gone = np.maximum.accumulate(shares)
    rows = np.flatnonzero((gone >= PART[0]) & (gone <= PART[1]))
    if len(rows) < 2:  # passed within two steps
        return whole / STEP_S, whole / STEP_S
    steps = np.diff(gone[rows[0] : rows[-1] + 1])
    return float(np.median(steps)) * whole / STEP_S, float(steps.mean()) * whole / STEP_S


def _check_span(report: Report, number: int, begin_s: float, end_s: float) -> None:
    """Check the reported times of a segment against those of its true motion."""
    if len(report.progress.finished) < number:
        raise RuleViolation(f"segment {number} was not reported finished")
    spans = report.progress.finished[number - 1]
    for what, t_ns, true_s in zip(("begin", "end"), spans, (begin_s, end_s), strict=True):
        off_s = report.true_s(t_ns) - true_s
        if not abs(off_s) <= SPAN_S:
            raise RuleViolation(
                f"segment {number} was reported to {what} {off_s:+.3f} s from when it did, on the "
                "controller's clock"
            )


def _off_line_mm(begin: Pose, end: Pose, poses: list[Pose]) -> float:
    first, last = np.array(begin.xyz_mm), np.array(end.xyz_mm)
    way = (last - first) / np.linalg.norm(last - first)
    off = np.array([pose.xyz_mm for pose in poses]) - first
    return float(np.linalg.norm(off - np.outer(off @ way, way), axis=1).max())


def _check_oriented(bench: ArmBench, to: Pose) -> None:
    """Check at rest the true orientation, and those that the driver reports."""
    off = angle_deg(bench.place(), to)
    if not off <= ORIENTED_DEG:
        raise RuleViolation(f"the orientation was {off:.2f} deg from {_deg(to)} deg")
    bench.read_times()
    reported = [("pose", bench.call("pose", bench.arm.pose))]
    bench.wait(QUIET_S)
    chunk = bench.call("read_poses", bench.arm.read_poses)
    if len(chunk):
        place, turn = chunk.xyz_mm[-1].tolist(), chunk.rotvec_deg[-1].tolist()
        reported.append(("read_poses", Pose((*place,), (*turn,))))
    for name, pose in reported:
        if not angle_deg(pose, to) <= ORIENTED_DEG:
            raise RuleViolation(
                f"{name} returned the rotation vector {_deg(pose)} deg, not {_deg(to)}"
            )


def _check_kept(bench: ArmBench) -> None:
    """Check that samples of a time without a read are read after it."""
    bench.read_times()
    bench.wait(PAUSE_S)
    times = bench.read_times()[0]
    went_s = (max(times) - min(times)) / 1e9 if times else 0.0
    if went_s < 0.5 * PAUSE_S:
        raise RuleViolation(
            f"{PAUSE_S:g} s after the last read, read_poses returned {len(times)} samples of "
            f"{went_s:.3f} s"
        )


def _check_samples(bench: ArmBench, report: Report) -> None:
    """Check times, places and arrival of each sample that was read."""
    last_ns, count = -1, 0
    for chunk in report.chunks:
        if int(chunk.t_ns[0]) == last_ns:
            raise RuleViolation(f"the pose of {last_ns} ns was read twice")
        last_ns = int(chunk.t_ns[-1])
        for t_ns, xyz in zip(chunk.t_ns.tolist(), chunk.xyz_mm.tolist(), strict=True):
            count += 1
            at_s, pose = report.true_s(t_ns), Pose((*xyz,), (0.0, 0.0, 0.0))
            if at_s < report.begin_s:
                continue
            near = _nearest_mm(bench, pose, at_s - STAMP_S, at_s + STAMP_S)
            if not near <= OFF_LINE_MM:
                raise RuleViolation(
                    f"read_poses returned {_xyz(pose)} mm for {t_ns} ns, the arm was at "
                    f"{_xyz(bench.true_pose(at_s))} mm then"
                )
    if not count:
        raise RuleViolation("read_poses returned no pose during a path")
    within = np.concatenate([np.diff(chunk.t_ns) for chunk in report.chunks])
    between = np.array(
        [int(new.t_ns[0] - old.t_ns[-1]) for old, new in itertools.pairwise(report.chunks)]
    )
    if min(len(within), len(between)) < FEWEST_STEPS:
        return
    if np.median(between) > LOST_SHARE * np.median(within):
        raise RuleViolation(
            f"samples read together are {np.median(within) / 1e6:g} ms apart, those of two reads "
            f"{np.median(between) / 1e6:g} ms: each read loses some"
        )


def _check_wrap(bench: ArmBench, wrap_s: float) -> None:
    """Read until the clock has passed a time; times must go on with those of arrival."""
    times: list[int] = []
    arrivals: list[int] = []
    nows: list[int] = []

    def read() -> bool:
        t_ns, host_ns = bench.read_times()
        times.extend(t_ns)
        arrivals.extend(host_ns)
        nows.append(bench.now_ns())
        return bench.clock_s() > wrap_s + QUIET_S

    bench.until(read, bench.bounds.connect_s)
    check_order("poses", times)
    check_order("now_ns", nows)
    if len(times) < 2:
        raise RuleViolation("read_poses returned no poses")
    went_s, passed_s = (times[-1] - times[0]) / 1e9, (arrivals[-1] - arrivals[0]) / 1e9
    if not abs(went_s - passed_s) <= CLOCK_S + SHARE * passed_s:
        raise RuleViolation(
            f"times of poses went on by {went_s:.3f} s in {passed_s:.3f} s, where the controller's "
            f"clock passed {wrap_s:.3f} s"
        )


def _xyz(pose: Pose) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*pose.xyz_mm)


def _deg(pose: Pose) -> str:
    return "({:.1f}, {:.1f}, {:.1f})".format(*pose.rotvec_deg)
