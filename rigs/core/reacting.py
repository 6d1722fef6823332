"""One trial's motion with a reflex: at slip the arm stops, presses deeper, or the gripper tightens.

`Rig.run_trial` records trials; here nothing is recorded. The watcher that reads the events triggers
the reflex by raising `SlipDetected` while the arm moves in contact. The arm is stopped before
anything else; only a grip is commanded first where the arm gets no deeper meanwhile, because that
returns at once, and a stop may wait for rest. A failure ends as in any trial: the arm is stopped,
and moved clear if healthy.

Where slip can no longer be detected (no events, no network, a decision too late) the rig goes to
its safe state: the arm stops, or the gripper tightens too, and both stay, because an arm that moves
clear drops what it holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from sliplab.protocols.program import ACTING, Move, Position, Program, Step, Twist
from sliplab.rigs.core.capabilities import ArmFault, RigError, StaysInContact
from sliplab.rigs.core.force_watch import PressPlaces
from sliplab.rigs.core.motion_watch import REST_LIMIT_S
from sliplab.rigs.core.rig import Rig, arm_fault, nuisances_of
from sliplab.storage.streams import Sink

GRIPPER = "gripper"
_LEVEL = ("slide", "retract", "twist")
"""Phases in which the arm gets no deeper."""
_SENSES = ("event camera", GRIPPER)
"""Devices whose failure ends in the safe state; after that of another the arm moves clear."""


@dataclass(frozen=True)
class DetectionTimes:
    """Times of a detection, up to the decision, ms.

    Attributes:
        trial_s: end of the window that decided, since the stream began, on the camera's clock.
        window_ms: span of the events that the decision rests on.
        sensor_ms: from the end of that span until its events were read, on the rig's clock; the
            freshest arrival counts as immediate.
        network_ms: from then to the decision: windows, network and rule, in real time.
    """

    trial_s: float
    window_ms: float
    sensor_ms: float
    network_ms: float


class SlipDetected(Exception):
    """A watcher detected slip and triggers the reflex; raised only while it is armed."""

    def __init__(self, evidence: DetectionTimes | None = None) -> None:
        super().__init__("slip")
        self.evidence = evidence


class SenseLost(Exception):
    """A watcher can no longer detect slip; the text gives the reason."""


class Watcher(Sink, Protocol):
    """A sink that monitors the events."""

    armed: bool
    """True while it may raise `SlipDetected`; set by `run_watched`."""
    guarded: bool
    """True while it may raise `SenseLost`; set by `run_watched`."""

    def step(self, phase: str, acting: bool) -> None:
        """Receive the start of a step of the program."""


@dataclass(frozen=True)
class Reflex:
    """The rig's reaction to detected slip.

    Attributes:
        kind: ``stop``: the arm stops. ``press``: it stops, then presses deeper. ``grip``: it stops,
            and the gripper's fingers close at once.
        deepest_mm: largest depth in contact: the arm's, and what the fingers add.
        deeper_mm: by how much `press` and `grip` go deeper.
        speed_mm_s: of the arm that presses, or of the fingers' opening.
        force_n: force at which closing fingers stall.
        hold_s: time for which the arm then holds its position and the stream is monitored.
    """

    kind: Literal["stop", "press", "grip"]
    deepest_mm: float
    deeper_mm: float = 0.0
    speed_mm_s: float = 1.0
    force_n: float = 0.0
    hold_s: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError if a number is not finite."""
        for name in ("deepest_mm", "deeper_mm", "speed_mm_s", "force_n", "hold_s"):
            if not math.isfinite(value := getattr(self, name)):
                raise ValueError(f"{name} of a reflex is {value}, which is no number")


@dataclass(frozen=True)
class Reaction:
    """The outcome of a reflex; times on the rig's clock.

    Attributes:
        phase: the interrupted phase.
        stop_ms: time from the detection until the arm was at rest.
        command_ms: time from the detection until the drivers had the command to stop, or to grip.
        actuator_ms: time from there until all was done: arm at rest, pressed, fingers at rest;
            a driver's way to its device is in it.
        stopped_mm: position at which it came to rest: x, y, depth in plate coordinates.
        depth_mm: final depth in contact: the arm's, and what the fingers add.
        closed_mm: by how much the fingers are closed, with what an earlier grip closed.
        stalled: they ended at their force.
        evidence: times of the detection, where the watcher measures them.
    """

    phase: str
    stop_ms: float
    command_ms: float
    actuator_ms: float
    stopped_mm: tuple[float, float, float]
    depth_mm: float
    closed_mm: float = 0.0
    stalled: bool = False
    evidence: DetectionTimes | None = None


