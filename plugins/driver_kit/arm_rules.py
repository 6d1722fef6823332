"""Rules of arms: stop, limits, times, silence, unplugging and late answers."""

from __future__ import annotations

import itertools
import math
from contextlib import suppress
from dataclasses import replace
from functools import partial

from sliplab.plugins.driver_kit.arm_bench import SHORT_MM, ArmBench
from sliplab.plugins.driver_kit.bench import QUIET_S, check_close, check_methods
from sliplab.plugins.driver_kit.rule import Rules, RuleViolation
from sliplab.rigs.core.capabilities import Arm, ArmState, Pose, RigError, Segment
from sliplab.rigs.core.fakes import CLOCK_BACK_S, Kind
from sliplab.rigs.core.pose import distance_mm

RULES = Rules[ArmBench]()
ARRIVED_MM = 0.1
CLOCK_S = 0.1
"""Deviation of reported from true times, s: a controller's cycle and a busy host."""
TIMES_S = 0.5
"""Time for which poses are read, s."""


@RULES.add(
    "declaration",
    "the driver has every method of an Arm, its ping finds the fake, and connect makes it ready "
    "and moves nothing",
)
def _declaration(bench: ArmBench) -> None:
    check_methods(bench.arm, Arm)
    problem = bench.call("ping", lambda: bench.driver.ping(bench.settings), bench.bounds.connect_s)
    if problem is not None:
        raise RuleViolation(f"ping of a fake that answers returned '{problem}'")
    if bench.state() is not ArmState.DISCONNECTED:
        raise RuleViolation(f"before connect its state was {bench.state()}")
    bench.connect()
    bench.connect()  # a second one changes nothing
    if bench.state() is not ArmState.READY:
        raise RuleViolation(f"after connect its state was {bench.state()}")
    if bench.moving() or distance_mm(bench.home, bench.place()) > ARRIVED_MM:
        raise RuleViolation("the arm moved when it was connected")


@RULES.add(
    "path",
    "a path is followed to its end, and each segment has its start and its end, those of one path "
    "alone",
)
def _path(bench: ArmBench) -> None:
    bench.connect()
    before_ns = bench.now_ns()
    path = [bench.to(SHORT_MM), bench.to(-SHORT_MM), bench.to(SHORT_MM)]
    bench.start(*path)
    progress = bench.end(6 * SHORT_MM / bench.speed_mm_s + bench.bounds.news_s)
    _check_arrived(bench, path[-1].to)
    if len(progress.finished) != len(path):
        raise RuleViolation(
            f"{len(progress.finished)} of {len(path)} segments were reported finished"
        )
    after_ns = bench.now_ns()
    _check_spans(progress.finished, before_ns, after_ns)
    bench.start(bench.to(-SHORT_MM))
    progress = bench.end(2 * SHORT_MM / bench.speed_mm_s + bench.bounds.news_s)
    if len(progress.finished) != 1:
        raise RuleViolation(
            f"{len(progress.finished)} segments of the next path, of one, were finished"
        )


@RULES.add(
    "times in order",
    "times of poses and now_ns never fall back, at rest and while the arm moves",
)
def _times(bench: ArmBench) -> None:
    bench.connect()
    bench.read_times()
    bench.start(bench.to(SHORT_MM))
    times: list[int] = []
    arrivals: list[int] = []
    nows: list[int] = []

    def read() -> bool:
        nows.append(bench.now_ns())
        t_ns, host_ns = bench.read_times()
        times.extend(t_ns)
        arrivals.extend(host_ns)
        return False

    bench.until(read, TIMES_S)
    bench.end(bench.bounds.news_s)
    read()
    if not times:
        raise RuleViolation(f"read_poses returned no pose within {TIMES_S:g} s")
    check_order("poses", times)
    check_order("arrivals of poses", arrivals)
    check_order("now_ns", nows)


@RULES.add(
    "clock falls back",
    "a controller whose clock falls back is reported as a fault, and no pose with an earlier time "
    "is returned",
)
def _clock_back(bench: ArmBench) -> None:
    bench.connect()
    times: list[int] = []

    def seen() -> bool:
        times.extend(bench.read_times()[0])
        return bool(times)

    bench.until(seen, bench.bounds.call_s)
    last_ns = max(times)
    bench.inject(Kind.CLOCK_BACK)

    def noticed() -> bool:
        for time_ns in _times_left(bench):
            if time_ns < last_ns - CLOCK_BACK_S * 0.5e9:
                raise RuleViolation(f"a pose of {time_ns} ns came after one of {last_ns} ns")
        return bench.fault_noticed()

    if not bench.until(noticed, bench.bounds.news_s):
        raise RuleViolation(f"no call reported it within {bench.bounds.news_s:g} s")


