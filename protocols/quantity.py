"""Physical quantities as exact decimals, in one unit per kind.

A protocol's numbers become trial ids, so they must be the same on every machine and for every
way of writing them: ``2.4 mm``, ``2.40 mm`` and ``0.24 cm`` are one level. They are therefore
stored as `decimal.Decimal` in the canonical unit of their kind, and never pass through a float.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer

from sliplab.protocols.shown import foreign_character
from sliplab.protocols.units import canonical_of, faults, find_unit, symbols_of

_DIGITS = r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
_NUMBER = re.compile(rf"{_DIGITS}\s*([A-Za-z%/][A-Za-z0-9%/]*)?")
_PATTERN = re.compile(rf"\s*{_DIGITS}\s*([A-Za-z%/][A-Za-z0-9%/]*)\s*")
_DASHES = "\u2010\u2011\u2012\u2013\u2014\u2212\ufe63"
_PLAIN = str.maketrans(dict.fromkeys(_DASHES, "-") | {"\u03bc": "u"})
_LARGEST = Decimal("1e9")
# by canonical unit, far beyond any rig: a larger value is a mistake of unit, or a typing error
_SIZES = {
    unit: Decimal(size)
    for unit, size in {
        "mm": "1e5",
        "mm/s": "1e5",
        "s": "1e6",
        "deg": "360",
        "kg": "1e3",
        "percent": "1e4",
        "px": "1e6",
    }.items()
}
_DECIMALS = 40


def canonical(value: Decimal) -> str:
    """`value` as the one decimal string that represents it: no exponent, no trailing zeros."""
    text = format(value.normalize(), "f")
    return "0" if text in {"-0", "0"} else text


def to_decimal(raw: object) -> Decimal:
    """A plain number as a finite decimal.

    Raises:
        ValueError: not a number, not finite, beyond 1e9 in size, or of more than 40 decimals.
    """
    if isinstance(raw, bool) or not isinstance(raw, (int, float, str, Decimal)):
        raise ValueError("must be a number")
    if isinstance(raw, str) and (meant := number_meant(raw)):
        raise ValueError(meant)
    try:
        value = Decimal(repr(raw)) if isinstance(raw, float) else Decimal(raw)
    except InvalidOperation as error:
        raise ValueError("must be a number") from error
    if not value.is_finite():
        raise ValueError("must be a finite number")
    if value.copy_abs() > _LARGEST:  # abs() fails for 1e1000000
        raise ValueError("must be at most 1e9 in size")
    exponent = value.as_tuple().exponent
    if isinstance(exponent, int) and exponent < -_DECIMALS:  # all of them are in ids
        raise ValueError(f"must have at most {_DECIMALS} decimals")
    return value


def parse(raw: object, unit: str) -> Decimal:
    """Text such as ``"15 mm"`` as a decimal in the canonical `unit`.

    Raises:
        ValueError: no number, no unit, or a unit of another kind; the text says what is right.
    """
    if isinstance(raw, (int, float, Decimal)) and not isinstance(raw, bool):
        to_decimal(raw)
        raise ValueError(f"has no unit: write a number with a unit, such as '{raw} {unit}'")
    match = _PATTERN.fullmatch(raw) if isinstance(raw, str) else None
    if match is None:
        if isinstance(raw, str) and (meant := number_meant(raw)):
            raise ValueError(meant)
        raise ValueError(f"must be a finite number with a unit, such as '1.5 {unit}'")
    number, written = match.groups()
    found = find_unit(written)
    if found is None or canonical_of(found) != unit:
        allowed, broken = ", ".join(symbols_of(unit)), faults() if found is None else ""
        raise ValueError(f"has the unit '{written}'; must be one of: {allowed}{broken}")
    value = to_decimal(number) * found.factor
    check_size(value, unit)
    return value


def number_meant(raw: str) -> str | None:
    """The message for a number in characters that are not read: a minus sign, a decimal comma."""
    plain = unicodedata.normalize("NFKC", raw).translate(_PLAIN).strip()
    numbers = [plain]
    if re.search(r"\d,\d", plain):
        whole = re.fullmatch(r"[^,.]*\d{1,3}(,\d{3})+\D*", plain) is not None
        numbers = [plain.replace(",", "")] * whole + [plain.replace(",", ".")]
    if numbers == [raw.strip()] or not all(_NUMBER.fullmatch(number) for number in numbers):
        return None
    if foreign := foreign_character(raw):
        found = f"holds {foreign}"
    else:
        found = "has a comma" if len(numbers) > 1 else "has a decimal comma"
    return f"{found}: write {' or '.join(repr(number) for number in numbers)}"


def check_size(value: Decimal, unit: str) -> None:
    """Hold a value in a canonical unit against the largest size that has a meaning.

    Raises:
        ValueError: it is larger.
    """
    size = _SIZES.get(unit, _LARGEST)
    if value.copy_abs() > size:
        raise ValueError(f"must be from -{size:f} to {size:f} {unit}")


def check_least(value: Decimal, unit: str, low: Decimal | None, strict: bool) -> None:
    """Hold a value in a canonical unit against the least that a field takes.

    Raises:
        ValueError: it is less, or equal to `low` where it must be more (`strict`).
    """
    if low is not None and (value < low or (strict and value == low)):
        words = "more than" if strict else "at least"
        raise ValueError(f"must be {words} {canonical(low)} {unit}")


@dataclass(frozen=True)
class FactorRef:
    """``$depth`` in a motion phase: the level of that factor in the current trial.

    Attributes:
        unit: what its levels must be in, canonical; None for words.
        low: the least that the field takes, in that unit; None if it takes any number.
        strict: true if a level must be more than `low`.
    """

    factor: str
    unit: str | None = None
    low: Decimal | None = None
    strict: bool = False

    def __str__(self) -> str:
        return f"${self.factor}"


def parse_or_ref(raw: object, unit: str) -> Decimal | FactorRef:
    """A quantity, or a reference to a factor (``$name``)."""
    if isinstance(raw, FactorRef):
        return raw
    if isinstance(raw, str) and raw.startswith("$"):
        if not re.fullmatch(r"\$[a-z][a-z0-9_]*", raw):
            raise ValueError("must be a factor's name after '$', such as '$depth'")
        return FactorRef(raw[1:], unit)
    return parse(raw, unit)


def word_or_ref(raw: object) -> object:
    """A word, or a reference to a factor (``$name``) of words."""
    if isinstance(raw, str) and raw.startswith("$"):
        return FactorRef(raw[1:])
    return raw


REF_SCHEMA: dict[str, Any] = {
    "type": "string",
    "pattern": r"^\$[a-z][a-z0-9_]*$",
    "patternErrorMessage": "must be a factor's name after '$', such as $depth",
    "description": "The trial's level of this factor, such as $depth.",
}


def quantity_schema(unit: str, *, negative: bool = True, zero: bool = True) -> dict[str, Any]:
    """JSON Schema of text that `parse` reads as a quantity in `unit`, for editors.

    Args:
        negative: whether it may be below 0; zero: whether it may be 0.
    """
    units = symbols_of(unit)
    sign = "[+-]?" if negative else "[+]?"
    some = "" if zero else "(?=[^eE]*[1-9])"
    number = r"([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?"
    least = "" if negative else (", 0 or more" if zero else ", more than 0")
    return {
        "type": "string",
        "pattern": rf"^\s*{some}{sign}{number}\s*({'|'.join(units)})\s*$",
        # read by editors with the YAML language server in place of the pattern
        "patternErrorMessage": (
            f"must be a number with its unit ({', '.join(units)}){least}, such as 1.5 {unit}"
        ),
        "description": f"A number with its unit: {', '.join(units)}.",
        "examples": [f"1.5 {unit}"],
    }


def _checked(
    unit: str, reader: Callable[[object, str], Any], low: Decimal | None, strict: bool
) -> Callable[[object], Any]:
    def read(raw: object) -> Any:
        value = reader(raw, unit)
        if isinstance(value, FactorRef):
            return replace(value, low=low, strict=strict)
        check_least(value, unit, low, strict)
        return value

    return read


def _writer(unit: str) -> Callable[[Any], str]:
    def write(value: Any) -> str:
        return str(value) if isinstance(value, FactorRef) else f"{canonical(value)} {unit}"

    return write


@dataclass(frozen=True)
class _Schema:
    """JSON Schema of a quantity, made when it is requested: packages may have brought units."""

    unit: str
    negative: bool
    zero: bool
    ref: bool

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: Any) -> dict[str, Any]:
        schema = quantity_schema(self.unit, negative=self.negative, zero=self.zero)
        return {"anyOf": [schema, REF_SCHEMA]} if self.ref else schema


def _quantity(unit: str, low: str | None, strict: bool, *, ref: bool) -> Any:
    bound = None if low is None else Decimal(low)
    kind: Any = (Decimal | FactorRef) if ref else Decimal
    reader = parse_or_ref if ref else parse
    return Annotated[
        kind,
        BeforeValidator(_checked(unit, reader, bound, strict)),
        PlainSerializer(_writer(unit)),
        _Schema(unit, negative=bound is None, zero=not strict, ref=ref),
    ]


# Types for pydantic fields: decimals in the canonical unit that the name says.
Millimetres: Any = _quantity("mm", None, False, ref=False)
PositiveMillimetres: Any = _quantity("mm", "0", True, ref=False)
PositiveDegrees: Any = _quantity("deg", "0", True, ref=False)
PositiveDegreesPerSecond: Any = _quantity("deg/s", "0", True, ref=False)
PositiveSpeed: Any = _quantity("mm/s", "0", True, ref=False)
Seconds: Any = _quantity("s", "0", False, ref=False)
PositiveSeconds: Any = _quantity("s", "0", True, ref=False)
PositivePixels: Any = _quantity("px", "0", True, ref=False)
PositiveNewtons: Any = _quantity("N", "0", True, ref=False)
PositivePercent: Any = _quantity("percent", "0", True, ref=False)
PositiveHertz: Any = _quantity("Hz", "0", True, ref=False)
PositiveCelsius: Any = _quantity("degC", "0", True, ref=False)
# The same, or a factor's name after a dollar sign.
MillimetresOrRef: Any = _quantity("mm", "0", True, ref=True)
AnyMillimetresOrRef: Any = _quantity("mm", None, False, ref=True)
SpeedOrRef: Any = _quantity("mm/s", "0", True, ref=True)
SecondsOrRef: Any = _quantity("s", "0", False, ref=True)
PositiveSecondsOrRef: Any = _quantity("s", "0", True, ref=True)
DegreesOrRef: Any = _quantity("deg", None, False, ref=True)
DegreesPerSecondOrRef: Any = _quantity("deg/s", "0", True, ref=True)
NewtonsOrRef: Any = _quantity("N", "0", True, ref=True)
KilogramsOrRef: Any = _quantity("kg", "0", True, ref=True)
PercentOrRef: Any = _quantity("percent", "0", False, ref=True)


def level_order(text: str) -> tuple[float, str]:
    """Key that sorts levels as text (``2.4 mm``) by their number, and those without one last."""
    try:
        return float(text.split()[0]), ""
    except (ValueError, IndexError):
        return float("inf"), text
