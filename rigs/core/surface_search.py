"""Touching off: the search for the plate's surface, where depth is zero, by the event camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.maintenance import Rezero
from sliplab.protocols.program import Move, Position
from sliplab.protocols.protocol_limits import MAX_CREEP_MM_S
from sliplab.rigs.core.capabilities import ArmFault, RigError, Segment
from sliplab.rigs.core.rig import (
    MOVE_GRACE_S,
    RETRACT_SPEED_MM_S,
    Rig,
    arm_fault,
    path_seconds,
)
from sliplab.rigs.core.touching import POLL_S, QUIET_S, NoiseWatch, RateTouch, count_central
from sliplab.storage.streams import EventChunk


@dataclass(frozen=True)
class TouchedZero:
    """Depth zero as the mean of some touches, and the standard deviation of single ones, mm."""

    mm: float
    sd_mm: float | None
    """None of a single touch."""


def rezero(rig: Rig, asked: Rezero, seed: int) -> TouchedZero:
    """Find depth zero as a protocol asks for: the mean of several touches.

    Args:
        seed: of the first touch on a simulated rig; the others have their own.

    Returns:
        The new depth zero, which the plate's frame uses from now on.

    Raises:
        RigError: as `touch_off`; one touch without a plate is enough.
    """
    speed, search = float(asked.speed), float(asked.search)
    seeds = (seed, *(hash_integer(seed, "touch", n) for n in range(1, asked.touches)))
    found = np.array([touch_off(rig, speed, search, each) for each in seeds])
    zero = float(found.mean())
    rig.plate_frame = rig.plate_frame.with_zero(zero)
    return TouchedZero(zero, float(found.std(ddof=1)) if len(found) > 1 else None)


def touch_off(rig: Rig, speed_mm_s: float, search_mm: float, seed: int) -> float:
    """Find depth zero: creep in until the event rate shows that the centre papilla touches.

    See `rigs.core.touching.RateTouch`. A touch is detected only after some indentation:
    `touch_mm` of the rig's calibration.

    Args:
        search_mm: hard limit beyond the taught plane.

    Returns:
        The new depth zero in the taught frame, mm; the frame uses it from now on.

    Raises:
        RigError: no touch was detected within `search_mm`.
    """
    if not speed_mm_s <= MAX_CREEP_MM_S:
        raise RigError("arm", f"touches off at {MAX_CREEP_MM_S:g} mm/s at most, not {speed_mm_s:g}")
    rig.plate_frame = rig.plate_frame.with_zero(0.0)
    start = Position(0.0, 0.0, -search_mm)
    with rig.safely(start):
        rig.begin_trial(start, seed)
        rig.events.start()
        zero = _approach_until_touch(rig, search_mm, speed_mm_s, measure_noise(rig))
        rig.events.stop()
        out_mm_s = rig.at_most(RETRACT_SPEED_MM_S)
        rig.move(Move("release", start, out_mm_s), rig.position(), None)
    rig.plate_frame = rig.plate_frame.with_zero(zero)
    return zero


def _approach_until_touch(rig: Rig, search_mm: float, speed_mm_s: float, rate: RateTouch) -> float:
    target = Position(0.0, 0.0, search_mm)
    seconds = path_seconds(2 * search_mm, speed_mm_s)
    with rig.moving(Segment(rig.plate_frame.pose(target), speed_mm_s)):
        deadline = rig.clock.now_ns() + int((2 * seconds + MOVE_GRACE_S) * 1e9)
        while not rig.arm.progress().done:
            if rig.clock.now_ns() > deadline:
                raise ArmFault("arm", "did not finish touching off in time")
            rig.wait(POLL_S)
            depth = rig.position().depth_mm
            if rate.touched(central_events(rig), depth, rig.clock.now_ns()):
                rig.arm.stop()
                break
        else:
            state = rig.arm.state()
            if not state.healthy:  # the arm was stopped; the taught plane may still be right
                raise arm_fault(state, "touching off")
    rig.rests_here(speed_mm_s)
    surface = rate.surface_mm(speed_mm_s)
    if surface is not None and abs(surface - rig.touch_mm) <= search_mm:
        return surface - rig.touch_mm
    raise RigError(
        "arm",
        f"touching off found no plate within {search_mm:g} mm of the taught plane; "
        "teach the contact plane again",
    )


def measure_noise(rig: Rig) -> RateTouch:
    """Measure the event camera's noise at rest for `QUIET_S`, to detect a touch by it.

    Raises:
        RigError: a real camera sent no event at all.
    """
    rig.noise = None
    rig.wait(QUIET_S)
    chunk = rig.events.read()
    rig.noise = NoiseWatch(chunk, rig.clock.now_ns, may_be_silent=rig.simulation is not None)
    return RateTouch(_count(rig, chunk))


def central_events(rig: Rig) -> int:
    """Read the events; return their number around the centre papilla.

    Raises:
        RigError: no more events came, not even noise.
    """
    chunk = rig.events.read()
    if rig.noise is not None:
        rig.noise.check(chunk)
    return _count(rig, chunk)


def _count(rig: Rig, chunk: EventChunk) -> int:
    return count_central(chunk, (rig.events.width, rig.events.height), rig.centre_px)