@RULES.add(
    "limits",
    "a path that leaves the limits anywhere is refused with a RigError before the arm moves at all",
)
def _limits(bench: ArmBench) -> None:
    bench.connect()
    limits, near = bench.limits, bench.to(SHORT_MM)
    x, y, z = bench.home.xyz_mm
    beyond = replace(near, to=Pose((limits.high_mm[0] + 10.0, y, z), near.to.rotvec_deg))
    below = replace(near, to=Pose((x, y, limits.low_mm[2] - 10.0), near.to.rotvec_deg))
    fast = replace(near, speed_mm_s=2 * limits.speed_mm_s)
    nowhere = replace(near, to=Pose((x, math.nan, z), near.to.rotvec_deg))
    for what, path in (
        ("outside the box", [beyond]),
        ("below the box", [below]),
        ("whose second segment lies outside the box", [near, beyond]),
        ("that leaves the box and returns", [beyond, near]),
        ("faster than speed_mm_s", [fast]),
        ("to a place that is no number", [nowhere]),
        ("without a segment", []),
    ):
        error = bench.refusal("start", lambda path=path: bench.arm.start(path))  # type: ignore[misc]
        bench.wait(QUIET_S)
        moved = distance_mm(bench.home, bench.place())
        if moved > ARRIVED_MM or bench.moving():
            raise RuleViolation(f"the arm moved {moved:.2f} mm on a path {what}")
        if error is None:
            raise RuleViolation(f"start took a path {what}")


@RULES.add("one path at a time", "start raises a RigError while the arm moves; the path continues")
def _one_path(bench: ArmBench) -> None:
    bench.connect()
    back, path = bench.to(-SHORT_MM), bench.to(4 * SHORT_MM)
    bench.start(path)
    if bench.refusal("start", lambda: bench.arm.start([back])) is None:
        raise RuleViolation("start took a second path while the arm moved")
    bench.end(bench.bounds.news_s + 4 * SHORT_MM / bench.speed_mm_s)
    _check_arrived(bench, path.to)


@RULES.add("stop at rest", "stop of an arm at rest returns and changes nothing, also twice")
def _stop_at_rest(bench: ArmBench) -> None:
    bench.call("stop before connect", bench.arm.stop)
    bench.connect()
    for _ in range(2):
        bench.call("stop", bench.arm.stop)
    if bench.state() is not ArmState.READY:
        raise RuleViolation(f"after stop its state was {bench.state()}")
    target = bench.to(SHORT_MM)
    bench.arrive(target)
    bench.call("stop", bench.arm.stop)
    _check_arrived(bench, target.to)


@RULES.add(
    "stop while moving",
    "stop returns in time with the arm at rest, the rest of the path is not followed nor reported "
    "finished, and the next path can start; each path can be stopped, also right after its start",
)
def _stop_moving(bench: ArmBench) -> None:
    bench.connect()
    segment = bench.start_long()
    bench.call("stop", bench.arm.stop)
    bench.check_at_rest(QUIET_S)
    if distance_mm(bench.place(), segment.to) < ARRIVED_MM:
        raise RuleViolation("the arm went on to the end of the path")
    progress = bench.end(bench.bounds.news_s)
    if progress.finished:
        raise RuleViolation("the stopped segment was reported finished")
    bench.call("a second stop", bench.arm.stop)
    target = bench.to(-SHORT_MM)
    bench.arrive(target)
    _check_arrived(bench, target.to)
    for way_mm, what in ((bench.long_mm, "the second path"), (-bench.long_mm, "a path at once")):
        bench.start(bench.to(way_mm))
        if what == "the second path":
            bench.until(bench.moving, bench.bounds.call_s)
        bench.call(f"stop of {what}", bench.arm.stop)
        bench.check_at_rest(QUIET_S)


