"""Tables of a foreign data set: small ones of text, row by row, and long ones of numbers.

Small tables (trials, labels) are CSV, a JSON list of objects, or JSON lines; their values stay the
text that they were, so that no digit of a time is lost. Long ones (events, poses) are CSV or
numpy's arrays, read column by column.
"""

from __future__ import annotations

import csv
import io
import json
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any

import numpy as np
import pandas as pd

from sliplab.protocols.adapter_parts import TIME_UNITS
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.storage.formats.data_folder import MOST_BYTES, DataFolder
from sliplab.storage.formats.foreign import LATEST_US, NO_TIME_NS, FormatError
from sliplab.storage.formats.numpy_files import ZIP_MAGIC, array_of, arrays_of, release
from sliplab.storage.streams import I64

MOST_TABLE = 1 << 26
_MOST_CELLS = 1 << 14
"""Cells of a row."""
_SEPARATORS = "\t;, "
_PACKED, _UTF_16 = (b"PK", b"\x1f\x8b", b"\xd0\xcf\x11\xe0"), (BOM_UTF16_LE, BOM_UTF16_BE)
"""First bytes of workbooks and compressed files, and of texts in UTF-16."""
_UNPACK = "is a workbook or compressed: save it as CSV, unpacked"
_ONLY_CR = "has lines that end in CR alone: save it with LF or CRLF"
_EMPTY = "is empty; its first line names the columns"
_QUOTED = re.compile('"[^"]*"')
_BLOCK_BYTES, _ROWS = 1 << 21, 1 << 18
"""Bytes of CSV and rows of numpy's arrays that are read at once."""
_LARGE = 1 << 53
"""From here on a float of 64 bits is not every whole number."""
_TOO_WIDE = re.compile(r"Expected \d+ fields in line (\d+), saw (\d+)")


@dataclass(frozen=True)
class TableRow:
    """A row of a small table.

    Attributes:
        number: of its line, or of the object in a JSON list, from 1.
        values: by column; empty cells are left out.
    """

    place: str
    number: int
    values: Mapping[str, str]

    def error(self, column: str, expected: str) -> InputError:
        """Return the error of one cell."""
        return InputError(
            self.place, f"row {self.number}, {column}", self.values.get(column), expected
        )

    def time_ns(self, column: str, unit: str) -> int | None:
        """Return a time; None where the cell is empty.

        Raises:
            InputError: it is no number, or beyond any time.
        """
        text = self.values.get(column)
        if text is None:
            return None
        found = exact_ns(text, unit)
        if found is None:
            raise self.error(column, f"must be a time in {unit}, or empty")
        return found


