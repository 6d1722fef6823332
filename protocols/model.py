"""What a protocol file may say: the frozen models of its `collection:` section.

Everything that decides what is measured stands here, and nothing that decides what it is made to
mean (that is `protocols.settings`). Quantities are decimals in the canonical unit of their kind
(mm, mm/s, deg, s, kg, percent, px), whatever unit the file used.
"""

from __future__ import annotations

import re
from decimal import Decimal
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainSerializer, field_validator, model_validator

from protocols.quantity import (
    UNITS,
    DegreesOrRef,
    FactorRef,
    KilogramsOrRef,
    Millimetres,
    MillimetresOrRef,
    PercentOrRef,
    PositiveMillimetres,
    PositiveSeconds,
    PositiveSpeed,
    Seconds,
    SpeedOrRef,
    canonical,
    to_decimal,
)
from protocols.settings import AnalysisSettings
from protocols.yaml_file import KeyedError, StrictModel, register_tags

MAX_TRIALS = 1_000_000
_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_WORD = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")

Level = Decimal | str


def _number(raw: object) -> Decimal:
    return to_decimal(raw)


Number = Annotated[Decimal, BeforeValidator(_number), PlainSerializer(canonical)]


class Range(StrictModel):
    """Evenly spaced levels, both ends included."""

    start: Number = Field(alias="from")
    stop: Number = Field(alias="to")
    step: Number

    @model_validator(mode="after")
    def _whole(self) -> Range:
        if self.step <= 0:
            raise ValueError(f"step = {canonical(self.step)} must be more than 0")
        if self.stop < self.start:
            raise ValueError("'to' must not be below 'from'")
        if (self.stop - self.start) % self.step:
            raise ValueError(
                f"from {canonical(self.start)} to {canonical(self.stop)} is not a whole number "
                f"of steps of {canonical(self.step)}"
            )
        if self.count > MAX_TRIALS:
            raise ValueError(f"has {self.count} levels; at most {MAX_TRIALS:,} trials")
        return self

    @property
    def count(self) -> int:
        """Number of levels."""
        return int((self.stop - self.start) / self.step) + 1

    def levels(self) -> tuple[Decimal, ...]:
        """The levels in order."""
        return tuple(self.start + index * self.step for index in range(self.count))


def _level(raw: object) -> Level:
    if isinstance(raw, str):
        if not _WORD.fullmatch(raw):
            raise ValueError(
                "must be a number (the unit stands once, in 'unit') or a word of letters, "
                "digits, '_' and '-'"
            )
        return raw
    return to_decimal(raw)


def _write_level(level: Level) -> str:
    return level if isinstance(level, str) else canonical(level)


LevelField = Annotated[Level, BeforeValidator(_level), PlainSerializer(_write_level)]


class Factor(StrictModel):
    """One factor of the factorial: its unit and its levels, as a list or a range."""

    unit: str | None = None
    values: tuple[LevelField, ...] | None = None
    range: Range | None = None
    optional: tuple[LevelField, ...] = ()
    """Levels that the protocol knows but does not take unless they are switched on."""
    changeover: Literal["none", "person"] = "none"
    """`person`: somebody has to change it by hand, so its levels become outer blocks."""

    @field_validator("unit")
    @classmethod
    def _known(cls, unit: str | None) -> str | None:
        canonical_units = sorted({kind for kind, _ in UNITS.values()})
        if unit is not None and unit not in canonical_units:
            raise ValueError(f"must be one of {', '.join(canonical_units)}")
        return unit

    @model_validator(mode="after")
    def _levels(self) -> Factor:
        if (self.values is None) == (self.range is None):
            raise ValueError("must have either 'values' or 'range'")
        levels = self.levels()
        if not levels:
            raise ValueError("has no levels; give at least one")
        seen: set[Level] = set()
        for level in (*levels, *self.optional):
            if level in seen:
                raise ValueError(f"has the level {_write_level(level)} twice")
            seen.add(level)
            if isinstance(level, str) == (self.unit is not None):
                raise ValueError(
                    f"has the level {_write_level(level)}: numbers need a unit, words have none"
                )
        return self

    def levels(self) -> tuple[Level, ...]:
        """The levels taken, in the order of the file."""
        if self.range is not None:
            return self.range.levels()
        return self.values or ()

    def text(self, level: Level) -> str:
        """A level with its unit: ``2.4 mm``, ``left``."""
        return level if isinstance(level, str) else f"{canonical(level)} {self.unit}"


class Approach(StrictModel):
    """Travel, clear of the plate, to above the place where the trial begins."""

    phase: Literal["approach"]
    clearance: PositiveMillimetres
    speed: PositiveSpeed


class Press(StrictModel):
    """Straight in along the plate's normal, to an indentation depth."""

    phase: Literal["press"]
    depth: MillimetresOrRef
    speed: PositiveSpeed