@RULES.add(
    "protective stop",
    "a path that a protective stop ends is reported as ended, not finished, and as no other "
    "stop; stop returns, and no path starts until a person has cleared it",
)
def _protective(bench: ArmBench) -> None:
    bench.connect()
    bench.start_long()
    bench.inject(Kind.PROTECTIVE_STOP)
    _check_aborted(bench)
    state = bench.state()  # one that only loses its connection is lost
    if state.healthy or state is ArmState.EMERGENCY_STOP:
        raise RuleViolation(f"in a protective stop its state was {state}")
    with suppress(RigError):
        if (stated := bench.call("progress", bench.arm.progress).state).healthy:
            raise RuleViolation(f"in a protective stop the state of its progress was {stated}")
    for _ in range(2):
        bench.stop()
    bench.until(lambda: not bench.moving(), bench.bounds.call_s)
    if bench.refusal("start", lambda: bench.arm.start([_home(bench)])) is None:
        raise RuleViolation("start took a path during a protective stop")
    bench.check_at_rest(QUIET_S)


def _ended_by(bench: ArmBench, kind: Kind) -> None:
    bench.connect()
    bench.inject(kind)
    if bench.host_clock:  # a controller that is only asked says nothing until a path starts
        if bench.refusal("start", lambda: bench.arm.start([_home(bench)])) is None:
            _check_aborted(bench)
        bench.check_at_rest(QUIET_S)
        return
    _check_noticed(bench)
    if (state := bench.state()).healthy or state is ArmState.PROTECTIVE_STOP:
        raise RuleViolation(f"after the fault '{kind.value}' its state was {state}")
    if bench.refusal("start", lambda: bench.arm.start([_home(bench)])) is None:
        raise RuleViolation(f"start took a path after the fault '{kind.value}'")
    bench.check_at_rest(QUIET_S)


for _name, _kind in (
    ("emergency stop", Kind.EMERGENCY_STOP),
    ("power off", Kind.POWER_OFF),
):
    RULES.add(
        _name,
        "its state is neither ready nor that of a protective stop, and no path starts until a "
        "person has cleared it",
    )(partial(_ended_by, kind=_kind))


@RULES.add(
    "silent while moving",
    "a controller that falls silent is reported in time, no segment counts as finished, and stop "
    "and close return",
)
def _silent_moving(bench: ArmBench) -> None:
    bench.connect()
    bench.start_long()
    bench.inject(Kind.SILENCE)
    _check_aborted(bench)
    bench.stop()
    bench.refusal("close", bench.arm.close)


@RULES.add(
    "silent when a path starts",
    "start of a path returns or raises a RigError in time, the path is reported as ended and not "
    "finished, and stop returns",
)
def _silent_path(bench: ArmBench) -> None:
    bench.connect()
    target = bench.to(SHORT_MM)
    bench.inject(Kind.SILENCE)
    if bench.refusal("start", lambda: bench.arm.start([target])) is None:
        _check_aborted(bench)
    bench.stop()


@RULES.add(
    "silent from the beginning",
    "connect to a controller that never answers raises a RigError in time; stop and close return",
)
def _silent_connect(bench: ArmBench) -> None:
    bench.inject(Kind.SILENCE)
    if bench.refusal("connect", bench.open, bench.bounds.connect_s) is None:
        raise RuleViolation("connect returned as if the controller had answered")
    bench.stop()
    bench.refusal("close", bench.arm.close)


@RULES.add(
    "unplugged",
    "a lost connection is reported in time, nothing starts on it, and connect works once it is "
    "plugged in again",
)
def _unplugged(bench: ArmBench) -> None:
    bench.connect()
    target = bench.to(SHORT_MM)
    bench.inject(Kind.LINK_CUT)
    _check_noticed(bench)
    if bench.refusal("start", lambda: bench.arm.start([target])) is None:
        raise RuleViolation("start took a path without a connection")
    if bench.refusal("connect", bench.open, bench.bounds.connect_s) is None:
        raise RuleViolation("connect returned without a connection")
    bench.stop()
    bench.refusal("close", bench.arm.close)
    bench.restore()
    # a controller may need a moment to end the program of the client that is gone
    reconnected = bench.until(
        lambda: bench.refusal("connect", bench.open, bench.bounds.connect_s) is None,
        bench.bounds.news_s,
    )
    if not reconnected:
        bench.connect()
    if bench.state() is not ArmState.READY:
        raise RuleViolation(f"after it was plugged in and connected its state was {bench.state()}")


