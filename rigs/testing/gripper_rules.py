"""Rules of grippers."""

from __future__ import annotations

import time

from sliplab.rigs.core.capabilities import Gripper
from sliplab.rigs.testing.bench import QUIET_S, check_close, check_methods
from sliplab.rigs.testing.gripper_bench import GripperBench
from sliplab.rigs.testing.rule import Rules, Seen

RULES = Rules[GripperBench]()
CLOSED_MM = 10.0
"""Way that the fingers close in a rule."""
EPS_MM = 1e-3


@RULES.add("gripper", "the gripper has every method of its capability, and ping finds the fake")
def _declaration(bench: GripperBench) -> None:
    bench.connect()
    check_methods(bench.device, Gripper)
    problem = bench.call("ping", lambda: bench.driver.ping(bench.settings), bench.bounds.connect_s)
    if problem is not None:
        raise Seen(f"ping of a fake that answers returned '{problem}'")


@RULES.add(
    "move of the fingers",
    "a move returns at once, is reported as moving from then on, and ends at most a step wider "
    "than it was asked for, never tighter",
)
def _move(bench: GripperBench) -> None:
    bench.connect()
    wanted = bench.opening_mm - CLOSED_MM
    slow = bench.range.speed_mm_s[0]
    began = time.monotonic()
    bench.move(wanted, slow)
    if time.monotonic() - began > CLOSED_MM / slow / 2:
        raise Seen("move returned when the fingers were half way or further")
    if not bench.state().moving:
        raise Seen("state said that nothing moved right after the move")
    if not bench.until(lambda: not bench.state().moving, bench.bounds.call_s):
        raise Seen(f"state still said moving after {bench.bounds.call_s:g} s")
    reached, true_mm = bench.state().opening_mm, bench.fingers.target_mm
    if not wanted - EPS_MM <= true_mm <= wanted + bench.range.step_mm + EPS_MM:
        raise Seen(f"asked for {wanted:g} mm, the fingers went to {true_mm:g} mm")
    if abs(reached - true_mm) > bench.range.step_mm + EPS_MM:
        raise Seen(f"state said {reached:g} mm, and the fingers stood at {true_mm:g} mm")


@RULES.add("range", "a value out of range is refused, and nothing moves")
def _range(bench: GripperBench) -> None:
    bench.connect()
    good = [bench.opening_mm, bench.range.speed_mm_s[0], bench.range.force_n[0]]
    spans = bench.range.opening_mm, bench.range.speed_mm_s, bench.range.force_n
    for place, (low, high) in enumerate(spans):
        for wrong in (low - 1.0, high + 1.0, float("nan")):
            given = [*good[:place], wrong, *good[place + 1 :]]
            if bench.refusal("move", lambda given=given: bench.device.move(*given)) is None:  # type: ignore[misc]
                raise Seen(f"move{tuple(given)} was accepted")
    bench.wait(QUIET_S)
    if bench.fingers.target_mm != bench.opening_mm:
        raise Seen("the fingers moved all the same")


@RULES.add("stop of the fingers", "stop returns in any state, and the fingers stand soon after")
def _stop(bench: GripperBench) -> None:
    bench.connect()
    bench.call("stop before a move", bench.device.stop)
    bench.move(bench.opening_mm - CLOSED_MM, bench.range.speed_mm_s[0])
    bench.wait(QUIET_S)
    for _ in range(2):
        bench.call("stop", bench.device.stop)
    if not bench.until(lambda: not bench.state().moving, bench.bounds.call_s):
        raise Seen("state said moving after the stop")
    if not bench.until(lambda: not bench.fingers.moving(time.monotonic_ns()), bench.bounds.call_s):
        raise Seen("the fingers moved on")
    if abs(bench.fingers.target_mm - (bench.opening_mm - CLOSED_MM)) < 1.0:
        raise Seen("the fingers went to the end of their move")


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
        raise Seen(f"state said {bench.state()}")
    bench.move(bench.opening_mm)
    if bench.state().stalled:
        raise Seen("state said stalled in the next move")


@RULES.add("fault of the gripper", "a fault that the gripper reports is a RigError of `state`")
def _fault(bench: GripperBench) -> None:
    bench.connect()
    bench.fake.fail()

    def reported() -> bool:
        return bench.refusal("state", bench.device.state) is not None

    if not bench.until(reported, bench.bounds.news_s):
        raise Seen(f"state did not report it within {bench.bounds.news_s:g} s")


@RULES.add("silent gripper", "a gripper that falls silent is reported; stop and close return")
def _silent(bench: GripperBench) -> None:
    bench.connect()
    bench.fake.silence()
    if bench.refusal("state", bench.device.state) is None:
        raise Seen("state returned though nothing answers")
    bench.refusal("stop", bench.device.stop)
    bench.refusal("close", bench.close_device)


@RULES.add(
    "absent gripper", "connecting to a gripper that does not answer raises a RigError in time"
)
def _absent(bench: GripperBench) -> None:
    bench.fake.silence()
    if bench.refusal("connect", bench.open, bench.bounds.connect_s) is None:
        raise Seen("connect returned though nothing answers")


@RULES.add("unplugged gripper", "an unplugged gripper is reported; stop and close return")
def _unplugged(bench: GripperBench) -> None:
    bench.connect()
    bench.fake.close()
    if bench.refusal("state", bench.device.state) is None:
        raise Seen("state returned though it is unplugged")
    bench.refusal("stop", bench.device.stop)
    bench.refusal("close", bench.close_device)


@RULES.add(
    "close of the gripper", "close gives everything back, and may be called twice", warm=True
)
def _close(bench: GripperBench) -> None:
    check_close(bench)
