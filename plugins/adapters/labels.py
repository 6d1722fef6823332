"""Labels that came with a foreign data set, and when its slides begin and end."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from sliplab.protocols.adapter import CLASSES, Adapter
from sliplab.protocols.adapter_parts import GivenMotion, GivenOnsets, GivenSpans
from sliplab.protocols.errors import InputError
from sliplab.protocols.file_pattern import FilePattern, fill, parse_pattern, template_fields
from sliplab.protocols.shown import plural
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.tables import TableRow, exact_ns, read_rows

SLIP = ("no_slip", "incipient", "gross")
_SOME = 5
_MOST_NAME = 100
Fields = Mapping[str, str]


@dataclass(frozen=True)
class FoundTime:
    """A time that a label states, on the clock that it names, ns; `row` and `column` say where."""

    ns: int
    row: TableRow
    column: str


@dataclass(frozen=True)
class FoundSpan:
    """An interval of one class."""

    start: FoundTime
    end: FoundTime
    name: str


@dataclass(frozen=True)
class FoundLabel:
    """The label of a trial as the data set states it.

    Attributes:
        source: file or field that it was read from.
        whole: class of the whole recording.
        clock: of its times: ``events``, ``frames`` or ``start``.
    """

    source: str
    whole: str | None = None
    spans: tuple[FoundSpan, ...] = ()
    incipient: FoundTime | None = None
    gross: FoundTime | None = None
    clock: str = "events"
    uncertainty_ns: float | None = None

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes that it shows, in their order in time."""
        names = [span.name for span in self.spans] if self.whole is None else [self.whole]
        return tuple(dict.fromkeys(names))

    def __str__(self) -> str:
        if self.whole is not None:
            return self.whole
        if self.spans:
            return f"{len(self.spans)} spans: {', '.join(self.classes)}"
        times = (("incipient", self.incipient), ("gross", self.gross))
        return ", ".join(f"{name} {time.ns / 1e9:g} s" for name, time in times if time is not None)


@dataclass(frozen=True)
class FoundLabels:
    """Labels by the ids of their trials, and notes about them."""

    by_trial: dict[str, FoundLabel]
    warnings: list[str]


FileOfAll = Callable[[str, str], str]
Lookup = Callable[[FilePattern, str, list[dict[str, str]]], list[tuple[str, ...]]]


def find_labels(
    adapter: Adapter,
    file: Path,
    folder: DataFolder,
    trials: Mapping[str, dict[str, str]],
    file_of_all: FileOfAll,
    lookup: Lookup,
) -> FoundLabels:
    """Find the labels of trials.

    Args:
        trials: fields by id.
        file_of_all: returns the one file that a pattern fits; lookup: those of each trial.

    Raises:
        InputError: a table is wrong, a trial has two rows, or times are in a wrong order.
    """
    labels = adapter.labels
    warnings: list[str] = []
    found: dict[str, FoundLabel] = {}
    if labels.whole is not None:
        found = _wholes(adapter, file, trials)
    elif (part := labels.onsets or labels.spans) is not None:
        key = "labels.onsets" if labels.onsets is not None else "labels.spans"
        rows = _rows(part, key, file, folder, trials, file_of_all, lookup, warnings)
        for id_, of_trial in rows.items():
            label = (
                _onsets(part, of_trial)
                if isinstance(part, GivenOnsets)
                else _spans(part, of_trial, adapter)
            )
            if label is not None:
                found[id_] = label
    else:
        return FoundLabels({}, [])
    if without := [id_ for id_ in trials if id_ not in found]:
        some = ", ".join(without[:_SOME])
        warnings.append(
            f"no label for {plural(len(without), 'trial')} ({some}); imported without one"
        )
    if not found:
        raise InputError(file, "labels", None, "fits no trial: none of them would have a label")
    if adapter.classes:
        for id_, label in found.items():
            if other := next((n for n in label.classes if n not in adapter.classes), None):
                raise InputError(
                    file, "classes", list(adapter.classes), f"does not list {other} of trial {id_}"
                )
    return FoundLabels(found, warnings)


