"""From the phases of a protocol and one trial's condition to a motion program.

A protocol's motion is also checked against its own limits here, level by level, so that a message
can name the level that violates a limit instead of a trial.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from decimal import Decimal
from itertools import product
from typing import Any

from sliplab.protocols.factors import Level
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.model import Collection, Protocol
from sliplab.protocols.nuisances import (
    MIX,
    QUIET_S,
    AnyNuisance,
    ArmMotion,
    Nuisances,
    Regrasp,
    Rotation,
)
from sliplab.protocols.phases import (
    Approach,
    HoldPhase,
    Place,
    PlateMotion,
    Press,
    Release,
    Retract,
    Return,
    Slide,
    Travel,
    TwistPhase,
)
from sliplab.protocols.program import Dwell, Move, PlateStep, Position, Program, Step, Twist
from sliplab.protocols.quantity import FactorRef, canonical, check_least
from sliplab.protocols.yaml_file import raise_all

Condition = Mapping[str, Level]
_ByArm = ArmMotion | Rotation | Regrasp
_FAR_MM = Decimal(10_000)
"""Longer ways are refused by themselves; where others lead, the workspace limits."""
UNTWIST_DEG_S = 20.0
"""Speed at which a sensor that was twisted turns back, clear of the plate."""


def _value(field: Decimal | FactorRef | str, condition: Condition) -> float:
    level = condition[field.factor] if isinstance(field, FactorRef) else field
    return float(level)


def _side(field: str | FactorRef, condition: Condition) -> int:
    side = condition[field.factor] if isinstance(field, FactorRef) else field
    return {"left": -1, "right": 1}[str(side)]


def build_program(collection: Collection, condition: Condition) -> Program:
    """The motion program of one trial.

    Recording runs from the end of settling in the last hold before the slide or retraction to
    the end of that motion. A slide is centred on the plate; a disturbance goes to the side
    (right is +x) during the whole retraction, on one straight path.
    """
    motion, acting = collection.motion, collection.acting
    holds = [i for i, phase in enumerate(motion) if isinstance(phase, HoldPhase) and i < acting[0]]
    approach = next(phase for phase in motion if isinstance(phase, Approach))
    home = Position(0.0, 0.0, -_value(approach.clearance, condition))
    start_xy = (0.0, 0.0)
    if isinstance(motion[acting[0]], Slide):
        half = _half_slide(motion[acting[0]], condition)
        start_xy = (-half[0], -half[1])
    steps: list[Step] = []
    at = home
    nuisances = () if collection.nuisances is None else collection.nuisances.in_trial(condition)
    for index, phase in enumerate(motion):
        recorded = holds[-1] <= index <= acting[-1]
        if isinstance(phase, Approach):
            at = Position(*start_xy, -_value(phase.clearance, condition))
            steps.append(Move("approach", at, _value(phase.speed, condition)))
        elif isinstance(phase, Press):
            deepest = collection.limits.depth if phase.depth is None else phase.depth
            at = replace(at, depth_mm=_value(deepest, condition))
            until = None if phase.force is None else _value(phase.force, condition)
            press = Move("press", at, _value(phase.speed, condition), until_force_n=until)
            steps.append(press)
        elif isinstance(phase, HoldPhase):
            settle = _value(phase.settle, condition)
            if settle:
                steps.append(Dwell("settle", settle, recorded and index > holds[-1]))
            seconds = _value(phase.duration, condition)
            if index == holds[-1]:
                steps += _disturbed_hold(seconds, at, nuisances)
            else:
                steps.append(Dwell("hold", seconds, recorded))
        elif isinstance(phase, Slide):
            half = _half_slide(phase, condition)
            at = replace(at, x_mm=at.x_mm + 2 * half[0], y_mm=at.y_mm + 2 * half[1])
            steps.append(Move("slide", at, _value(phase.speed, condition), recorded))
        elif isinstance(phase, Retract):
            distance, speed = _value(phase.distance, condition), _value(phase.speed, condition)
            share = _signed_share(phase, condition)
            at = replace(at, x_mm=at.x_mm + share * distance, depth_mm=at.depth_mm - distance)
            steps.append(Move("retract", at, speed * math.hypot(1.0, share), recorded))
        elif isinstance(phase, PlateMotion):
            steps.append(
                PlateStep("plate", phase.action, _value(phase.duration, condition), recorded)
            )
        elif isinstance(phase, Travel):
            at = _place(phase, at, condition)
            name = "move" if index in acting else "travel"
            steps.append(Move(name, at, _value(phase.speed, condition), recorded))
        elif isinstance(phase, Release):
            at = replace(at, depth_mm=-_value(phase.clearance, condition))
            steps.append(Move("release", at, _value(phase.speed, condition)))
        elif isinstance(phase, TwistPhase):
            at = replace(at, twist_deg=at.twist_deg + _value(phase.angle, condition))
            steps.append(Twist("twist", at, _value(phase.speed, condition), recorded))
        elif isinstance(phase, Return):
            if at.twist_deg:
                at = replace(at, twist_deg=0.0)
                steps.append(Twist("untwist", at, UNTWIST_DEG_S))
            at = Position(0.0, 0.0, home.depth_mm)
            steps.append(Move("return", at, _value(phase.speed, condition)))
    return Program(home, tuple(steps), nuisances)


def _disturbed_hold(
    seconds: float, at: Position, nuisances: tuple[AnyNuisance, ...]
) -> Iterator[Step]:
    """The recorded hold, in which the arm makes the motions of nuisances and returns each time.

    It rests as long as without nuisances; the last `QUIET_S` seconds are undisturbed.
    """
    due = sorted(
        (number * float(each.every), order)
        for order, each in enumerate(nuisances)
        if isinstance(each, _ByArm)
        for number in range(1, int(max(seconds - QUIET_S, 0.0) / float(each.every)) + 1)
    )
    past = 0.0
    for moment, order in due:
        if moment > past:
            yield Dwell("hold", moment - past, True)
        past = moment
        yield from _there_and_back(nuisances[order], at)
    yield Dwell("hold", seconds - past, True)


def _there_and_back(nuisance: AnyNuisance, at: Position) -> Iterator[Step]:
    if isinstance(nuisance, Rotation):
        turned = replace(at, twist_deg=at.twist_deg + float(nuisance.angle))
        for to in (turned, at):
            yield Twist("nuisance", to, float(nuisance.speed), True)
    elif isinstance(nuisance, ArmMotion | Regrasp):
        distance = float(nuisance.distance)
        away = replace(at, x_mm=at.x_mm + distance)
        if isinstance(nuisance, Regrasp):
            away = replace(at, depth_mm=at.depth_mm - distance)
        for to in (away, at):
            yield Move("nuisance", to, float(nuisance.speed), True)


def _place(phase: Travel, at: Position, condition: Condition) -> Position:
    """Return where a move from `at` ends."""
    absolute = phase.to is not None
    place = phase.to if phase.to is not None else phase.by

    def coordinate(field: Decimal | FactorRef | None, here: float) -> float:
        if field is None:
            return here
        value = _value(field, condition)
        return value if absolute else here + value

    assert place is not None
    return Position(
        coordinate(place.x, at.x_mm),
        coordinate(place.y, at.y_mm),
        coordinate(place.depth, at.depth_mm),
        at.twist_deg,
    )


def _half_slide(phase: Any, condition: Condition) -> tuple[float, float]:
    """Half of the slide's vector; multiples of 90 degrees are exact."""
    half = _value(phase.distance, condition) / 2
    angle = math.fmod(_value(phase.direction, condition), 360.0)
    exact = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}
    unit = exact.get(angle % 360.0)
    if unit is None:
        unit = (math.cos(math.radians(angle)), math.sin(math.radians(angle)))
    return half * unit[0], half * unit[1]


