"""Trials of a foreign data set as an adapter describes them, found before anything is read.

Every fault that names, tables and labels can show is found here, so that nothing is written then.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sliplab.plugins.adapters.labels import FoundLabel, find_labels
from sliplab.protocols.adapter import Adapter
from sliplab.protocols.adapter_parts import BUILT_IN, OWN_FORMATS, FieldRule
from sliplab.protocols.errors import InputError
from sliplab.protocols.file_pattern import FilePattern, fill, parse_pattern, template_fields
from sliplab.protocols.recorded import TrialProperties, natural, split_recorded
from sliplab.protocols.shown import plural
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.foreign import Skipped
from sliplab.storage.formats.known import format_names, known_format
from sliplab.storage.formats.recognition import unique_names
from sliplab.storage.formats.tables import TableRow, read_rows

EVENTS, FRAMES, FRAME_TIMES, POSES = "events", "frames", "frames.times", "poses"
"""Streams by the keys of their files; wrenches and scalars are ``wrenches.NAME``."""
NO_MATCH = "matches no pattern of the adapter"
_SOME = 5


@dataclass(frozen=True)
class AdaptedTrial:
    """A trial that can be read.

    Attributes:
        source: its file, or the table with its row.
        fields: its fields from names and tables.
        condition: levels by factor as text with unit.
        files: paths of each stream's files, by the stream's key.
        missing: streams that it has no files of.
    """

    id: str
    source: str
    fields: dict[str, str]
    condition: dict[str, str]
    files: dict[str, tuple[str, ...]]
    label: FoundLabel | None
    missing: tuple[str, ...] = ()

    def recorded(self) -> TrialProperties:
        """Properties that the split needs; the recording's length is not known yet."""
        names = () if self.label is None else self.label.classes
        first = names[0] if names else None
        return TrialProperties(self.id, self.condition, self.fields, first, 0.0, names)


@dataclass(frozen=True)
class AdaptedSet:
    """The trials of a data set, in natural order of their ids.

    Attributes:
        file: the adapter's, for messages.
        skipped: files that are not used.
    """

    adapter: Adapter
    file: Path
    folder: DataFolder
    trials: tuple[AdaptedTrial, ...]
    skipped: tuple[Skipped, ...]
    warnings: tuple[str, ...]

    def parts(self, others: Iterable[TrialProperties] = ()) -> dict[str, str]:
        """Return the part of the split of each trial by id, of `others` that are there as well.

        Raises:
            InputError: the adapter's split does not fit the trials.
        """
        mine = [trial.recorded() for trial in self.trials]
        ids = {trial.id for trial in mine}
        every = [*mine, *(trial for trial in others if trial.id not in ids)]
        every.sort(key=lambda trial: natural(trial.id))
        return split_recorded(self.adapter, every, str(self.file))


@dataclass
class _Draft:
    """A trial whose fields are known."""

    source: str
    name: str | None
    """Its own file; None of a row without one."""
    fields: dict[str, str]
    built_in: dict[str, str] = field(default_factory=dict)
    row: TableRow | None = None

    @property
    def all(self) -> dict[str, str]:
        """Its fields with those that every trial has."""
        return {**self.built_in, **self.fields}


def find_trials(adapter: Adapter, file: Path, folder: DataFolder) -> AdaptedSet:
    """Find the trials of a data set with their fields from names and tables.

    Raises:
        InputError: a pattern fits nothing, two trials have one id, a field is missing, or a table
            or label is wrong.
    """
    found = _Finding(adapter, file, folder)
    return found.run()


