"""One trial's motion with a reflex: when slip is detected, the arm stops, or presses deeper.

`Rig.run_trial` records trials; here nothing is recorded. The watcher that reads the events triggers
the reflex by raising `SlipDetected` while the arm moves in contact. The arm is stopped before
anything else. A failure ends as in any trial: the arm is stopped, and moved clear if healthy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

from sliplab.protocols.program import ACTING, Move, Position, Program, Step
from sliplab.rigs.core.capabilities import ArmFault
from sliplab.rigs.core.force_watch import Course
from sliplab.rigs.core.rig import Rig, arm_fault, nuisances_of
from sliplab.storage.streams import Sink

REST_S = 2.0
"""Timeout for a stopped arm to come to rest, s."""


class SlipDetected(Exception):
    """A watcher detected slip and triggers the reflex; raised only while it is armed."""


class Watcher(Sink, Protocol):
    """A sink that monitors the events."""

    armed: bool
    """True while it may raise `SlipDetected`; set by `run_watched`."""

    def step(self, phase: str, acting: bool) -> None:
        """Receive the start of a step of the program."""


@dataclass(frozen=True)
class Reflex:
    """The arm's reaction to detected slip.

    Attributes:
        kind: ``stop``; or ``press``: stop, then press deeper by `press_mm` at `speed_mm_s`.
        deepest_mm: largest depth of a reflex.
        hold_s: time for which the arm then holds its position and the stream is monitored.
    """

    kind: Literal["stop", "press"]
    deepest_mm: float
    press_mm: float = 0.0
    speed_mm_s: float = 1.0
    hold_s: float = 1.0


@dataclass(frozen=True)
class Reaction:
    """The outcome of a reflex; times on the rig's clock.

    Attributes:
        phase: the interrupted phase.
        stop_ms: time from the detection until the arm was at rest.
        stopped_mm: position at which it came to rest: x, y, depth in plate coordinates.
        depth_mm: final depth.
    """

    phase: str
    stop_ms: float
    stopped_mm: tuple[float, float, float]
    depth_mm: float


def run_watched(
    rig: Rig, program: Program, watcher: Watcher, seed: int, rate_hz: int, reflex: Reflex | None
) -> Reaction | None:
    """Run a program while `watcher` reads the streams of its recorded steps.

    After a reflex the arm leaves the plate straight out from its current position, and the rest of
    the program follows.

    Args:
        seed: seed of a simulated trial's randomness.
        reflex: None to monitor slip without a reaction.

    Returns:
        the outcome of the reflex; None if there was none.

    Raises:
        StopRequested: as `Rig.run_trial`.
        RigError: anything failed; the arm is stopped.
    """
    reaction: Reaction | None = None
    with rig.safely(program.home):
        rig.begin_trial(program.home, seed, nuisances_of(program))
        course, streaming = Course(program.home), False
        for index, planned in enumerate(program.steps):
            step = course.step(planned)
            if step.recorded and not streaming:
                rig.start_streams(seed, rate_hz, False, with_further=False)
                streaming = True
            if streaming and not step.recorded:
                rig.stop_streams(watcher, False)
                streaming = False
            if reaction is not None:
                step = _from_current_position(step, course.at)
            acting = isinstance(step, Move) and step.phase in ACTING and reflex is not None
            watcher.step(step.phase, acting)
            watcher.armed = acting
            try:
                rig.take_step(index, step, course.at, watcher if streaming else None)
                course.taken(step, rig.position)
            except SlipDetected:
                assert reflex is not None
                reaction = _react(rig, step.phase, reflex, watcher)
                course.at = rig.position()
            finally:
                watcher.armed = False
    return reaction


def _react(rig: Rig, phase: str, reflex: Reflex, watcher: Watcher) -> Reaction:
    began_ns = rig.clock.now_ns()
    rig.arm.stop()
    watcher.armed = False
    watcher.step("reflex", False)
    deadline = began_ns + int(REST_S * 1e9)
    while not (progress := rig.arm.progress()).done:
        if rig.clock.now_ns() > deadline:
            raise ArmFault("arm", f"is still moving {REST_S:g} s after the stop command")
        rig.wait(min(rig.poll_s, 0.002))
    if not progress.state.healthy:
        raise arm_fault(progress.state, phase)
    stop_ms = (rig.clock.now_ns() - began_ns) / 1e6
    here = at = rig.position()
    if reflex.kind == "press":
        # measured depths scatter about the command; the limit applies all the same
        depth = min(at.depth_mm + reflex.press_mm, reflex.deepest_mm)
        if depth > at.depth_mm:
            at = Position(at.x_mm, at.y_mm, depth)
            rig.move(Move("reflex", at, reflex.speed_mm_s), here, watcher)
    rig.wait(reflex.hold_s, watcher)
    return Reaction(phase, stop_ms, (here.x_mm, here.y_mm, here.depth_mm), rig.position().depth_mm)


def _from_current_position(step: Step, at: Position) -> Step:
    """Adapt a step after a reflex: it was planned from the end of the interrupted motion."""
    if isinstance(step, Move) and step.phase == "release":
        return replace(step, to=Position(at.x_mm, at.y_mm, step.to.depth_mm))
    return step
