"""Factors of an experiment and their levels, as a protocol file gives them: a list or a range."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from decimal import Decimal
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.quantity import canonical, check_size, number_meant, parse, to_decimal
from sliplab.protocols.shown import did_you_mean, foreign_character
from sliplab.protocols.units import all_symbols, canonical_of, faults, find_unit
from sliplab.protocols.yaml_file import StrictModel, rule

MAX_TRIALS = 1_000_000
_WORD = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")

Level = Decimal | str


_DIGITS = r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?"
_QUANTITY = {
    "type": "string",
    "pattern": rf"^\s*{_DIGITS}\s*[A-Za-z%/][A-Za-z0-9%/]*\s*$",
    "patternErrorMessage": "must be a number, which may have a unit: 2.4 or 2.4 mm",
}
Number = Annotated[
    Decimal,
    BeforeValidator(to_decimal),
    PlainSerializer(canonical),
    WithJsonSchema({"anyOf": [{"type": "number"}, _QUANTITY]}),
]


class LevelRange(StrictModel):
    """Evenly spaced levels, both ends included."""

    start: Number = Field(alias="from")
    stop: Number = Field(alias="to")
    step: Number

    @rule
    def _whole(self) -> LevelRange:
        if self.step <= 0:
            raise ValueError(f"step = {canonical(self.step)} must be more than 0")
        if self.stop < self.start:
            raise ValueError("'to' must be at least 'from'")
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
            if meant := number_meant(raw):
                raise ValueError(meant)
            if re.fullmatch(r"[+-]?[\d.]+([eE][+-]?\d+)?", raw):
                raise ValueError(f"reads as text; write {canonical(to_decimal(raw))}")
            raise ValueError(
                "must be a number (with a unit only where 'unit' is given) or a word of letters, "
                "digits, '_' and '-'"
            )
        return raw
    return to_decimal(raw)


def _write_level(level: Level) -> str:
    return level if isinstance(level, str) else canonical(level)


def _schema(text: re.Pattern[str]) -> WithJsonSchema:
    """Return the JSON Schema of a level that is a number, or text of a pattern."""
    words = {"type": "string", "pattern": f"^{text.pattern}$"}
    return WithJsonSchema({"anyOf": [{"type": "number"}, _QUANTITY, words]})


LevelField = Annotated[
    Level, BeforeValidator(_level), PlainSerializer(_write_level), _schema(_WORD)
]


def _named(raw: object) -> Level:
    """A level of context: a number, or text that names a thing, also one of digits (``"0042"``)."""
    if isinstance(raw, str):
        if not _NAME.fullmatch(raw):
            raise ValueError(
                "must be a number (its unit is given in 'unit') or a text of letters, digits, "
                "'_', '-' and '.', 32 characters at most"
            )
        return raw
    return to_decimal(raw)


ContextLevel = Annotated[
    Level, BeforeValidator(_named), PlainSerializer(_write_level), _schema(_NAME)
]


def _list_units(schema: dict[str, Any]) -> None:
    schema["enum"] = [*all_symbols(), None]


_PLAIN = re.compile(rf"\s*{_DIGITS}\s*")
_WITH_UNIT = re.compile(r"\s*[+-]?[\d.].*[A-Za-z%]\d?\s*")


def in_canonical_unit(level: Any, symbol: object) -> Any:
    """Return a level as a number in the canonical unit of its factor.

    Args:
        level: a number in the factor's unit, or text with any unit of its dimension.
        symbol: the factor's unit, as a file gives it.

    Returns:
        the number; a level that is no number, or has no unit, unchanged.

    Raises:
        ValueError: the unit is of another dimension.
    """
    unit = find_unit(symbol) if isinstance(symbol, str) else None
    if unit is None:
        return level
    if isinstance(level, str) and _WITH_UNIT.fullmatch(level) and not _PLAIN.fullmatch(level):
        return parse(level, canonical_of(unit))
    try:
        return level if unit.factor == 1 else to_decimal(level) * unit.factor
    except ValueError:
        return level


def written_units(*sections: Any) -> dict[str, Any]:
    """Return the unit of each factor, as the sections of a file have them."""
    return {
        name: each.get("unit")
        for part in sections
        if isinstance(part, dict)
        for name, each in part.items()
        if isinstance(each, dict)
    }


def levels_in_canonical_units(
    levels: Any, key: str, unit_of: Callable[[Any], object], faults: list[KeyedError]
) -> Any:
    """Return a list or mapping of levels as a file gives them, by `in_canonical_unit`.

    Args:
        key: of the levels.
        unit_of: returns the unit of a level's place: its index or name.
        faults: gets those of units.
    """
    if not isinstance(levels, dict | list | tuple):
        return levels
    found: dict[Any, Any] = {}
    for place, level in levels.items() if isinstance(levels, dict) else enumerate(levels):
        try:
            found[place] = in_canonical_unit(level, unit_of(place))
        except ValueError as error:
            below = f".{place}" if isinstance(levels, dict) else f"[{place}]"
            faults.append(KeyedError(f"{key}{below}", level, str(error)))
    return found if isinstance(levels, dict) else list(found.values())


class Factor(StrictModel):
    """One factor of the factorial: its unit and its levels, as a list or a range."""

    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": ["values"]}, {"required": ["range"]}]}
    )

    _HINT: ClassVar[str] = ""

    unit: str | None = Field(default=None, json_schema_extra=_list_units)
    """Of all its levels, which are taken over in the canonical unit of its dimension; words have
    none."""
    values: tuple[LevelField, ...] | None = None
    range: LevelRange | None = None
    optional: tuple[LevelField, ...] = ()
    """Levels that the protocol knows but does not take unless they are switched on."""
    changeover: Literal["none", "person"] = "none"
    """`person`: somebody has to change it by hand, so its levels become outer blocks."""

    @field_validator("unit")
    @classmethod
    def _known(cls, unit: str | None) -> str | None:
        if unit is not None and find_unit(unit) is None:
            raise ValueError(f"must be one of {', '.join(all_symbols())}{faults()}")
        return unit

    @model_validator(mode="before")
    @classmethod
    def _in_canonical_unit(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(symbol := data.get("unit"), str):
            return data
        if (unit := find_unit(symbol)) is None:
            return data
        made, faults = {**data, "unit": canonical_of(unit)}, list[KeyedError]()
        for key in ("values", "optional", "range"):
            if key in data:
                made[key] = levels_in_canonical_units(
                    data[key], f".{key}", lambda _: symbol, faults
                )
        if faults:
            raise KeyedError.joined(faults)
        return made

    @rule
    def _levels(self) -> Factor:
        if (self.values is None) == (self.range is None):
            raise ValueError("must have exactly one of 'values' and 'range'")
        levels = self.levels()
        if not levels:
            raise ValueError("is empty; give at least one level")
        seen: set[Level] = set()
        for level in (*levels, *self.optional):
            if level in seen:
                raise ValueError(f"has the level {_write_level(level)} twice")
            seen.add(level)
            if isinstance(level, str) or self.unit is None:
                if isinstance(level, str) == (self.unit is not None):
                    raise ValueError(
                        f"has the level {_write_level(level)}: numbers need a unit, words have none"
                        f"{self._HINT}"
                    )
                continue
            try:
                check_size(level, self.unit)
            except ValueError as error:
                raise KeyedError(f".{self.place(level)}", level, str(error)) from None
        return self

    def levels(self) -> tuple[Level, ...]:
        """The levels taken, in the order of the file."""
        if self.range is not None:
            return self.range.levels()
        return self.values or ()

    def place(self, level: Level) -> str:
        """The key below the factor that gives one of its levels: ``values[2]``, ``range``."""
        for key in ("values", "optional"):
            levels = getattr(self, key) or ()
            if level in levels:
                return f"{key}[{levels.index(level)}]"
        return "range"

    def text(self, level: Level) -> str:
        """A level with its unit: ``2.4 mm``, ``left``."""
        return level if isinstance(level, str) else f"{canonical(level)} {self.unit}"


class Context(Factor):
    """One thing that is known of a trial and moves nothing: skin, temperature, serial number.

    Its levels belong to conditions, ids, tables and splits as those of a factor do. Text may be
    any name, also one of digits only where it is in quotes.
    """

    _HINT: ClassVar[str] = " (quote a number that is a name)"

    values: tuple[ContextLevel, ...] | None = None
    optional: tuple[ContextLevel, ...] = ()
    """Levels that the protocol knows but does not take unless they are switched on."""


def unknown_factor(name: str, factors: Iterable[str]) -> str:
    """Return the message for a `name` that is not one of the defined `factors`."""
    foreign = foreign_character(name)
    hint = f" (holds {foreign})" if foreign else ""
    names = list(factors)
    close = did_you_mean(name.removeprefix("$"), names)
    return f"unknown factor {name}{hint}; defined factors: {', '.join(names)}{close}"