def exact_ns(text: str, unit: str) -> int | None:
    """Return a time as whole nanoseconds; None for what is no number, or beyond any time."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    if not value.is_finite() or value.copy_abs() > Decimal("1e30"):
        return None
    found = int((value * TIME_UNITS[unit]).to_integral_value())
    return found if abs(found) < LATEST_US * 1000 else None


def read_rows(folder: DataFolder, name: str) -> list[TableRow]:
    """Read a small table; the ending says which: ``.json``, ``.jsonl``, ``.ndjson``, else CSV.

    Raises:
        InputError: it is damaged, has no heading, a column twice, or is larger than 64 MiB.
    """
    place = folder.place(name)
    text = table_text(place, bytes(folder.read(name)[: MOST_TABLE + 1]))
    ending = name.lower().rpartition(".")[2]
    if ending == "json":
        return _from_json(place, _json(place, text, None), "list")
    if ending in {"jsonl", "ndjson"}:
        lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
        return [
            row
            for number, line in lines
            for row in _from_json(place, [_json(place, line, number)], "lines", number)
        ]
    return rows_of_csv(place, text)[1]


def table_text(place: str, data: bytes) -> str:
    """Return the text of a table, UTF-8 or UTF-16 with its byte order mark.

    Args:
        place: for messages. data: of a larger file the first `MOST_TABLE` bytes and one more.

    Raises:
        InputError: it is larger, compressed, a workbook, or no text.
    """
    if len(data) > MOST_TABLE:
        text = f"is larger than {MOST_TABLE >> 20} MiB: leave out rows and columns without use"
        raise InputError(place, "", None, text)
    if data.startswith(_PACKED):
        raise InputError(place, "", None, _UNPACK)
    wide = data.startswith(_UTF_16)
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(place, f"byte {error.start}", None, "is not UTF-8 text") from None
    if "\0" in text:
        raise InputError(place, f"byte {text.index(chr(0))}", None, "is no text")
    return text


def _json(place: str, text: str, line: int | None) -> Any:
    try:  # numbers stay text, with all of their digits
        return json.loads(text, parse_float=str, parse_int=str, parse_constant=str)
    except (ValueError, RecursionError) as error:
        where = "" if line is None else f"row {line}"
        raise InputError(place, where, None, f"is not JSON: {error}") from None


def _from_json(place: str, found: Any, what: str, first: int = 1) -> list[TableRow]:
    if not isinstance(found, list):
        raise InputError(place, "", None, "must be a list of objects, one a row")
    rows = []
    for number, item in enumerate(found, first):
        if not isinstance(item, dict):
            raise InputError(place, f"row {number}", None, "must be an object: {column: value}")
        values = {}
        for column, value in item.items():
            if isinstance(value, list | dict):
                raise InputError(place, f"row {number}, {column}", None, "must be text or a number")
            if value is not None and value != "":
                values[column] = str(value).lower() if isinstance(value, bool) else value.strip()
        rows.append(TableRow(place, number, values))
    return rows


def _separator(line: str) -> str:
    """Return what separates the columns of a line of CSV."""
    line = _QUOTED.sub("", line.strip(" \r\n"))
    return next((each for each in _SEPARATORS[:3] if each in line), " " if " " in line else ",")


def rows_of_csv(
    place: str, text: str, columns: list[str] | None = None
) -> tuple[list[str], list[TableRow]]:
    """Read CSV; return its columns and rows. Empty lines are left out.

    Args:
        place: for messages.
        columns: of a text without a heading.

    Raises:
        InputError: it is damaged, empty, names a column twice, or has a row of another length.
    """
    if "\r" in text and "\n" not in text:
        raise InputError(place, "", None, _ONLY_CR)
    lines = (line for line in text.split("\n") if line.strip())
    separator = _separator(next(lines, ""))
    if separator == " " and " " not in next(lines, " ").strip():
        separator = ","  # the heading is a name of several words
    reader = csv.reader(io.StringIO(text), delimiter=separator, strict=True)
    rows: list[TableRow] = []
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if columns is None:
                columns = [cell.strip() for cell in cells]
                if twice := next((c for c in columns if columns.count(c) > 1), None):
                    raise InputError(place, "row 1", twice, "is the name of two columns")
                continue
            if len(cells) != len(columns):
                raise InputError(
                    place,
                    f"row {reader.line_num}",
                    None,
                    f"has {plural(len(cells), 'cell')} below a heading of "
                    f"{plural(len(columns), 'column')}; a number has a decimal point, and text "
                    "that contains the separator has quotes",
                )
            values = {
                column: cell.strip()
                for column, cell in zip(columns, cells, strict=True)
                if cell.strip()
            }
            rows.append(TableRow(place, reader.line_num, values))
    except csv.Error as error:
        raise InputError(place, f"row {reader.line_num}", None, f"is not CSV: {error}") from None
    if columns is None:
        raise InputError(place, "", None, _EMPTY)
    return columns, rows


def read_columns(
    folder: DataFolder, name: str, form: str, columns: Mapping[str, str | int]
) -> tuple[dict[str, Any], int]:
    """Read all rows of `column_chunks` at once; return them and the number of rows left out."""
    chunks, left_out = zip(*column_chunks(folder, name, form, columns), strict=True)
    return {key: _joined([chunk[key] for chunk in chunks]) for key in columns}, sum(left_out)


def _joined(parts: list[Any]) -> Any:
    """Join parts of a column: whole numbers that a float cannot hold stay exact beside floats."""
    large = any(len(part) and part.dtype.kind in "iu" and _is_large(part) for part in parts)
    floats = any(len(part) and part.dtype.kind == "f" for part in parts)
    return np.concatenate(parts, dtype=np.longdouble if large and floats else None)


def _is_large(numbers: Any) -> bool:
    """Return whether some numbers are so large that not every whole one is a float of 64 bits."""
    return bool(numbers.max() >= _LARGE or numbers.min() <= -_LARGE)


def column_chunks(
    folder: DataFolder, name: str, form: str, columns: Mapping[str, str | int]
) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield columns of numbers from a long table, a part of the rows at a time.

    Args:
        form: ``csv`` or ``numpy``: a structured array, a two-dimensional one, or an ``.npz`` with
            an array a column.
        columns: name or index of each column.

    Yields:
        One-dimensional arrays of one length, by the keys of `columns`, and the number of rows of
        CSV that were left out because they are no rows of numbers.

    Raises:
        FormatError: it is damaged, lacks a column, or most of the first rows are not of numbers.
    """
    data = folder.read(name)
    if form == "csv":
        yield from _csv_chunks(data, columns)
        return
    if bytes(data[: len(ZIP_MAGIC)]) == ZIP_MAGIC:
        with folder.local(name) as (path,):
            there = arrays_of(path, MOST_BYTES)
    elif (found := array_of(data)).dtype.names is not None:
        there = {column: found[column] for column in found.dtype.names}
    elif found.ndim == 2:
        there = {str(index): found[:, index] for index in range(found.shape[1])}
    else:
        raise FormatError(
            f"holds an array of shape {found.shape}; a table has rows and columns, or is structured"
        )
    arrays = {key: _column(there, column) for key, column in columns.items()}
    if len({len(array) for array in arrays.values()}) > 1:
        raise FormatError("has columns of different lengths")
    for low in range(0, max(1, len(next(iter(arrays.values())))), _ROWS):
        yield {key: np.array(array[low : low + _ROWS]) for key, array in arrays.items()}, 0
        for array in arrays.values():
            release(array)


