"""Lists of event times: arrays, CSV files, and edges that spell a Harp clock's seconds."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sliplab.protocols.errors import InputError

Ints = NDArray[np.int64]

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_TIMES = ("t", "time", "times", "timestamp", "timestamps")
_IDS = ("id", "code", "barcode")
_LEVELS = ("state", "level")
HARP_BAUD = 1000.0
"""Bits a second of the slow copy of a Harp clock that acquisition systems record."""
_WORD = 40
"""Bits of a Harp word: four bytes of a start bit, eight bits and a stop bit."""


@dataclass(frozen=True)
class Events:
    """Events on one clock, in the order in which they were recorded.

    Attributes:
        name: where they come from, for messages.
        ns: (n,) int64.
        ids: (n,) int64, what tells an event from others, or None.
        unit_ns: the unit to which the times are cut, as far as they show it.
    """

    name: str
    ns: Ints
    ids: Ints | None = None

    @property
    def unit_ns(self) -> int:
        """The largest power of ten, in ns, that divides all times; 1 of fewer than two events."""
        unit = 1
        while self.ns.size > 1 and unit < 10**9 and not (self.ns % (10 * unit)).any():
            unit *= 10
        return unit


def events_from(source: Any, name: str, unit: str | None = None, *, harp: bool = False) -> Events:
    """Events of a file or an array.

    Args:
        source: a CSV file with a column of times (named ``t`` or ``time`` with an optional unit, as
            ``time_ms``; else the first column) and perhaps one of ids (``id``, ``code`` or
            ``barcode``) or levels (``state`` or ``level``: rising edges count); or (n,) times,
            floats in s or integers in ns; or a pair of times and ids.
        name: for messages about an array.
        unit: of the times, one of `UNITS`; by default as named in the file, else s.
        harp: the edges spell a Harp clock's seconds: each word is an event whose id is its second.

    Raises:
        InputError: times or ids that cannot be read.
    """
    if unit is not None and unit not in UNITS:
        raise InputError(name, "unit", unit, f"must be one of {', '.join(UNITS)}")
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
    return Events(name, ns, ids)


def _ns_of(times: ArrayLike, name: str, unit: str | None) -> Ints:
    array = np.asarray(times)
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        raise InputError(name, "", None, "must be one row of numbers: seconds, or integers in ns")
    if array.dtype.kind == "f":
        if not np.isfinite(array).all():
            bad = int(np.flatnonzero(~np.isfinite(array))[0])
            raise InputError(name, f"[{bad}]", float(array[bad]), "must be a finite time")
        scaled = array.astype(np.longdouble) * UNITS[unit or "s"]
        if scaled.size and np.abs(scaled).max() >= 2**62:
            raise InputError(name, "", None, "has times too large for int64 ns: check their unit")
        result: Ints = np.rint(scaled).astype(np.int64)
        return result
    return array.astype(np.int64) * UNITS[unit or "ns"]


def _from_csv(path: Path, unit: str | None, harp: bool) -> Events:
    name = str(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(name, "", None, f"cannot be read as CSV: {error}") from None
    if not rows:
        raise InputError(name, "", None, "holds no times")
    columns = [cell.strip().lower() for cell in rows[0]]
    header = not _is_number(columns[0])
    if header:
        rows = rows[1:]
    else:
        columns = ["t", *(f"column {k + 1}" for k in range(1, len(columns)))]
    time, named = _time_column(columns)
    scale = UNITS[unit or named or "s"]
    ns = np.array([_number(name, k, row, time, scale) for k, row in enumerate(rows)], np.int64)
    ids = _column(name, rows, columns, _IDS)
    levels = _column(name, rows, columns, _LEVELS)
    if harp:
        if levels is None:
            raise InputError(name, "", None, f"needs a column {' or '.join(_LEVELS)} of edges")
        return harp_words(name, ns, levels > 0)
    if levels is not None:
        ns, ids = ns[levels > 0], None if ids is None else ids[levels > 0]
    return Events(name, ns, ids)


def _time_column(columns: list[str]) -> tuple[int, str | None]:
    for k, column in enumerate(columns):
        stem, _, unit = column.replace(" ", "_").replace("(", "").replace(")", "").rpartition("_")
        if column in _TIMES:
            return k, None
        if stem in _TIMES and unit in UNITS:
            return k, unit
    return 0, None


def _column(
    name: str, rows: list[list[str]], columns: list[str], wanted: tuple[str, ...]
) -> Ints | None:
    for k, column in enumerate(columns):
        if column in wanted:
            return np.array([_number(name, n, row, k, 1) for n, row in enumerate(rows)], np.int64)
    return None


def _number(name: str, index: int, row: list[str], column: int, scale: int) -> int:
    text = row[column].strip() if column < len(row) else ""
    if not _is_number(text) or abs(Decimal(text)) * scale >= 2**62:
        raise InputError(name, f"row {index + 1}", text, "must be a number that fits int64 ns")
    return int((Decimal(text) * scale).to_integral_value())


def _is_number(text: str) -> bool:
    try:
        return Decimal(text).is_finite()
    except InvalidOperation:
        return False


def harp_words(name: str, ns: Ints, high: NDArray[np.bool_]) -> Events:
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
    return Events(name, np.array(begins, np.int64), np.array(seconds, np.int64))
