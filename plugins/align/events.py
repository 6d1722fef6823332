"""Lists of event times: arrays, CSV files, and edges that spell a Harp clock's seconds."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sliplab.protocols.adapter_parts import TIME_UNITS
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.tables import (
    MOST_TABLE,
    TableRow,
    exact_ns,
    rows_of_csv,
    table_text,
)

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

_TIMES = ("t", "time", "times", "timestamp", "timestamps", "onset")
_IDS = ("id", "code", "barcode")
_LEVELS = ("state", "level")
_UNIT = re.compile(r"(.+?)[ _(\[/]+(ns|us|μs|ms|s)[)\]]?")
"""A heading that ends in a unit: ``time_ms``, ``Time [ms]``, ``t (µs)``."""
_MOST_NS = 2**62
HARP_BAUD = 1000.0
"""Bits a second of the slow copy of a Harp clock that acquisition systems record."""
_WORD = 40
"""Bits of a Harp word: four bytes of a start bit, eight bits and a stop bit."""


@dataclass(frozen=True)
class ClockEvents:
    """Events on one clock, in the order in which they were recorded.

    Attributes:
        name: where they come from, for messages.
        ns: (n,) int64.
        ids: (n,) int64, what tells an event from others, or None.
        column: of the file that has the times, with its unit; empty without a file.
        rows: (n,) int64 lines of the file, or None without one.
        unit_ns: the unit to which the times are cut, as far as they show it.
    """

    name: str
    ns: Ints
    ids: Ints | None = None
    column: str = ""
    rows: Ints | None = None

    def error(self, k: int, expected: str) -> InputError:
        """Return the error of one event's time."""
        place = f"[{k}]" if self.rows is None else f"row {self.rows[k]}"
        return InputError(self.name, place, f"{self.ns[k] / 1e9:.9g} s", expected)

    @property
    def unit_ns(self) -> int:
        """The largest power of ten, in ns, that divides all times; 1 of fewer than two events."""
        unit = 1
        while self.ns.size > 1 and unit < 10**9 and not (self.ns % (10 * unit)).any():
            unit *= 10
        return unit


def events_from(
    source: Any, name: str, unit: str | None = None, *, harp: bool = False
) -> ClockEvents:
    """Events of a file or an array.

    Args:
        source: events; a CSV file; or (n,) times, floats in s or integers in ns; or a pair of times
            and ids. A file has a column of times, named ``t`` or ``time`` with an optional unit, as
            ``time_ms``, or the only one, or the only one with a unit; and perhaps one of ids
            (``id``, ``code`` or ``barcode``) or levels (``state`` or ``level``: rising edges
            count).
        name: for messages about an array.
        unit: of the times, s, ms, us or ns; by default as named in the file, else s.
        harp: the edges spell a Harp clock's seconds: each word is an event whose id is its second.

    Raises:
        InputError: times or ids that cannot be read.
    """
    if unit is not None and unit not in TIME_UNITS:
        raise InputError(name, "unit", unit, "must be one of s, ms, us, ns")
    if isinstance(source, ClockEvents):
        return source
    if isinstance(source, str | PathLike):
        return _from_csv(Path(source), unit, harp)
    times, ids = source if isinstance(source, tuple) and len(source) == 2 else (source, None)
    ns = _ns_of(times, name, unit)
    if harp:
        if ids is None:
            raise InputError(name, "", None, "needs edges' levels: a pair (times, levels)")
        return harp_words(name, ns, np.asarray(ids).astype(bool))
    if ids is not None:
        ids = np.asarray(ids)
        if ids.dtype.kind not in "iu" or ids.shape != ns.shape:
            raise InputError(name, "ids", None, f"must be {ns.size} integers, one an event")
        ids = ids.astype(np.int64)
    return ClockEvents(name, ns, ids)


def _ns_of(times: ArrayLike, name: str, unit: str | None) -> Ints:
    array = np.asarray(times)
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        raise InputError(name, "", None, "must be one row of numbers: seconds, or integers in ns")
    factor = TIME_UNITS[unit or ("s" if array.dtype.kind == "f" else "ns")]
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = int(np.flatnonzero(~np.isfinite(array))[0])
        raise InputError(name, f"[{bad}]", float(array[bad]), "must be a finite time")
    scaled = array.astype(np.longdouble) * factor  # to judge integers before they overflow
    if scaled.size and np.abs(scaled).max() >= _MOST_NS:
        raise InputError(name, "", None, "has times too large for int64 ns: check their unit")
    if array.dtype.kind == "f":
        result: Ints = np.rint(scaled).astype(np.int64)
        return result
    return array.astype(np.int64) * factor


def signal_of_csv(path: Path, unit: str | None) -> tuple[Ints, Floats]:
    """Return a file's times (n,), ns, and its other columns (n, columns). Raises InputError."""
    columns, rows, time, unit = _rows(path, unit)
    others = [column for column in columns if column != time]
    if not others:
        raise InputError(path, "heading", time, "needs a column of values beside that of times")
    for row in rows:
        for column in others:
            if not _is_number(row.values.get(column, "")):
                raise row.error(column, "must be a number")
    values = [[float(row.values[column]) for column in others] for row in rows]
    return np.array([_time_ns(row, time, unit) for row in rows]), np.array(values)