def _column(there: Mapping[str, Any], column: str | int) -> Any:
    array = there.get(str(column))
    if array is None:
        raise FormatError(f"has no column {column}; there are {', '.join(there) or 'none'}")
    if array.ndim != 1 or array.dtype.kind not in "iufb":
        raise FormatError(f"has a column {column} that is not one number a row")
    return array


def _csv_chunks(
    data: Any, columns: Mapping[str, str | int]
) -> Iterator[tuple[dict[str, Any], int]]:
    head = bytes(data[: 1 << 16])
    for fault, wrong in (
        (_UNPACK, head.startswith(_PACKED)),
        ("is UTF-16 text: save it as UTF-8", head.startswith(_UTF_16)),
        (_ONLY_CR, b"\r" in head and b"\n" not in head),
        ("is no text", b"\0" in head),
        (_EMPTY, not head.strip()),
    ):
        if wrong:
            raise FormatError(fault)
    lines = head.decode("utf-8-sig", "replace").split("\n")
    separator = _separator(lines[0])
    # the first row of numbers may have more cells than the heading
    cells, second = (
        _cells([line for line in rows if line.strip()], separator)
        for rows in (lines[:1], lines[1:])
    )
    # a heading has no number in a column that is read; others may hold words in every row
    used = [cells[c] for c in columns.values() if isinstance(c, int) and c < len(cells)]
    headed = len(used) < len(columns) or not all(map(_is_number, used))
    if headed:
        there = {cell: str(index) for index, cell in enumerate(cells)}
        there |= {str(index): str(index) for index in range(len(cells)) if str(index) not in there}
    else:
        there = {str(index): str(index) for index in range(len(cells))}
    for column in columns.values():
        if str(column) not in there:
            raise FormatError(f"has no column {column}; there are {', '.join(cells)}")
        if isinstance(column, str) and cells.count(column) > 1:
            raise FormatError(f"has the column {column} twice")
    wanted = {key: int(there[str(column)]) for key, column in columns.items()}
    width = max(len(cells), len(second)) if headed else len(cells)
    table = _Csv(separator, cells, columns, wanted, headed, width)
    for number, block in enumerate(_blocks(data)):
        if number and not block.strip():
            continue
        yield table.read(block)
        release(data)


def _blocks(data: Any) -> Iterator[bytes]:
    """Yield a text in blocks that end with a row; at least one."""
    low, size = 0, _BLOCK_BYTES
    while low < len(data) or not low:
        block, at_end = bytes(data[low : low + size]), low + size >= len(data)
        end = len(block) if at_end else block.rfind(b"\n") + 1
        if not at_end and (not end or block.count(b'"', 0, end) % 2):
            size *= 2  # a row or a quoted cell continues
            continue
        yield block[:end]
        low, size = low + max(end, 1), _BLOCK_BYTES