def _signed_share(phase: Retract, condition: Condition) -> float:
    if phase.disturbance is None:
        return 0.0
    return (
        _value(phase.disturbance.share, condition)
        / 100.0
        * _side(phase.disturbance.side, condition)
    )


def check_limits(protocol: Protocol, enabled: Mapping[str, tuple[Level, ...]]) -> None:
    """Hold every level of every phase against the protocol's limits.

    Args:
        enabled: the levels taken, by factor.

    Raises:
        KeyedError: the limits broken, each with the key of the level that breaks it.
    """
    factors = protocol.collection.factors
    written = {
        name: [
            (level, f"collection.factors.{name}.{factor.place(level)}") for level in enabled[name]
        ]
        for name, factor in factors.items()
    }
    raise_all([lambda: _limit_faults(protocol.collection, written)])


def check_reference_limits(collection: Collection) -> None:
    """Hold the condition of reference trials against the protocol's limits, as `check_limits`."""
    if collection.references is not None:
        condition = collection.references.condition
        key = "collection.references.condition"
        written = {name: [(level, f"{key}.{name}")] for name, level in condition.items()}
        raise_all([lambda: _limit_faults(collection, written)])


def _limit_faults(
    collection: Collection, written: Mapping[str, list[tuple[Level, str]]]
) -> Iterator[KeyedError]:
    """Hold levels, each with the key it is written under, against the limits."""
    limits = collection.limits

    def levels(field: Any, key: str) -> Iterator[tuple[Any, str]]:
        """Each value a field can take, with the key it is written under."""
        if not isinstance(field, FactorRef):
            yield field, key
            return
        yield from written.get(field.factor, ())  # an unknown factor is named by another rule

    def at_most(
        field: Any, key: str, name: str, unit: str = "mm", limit: Decimal | None = None
    ) -> Iterator[KeyedError]:
        limit = getattr(limits, name) if limit is None else limit
        for value, where in levels(field, key):
            if value > limit:
                yield KeyedError(
                    where,
                    f"{canonical(value)} {unit}",
                    f"exceeds collection.limits.{name} = {canonical(limit)} {unit}",
                )

    yield from _check_levels(collection, written)
    if collection.nuisances is not None:
        yield from _check_nuisances(collection.nuisances, levels, limits)
    for index, phase in enumerate(collection.motion):
        base = f"collection.motion[{index}]"
        if isinstance(phase, TwistPhase):
            yield from _check_twist(phase, base, levels, limits)
        elif not isinstance(phase, (HoldPhase, PlateMotion)):
            yield from at_most(phase.speed, f"{base}.speed", "speed", "mm/s")
        if isinstance(phase, (Approach, Release)):
            yield from at_most(phase.clearance, f"{base}.clearance", "clearance")
        if isinstance(phase, Press) and phase.depth is not None:
            yield from at_most(phase.depth, f"{base}.depth", "depth")
        if isinstance(phase, Slide):
            yield from at_most(phase.distance, f"{base}.distance", "workspace", limit=_FAR_MM)
            yield from _check_slide(phase, base, levels, limits)
        if isinstance(phase, Travel) and phase.to is not None:
            yield from _check_place(phase.to, f"{base}.to", levels, limits)
        if isinstance(phase, Retract):
            yield from at_most(phase.distance, f"{base}.distance", "clearance", limit=_FAR_MM)
            yield from _check_retract(phase, base, levels, limits)
    if collection.maintenance.warm_up is not None:
        warm_up, base = collection.maintenance.warm_up, "collection.maintenance.warm_up"
        yield from at_most(warm_up.depth, f"{base}.depth", "depth")
        yield from at_most(warm_up.speed, f"{base}.speed", "speed", "mm/s")
        yield from at_most(warm_up.clearance, f"{base}.clearance", "clearance")
    if collection.maintenance.rezero is not None:
        rezero, base = collection.maintenance.rezero, "collection.maintenance.rezero"
        yield from at_most(rezero.speed, f"{base}.speed", "speed", "mm/s")
        yield from at_most(rezero.search, f"{base}.search", "depth")
    if collection.plate is not None:
        key = "collection.plate.mass"
        yield from at_most(collection.plate.mass, key, "mass (fixed)", "kg", Decimal(5))