class _Finding:
    def __init__(self, adapter: Adapter, file: Path, folder: DataFolder) -> None:
        self._adapter, self._file, self._folder = adapter, file, folder
        self._used: set[str] = set()
        self._warnings: list[str] = []

    def run(self) -> AdaptedSet:
        drafts = self._from_table() if self._adapter.trials.table else self._from_files()
        for name, rule in self._adapter.fields.items():
            for draft in drafts:
                self._derive(draft, name, rule)
        self._name(drafts)
        self._check_factors(drafts)
        streams = self._streams(drafts)
        labels = find_labels(
            self._adapter,
            self._file,
            self._folder,
            {draft.built_in["id"]: draft.all for draft in drafts},
            self.file_of_all,
            self.lookup,
        )
        self._warnings += labels.warnings
        trials, left_out = [], {}
        for draft, files in zip(drafts, streams, strict=True):
            id_ = draft.built_in["id"]
            missing = tuple(key for key, names in files.items() if not names)
            needed = self._needed
            if lacking := next((key for key in needed if key in missing), None):
                left_out[draft.source] = f"trial {id_} has no file of {lacking}"
                continue
            if not needed and len(missing) == len(files):
                left_out[draft.source] = f"trial {id_} has no file of any stream"
                continue
            for names in files.values():
                self._used.update(names)
            there = {key: names for key, names in files.items() if names}
            label = labels.by_trial.get(id_)
            trials.append(
                AdaptedTrial(
                    id_, draft.source, draft.fields, self._condition(draft), there, label, missing
                )
            )
        if not trials:
            key = next(iter(self._needed or streams[0]))
            self._none(f"streams.{key}.files", None)
        trials.sort(key=lambda trial: natural(trial.id))
        self._warn_of_missing(trials)
        skipped = [
            Skipped(name, left_out.pop(name, NO_MATCH))
            for name in self._folder.names
            if name not in self._used
        ]
        skipped += [Skipped(source, reason) for source, reason in left_out.items()]
        return AdaptedSet(
            self._adapter,
            self._file,
            self._folder,
            tuple(trials),
            (*skipped, *self._folder.skipped),
            tuple(self._warnings),
        )

    @property
    def _needed(self) -> tuple[str, ...]:
        """Streams without which a trial is left out; where there are none of these, any does."""
        streams = self._adapter.streams
        if streams.events is not None:
            return (EVENTS,)
        return () if streams.frames is None else (FRAMES, FRAME_TIMES)

    def _error(self, key: str, value: object, expected: str) -> InputError:
        return InputError(self._file, key, value, expected)

    def _none(self, key: str, value: object) -> Iterator[Any]:
        names = self._folder.names
        there = ", ".join(names[:_SOME]) + (", ..." if len(names) > _SOME else "")
        what = f"there are {len(names)} files: {there}" if names else "there are no files"
        raise self._error(key, value, f"fits no file below {self._folder.path}; {what}")

    def _from_files(self) -> list[_Draft]:
        drafts: list[_Draft] = []
        taken: set[str] = set()
        several = not isinstance(self._adapter.trials.files, str)
        for index, text in enumerate(self._adapter.trials.patterns):
            pattern = parse_pattern(text)
            before = len(drafts)
            for name in self._folder.names:
                if name in taken:
                    continue
                caught = self._folder.match(pattern, name)
                if caught is None:
                    continue
                taken.add(name)
                drafts.append(_Draft(name, name, self._caught(caught), _built_in(name)))
            if len(drafts) == before:
                self._none(f"trials.files[{index}]" if several else "trials.files", text)
        return drafts

    def _caught(self, caught: dict[str, str]) -> dict[str, str]:
        if own := next((name for name in caught if name in BUILT_IN), None):
            raise self._error("trials.files", f"{{{own}}}", "every trial has it; choose another")
        return caught

    def _from_table(self) -> list[_Draft]:
        table = str(self._adapter.trials.table)
        name = self.file_of_all(table, "trials.table")
        rows = read_rows(self._folder, name)
        if not rows:
            raise InputError(self._folder.place(name), "", None, "has no row: there is no trial")
        drafts = []
        patterns = [parse_pattern(text) for text in self._adapter.trials.patterns]
        for row in rows:
            fields = {key: value for key, value in row.values.items() if key not in BUILT_IN}
            built = {key: value for key, value in row.values.items() if key in BUILT_IN}
            drafts.append(_Draft(f"{name}, row {row.number}", None, fields, built, row))
        for index, pattern in enumerate(patterns):
            found = self.lookup(pattern, f"trials.files[{index}]", [draft.all for draft in drafts])
            for draft, names in zip(drafts, found, strict=True):
                if draft.name is None and names:
                    self._one(names, "trials.files", draft)
                    draft.name = draft.source = names[0]
                    draft.built_in = {**_built_in(names[0]), **draft.built_in}
        if patterns and not any(draft.name for draft in drafts):
            self._none("trials.files", self._adapter.trials.patterns[0])
        return drafts

    def file_of_all(self, text: str, key: str) -> str:
        """Return the one file that a pattern without fields fits."""
        pattern = parse_pattern(text)
        found = [
            name for name in self._folder.names if self._folder.match(pattern, name) is not None
        ]
        if not found:
            self._none(key, text)
        if len(found) > 1:
            raise self._error(
                key, text, (f"fits {plural(len(found), 'file')}: {', '.join(found[:_SOME])}")
            )
        self._used.add(found[0])
        return found[0]

    def lookup(
        self, pattern: FilePattern, key: str, fields: list[dict[str, str]]
    ) -> list[tuple[str, ...]]:
        """Return the files that a pattern fits with the fields of each trial filled in.

        Fields that no trial has match any characters.
        """
        known = [name for name in pattern.fields if any(name in each for each in fields)]
        if pattern.exact and len(known) == len(pattern.fields):
            found = [self._exact(pattern, each) for each in fields]
        else:
            by_fields: dict[tuple[str, ...], list[str]] = {}
            for name in self._folder.names:
                caught = self._folder.match(pattern, name)
                if caught is not None:
                    by_fields.setdefault(tuple(caught[each] for each in known), []).append(name)
            found = [
                tuple(by_fields.get(tuple(each.get(name, "") for name in known), ()))
                for each in fields
            ]
        if fields and not any(found):
            self._none(key, pattern.text)
        return found

    def _exact(self, pattern: FilePattern, fields: Mapping[str, str]) -> tuple[str, ...]:
        if any(name not in fields for name in pattern.fields):
            return ()
        name = pattern.filled(fields)
        root = f"{self._folder.root}/"
        for each in (name, name.removeprefix(root)):
            if each in self._folder:
                return (each,)
        return ()

    def _one(self, names: tuple[str, ...], key: str, draft: _Draft) -> None:
        if len(names) > 1:
            raise self._error(
                key, ", ".join(names[:_SOME]), f"are several files for one trial ({draft.source})"
            )

    def _derive(self, draft: _Draft, name: str, rule: FieldRule) -> None:
        key = f"fields.{name}"
        text = f"{{{name}}}" if rule.source is None else rule.source
        known = draft.all
        missing = [each for each in template_fields(text) if each not in known]
        if missing:
            if draft.row is not None and rule.source is None:
                return  # an empty cell
            raise self._error(key, text, _unknown(missing[0], known, draft.source))
        value = fill(text, known)
        if rule.pattern is not None:
            pattern = parse_pattern(rule.pattern)
            if name not in pattern.fields:
                raise self._error(f"{key}.pattern", rule.pattern, f"must catch {{{name}}}")
            caught = pattern.match(value)
            if caught is None:
                raise self._error(
                    f"{key}.pattern", rule.pattern, f"does not fit {value!r} of {draft.source}"
                )
            value = caught[name]
        draft.fields[name] = rule.values.get(value, value)

    def _name(self, drafts: list[_Draft]) -> None:
        template = self._adapter.trials.id
        texts: list[str] = []
        for draft in drafts:
            known = draft.all
            if template is not None:
                if missing := [each for each in template_fields(template) if each not in known]:
                    raise self._error(
                        "trials.id", template, _unknown(missing[0], known, draft.source)
                    )
                text = fill(template, known)
            elif "id" in known or "path" in known:
                text = known.get("id") or known["path"].replace("/", "-")
            else:
                raise self._error(
                    "trials.id", None, f"is missing: {draft.source} has no column id and no file"
                )
            texts.append(text)
        sources: dict[str, str] = {}
        for draft, id_ in zip(drafts, unique_names(texts), strict=True):
            if (other := sources.setdefault(id_, draft.source)) != draft.source:
                raise self._error(
                    "trials.id",
                    template,
                    f"gives {other} and {draft.source} one id, {id_}; put more fields into it",
                )
            draft.built_in["id"] = id_

    def _check_factors(self, drafts: list[_Draft]) -> None:
        for name, factor in self._adapter.factors.items():
            if not any(factor.field in draft.all for draft in drafts):
                raise self._error(
                    f"factors.{name}.field",
                    factor.field,
                    _unknown(factor.field, drafts[0].all, drafts[0].source),
                )

    def _condition(self, draft: _Draft) -> dict[str, str]:
        condition = {}
        for name, factor in self._adapter.factors.items():
            value = draft.all.get(factor.field)
            if value is None:
                self._warnings.append(f"{draft.source}: has no {factor.field} for factor {name}")
                continue
            text = factor.levels.get(value, value)
            if factor.unit is not None:
                try:
                    finite = abs(float(text)) < float("inf")
                except ValueError:
                    finite = False
                if not finite:
                    raise self._error(
                        f"factors.{name}",
                        text,
                        f"must be a number of {factor.unit} in "
                        f"{draft.source}; or leave out the unit",
                    )
                text = f"{text} {factor.unit}"
            condition[name] = text if factor.unit else "_".join(text.split())
        return condition

    def _streams(self, drafts: list[_Draft]) -> list[dict[str, tuple[str, ...]]]:
        """Return the files of each trial by stream; none where they are missing."""
        wanted: dict[str, tuple[str | None, bool]] = {}
        streams = self._adapter.streams
        if streams.events is not None:
            wanted[EVENTS] = (streams.events.files, self._has_several(streams.events.format))
        if streams.frames is not None:
            wanted[FRAMES] = (streams.frames.files, streams.frames.format == "images")
            if streams.frames.times is not None:
                wanted[FRAME_TIMES] = (streams.frames.times.files, False)
        if streams.poses is not None:
            wanted[POSES] = (streams.poses.files, False)
        for kind, named in (("wrenches", streams.wrenches), ("scalars", streams.scalars)):
            for name, table in named.items():
                wanted[f"{kind}.{name}"] = (table.files, False)
        files: list[dict[str, tuple[str, ...]]] = [{} for _ in drafts]
        fields = [draft.all for draft in drafts]
        for stream, (text, many) in wanted.items():
            key = f"streams.{stream}.files"
            if text is None:
                found: list[tuple[str, ...]] = [
                    () if draft.name is None else (draft.name,) for draft in drafts
                ]
                if not any(found):
                    raise self._error(key, None, "is missing; trials of a table have no own file")
            else:
                found = self.lookup(parse_pattern(text), key, fields)
            for draft, names, there in zip(drafts, found, files, strict=True):
                if not many:
                    self._one(names, key, draft)
                there[stream] = names
        return files

    def _has_several(self, name: str) -> bool:
        """Return whether a trial may have more than one file of a format of events."""
        if name in OWN_FORMATS:
            return False
        if name not in format_names():
            known = ", ".join((*OWN_FORMATS, *format_names()))
            raise self._error("streams.events.format", name, f"must be one of {known}")
        return known_format(name).read is None  # a layout joins them

    def _warn_of_missing(self, trials: list[AdaptedTrial]) -> None:
        counts = Counter(key for trial in trials for key in trial.missing)
        for key, count in counts.items():
            some = [trial.id for trial in trials if key in trial.missing][:_SOME]
            self._warnings.append(
                f"{key}: no file for {plural(count, 'trial')} ({', '.join(some)})"
            )


def _built_in(name: str) -> dict[str, str]:
    folder, _, last = name.rpartition("/")
    stem = last.rpartition(".")[0] or last
    path = f"{folder}/{stem}" if folder else stem
    return {"stem": stem, "folder": folder.rpartition("/")[2], "path": path}


def _unknown(name: str, known: Mapping[str, str], source: str) -> str:
    return f"{{{name}}} is no field of {source}; it has {', '.join(sorted(known)) or 'none'}"
