"""One trial's motion that a watcher may cut short: the arm stops at a slip, or presses on.

`Rig.run_trial` takes trials to be kept; here nothing is kept, and whoever reads the events may ask
for a reflex by raising `SlipSeen` while the arm slides or retracts. The arm is stopped first, then
all else is done. Whatever fails on the way ends as in any trial: stopped, and clear if healthy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

from sliplab.protocols.program import Move, Position, Program, Step, step_seconds
from sliplab.rigs.core.capabilities import ArmFault
from sliplab.rigs.core.rig import Rig, arm_fault
from sliplab.storage.streams import Sink

ACTING = ("slide", "retract")
"""The phases in which a reflex may act: those that this program itself moves the arm in."""
REST_S = 2.0
"""The longest that a stopped arm takes to stand still, s."""


class SlipSeen(Exception):
    """A watcher saw slip and wants the reflex; only while it is armed."""


class Watcher(Sink, Protocol):
    """A sink that looks at the events."""

    armed: bool
    """True while it may raise `SlipSeen`; set by the run."""

    def step(self, phase: str, acting: bool) -> None:
        """A step of the program begins."""


@dataclass(frozen=True)
class Reflex:
    """The arm's reaction when slip is seen.

    Attributes:
        kind: ``stop``, or ``press``: stop, and then press on by `press_mm` at `speed_mm_s`.
        deepest_mm: no reflex goes deeper than this.
        hold_s: how long the arm then stands and the stream is watched.
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
        phase: the motion that it cut short.
        stop_ms: from when the slip was reported until the arm stood still.
        stopped_mm: where it stood then: x, y, depth in plate coordinates.
        depth_mm: its depth in the end.
    """

    phase: str
    stop_ms: float
    stopped_mm: tuple[float, float, float]
    depth_mm: float


def run_watched(
    rig: Rig, program: Program, watcher: Watcher, seed: int, rate_hz: int, reflex: Reflex | None
) -> Reaction | None:
    """Move through a program while `watcher` reads the streams of its recorded steps.

    After a reflex the arm leaves the plate straight out from where it stands, and the rest of the
    program follows.

    Args:
        seed: of a simulated trial's randomness.
        reflex: None where slip is only watched.

    Returns:
        what the reflex did; None where there was none.

    Raises:
        StopRequested: as `Rig.run_trial`.
        RigError: anything failed; the arm is stopped.
    """
    reaction: Reaction | None = None
    with rig.safely(program.home):
        rig.begin_trial(program.home, seed)
        at, streaming = program.home, False
        for index, step in enumerate(program.steps):
            if step.recorded and not streaming:
                rig.start_streams(seed, rate_hz, False)
                streaming = True
            if streaming and not step.recorded:
                rig.stop_streams(watcher, False)
                streaming = False
            if reaction is not None:
                step = _from_where_it_stands(step, at)
            acting = isinstance(step, Move) and step.phase in ACTING and reflex is not None
            watcher.step(step.phase, acting)
            watcher.armed = acting
            try:
                rig.take_step(index, step, at, watcher if streaming else None)
                at = step_seconds(step, at)[1]
            except SlipSeen:
                assert reflex is not None
                reaction = _react(rig, step.phase, reflex, watcher)
                at = rig.position()
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
            raise ArmFault("arm", f"was told to stop and still moves after {REST_S:g} s")
        rig.wait(min(rig.poll_s, 0.002))
    if not progress.state.healthy:
        raise arm_fault(progress.state, phase)
    stop_ms = (rig.clock.now_ns() - began_ns) / 1e6
    here = at = rig.position()
    if reflex.kind == "press":
        # what is measured scatters about the command; the limit holds whatever it says
        depth = min(at.depth_mm + reflex.press_mm, reflex.deepest_mm)
        if depth > at.depth_mm:
            at = Position(at.x_mm, at.y_mm, depth)
            rig.move(Move("reflex", at, reflex.speed_mm_s), here, watcher)
    rig.wait(reflex.hold_s, watcher)
    return Reaction(phase, stop_ms, (here.x_mm, here.y_mm, here.depth_mm), rig.position().depth_mm)


def _from_where_it_stands(step: Step, at: Position) -> Step:
    """A step after a reflex: it was planned from the end of a motion that never came there."""
    if isinstance(step, Move) and step.phase == "release":
        return replace(step, to=Position(at.x_mm, at.y_mm, step.to.depth_mm))
    return step
