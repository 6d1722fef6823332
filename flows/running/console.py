"""Output for people and programs: tables and progress on standard error, JSON on output.

With ``--json`` a command prints exactly one JSON object on standard output and everything else on
standard error. Without it, results are tables for people.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

from rich.box import SIMPLE, SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from sliplab.flows.running import stopping
from sliplab.protocols.shown import CONTROL, printable
from sliplab.storage.errors import masked

LINE_EVERY_S = 60.0
"""Interval between lines of progress where there is no terminal, s: in the log of a long run."""

SPEED_OVER_S = 900.0
"""Time over which speed is averaged to estimate the time left, s. With rich's default of 30,
steps of other kinds, counted by the same bar, changed the estimate from minutes to an hour."""

WIDTH = 120
"""Columns of a table where there is no terminal: in a file, a pipe or a log."""

_FEWEST = 12
"""Width to which columns are folded inside a word, outside of a terminal."""

_FOLDED = 30
"""Width to which columns are folded in a table that is too wide all the same."""


def results_width() -> int | None:
    """Return how wide results may be; None where the terminal says so."""
    terminal = sys.stdout is not None and sys.stdout.isatty()
    return None if terminal or "COLUMNS" in os.environ else WIDTH


messages = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
results = Console(highlight=False, width=results_width(), emoji=False)


_listeners: list[Callable[[str], None]] = []


def say(text: str) -> None:
    """A line for people."""
    line = _clean(text)
    messages.print(line, markup=False)
    for listener in _listeners:
        listener(line)


@contextmanager
def lines_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Pass the lines for people to `listener`, too, while the block runs."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def show(text: str) -> None:
    """A line of a command's result, for people."""
    results.print(_clean(text), markup=False, soft_wrap=True)


_as_json = _printed = False


def begin(*, as_json: bool) -> None:
    """A command begins: its errors are objects, too, with `as_json`."""
    global _as_json, _printed
    _as_json, _printed = as_json, False


def printed() -> bool:
    """Return True where the command has printed its one JSON object."""
    return _printed


def print_error(
    named: Mapping[str, str | None],
    exit_code: int,
    faults: Sequence[Mapping[str, str | None]] = (),
) -> None:
    """Print the error as the one JSON object of a command, unless it has printed one already.

    Args:
        named: ``file``, ``key``, ``value`` and ``message``.
        faults: the same of each fault, where there are several.
    """
    if _as_json and not _printed:
        shown = {name: text and masked(text) for name, text in named.items()}
        error: dict[str, Any] = {**shown, "exit_code": exit_code}
        if faults:
            error["faults"] = [{k: text and masked(text) for k, text in f.items()} for f in faults]
        print_json({"error": error})


def plain(value: Any) -> Any:
    """Return a typed value of a result as plain data: its fields, or of a document its keys.

    Raises:
        TypeError: it is neither a dataclass nor a part of a document.
    """
    from sliplab.storage.schema.document import Part  # a command without results loads no models

    if isinstance(value, Part):
        return value.to_json()
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: getattr(value, each.name) for each in fields(value)}
    raise TypeError(f"{type(value).__name__} has no form in JSON")