def _check_levels(
    collection: Collection, written: Mapping[str, list[tuple[Level, str]]]
) -> Iterator[KeyedError]:
    """Check every level against the fields that use it: a number, and in their range."""
    for key, ref in collection.bindings():
        for level, where in written.get(ref.factor, ()) if ref.unit is not None else ():
            if isinstance(level, str):
                yield KeyedError(where, level, f"is text, expected a number in {ref.unit} belongs")
                continue
            try:
                check_least(level, str(ref.unit), ref.low, ref.strict)
            except ValueError as error:
                value = f"{canonical(level)} {ref.unit}"
                yield KeyedError(where, value, f"{error} in {key}")


Levels = Callable[[Any, str], Iterator[tuple[Any, str]]]


def _inside(x: float, y: float, limits: Any) -> str | None:
    for name, value, axis in (("x", x, limits.workspace.x), ("y", y, limits.workspace.y)):
        if not float(axis.low) - 1e-9 <= value <= float(axis.high) + 1e-9:
            return (
                f"reaches {name} = {value:.3f} mm, outside collection.limits.workspace.{name} = "
                f"{canonical(axis.low)} to {canonical(axis.high)} mm"
            )
    return None


def _check_place(place: Place, base: str, levels: Levels, limits: Any) -> Iterator[KeyedError]:
    for name in ("x", "y", "depth"):
        field = getattr(place, name)
        for value, where in () if field is None else levels(field, f"{base}.{name}"):
            x, y, depth = (float(value) if name == axis else 0.0 for axis in ("x", "y", "depth"))
            if broken := _outside(Position(x, y, depth), limits):
                yield KeyedError(where, f"{canonical(value)} mm", broken)


def _outside(place: Position, limits: Any) -> str | None:
    if place.depth_mm > float(limits.depth) + 1e-9:
        return (
            f"reaches a depth of {place.depth_mm:.3f} mm, over collection.limits.depth = "
            f"{canonical(limits.depth)} mm"
        )
    if -place.depth_mm > float(limits.clearance) + 1e-9:
        return (
            f"reaches a clearance of {-place.depth_mm:.3f} mm, over collection.limits.clearance = "
            f"{canonical(limits.clearance)} mm"
        )
    return _inside(place.x_mm, place.y_mm, limits)