@dataclass
class _Csv:
    """A long table of CSV that is read in blocks of rows.

    Attributes:
        cells: of the heading, or else of the first row.
        wanted: index of each column that is read, by its key.
        width: cells of the widest row so far.
        lines: of the blocks before. rows: of numbers in them.
    """

    separator: str
    cells: list[str]
    columns: Mapping[str, str | int]
    wanted: Mapping[str, int]
    headed: bool
    width: int
    lines: int = 0
    rows: int = 0

    def read(self, block: bytes) -> tuple[dict[str, Any], int]:
        """Return the columns of a block, and the number of rows that were left out.

        Raises:
            FormatError: it is no CSV, or the first block and most of its rows are not of numbers.
        """
        is_first = not self.lines
        line, table = self._table(block, int(is_first and self.headed))
        first_row = 1 + self.headed + self.rows
        self.lines += block.count(b"\n")
        self.rows += len(table)
        if table.empty:
            return {key: np.empty(0, np.int64) for key in self.wanted}, 0
        # separators at the ends of rows make empty cells
        beyond = table.iloc[:, len(self.cells) :].notna().to_numpy()
        good = ~beyond.any(axis=1)
        if is_first and 2 * int(good.sum()) <= len(good):
            at = int((~good).argmax())
            last = int(np.flatnonzero(beyond[at])[-1])
            raise self._too_wide(len(self.cells) + last + 1, line or first_row + at)
        for index in self.wanted.values():
            good &= pd.to_numeric(table[index], errors="coerce").notna().to_numpy()
        found = {key: table[index].to_numpy() for key, index in self.wanted.items()}
        if not good.any() and not is_first:
            return {key: np.empty(0, np.int64) for key in self.wanted}, len(table)
        inexact = any(each.dtype.kind == "f" and _is_large(each) for each in found.values())
        if (inexact or not good.all()) and not (is_first and 2 * int(good.sum()) <= len(good)):
            # as text: an empty cell, or one with a point, makes floats of whole numbers
            _, words = self._table(
                block, int(is_first and self.headed), dict.fromkeys(self.wanted.values(), str)
            )
            found = {key: _exact(words[index][good]) for key, index in self.wanted.items()}
        rows = {key: _numbers(v, self.columns[key], first_row) for key, v in found.items()}
        return rows, len(table) - len(next(iter(rows.values())))

    def _table(self, block: bytes, skipped: int, types: Any = None) -> tuple[int, pd.DataFrame]:
        """Return the first row that is wider than those before, 0 for none, and all rows."""
        line = 0
        while True:
            try:
                # of some columns alone pandas drops the cells that a row has too many
                return line, pd.read_csv(
                    io.BytesIO(block),
                    sep=r"\s+" if self.separator == " " else self.separator,  # any number of spaces
                    header=None,
                    names=range(self.width),
                    index_col=False,
                    skiprows=skipped,
                    low_memory=False,
                    encoding="utf-8-sig",
                    dtype=types,
                )
            except (ValueError, OverflowError) as error:  # also pandas' own errors of parsing
                text = " ".join(str(error).split())
                wide = _TOO_WIDE.search(text)
                if wide is None:
                    raise FormatError(f"is not CSV: {text}") from None
                row = self.lines + int(wide[1])
                if not self.width < int(wide[2]) <= _MOST_CELLS:
                    raise self._too_wide(int(wide[2]), row) from None
                self.width, line = int(wide[2]), line or row

    def _too_wide(self, cells: int, row: int) -> FormatError:
        what = "heading" if self.headed else "first row"
        return FormatError(
            f"has {cells} cells in row {row} below a {what} of {len(self.cells)} columns; name "
            "every column, and quote a cell that contains the separator"
        )


def _cells(lines: list[str], separator: str) -> list[str]:
    """Return the cells of the first row; none where there is no row."""
    spaces = separator == " "
    rows = csv.reader(
        (line.strip() if spaces else line.rstrip("\r") for line in lines),
        delimiter=separator,
        skipinitialspace=spaces,
    )
    try:
        return [cell.strip() for cell in next(rows, [])]
    except csv.Error as error:
        raise FormatError(f"is not CSV: {error}") from None


def _exact(words: pd.Series) -> Any:
    """Return numbers from their text, large ones that are not all whole with 64 bits of digits."""
    numbers = pd.to_numeric(words).to_numpy()
    if numbers.dtype.kind == "f" and _is_large(numbers):
        return words.str.strip().to_numpy(np.str_).astype(np.longdouble)
    return numbers


def _numbers(column: Any, name: str | int, first_row: int) -> Any:
    if column.dtype.kind not in "iufb":
        at = next((k for k, value in enumerate(column) if not _is_number(str(value))), 0)
        raise FormatError(
            f"has a column {name} that is not all numbers: row {first_row + at} is "
            f"{str(column[at])!r:.40}"
        )
    if column.dtype.kind == "f" and np.isnan(column).any():
        at = int(np.flatnonzero(np.isnan(column))[0])
        raise FormatError(f"has no number in column {name}: row {first_row + at}")
    return column


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def times_ns(times: Any, unit: str) -> I64:
    """Return times in a unit as nanoseconds: whole ones exactly, fractions rounded.

    What is not a number, or beyond any time, becomes `NO_TIME_NS`.
    """
    factor = TIME_UNITS[unit]
    limit = LATEST_US * 1000 // factor
    if not len(times):
        return np.empty(0, np.int64)
    if times.dtype.kind == "f":
        good = np.isfinite(times) & (np.abs(np.where(np.isfinite(times), times, 0)) < limit)
    else:
        good = (times < limit) & (times > -limit if times.dtype.kind == "i" else True)
    times = np.where(good, times, 0)
    if times.dtype.kind == "f":
        exact = times if times.dtype == np.longdouble else times.astype(np.float64)
        found = np.asarray(np.rint(exact * factor), np.int64)
    else:
        found = np.asarray(times, np.int64) * factor
    return np.where(good, found, NO_TIME_NS)