def _wholes(
    adapter: Adapter, file: Path, trials: Mapping[str, dict[str, str]]
) -> dict[str, FoundLabel]:
    template = str(adapter.labels.whole)
    wanted = template_fields(template)
    found = {}
    for id_, fields in trials.items():
        if all(name in fields for name in wanted):
            name = _class_name(fill(template, fields), file, "labels.class", template)
            found[id_] = FoundLabel("file name" if "path" in fields else "table", whole=name)
    if not found and trials:
        some = next(iter(trials.values()))
        missing = next(name for name in wanted if name not in some)
        raise InputError(
            file,
            "labels.class",
            template,
            f"{{{missing}}} is no field of the trials; they have {', '.join(sorted(some))}",
        )
    return found


def _class_name(name: str, file: str | Path, key: str, value: object) -> str:
    name = name.strip()
    if not name or len(name) > _MOST_NAME or not name.isprintable():
        raise InputError(
            file,
            key,
            value,
            f"gives the class {name[:40]!r}; a name is 1 to {_MOST_NAME} printable characters",
        )
    return name


def _rows(
    part: GivenOnsets | GivenSpans,
    key: str,
    file: Path,
    folder: DataFolder,
    trials: Mapping[str, dict[str, str]],
    file_of_all: FileOfAll,
    lookup: Lookup,
    warnings: list[str],
) -> dict[str, list[TableRow]]:
    """Return the rows that belong to each trial."""
    if part.file is None:
        if isinstance(part, GivenSpans):
            raise InputError(file, f"{key}.file", None, "is missing")
        return {id_: [TableRow(f"trial {id_}", 1, fields)] for id_, fields in trials.items()}
    pattern = parse_pattern(part.file)
    if not pattern.fields:
        name = file_of_all(part.file, f"{key}.file")
        rows = read_rows(folder, name)
        _check_columns(part, key, file, rows)
        return _matched(part, key, file, rows, trials, warnings)
    found: dict[str, list[TableRow]] = {}
    names = lookup(pattern, f"{key}.file", list(trials.values()))
    for (id_, fields), of_trial in zip(trials.items(), names, strict=True):
        if len(of_trial) > 1:
            raise InputError(
                file,
                f"{key}.file",
                part.file,
                f"fits several files for trial {id_}: {', '.join(of_trial[:_SOME])}",
            )
        if of_trial:
            rows = read_rows(folder, of_trial[0])
            _check_columns(part, key, file, rows)
            if part.match:
                rows = _matched(part, key, file, rows, {id_: fields}, []).get(id_, [])
            found[id_] = rows
    return found


def _check_columns(
    part: GivenOnsets | GivenSpans, key: str, file: Path, rows: list[TableRow]
) -> None:
    """Check that every column that the adapter names is in some row."""
    there = {column for row in rows for column in row.values}
    named = {f"{key}.match": list(part.match)}
    if isinstance(part, GivenOnsets):
        named |= {f"{key}.incipient": [part.incipient]}
        named |= {f"{key}.gross": [] if part.gross is None else [part.gross]}
    else:
        named |= {
            f"{key}.start": [part.start],
            f"{key}.end": [part.end],
            f"{key}.class": [part.name],
        }
    for where, columns in named.items():
        for column in columns:
            if rows and column not in there:
                raise InputError(
                    file,
                    where,
                    column,
                    f"is no column of {rows[0].place}; there are {', '.join(sorted(there))}",
                )


def _matched(
    part: GivenOnsets | GivenSpans,
    key: str,
    file: Path,
    rows: list[TableRow],
    trials: Mapping[str, dict[str, str]],
    warnings: list[str],
) -> dict[str, list[TableRow]]:
    by_value: dict[tuple[str, ...], list[TableRow]] = {}
    for row in rows:
        value = tuple(row.values.get(column, "") for column in part.match)
        by_value.setdefault(value, []).append(row)
    found = {}
    used = set()
    for id_, fields in trials.items():
        try:
            value = tuple(fill(template, fields) for template in part.match.values())
        except KeyError as error:
            raise InputError(
                file,
                f"{key}.match",
                part.match,
                f"{{{error.args[0]}}} is no field of trial {id_}; it has "
                f"{', '.join(sorted(fields))}",
            ) from None
        used.add(value)
        if value in by_value:
            found[id_] = by_value[value]
    if left := [
        row for value, of_value in by_value.items() if value not in used for row in of_value
    ]:
        some = ", ".join(
            f"row {row.number} ({', '.join(row.values.get(c, '') for c in part.match)})"
            for row in left[:_SOME]
        )
        warnings.append(f"{left[0].place}: {plural(len(left), 'row')} of no trial: {some}")
    return found