@RULES.add(
    "unplugged while moving",
    "a connection lost in a move is reported in time, and the segment is not reported finished",
)
def _unplugged_moving(bench: ArmBench) -> None:
    bench.connect()
    bench.start_long()
    bench.inject(Kind.LINK_CUT)
    _check_aborted(bench)
    bench.stop()


@RULES.add(
    "late answer",
    "an answer that comes too late is dropped: it is not taken for that of the next request, and "
    "the next path is reported with its own times",
)
def _late(bench: ArmBench) -> None:
    bench.connect()
    first = bench.to(SHORT_MM)
    bench.inject(Kind.LATE_ANSWER)
    if bench.refusal("start", lambda: bench.arm.start([first])) is None:
        bench.until(lambda: _path_over(bench), bench.bounds.news_s)
    bench.stop()
    bench.wait(3 * CLOCK_S)
    if not bench.healthy():
        bench.refusal("close", bench.arm.close)
        bench.connect()
    before_ns = bench.now_ns()
    second = bench.to(-SHORT_MM)
    progress = bench.arrive(second)
    _check_arrived(bench, second.to)
    after_ns = bench.now_ns()
    _check_spans(progress.finished, before_ns, after_ns)


@RULES.add(
    "close",
    "close gives back every thread, process, file and socket, works twice, and calls after it "
    "raise a RigError",
    warm=True,
)
def _close(bench: ArmBench) -> None:
    bench.connect()
    bench.call("close", bench.arm.close)
    bench.call("stop after close", bench.arm.stop)
    if bench.state() is not ArmState.DISCONNECTED:
        raise RuleViolation(f"after close its state was {bench.state()}")
    if bench.refusal("start", lambda: bench.arm.start([_home(bench)])) is None:
        raise RuleViolation("start took a path after close")
    check_close(bench)


# ---------------------------------------------------------------------------------------------


def check_order(what: str, times: list[int]) -> None:
    """Raise Seen if times, ns, fall back."""
    for before, after in itertools.pairwise(times):
        if after < before:
            raise RuleViolation(f"{what}: {after} ns came after {before} ns")


def _home(bench: ArmBench) -> Segment:
    return Segment(bench.place(), bench.speed_mm_s)


def _times_left(bench: ArmBench) -> list[int]:
    try:
        return bench.read_times()[0]
    except RigError:
        return []


def _check_arrived(bench: ArmBench, target: Pose) -> None:
    off = distance_mm(bench.place(), target)
    if off > ARRIVED_MM:
        raise RuleViolation(f"progress was done {off:.2f} mm before the end of the path")


def _check_spans(spans: tuple[tuple[int, int], ...], before_ns: int, after_ns: int) -> None:
    """Raise Seen if segments' times do not follow each other within a time."""
    slack_ns, last_ns = round(CLOCK_S * 1e9), before_ns
    for number, (begin_ns, end_ns) in enumerate(spans, 1):
        if begin_ns < last_ns - slack_ns:
            early = "the path was started" if number == 1 else "the one before it ended"
            raise RuleViolation(
                f"segment {number} was reported to begin {(last_ns - begin_ns) / 1e9:.3f} s before "
                f"{early}"
            )
        if not begin_ns <= end_ns <= after_ns + slack_ns:
            raise RuleViolation(
                f"segment {number} was reported from {begin_ns} to {end_ns} ns, at {after_ns} ns"
            )
        last_ns = end_ns


def _path_over(bench: ArmBench) -> bool:
    try:
        return bench.call("progress", bench.arm.progress).done
    except RigError:
        return True


def _check_noticed(bench: ArmBench) -> None:
    if not bench.until(bench.fault_noticed, bench.bounds.news_s):
        raise RuleViolation(f"no call reported it within {bench.bounds.news_s:g} s")


def _check_aborted(bench: ArmBench) -> None:
    """Raise Seen if a path that a fault ended is not reported so."""
    _check_noticed(bench)
    if not bench.until(lambda: _path_over(bench), bench.bounds.news_s):
        raise RuleViolation(f"progress was not done {bench.bounds.news_s:g} s after the fault")
    try:
        finished = bench.call("progress", bench.arm.progress).finished
    except RigError:
        return
    if finished:
        raise RuleViolation("the segment that the fault ended was reported finished")