class Hold(StrictModel):
    """Standing still: `settle` passes first, then `duration`, which may be recorded."""

    phase: Literal["hold"]
    duration: PositiveSeconds
    settle: Seconds = Decimal(0)


class Slide(StrictModel):
    """Along the plate at constant depth; the path is centred on the plate."""

    phase: Literal["slide"]
    distance: MillimetresOrRef
    speed: SpeedOrRef
    direction: DegreesOrRef


def _share_or_side(raw: object) -> object:
    if isinstance(raw, str) and raw.startswith("$"):
        return FactorRef(raw[1:])
    return raw


SideField = Annotated[
    Literal["left", "right"] | FactorRef, BeforeValidator(_share_or_side), PlainSerializer(str)
]


class Disturbance(StrictModel):
    """A sideways motion during retraction, as a share of the retraction's speed."""

    share: PercentOrRef
    side: SideField


class Retract(StrictModel):
    """Slowly out along the normal, with an optional sideways disturbance."""

    phase: Literal["retract"]
    distance: MillimetresOrRef
    speed: SpeedOrRef
    disturbance: Disturbance | None = None


class PlateMotion(StrictModel):
    """Something done to the sliding plate."""

    phase: Literal["plate"]
    action: Literal["raise", "release", "catch"]
    duration: Seconds = Decimal(0)


class Release(StrictModel):
    """Out along the normal until clear of the plate."""

    phase: Literal["release"]
    clearance: PositiveMillimetres
    speed: PositiveSpeed


class Return(StrictModel):
    """Back to above the plate's centre."""

    phase: Literal["return"]
    speed: PositiveSpeed


_PHASES = ("approach", "press", "hold", "slide", "retract", "plate", "release", "return")
register_tags(*_PHASES)
Phase = Annotated[
    Approach | Press | Hold | Slide | Retract | PlateMotion | Release | Return,
    Field(discriminator="phase"),
]


class Region(StrictModel):
    """The part of the plate that the outside camera reads out, centred."""

    width: PositiveMillimetres
    height: PositiveMillimetres


class Recording(StrictModel):
    """What is kept of each trial, from the end of settling to the end of the motion."""

    region: Region
    sync_rate: Annotated[Literal[100], Field()] = 100
    """Ticks of the sync box a second, Hz: frames are taken on them."""
    streams: tuple[Literal["events", "frames", "poses"], ...] = ("events", "frames", "poses")

    @field_validator("streams")
    @classmethod
    def _needed(cls, streams: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(streams)) != len(streams) or "events" not in streams or "poses" not in streams:
            raise ValueError("must hold 'events' and 'poses', and may hold 'frames', none twice")
        return streams


class Axis(StrictModel):
    """Allowed interval of one coordinate, in plate coordinates."""

    low: Millimetres
    high: Millimetres

    @model_validator(mode="after")
    def _ordered(self) -> Axis:
        if not self.low < self.high:
            raise ValueError("'low' must be below 'high'")
        return self


class Workspace(StrictModel):
    """The box that the sensor's centre must stay in, in plate coordinates."""

    x: Axis
    y: Axis


class Limits(StrictModel):
    """What no trial of this protocol may exceed, checked before anything moves."""

    depth: PositiveMillimetres
    speed: PositiveSpeed
    clearance: PositiveMillimetres
    workspace: Workspace
    duration: PositiveSeconds


class Gates(StrictModel):
    """When a trial is not good enough and is taken again."""

    sync_uncertainty: PositiveSeconds = Decimal("0.001")
    """95 % uncertainty of events against frames and poses."""
    frames_lost: Annotated[int, Field(ge=0)] = 0
    event_gap: PositiveSeconds = Decimal("0.05")
    """Longest silence of the event camera while the arm moves in contact."""
    retakes: Annotated[int, Field(ge=0, le=10)] = 2
    """How often a trial is taken again before it is set aside."""


class References(StrictModel):
    """One condition taken again and again, to see the skin wear and the rig drift."""

    every: Annotated[int, Field(ge=1)]
    condition: dict[str, LevelField]


class WarmUp(StrictModel):
    """Presses before the first trial of every stretch of work."""

    presses: Annotated[int, Field(ge=1, le=100)]
    depth: PositiveMillimetres
    speed: PositiveSpeed
    clearance: PositiveMillimetres


class Rezero(StrictModel):
    """Depth zero found again by touching off, before every so many trials."""

    every: Annotated[int, Field(ge=1)]
    speed: PositiveSpeed
    search: PositiveMillimetres
    """How far beyond the taught plane the touch may be looked for; a hard limit."""


class Cleaning(StrictModel):
    """A person cleans skin and plate before every so many trials."""

    every: Annotated[int, Field(ge=1)]
    prompt: Annotated[str, Field(min_length=1, max_length=400)]


class Maintenance(StrictModel):
    """What keeps a long campaign comparable from its first trial to its last."""

    warm_up: WarmUp | None = None
    rezero: Rezero | None = None
    clean: Cleaning | None = None