class SafeState(StaysInContact):
    """Slip could no longer be detected, and the rig went to its safe state.

    Attributes:
        cause: why slip could not be detected.
        reaction: the reaction carried out.
    """

    plate_held = True

    def __init__(self, cause: str, kind: str, reaction: Reaction) -> None:
        took_ms = reaction.command_ms + reaction.actuator_ms
        super().__init__(
            "reflex",
            f"{cause}; the safe state '{kind}' was reached {took_ms:.0f} ms later in the phase "
            f"'{reaction.phase}', and the arm stays in contact: secure the object, then move the "
            "arm clear",
        )
        self.cause, self.reaction = cause, reaction


def run_watched(
    rig: Rig,
    program: Program,
    watcher: Watcher,
    seed: int,
    rate_hz: int,
    reflex: Reflex | None,
    safe: Reflex | None = None,
) -> Reaction | None:
    """Run a program while `watcher` reads the streams of its recorded steps.

    After a reflex no motion along the plate or into it is made: the arm leaves the plate straight
    out from its current position, by the next retract or release, and the rest of the program
    follows.

    Args:
        seed: seed of a simulated trial's randomness.
        reflex: None to monitor slip without a reaction.
        safe: reaction when slip can no longer be detected; None: a failure as any other, where a
            reflex depends on it.

    Returns:
        the outcome of the reflex; None if there was none.

    Raises:
        SafeState: slip can no longer be detected.
        StopRequested: as `Rig.run_trial`.
        RigError: anything failed; the arm is stopped.
    """
    reaction: Reaction | None = None
    holding = False  # since a reflex, until the arm is clear
    with rig.safely(program.home):
        rig.begin_trial(program.home, seed, nuisances_of(program))
        course, streaming = PressPlaces(program.home), False
        for index, planned in enumerate(program.steps):
            step = course.step(planned)
            if step.recorded and not streaming:
                rig.start_streams(seed, rate_hz, False, with_further=False)
                streaming, watcher.guarded = True, reflex is not None or safe is not None
            if streaming and not step.recorded:
                watcher.guarded = False
                rig.stop_streams(watcher)
                streaming = False
            if reaction is not None:
                left = _after_reflex(step, course.at, holding)
                if left is None:
                    continue
                step = left
            acting = isinstance(step, Move) and step.phase in ACTING and reflex is not None
            watcher.step(step.phase, acting)
            watcher.armed = acting
            try:
                made = _take(rig, index, step, course.at, watcher, reflex, safe, streaming)
            except (SenseLost, RigError) as lost:
                if isinstance(lost, SenseLost) and safe is None:
                    device, found, text = str(lost).partition(": ")
                    why = f"{text or lost}; slip cannot be detected, and the arm was stopped"
                    raise RigError(device if found else "reflex", why) from lost
                ends = isinstance(lost, RigError) and lost.device not in _SENSES
                if ends or not streaming or safe is None:
                    raise
                raise _go_safe(rig, step.phase, safe, watcher, str(lost)) from lost
            finally:
                watcher.armed = False
            if made is None:
                course.taken(step, rig.position)
                holding = holding and course.at.depth_mm + rig._closed_mm > 0.0
            else:
                reaction, holding = made, True
                course.at = replace(rig.position(), twist_deg=course.at.twist_deg)
    return reaction


def _take(
    rig: Rig,
    index: int,
    step: Step,
    at: Position,
    watcher: Watcher,
    reflex: Reflex | None,
    safe: Reflex | None,
    streaming: bool,
) -> Reaction | None:
    """Carry out a step, or as much of it as a reflex leaves, and the reflex."""
    try:
        rig.take_step(index, step, at, watcher if streaming else None)
    except SlipDetected as slip:
        assert reflex is not None
        watcher.guarded = safe is not None  # without one nothing depends on slip from here on
        made = _react(rig, step.phase, reflex, watcher, watcher, slip.evidence, at.twist_deg)
        rig.wait(reflex.hold_s, watcher)
        return made
    return None


