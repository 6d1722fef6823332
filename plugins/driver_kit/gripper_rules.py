"""Rules of grippers."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sliplab.plugins.driver_kit.bench import POLL_S, QUIET_S, check_close, check_methods
from sliplab.plugins.driver_kit.gripper_bench import GripperBench
from sliplab.plugins.driver_kit.rule import Rules, RuleViolation
from sliplab.rigs.core.capabilities import Gripper, GripperState

RULES = Rules[GripperBench]()
CLOSED_MM = 10.0
"""Distance that the fingers close in a rule."""
EPS_MM = 1e-3
SHARE = 0.1
"""Largest relative deviation of a speed, and shortfall of a force below the requested one."""
MIDDLE_OF_RANGE = 0.3
"""Speed and force of a move, as a share of their range."""
LAG_S = 0.1
"""Longest delay of a reported opening, s."""
ASKED_S = 0.1
"""Time for a call to send its question, s."""
AT_ONCE_S = 0.25
"""Longest duration of a call that does not wait for a motion, s."""


@RULES.add("gripper", "the gripper has every method of its capability, and ping finds the fake")
def _declaration(bench: GripperBench) -> None:
    bench.connect()
    check_methods(bench.device, Gripper)
    problem = bench.call("ping", lambda: bench.driver.ping(bench.settings), bench.bounds.connect_s)
    if problem is not None:
        raise RuleViolation(f"ping of a fake that answers returned '{problem}'")


@RULES.add(
    "move of the fingers",
    "a move returns at once, is reported as moving from then on, and ends at most a step wider "
    "than requested, never tighter",
)
def _move(bench: GripperBench) -> None:
    bench.connect()
    wanted = bench.opening_mm - CLOSED_MM
    slow = bench.range.speed_mm_s[0]
    began = time.monotonic()
    bench.move(wanted, slow)
    if time.monotonic() - began > CLOSED_MM / slow / 2:
        raise RuleViolation("move returned when the fingers were half way or further")
    if not bench.state().moving and bench.moving():
        raise RuleViolation("state reported no motion right after the move")
    if not bench.until(lambda: not bench.state().moving, bench.bounds.call_s):
        raise RuleViolation(f"state still reported motion after {bench.bounds.call_s:g} s")
    reached, true_mm = bench.state().opening_mm, bench.fingers.target_mm
    if not wanted - EPS_MM <= true_mm <= wanted + bench.range.step_mm + EPS_MM:
        raise RuleViolation(f"requested {wanted:g} mm, the fingers went to {true_mm:g} mm")
    if abs(reached - true_mm) > bench.range.step_mm + EPS_MM:
        raise RuleViolation(
            f"state reported {reached:g} mm, and the fingers were at {true_mm:g} mm"
        )


@RULES.add(
    "values of a move",
    "fingers go to the requested opening, in mm, at the speed in mm/s, within 10 %, and "
    "with the force in N or up to 10 % less; they open as well as they close",
)
def _values(bench: GripperBench) -> None:
    bench.connect()
    speed, force = (
        low + MIDDLE_OF_RANGE * (high - low)
        for low, high in (bench.range.speed_mm_s, bench.range.force_n)
    )
    for wanted in (bench.opening_mm - CLOSED_MM, bench.opening_mm - CLOSED_MM / 4):
        from_mm, began_ns = bench.true_mm(time.monotonic_ns())[0], time.monotonic_ns()
        bench.move(wanted, speed, force)
        if not bench.until(lambda: not bench.state().moving, bench.bounds.call_s):
            raise RuleViolation(f"state still reported motion after {bench.bounds.call_s:g} s")
        if bench.moving():
            raise RuleViolation("state reported no motion while the fingers moved")
        (to_mm,) = bench.true_mm(time.monotonic_ns())
        if not wanted - EPS_MM <= to_mm <= wanted + bench.range.step_mm + EPS_MM:
            raise RuleViolation(
                f"requested {wanted:g} mm from {from_mm:g} mm, the fingers are at {to_mm:g}"
            )
        reached = _speed_mm_s(bench, began_ns, from_mm, to_mm)
        if not abs(reached - speed) <= SHARE * speed:
            raise RuleViolation(f"requested {speed:g} mm/s, the fingers went at {reached:.1f} mm/s")
        sent_n = bench.fingers.last_force_n
        if not (1.0 - SHARE) * force <= sent_n <= force + EPS_MM:
            raise RuleViolation(f"requested {force:g} N, the gripper was sent {sent_n:g} N")
        if bench.state().stalled:
            raise RuleViolation("state reported a stall, though no object was there")


@RULES.add(
    "state while moving",
    "state returns at once, and reports the opening of the moment in mm, and that fingers move "
    "until they rest",
)
def _state_moving(bench: GripperBench) -> None:
    bench.connect()
    if bench.device.range != bench.range:
        raise RuleViolation(
            f"its range was {bench.device.range}, the driver declares {bench.range}"
        )
    for wanted in (bench.opening_mm - CLOSED_MM, bench.opening_mm):
        bench.move(wanted, bench.range.speed_mm_s[0])
        bench.until(bench.moving, QUIET_S)
        took: list[float] = []
        while bench.moving():
            begun_ns = time.monotonic_ns()
            state = bench.state()
            ended_ns = time.monotonic_ns()
            if not bench.moving():
                break
            took.append((ended_ns - begun_ns) / 1e9)
            _check_state(bench, state, begun_ns, ended_ns)
            bench.wait(POLL_S)
        if not took:
            raise RuleViolation("state had not returned before the fingers were at rest")
        if min(took) > AT_ONCE_S:
            raise RuleViolation(f"state took {min(took):.2f} s or more while the fingers moved")
        bench.until(lambda: not bench.state().moving, bench.bounds.call_s)


@RULES.add("fingers stay", "connect and close move no finger: what is held stays held")
def _stay(bench: GripperBench) -> None:
    (before,) = bench.true_mm(time.monotonic_ns())
    bench.connect()
    bench.wait(QUIET_S)
    bench.call("close", bench.close_device)
    bench.wait(QUIET_S)
    (after,) = bench.true_mm(time.monotonic_ns())
    if bench.moving() or abs(after - before) > EPS_MM:
        raise RuleViolation(f"the fingers went from {before:g} to {after:g} mm")
    if bench.refusal("state", bench.device.state) is None:
        raise RuleViolation("state returned after close")


@RULES.add("range", "a value out of range is refused, and nothing moves")
def _range(bench: GripperBench) -> None:
    bench.connect()
    good = [bench.opening_mm, bench.range.speed_mm_s[0], bench.range.force_n[0]]
    spans = bench.range.opening_mm, bench.range.speed_mm_s, bench.range.force_n
    for place, (low, high) in enumerate(spans):
        for wrong in (low - 1.0, high + 1.0, float("nan")):
            given = [*good[:place], wrong, *good[place + 1 :]]
            if bench.refusal("move", lambda given=given: bench.device.move(*given)) is None:  # type: ignore[misc]
                raise RuleViolation(f"move{tuple(given)} was accepted")
    bench.wait(QUIET_S)
    if bench.fingers.target_mm != bench.opening_mm:
        raise RuleViolation("the fingers moved all the same")


@RULES.add(
    "stop of the fingers",
    "stop returns in any state, and the fingers stand soon after, where they were",
)
def _stop(bench: GripperBench) -> None:
    bench.connect()
    bench.call("stop before a move", bench.device.stop)
    bench.move(bench.opening_mm - CLOSED_MM, bench.range.speed_mm_s[0])
    bench.wait(QUIET_S)
    for _ in range(2):
        bench.call("stop", bench.device.stop)
    (stopped_mm,) = bench.true_mm(time.monotonic_ns())
    if not bench.until(lambda: not bench.state().moving, bench.bounds.call_s):
        raise RuleViolation("state reported motion after the stop")
    if not bench.until(lambda: not bench.fingers.moving(time.monotonic_ns()), bench.bounds.call_s):
        raise RuleViolation("the fingers moved on")
    if abs(bench.fingers.target_mm - (bench.opening_mm - CLOSED_MM)) < 1.0:
        raise RuleViolation("the fingers went to the end of their move")
    if bench.fingers.target_mm > stopped_mm + bench.range.step_mm + EPS_MM:
        raise RuleViolation(f"the fingers opened to {bench.fingers.target_mm:g} mm after the stop")


@RULES.add("stall", "fingers that an object stops are reported as stalled, not as moving")
def _stall(bench: GripperBench) -> None:
    bench.connect()
    bench.move(bench.opening_mm - CLOSED_MM, bench.range.speed_mm_s[0])
    bench.wait(QUIET_S)
    bench.stall()

    def stalled() -> bool:
        state = bench.state()
        return state.stalled and not state.moving

    if not bench.until(stalled, bench.bounds.news_s):
        raise RuleViolation(f"state reported {bench.state()}")
    bench.move(bench.opening_mm)
    if bench.state().stalled:
        raise RuleViolation("state reported a stall in the next move")


@RULES.add("fault of the gripper", "a fault that the gripper reports is a RigError of `state`")
def _fault(bench: GripperBench) -> None:
    bench.connect()
    bench.fake.fail()

    def reported() -> bool:
        return bench.refusal("state", bench.device.state) is not None

    if not bench.until(reported, bench.bounds.news_s):
        raise RuleViolation(f"state did not report it within {bench.bounds.news_s:g} s")


@RULES.add(
    "silent gripper",
    "a gripper that falls silent is reported; stop and close return, also while a call waits for "
    "its answer",
)
def _silent(bench: GripperBench) -> None:
    bench.connect()
    bench.fake.silence()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(bench.device.state)
        bench.wait(ASKED_S)
        waited, began = not waiting.done(), time.monotonic()
        bench.refusal("stop", bench.device.stop)
        took_s = time.monotonic() - began
        if waited and waiting.done() and took_s > AT_ONCE_S:
            raise RuleViolation(
                f"stop took {took_s:.2f} s: it waited for the answer to another call"
            )
    if bench.refusal("state", waiting.result) is None:
        raise RuleViolation("state returned though nothing answers")
    bench.refusal("close", bench.close_device)


@RULES.add(
    "absent gripper", "connecting to a gripper that does not answer raises a RigError in time"
)
def _absent(bench: GripperBench) -> None:
    bench.fake.silence()
    if bench.refusal("connect", bench.open, bench.bounds.connect_s) is None:
        raise RuleViolation("connect returned though nothing answers")


@RULES.add("unplugged gripper", "an unplugged gripper is reported; stop and close return")
def _unplugged(bench: GripperBench) -> None:
    bench.connect()
    bench.fake.close()
    if bench.refusal("state", bench.device.state) is None:
        raise RuleViolation("state returned though it is unplugged")
    bench.refusal("stop", bench.device.stop)
    bench.refusal("close", bench.close_device)


@RULES.add(
    "close of the gripper", "close gives everything back, and may be called twice", warm=True
)
def _close(bench: GripperBench) -> None:
    check_close(bench)


# ---------------------------------------------------------------------------------------------


def _speed_mm_s(bench: GripperBench, began_ns: int, from_mm: float, to_mm: float) -> float:
    """Return the median of the true speed in the middle part of the last move."""
    t_ns = np.arange(began_ns, time.monotonic_ns(), 1_000_000)
    shares = (np.array(bench.true_mm(*t_ns.tolist())) - from_mm) / (to_mm - from_mm)
    middle = np.flatnonzero((shares > 0.3) & (shares < 0.7))
    if len(middle) < 2:  # passed within two steps
        return abs(to_mm - from_mm) * 1e3
    steps = np.diff(shares[middle[0] : middle[-1] + 1])
    return float(np.median(steps)) * abs(to_mm - from_mm) * 1e3


def _check_state(bench: GripperBench, state: GripperState, begun_ns: int, ended_ns: int) -> None:
    if not state.moving or state.stalled:
        raise RuleViolation(f"while the fingers moved it reported {state}")
    true = bench.true_mm(begun_ns - round(LAG_S * 1e9), begun_ns, ended_ns)
    step = bench.range.step_mm + EPS_MM
    if not min(true) - step <= state.opening_mm <= max(true) + step:
        raise RuleViolation(
            f"state reported {state.opening_mm:g} mm, the fingers were at {true[-1]:.2f} mm"
        )