class PlateSetup(StrictModel):
    """The plate that hangs on the slider in gravity and disturbance trials."""

    mass: KilogramsOrRef


class Collection(StrictModel):
    """The `collection:` section: it alone decides whether a campaign may go on."""

    experiment: Literal["kinematic", "gravity", "disturbance"]
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    factors: dict[str, Factor]
    repetitions: Annotated[int, Field(ge=1, le=100_000)]
    order: Literal["shuffled", "listed"] = "shuffled"
    references: References | None = None
    plate: PlateSetup | None = None
    motion: tuple[Phase, ...]
    recording: Recording
    limits: Limits
    gates: Gates = Gates()
    maintenance: Maintenance = Maintenance()

    @field_validator("factors")
    @classmethod
    def _named(cls, factors: dict[str, Factor]) -> dict[str, Factor]:
        if not factors:
            raise ValueError("is empty; give at least one factor")
        for name in factors:
            if not _NAME.fullmatch(name) or name == "r":
                raise KeyedError(
                    f"collection.factors.{name}",
                    name,
                    "a factor's name is a small letter, then small letters, digits and '_' "
                    "('r' stands for the repetition)",
                )
        return factors

    @model_validator(mode="after")
    def _consistent(self) -> Collection:
        count = self.repetitions
        for name, factor in self.factors.items():
            count *= len(factor.levels())
            if count > MAX_TRIALS:
                raise KeyedError(
                    f"collection.factors.{name}",
                    f"{count:,} trials",
                    f"the factorial has more than {MAX_TRIALS:,} trials",
                )
        self._check_references()
        self._check_motion()
        return self

    def _check_references(self) -> None:
        if self.references is None:
            return
        given = self.references.condition
        for name, factor in self.factors.items():
            key = f"collection.references.condition.{name}"
            if name not in given:
                raise KeyedError(key, None, "is missing: a reference trial has every factor")
            if isinstance(given[name], str) == (factor.unit is not None):
                raise KeyedError(key, given[name], f"must be a level in '{factor.unit or 'words'}'")
            if factor.changeover == "person":
                raise KeyedError(
                    key,
                    given[name],
                    "a reference trial cannot ask for a changeover; leave references out",
                )
        for name in given:
            if name not in self.factors:
                raise KeyedError(
                    f"collection.references.condition.{name}",
                    given[name],
                    f"is not a factor; the factors are {', '.join(self.factors)}",
                )

    def _check_motion(self) -> None:
        names = [phase.phase for phase in self.motion]
        acting = [index for index, name in enumerate(names) if name in {"slide", "retract"}]

        def fail(expected: str, value: object = None) -> None:
            raise KeyedError("collection.motion", value or " -> ".join(names), expected)

        if names[:1] != ["approach"] and names[:1] != ["plate"]:
            fail("must begin with 'approach' (or 'plate')")
        if names[-1:] != ["return"]:
            fail("must end with 'return'")
        for name in ("approach", "press", "release", "return"):
            if names.count(name) != 1:
                fail(f"must hold the phase '{name}' exactly once")
        if len(acting) != 1:
            fail("must hold exactly one 'slide' or 'retract'")
        if "hold" not in names[: acting[0]]:
            fail("must hold still ('hold') before the slide or retraction: recording begins there")
        ordered = [name for name in names if name in {"approach", "press", "release", "return"}]
        if ordered != ["approach", "press", "release", "return"]:
            fail("must have approach, press, release and return in this order")
        press, release = names.index("press"), names.index("release")
        if not all(press < index < release for index in acting):
            fail("must slide or retract between press and release")
        if any(names.index("approach") > i for i, name in enumerate(names) if name == "hold"):
            fail("cannot hold before the approach")
        if ("plate" in names) != (self.plate is not None):
            fail("phases 'plate' and the section 'plate' belong together")
        used = {str(ref) for ref in _references_in(self.motion)}
        used |= {str(ref) for ref in _references_in(self.plate)}
        for ref in sorted(used):
            if ref[1:] not in self.factors:
                fail(f"names a factor that is not there; there are {', '.join(self.factors)}", ref)
        for name in self.factors:
            if f"${name}" not in used:
                raise KeyedError(
                    f"collection.factors.{name}",
                    name,
                    f"is used by no phase; write ${name} where it belongs",
                )


def _references_in(part: Any) -> list[FactorRef]:
    if isinstance(part, FactorRef):
        return [part]
    if isinstance(part, tuple):
        return [ref for item in part for ref in _references_in(item)]
    if isinstance(part, StrictModel):
        return [
            ref for name in type(part).model_fields for ref in _references_in(getattr(part, name))
        ]
    return []


class Protocol(StrictModel):
    """A whole protocol file."""

    protocol: Literal[1]
    """Version of the file format."""
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,47}$")]
    title: Annotated[str, Field(max_length=200)] = ""
    collection: Collection
    analysis: AnalysisSettings = AnalysisSettings()