def _rows(path: Path, unit: str | None) -> tuple[list[str], list[TableRow], str, str]:
    """Return a file's columns and rows, and that of times with its unit."""
    name = str(path)
    lines = _text(path).splitlines()
    # a comment keeps its line, so that rows are counted as an editor counts them
    lines = ["" if line.startswith("#") else line for line in lines]
    first = next((line for line in lines if line.strip()), "")
    heading = ["t"] if _is_number(first.strip(' "')) else None
    columns, rows = rows_of_csv(name, "\n".join(lines), heading)
    time, named = _time_column(name, columns)
    if not rows:
        raise InputError(name, "", None, f"is empty below its heading {', '.join(columns)}")
    if unit is not None and named not in {None, unit}:
        text = f"names the unit {named}, and --unit {unit}: leave one out"
        raise InputError(name, "heading", time, text)
    return columns, rows, time, unit or named or "s"


def _from_csv(path: Path, unit: str | None, harp: bool) -> ClockEvents:
    name = str(path)
    columns, rows, time, unit = _rows(path, unit)
    levels = _column(columns, _LEVELS)
    if harp and levels is None:
        raise InputError(name, "", None, f"needs a column {' or '.join(_LEVELS)} of edges")
    high = np.array([levels is None or _level(row, levels) for row in rows])
    if harp:
        edges = np.array([_time_ns(row, time, unit) for row in rows])
        return replace(harp_words(name, edges, high), column=f"{time} ({unit})")
    rows = [row for row, rises in zip(rows, high.tolist(), strict=True) if rises]
    if not rows:
        raise InputError(name, str(levels), None, "is 0 in every row; events are where it is 1")
    ids = _column(columns, _IDS)
    return ClockEvents(
        name,
        np.array([_time_ns(row, time, unit) for row in rows]),
        None if ids is None else np.array([_id(row, ids) for row in rows]),
        f"{time} ({unit})",
        np.array([row.number for row in rows]),
    )


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return table_text(str(path), file.read(MOST_TABLE + 1))
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None


def _time_column(name: str, columns: list[str]) -> tuple[str, str | None]:
    """Return the column of times, and the unit that it names."""
    found: dict[str, str | None] = {}
    known = []
    for column in columns:
        plain = unicodedata.normalize("NFKC", column).lower()
        match = _UNIT.fullmatch(plain)
        stem, unit = (match[1], match[2].replace("μ", "u")) if match else (plain, None)
        if stem in _TIMES:
            known.append(column)
        if unit is not None or stem in _TIMES or len(columns) == 1:
            found[column] = unit
    if len(found) != 1 and not known:
        text = "name the column of times t or time, with its unit: time_ms"
        raise InputError(name, "heading", ", ".join(columns), text)
    time = next(iter(known or found))
    return time, found[time]


def _column(columns: list[str], wanted: tuple[str, ...]) -> str | None:
    return next((column for column in columns if column.lower() in wanted), None)


def _time_ns(row: TableRow, column: str, unit: str) -> int:
    text = row.values.get(column, "")
    found = exact_ns(text, unit)
    if found is not None and abs(found) < _MOST_NS:
        return found
    if _is_number(text):
        right = f"is no time in {unit}: name the unit by --unit, or in the heading: time_ms"
        raise row.error(column, right)
    raise row.error(column, f"must be a time in {unit}: a number, with a decimal point")


def _id(row: TableRow, column: str) -> int:
    text = row.values.get(column, "")
    if not (_is_number(text) and Decimal(text) % 1 == 0 and abs(Decimal(text)) < 2**63):
        raise row.error(column, "must be a whole number")
    return int(Decimal(text))


def _level(row: TableRow, column: str) -> bool:
    text = row.values.get(column, "")
    if not _is_number(text):
        raise row.error(column, "must be 0 or 1")
    return Decimal(text) > 0


def _is_number(text: str) -> bool:
    try:
        return Decimal(text).is_finite()
    except InvalidOperation:
        return False


def harp_words(name: str, ns: Ints, high: NDArray[np.bool_]) -> ClockEvents:
    """Words of a Harp clock among edges: each begins with a second, and says which.

    A word is 32 bits, little-endian, as four bytes with start and stop bits at `HARP_BAUD`; the
    line is high in between. A word with a missing edge is left out.

    Args:
        ns, high: (n,) times of edges, and the level behind each.

    Raises:
        InputError: no word can be read.
    """
    bit = 1e9 / HARP_BAUD
    falls = np.flatnonzero(~high)
    before = np.diff(ns, prepend=ns[0] - 10**9 if ns.size else 0)
    begins, seconds = [], []
    place = bit * (np.arange(_WORD) + 0.5)
    for k in falls[before[falls] > 12 * bit].tolist():
        since = ns[k : k + _WORD] - ns[k]
        edges = high[k : k + _WORD][(since >= 0) & (since < _WORD * bit)]
        # the level in the middle of each bit; edges alternate unless one was lost
        last = np.searchsorted(since[: edges.size], place, side="right") - 1
        levels = edges[last].reshape(4, 10)
        whole = bool((edges[1:] != edges[:-1]).all())
        if whole and not levels[:, 0].any() and levels[:, 9].all():
            begins.append(int(ns[k]))
            seconds.append(
                int.from_bytes(np.packbits(levels[:, 1:9], bitorder="little").tobytes(), "little")
            )
    if not begins:
        raise InputError(name, "", None, f"holds no Harp word ({HARP_BAUD:g} bits a second)")
    return ClockEvents(name, np.array(begins, np.int64), np.array(seconds, np.int64))