def print_json(data: Any) -> None:
    """Print the one JSON object of a command; `plain` gives the form of typed values in it."""
    global _printed
    text = json.dumps(data, default=plain, allow_nan=False, ensure_ascii=False)
    text = CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
    _printed = True
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    *,
    limit: int = 0,
    spare: int = 0,
) -> None:
    """Print a table. No word is broken: an id or a path can be copied and searched for.

    Cells are folded between words where they are too wide. Where that is not enough, lines are
    longer than a terminal; outside of a terminal the longest words are folded, too.

    Args:
        limit: rows; the middle of a longer table is left out and counted.
        spare: how many of the last columns may be left out where the terminal is too narrow.
    """
    cells = [[_cell(item) for item in row] for row in rows]
    if limit and len(cells) > limit:
        more = [f"... {len(cells) - limit} more", *("" for _ in columns[1:])]
        cells[limit // 2 : limit // 2 - limit] = [more]
    _print(Table(title=escape(_clean(title)), box=SIMPLE_HEAD), columns, cells, spare)


def _print(
    table: Table, columns: Sequence[str], cells: Sequence[Sequence[str]], spare: int = 0
) -> None:
    by_column = list(zip(columns, *cells, strict=True))
    outside = table.show_header and not results.is_terminal
    widths, gap = _layout(by_column, results.width, spare, outside)
    table.title_justify, table.padding = "left", (0, 1 if gap == 3 else 0, 0, 1)
    table.width = _table_width(widths, gap)
    for column, width in zip(columns, widths, strict=False):
        table.add_column(escape(_clean(column)), width=width, overflow="fold")
    for row in cells:
        table.add_row(*map(Text, row[: len(widths)]))
    if results.is_terminal:
        results.print(table, crop=False)
        return
    with results.capture() as captured:
        results.print(table, crop=False)
    lines = "".join(f"{line.rstrip()}\n" for line in captured.get().splitlines())
    results.print(lines, end="", markup=False, soft_wrap=True)


def _layout(
    by_column: Sequence[Sequence[str]], room: int, spare: int, fold_words: bool
) -> tuple[list[int], int]:
    """Choose the width of each column that is shown, and of the gap between two.

    Args:
        room: of the whole table; a table whose words do not fit is wider.
        spare: how many of the last columns may be left out to make it fit.
        fold_words: whether words are folded where they do not fit `WIDTH`.
    """
    widths, gap = [max(map(cell_len, cells)) for cells in by_column], 3
    words = [
        max(cell_len(word) for cell in cells for word in cell.split() or [""])
        for cells in by_column
    ]
    while spare and _table_width(words, gap) > room:
        del widths[-1], words[-1]
        spare -= 1
    if _table_width(words, gap) > room:
        gap = 2
    if fold_words and _table_width(words, gap) > max(room, WIDTH):
        for column in reversed(range(len(widths))):  # ids and paths come first in a row
            over = max(_table_width(widths, gap) - max(room, WIDTH), 0)
            widths[column] -= min(over, max(widths[column] - _FEWEST, 0))
        return widths, gap
    if _table_width(words, gap) > room:
        return [
            min(pair) for pair in zip(widths, (max(_FOLDED, w) for w in words), strict=True)
        ], gap
    while _table_width(widths, gap) > room:
        foldable = [number for number, width in enumerate(widths) if width > words[number]]
        widths[max(foldable, key=widths.__getitem__)] -= 1
    return widths, gap


def _table_width(widths: Sequence[int], gap: int) -> int:
    return sum(widths) + gap * len(widths) + 1


def print_pairs(title: str, pairs: Mapping[str, object]) -> None:
    """Names and values, one pair a line."""
    cells = [[_cell(name), _cell(value)] for name, value in pairs.items()]
    _print(Table(title=escape(_clean(title)), show_header=False, box=SIMPLE), ["", ""], cells)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return _clean(f"{value:.4g}" if isinstance(value, float) else str(value))


def _clean(text: str) -> str:
    """Return text for people: secrets are masked, control codes written out."""
    return printable(masked(text))


class ProgressBar:
    """A progress bar's handle; where there is no terminal, a line now and then."""

    def __init__(self, progress: Progress, task: Any) -> None:
        self._progress, self._task = progress, task
        self._printed_s = time.monotonic()

    def advance(self, count: float = 1, note: str = "", left: str = "") -> None:
        """Advance by `count`; a stop request raises here.

        Args:
            left: the time left as text, for a bar that was created to show it.

        Raises:
            KeyboardInterrupt: a stop was requested.
        """
        stopping.check()
        self._progress.update(self._task, advance=count, note=printable(note), left=left)
        now_s = time.monotonic()
        if not messages.is_terminal and now_s - self._printed_s >= LINE_EVERY_S:
            self._printed_s = now_s
            self._say(note, left)

    def _say(self, note: str, left: str) -> None:
        (task,) = (task for task in self._progress.tasks if task.id == self._task)
        if not left and task.time_remaining is not None:
            left = f"{duration(task.time_remaining)} left"
        far = f"{task.completed:.0f} of {task.total or 0:.0f}"
        say(", ".join(part for part in (f"{task.description}: {far}", left, note) if part))

    def extend(self, count: float) -> None:
        """`count` more are to be done than it was thought."""
        for task in self._progress.tasks:
            if task.id == self._task:
                self._progress.update(self._task, total=(task.total or 0) + count)

    def count(self, name: str) -> None:
        """Count one that was not expected: of a bar whose total is not known."""
        self.extend(1)
        self.advance(1, name)


@contextmanager
def bar(title: str, total: float, left: str | None = None) -> Iterator[ProgressBar]:
    """A progress bar on standard error while the block runs.

    Args:
        left: the time that is left as text, where the caller knows better than a count would.
    """
    progress = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn() if left is None else TextColumn("{task.fields[left]}"),
        TextColumn("{task.fields[note]}", markup=False),
        console=messages,
        transient=not messages.is_terminal,
        speed_estimate_period=SPEED_OVER_S,
    )
    with progress:
        yield ProgressBar(
            progress, progress.add_task(printable(title), total=total, note="", left=left or "")
        )


def duration(seconds: float) -> str:
    """``3 h 05 min``, ``4 min 10 s`` or ``12 s``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 60} min {whole % 60:02d} s" if whole >= 60 else f"{whole} s"


def size(count: float) -> str:
    """``3.2 GB``: decimal units."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000 or unit == "TB":
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    raise AssertionError("unreachable")
