"""Units as data: one table of symbols, and more of them from installed packages.

A package brings units by an entry point of the group ``sliplab.units`` that names a mapping from a
symbol to its dimension and its size in the dimension's canonical unit, as decimal text:

    [project.entry-points."sliplab.units"]
    pressure = "my_package:UNITS"

    UNITS = {"kPa": ("pressure", "1"), "bar": ("pressure", "100"), "inch": ("length", "25.4")}

A dimension that is new needs one unit of factor 1, which becomes its canonical one. Packages are
only imported when a symbol is met that the table does not have. There is no offset: a temperature
is a number with a name, and 20 degC is nothing in kelvin.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from sliplab.protocols.plugins import PluginError, import_foreign

GROUP = "sliplab.units"
_SYMBOL = re.compile(r"[A-Za-z%/][A-Za-z0-9%/]{0,15}")
_DIMENSION = re.compile(r"[a-z][a-z ]{0,31}")


@dataclass(frozen=True)
class Unit:
    """One unit.

    Attributes:
        dimension: name of what it measures; the dimension's first unit, of factor 1, is canonical.
        factor: its size in the canonical unit, exact.
    """

    symbol: str
    dimension: str
    factor: Decimal


TABLE: tuple[Unit, ...] = tuple(
    Unit(symbol, dimension, Decimal(factor))
    for symbol, dimension, factor in (
        ("mm", "length", "1"),
        ("um", "length", "0.001"),
        ("cm", "length", "10"),
        ("m", "length", "1000"),
        ("mm/s", "speed", "1"),
        ("cm/s", "speed", "10"),
        ("m/s", "speed", "1000"),
        ("deg", "angle", "1"),
        ("deg/s", "angular speed", "1"),
        ("s", "time", "1"),
        ("ms", "time", "0.001"),
        ("min", "time", "60"),
        ("kg", "mass", "1"),
        ("g", "mass", "0.001"),
        ("percent", "share", "1"),
        ("%", "share", "1"),
        ("px", "pixels", "1"),
        ("Hz", "frequency", "1"),
        ("kHz", "frequency", "1000"),
        ("ppm", "drift", "1"),
        ("N", "force", "1"),
        ("degC", "temperature", "1"),
    )
)


@dataclass
class _KnownUnits:
    """Units by symbol, and why units of packages cannot be used; None before they were loaded."""

    units: dict[str, Unit] = field(default_factory=lambda: {each.symbol: each for each in TABLE})
    faults: list[str] | None = None


_known = _KnownUnits()


def find_unit(symbol: str) -> Unit | None:
    """Return the unit of a symbol; packages are searched for one that the table does not have."""
    if symbol not in _known.units:
        load_packages()
    return _known.units.get(symbol)


def canonical_of(unit: Unit) -> str:
    """Return the symbol of the canonical unit of a unit's dimension."""
    return next(each.symbol for each in _of_dimension(unit.dimension) if each.factor == 1)


def symbols_of(canonical: str) -> list[str]:
    """Return the symbols known so far that measure what a canonical unit does, itself first."""
    return [each.symbol for each in _of_dimension(_known.units[canonical].dimension)]


def all_symbols() -> list[str]:
    """Return the symbols known so far, sorted."""
    return sorted(_known.units)


def faults() -> str:
    """Return why units of packages cannot be used, to end a message; empty where all can."""
    return "".join(f"; {fault}" for fault in _known.faults or ())


def file_text(unit: str | None) -> str:
    """Return a canonical unit as file names may hold it: ``mmps`` for ``mm/s``, ``pct``."""
    return (unit or "").replace("percent", "pct").replace("%", "pct").replace("/", "p")


def load_packages() -> None:
    """Take the units of all installed packages, once."""
    if _known.faults is not None:
        return
    _known.faults = []
    for point in sorted(entry_points(group=GROUP), key=lambda each: (each.name, each.value)):
        try:
            _take(import_foreign(point.value))
        except (PluginError, UnitError) as error:
            text = " ".join(str(error).split())
            _known.faults.append(f"the units of {_owner(point)} cannot be used: {text}")


def forget_packages() -> None:
    """Forget the units of packages, so that they are loaded again."""
    _known.units = {each.symbol: each for each in TABLE}
    _known.faults = None


class UnitError(ValueError):
    """An invalid unit of a package."""


def _take(found: Any) -> None:
    """Add a package's units, all or none."""
    if not isinstance(found, Mapping):
        raise UnitError(f"must be a mapping of symbols, not {type(found).__name__}")
    new = [_read(symbol, given) for symbol, given in found.items()]
    dimensions = {each.dimension for each in _known.units.values()}
    for each in new:
        if each.symbol in _known.units:
            raise UnitError(f"{each.symbol}: is a unit already")
        if each.dimension not in dimensions and not any(
            other.dimension == each.dimension and other.factor == 1 for other in new
        ):
            raise UnitError(f"{each.dimension}: has no unit of factor 1")
    _known.units |= {each.symbol: each for each in new}


def _read(symbol: Any, given: Any) -> Unit:
    if not isinstance(symbol, str) or not _SYMBOL.fullmatch(symbol):
        raise UnitError(f"{symbol}: a symbol is letters, digits, '%' and '/', 16 at most")
    pair = tuple(given) if isinstance(given, tuple | list) else ()
    if len(pair) != 2 or not all(isinstance(part, str) for part in pair):
        raise UnitError(f"{symbol}: must be (dimension, decimal text), such as ('length', '25.4')")
    dimension, text = pair
    if not _DIMENSION.fullmatch(dimension):
        raise UnitError(f"{symbol}: a dimension is small letters, such as 'length'")
    try:
        factor = Decimal(text)
    except InvalidOperation:
        factor = Decimal("nan")
    if not factor.is_finite():
        raise UnitError(f"{symbol}: {text} must be a finite number")
    if factor <= 0:
        raise UnitError(f"{symbol}: {text} must be more than 0")
    return Unit(symbol, dimension, factor)


def _of_dimension(dimension: str) -> list[Unit]:
    return [each for each in _known.units.values() if each.dimension == dimension]


def _owner(point: EntryPoint) -> str:
    """Return the package that an entry point belongs to, with its version."""
    return point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"