def _go_safe(rig: Rig, phase: str, safe: Reflex, watcher: Watcher, cause: str) -> SafeState:
    """Go to the safe state; a gripper that fails leaves the arm stopped all the same."""
    try:
        made = _react(rig, phase, safe, watcher, None, None)
    except RigError as fault:
        if fault.device != GRIPPER:
            raise
        cause, safe = f"{cause}; {fault}", replace(safe, kind="stop")
        made = _react(rig, phase, safe, watcher, None, None)
    return SafeState(cause, safe.kind, made)


def _react(
    rig: Rig,
    phase: str,
    reflex: Reflex,
    watcher: Watcher,
    sink: Sink | None,
    evidence: DetectionTimes | None,
    twist_deg: float = 0.0,
) -> Reaction:
    """Carry out a reflex; streams are read meanwhile where they have a sink.

    Args:
        twist_deg: rotation of the sensor, which a press keeps.
    """
    began_ns = rig.clock.now_ns()

    def passed_ms() -> float:
        return (rig.clock.now_ns() - began_ns) / 1e6

    watcher.armed = False
    closed_mm = rig._closed_mm
    try:
        if reflex.kind == "grip" and phase in _LEVEL:
            closed_mm = _grip(rig, reflex)
        command_ms = passed_ms()
    finally:
        rig.arm.stop()
    if reflex.kind == "grip" and phase not in _LEVEL:
        closed_mm = _grip(rig, reflex)
        command_ms = passed_ms()
    watcher.step("reflex", False)
    while not (progress := rig.arm.progress()).done:
        if passed_ms() > REST_LIMIT_S * 1e3:
            raise ArmFault("arm", f"is still moving {REST_LIMIT_S:g} s after the stop command")
        rig.wait(min(rig.poll_s, 0.002))
    if not progress.state.healthy:
        raise arm_fault(progress.state, phase)
    stop_ms = passed_ms()
    here = rig.position()
    stalled = False
    if reflex.kind == "press":
        # measured depths scatter about the command; the limit applies all the same
        depth = min(here.depth_mm + reflex.deeper_mm, reflex.deepest_mm - closed_mm)
        if not depth <= here.depth_mm:  # a depth that is no number is refused by the rig
            deep = Position(here.x_mm, here.y_mm, depth, twist_deg)
            rig.move(Move("reflex", deep, reflex.speed_mm_s), here, sink)
    if rig.gripper is not None and closed_mm:
        try:
            state = rig.await_fingers(rig.gripper, sink)
            closed_mm, stalled = rig.grip_opening_mm - state.opening_mm, state.stalled
        except RigError as fault:
            # a stop lets an earlier grip end; a gripper that fails does not keep it from ending
            if fault.device != GRIPPER or reflex.kind == "grip":
                raise
    return Reaction(
        phase,
        stop_ms,
        command_ms,
        passed_ms() - command_ms,
        (here.x_mm, here.y_mm, here.depth_mm),
        rig.position().depth_mm + closed_mm,
        closed_mm,
        stalled,
        evidence,
    )


def _grip(rig: Rig, reflex: Reflex) -> float:
    """Start to close the fingers further, not beyond the deepest place, and never open them.

    Returns:
        by how much they are then closed in all, mm.
    """
    if rig.gripper is None:
        raise RigError(GRIPPER, "this rig has none to tighten")
    already_mm = rig._closed_mm  # by an earlier grip: less would drop what it holds
    room_mm = reflex.deepest_mm - rig.position().depth_mm
    closed_mm = min(already_mm + reflex.deeper_mm, room_mm)
    if not closed_mm > already_mm:
        return already_mm
    rig.move_fingers(rig.grip_opening_mm - closed_mm, reflex.speed_mm_s, reflex.force_n)
    return closed_mm


def _after_reflex(step: Step, at: Position, holding: bool) -> Step | None:
    """Adapt a step after a reflex: it was planned from the end of the interrupted motion.

    Args:
        holding: the arm has not left the plate since: it only moves straight out, for any other
            motion would drag or press what the reflex holds.

    Returns:
        None for a step that is not made.
    """
    if not isinstance(step, Move | Twist):
        return step
    if isinstance(step, Twist):
        on_the_spot = replace(step, to=replace(at, twist_deg=step.to.twist_deg))
        return None if holding else on_the_spot
    if not holding and step.phase != "release":
        return step
    leaves = step.phase in ("retract", "release") or step.to.depth_mm <= 0.0
    if not leaves or step.to.depth_mm >= at.depth_mm:
        return None
    return replace(step, to=replace(at, depth_mm=step.to.depth_mm))
