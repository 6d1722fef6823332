"""Validation rules over several keys, introduced after the first campaigns.

They reject combinations that are valid key by key but surely unintended: an unknown factor, one
direction twice, a plate that is never caught. They do not apply to the copies of protocols in
stores, so that collected trials stay usable (docs/decisions/protocols.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from decimal import Decimal
from itertools import pairwise

from sliplab.protocols.claims import repeated
from sliplab.protocols.factors import Factor, unknown_factor
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.model import Collection, Protocol
from sliplab.protocols.motion import check_reference_limits
from sliplab.protocols.phases import PlateMotion
from sliplab.protocols.protocol_limits import MAX_CREEP_MM_S
from sliplab.protocols.quantity import canonical, check_size
from sliplab.protocols.split import Split, check_split
from sliplab.protocols.yaml_file import StrictModel, raise_all

FULL_TURN = 360


def check_consistency(protocol: Protocol) -> None:
    """Check a protocol against the rules that concern several keys.

    Raises:
        KeyedError: the rules that are broken.
    """
    collection, split = protocol.collection, protocol.analysis.split
    raise_all(
        (
            lambda: _check_strata(split, collection.all_factors),
            lambda: _check_held_out(check_split(split, collection.all_factors)),
            lambda: _check_directions(collection),
            lambda: _check_plate(collection),
            lambda: _check_references(collection),
            lambda: _check_claims(collection),
            lambda: _check_creep(collection),
        )
    )


def _check_strata(split: Split, factors: Mapping[str, Factor]) -> Iterator[KeyedError]:
    if "strata" not in split.model_fields_set:  # the default is of the kinematic grid
        return
    for index, name in enumerate(split.strata):
        key = f"analysis.split.strata[{index}]"
        if name not in factors:
            yield KeyedError(key, name, unknown_factor(name, factors))
        elif name in split.strata[:index]:
            yield KeyedError(key, name, "appears twice")


def _check_held_out(split: Split) -> Iterator[KeyedError]:
    if split.method != "leave_conditions_out":
        return
    for part in ("validation_levels", "test_levels"):
        for name, levels in getattr(split, part).items():
            key = f"analysis.split.{part}.{name}"
            if not levels:
                yield KeyedError(key, "[]", "must name at least one level")
            for index, level in enumerate(levels):
                if level in levels[:index]:
                    yield KeyedError(f"{key}[{index}]", level, "is listed twice as held out")
                if part == "validation_levels" and level in split.test_levels.get(name, ()):
                    yield KeyedError(key, level, "is already held out for testing")


def _check_creep(collection: Collection) -> Iterator[KeyedError]:
    """Check that touching off is as slow as teaching."""
    rezero = collection.maintenance.rezero
    if rezero is not None and rezero.speed > MAX_CREEP_MM_S:
        yield KeyedError(
            "collection.maintenance.rezero.speed",
            f"{canonical(rezero.speed)} mm/s",
            f"must be at most {MAX_CREEP_MM_S:g} mm/s: the skin is deep in the plate before a "
            "faster touch is noticed",
        )


def _check_claims(collection: Collection) -> Iterator[KeyedError]:
    """Claims differ, and no key of theirs is empty."""
    stopping = collection.stopping
    parts: dict[str, StrictModel | None] = {"stopping": stopping, "choice": collection.choice}
    claims = () if stopping is None else stopping.claims
    parts |= {f"stopping.claims[{k}]": claim for k, claim in enumerate(claims)}
    for place, part in parts.items():
        for name in () if part is None else sorted(part.model_fields_set):
            if getattr(part, name) is None:
                yield KeyedError(
                    f"collection.{place}.{name}", None, "is empty: give a value, or leave it out"
                )
    for k, earlier in enumerate(repeated(claims)):
        if earlier is not None:
            yield KeyedError(
                f"collection.stopping.claims[{k}]", None, f"is the same as claims[{earlier}]"
            )


def _check_directions(collection: Collection) -> Iterator[KeyedError]:
    """Two directions that differ by full turns are one condition under two names."""
    directions = {ref.factor for key, ref in collection.bindings() if key.endswith(".direction")}
    for name, factor in collection.factors.items():
        if name not in directions or factor.unit is None:
            continue
        seen: dict[Decimal, Decimal] = {}
        for level in (*factor.levels(), *factor.optional):
            assert not isinstance(level, str)  # a factor with a unit has no words
            known = seen.setdefault((level % FULL_TURN + FULL_TURN) % FULL_TURN, level)
            if known is not level:
                yield KeyedError(
                    f"collection.factors.{name}.{factor.place(level)}",
                    level,
                    f"{canonical(level)} deg is the same direction as {canonical(known)} deg",
                )


def _check_references(collection: Collection) -> None:
    """Reference trials obey the limits as all others do."""
    given = {} if collection.references is None else collection.references.condition
    for name, level in given.items():
        unit = collection.all_factors[name].unit
        if unit is not None and not isinstance(level, str):
            try:
                check_size(level, unit)
            except ValueError as error:
                key = f"collection.references.condition.{name}"
                raise KeyedError(key, level, str(error)) from None
    check_reference_limits(collection)


def _check_plate(collection: Collection) -> None:
    """A plate is raised, released and caught, in this order; it must not fall on what is below."""
    motion = collection.motion
    places: dict[str, int] = {}
    for index, phase in enumerate(motion):
        if isinstance(phase, PlateMotion):
            if phase.action in places:
                raise KeyedError(
                    f"collection.motion[{index}].action",
                    phase.action,
                    "appears twice in the motion",
                )
            places[phase.action] = index
    falls = collection.experiment != "kinematic"
    acting = collection.acting[0]

    def wanted(action: str, text: str) -> None:
        if action not in places:
            names = " -> ".join(phase.phase for phase in motion)
            raise KeyedError(
                "collection.motion", names, f"{text}: add {{phase: plate, action: {action}}}"
            )

    if falls:
        wanted("release", f"a {collection.experiment} protocol must release the plate")
    if "release" in places:
        wanted("raise", "must raise the plate before releasing it")
        wanted("catch", "the plate is released but never caught")
    order = [name for name in ("raise", "release", "catch") if name in places]
    for before, after in pairwise(order):
        if places[after] < places[before]:
            key = f"collection.motion[{places[after]}].action"
            raise KeyedError(key, after, f"must come after '{before}'")
    for name, late in (("release", False), ("catch", True)):
        if name in places and (places[name] > acting) != late:
            raise KeyedError(
                f"collection.motion[{places[name]}].action",
                name,
                f"must come {'after' if late else 'before'} '{motion[acting].phase}'",
            )