def _time(row: TableRow, column: str, unit: str) -> FoundTime | None:
    found = row.time_ns(column, unit)
    return None if found is None else FoundTime(found, row, column)


def _uncertainty_ns(part: GivenOnsets | GivenSpans) -> float | None:
    return None if part.uncertainty_ms is None else part.uncertainty_ms * 1e6


def _onsets(part: GivenOnsets, rows: list[TableRow]) -> FoundLabel | None:
    if not rows:
        return None
    if len(rows) > 1:
        raise InputError(
            rows[0].place,
            f"row {rows[1].number}",
            None,
            f"is of the same trial as row {rows[0].number}; keep one of them",
        )
    row = rows[0]
    incipient = _time(row, part.incipient, part.unit)
    gross = None if part.gross is None else _time(row, part.gross, part.unit)
    if incipient is None and gross is None:
        return None
    if incipient is not None and gross is not None and gross.ns < incipient.ns:
        raise row.error(
            gross.column, f"lies before {incipient.column} = {row.values[incipient.column]}"
        )
    return FoundLabel(
        row.place.rpartition("/")[2],
        incipient=incipient,
        gross=gross,
        clock=part.clock,
        uncertainty_ns=_uncertainty_ns(part),
    )


def _spans(part: GivenSpans, rows: list[TableRow], adapter: Adapter) -> FoundLabel | None:
    spans = []
    for row in rows:
        start, end = _time(row, part.start, part.unit), _time(row, part.end, part.unit)
        name = row.values.get(part.name)
        if start is None or end is None or name is None:
            empty = next(c for c in (part.start, part.end, part.name) if c not in row.values)
            raise row.error(empty, "is empty")
        name = part.names.get(name, name)
        if not name:
            continue
        if end.ns <= start.ns:
            raise row.error(part.end, f"must be after {part.start} = {row.values[part.start]}")
        _class_name(name, row.place, f"row {row.number}, {part.name}", row.values[part.name])
        spans.append(FoundSpan(start, end, name))
    spans.sort(key=lambda span: span.start.ns)
    for before, after in pairwise(spans):
        if after.start.ns < before.end.ns:
            raise after.start.row.error(
                part.start, f"lies inside the interval of row {before.start.row.number}"
            )
    if not spans:
        return None
    label = FoundLabel(
        rows[0].place.rpartition("/")[2],
        spans=tuple(spans),
        clock=part.clock,
        uncertainty_ns=_uncertainty_ns(part),
    )
    return label if adapter.experiment == CLASSES else _slip(label, part)


def _slip(label: FoundLabel, part: GivenSpans) -> FoundLabel:
    """Return the onsets that intervals of no slip, incipient and gross slip give."""
    for span in label.spans:
        if span.name not in SLIP:
            raise span.start.row.error(
                part.name, f"must become one of {', '.join(SLIP)} by labels.spans.names"
            )
    first = {span.name: span.start for span in reversed(label.spans)}
    incipient, gross = first.get(SLIP[1]), first.get(SLIP[2])
    if incipient is not None and gross is not None and gross.ns < incipient.ns:
        raise gross.row.error(part.start, "is of gross slip before any incipient slip")
    return replace(label, spans=(), incipient=incipient, gross=gross)


def find_motion(
    motion: GivenMotion, fields: Fields, file: Path, trial: str
) -> tuple[int, int] | None:
    """Return begin and end of the slide on the motion's own clock, ns; None where a field is empty.

    Raises:
        InputError: they are no times, or in a wrong order.
    """
    ends = []
    for key in ("start", "end"):
        text = getattr(motion, key)
        if any(name not in fields for name in template_fields(text)):
            return None
        found = exact_ns(fill(text, fields), motion.unit)
        if found is None:
            raise InputError(
                file, f"motion.{key}", fill(text, fields), f"is no time of trial {trial}"
            )
        ends.append(found)
    if ends[1] <= ends[0]:
        raise InputError(
            file, "motion.end", motion.end, f"must be after the start of trial {trial}"
        )
    return ends[0], ends[1]