def _check_twist(phase: TwistPhase, base: str, levels: Levels, limits: Any) -> Iterator[KeyedError]:
    for angle, where in levels(phase.angle, f"{base}.angle"):
        if not 0 < abs(angle) <= limits.twist:
            yield KeyedError(
                where,
                f"{canonical(angle)} deg",
                f"must not be 0, and at most collection.limits.twist = {canonical(limits.twist)} "
                "deg either way",
            )
    for speed, where in levels(phase.speed, f"{base}.speed"):
        if speed > limits.twist_speed:
            yield KeyedError(
                where,
                f"{canonical(speed)} deg/s",
                f"is over collection.limits.twist_speed = {canonical(limits.twist_speed)} deg/s",
            )


def _check_nuisances(nuisances: Nuisances, levels: Levels, limits: Any) -> Iterator[KeyedError]:
    """Check names and the arm's speeds against known names and the limits; see `path_fault`."""
    base, known = "collection.nuisances", nuisances.known
    for name, where in levels(nuisances.apply, f"{base}.apply"):
        nuisances.check_name(name, where)
        for element in known if name == MIX else {name} & known.keys():
            nuisance, key = known[element], f"{base}.elements.{element}.speed"
            if isinstance(nuisance, Rotation):
                if limits.twist is None or limits.twist_speed is None:
                    missing = "twist" if limits.twist is None else "twist_speed"
                    text = f"is needed: the nuisance '{element}' turns the sensor"
                    yield KeyedError(f"collection.limits.{missing}", None, text)
                    continue
                most, limit, unit = limits.twist_speed, "twist_speed", "deg/s"
            elif isinstance(nuisance, ArmMotion | Regrasp):
                most, limit, unit = limits.speed, "speed", "mm/s"
            else:
                continue
            if nuisance.speed > most:
                yield KeyedError(
                    key,
                    f"{canonical(nuisance.speed)} {unit}",
                    f"exceeds collection.limits.{limit} = {canonical(most)} {unit}",
                )


def path_fault(collection: Collection, program: Program) -> str | None:
    """Return how a program with moves breaks the limits on its way; None if it does not.

    Phases other than a move are held against the limits one by one, which names the level.
    """
    moves = any(isinstance(phase, Travel | TwistPhase) for phase in collection.motion)
    if moves or program.nuisances:
        most = float(collection.limits.twist or 0)
        for step in program.steps:
            if isinstance(step, Twist) and abs(step.to.twist_deg) > most + 1e-9:
                return (
                    f"reaches a twist of {step.to.twist_deg:g} deg, over collection.limits.twist "
                    f"= {most:g} deg"
                )
            if isinstance(step, Move) and (broken := _outside(step.to, collection.limits)):
                return broken
    return None


def _check_slide(phase: Slide, base: str, levels: Levels, limits: Any) -> Iterator[KeyedError]:
    pairs = product(
        levels(phase.distance, f"{base}.distance"), levels(phase.direction, f"{base}.direction")
    )
    for (distance, where), (direction, _) in pairs:
        probe = Slide.model_construct(
            phase="slide", distance=distance, speed=phase.speed, direction=direction
        )
        half = _half_slide(probe, {})
        for sign in (-1, 1):
            broken = _inside(sign * half[0], sign * half[1], limits)
            if broken:
                yield KeyedError(
                    where,
                    f"{canonical(distance)} mm",
                    f"a slide at {canonical(direction)} deg {broken}",
                )


def _check_retract(phase: Retract, base: str, levels: Levels, limits: Any) -> Iterator[KeyedError]:
    if phase.disturbance is None:
        return
    key = f"{base}.disturbance"
    for side, where in levels(phase.disturbance.side, f"{key}.side"):
        if side not in {"left", "right"}:
            yield KeyedError(where, side, "must be 'left' or 'right'")
    for share, where in levels(phase.disturbance.share, f"{key}.share"):
        if isinstance(share, str) or not 0 <= share <= 200:
            yield KeyedError(where, share, "must be from 0 to 200 percent of the retraction speed")
            continue
        for distance, _ in levels(phase.distance, f"{base}.distance"):
            reach = float(share) / 100 * float(distance)
            broken = _inside(reach, 0.0, limits) or _inside(-reach, 0.0, limits)
            if broken:
                yield KeyedError(where, f"{canonical(share)} percent", broken)
        for speed, at in levels(phase.speed, f"{base}.speed"):
            total = float(speed) * math.hypot(1.0, float(share) / 100)
            if total > float(limits.speed) + 1e-9:
                yield KeyedError(
                    at,
                    f"{canonical(speed)} mm/s",
                    f"with a disturbance of {canonical(share)} percent makes {total:.3f} mm/s, "
                    f"over collection.limits.speed = {canonical(limits.speed)} mm/s",
                )
