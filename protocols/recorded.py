"""Plan of a campaign that was recorded elsewhere: its trials, conditions and split.

It takes the place of the plan of a protocol. Its trials are those that were imported; nothing is
planned beyond them. The split is a function of the adapter and the trials' own names and fields.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from functools import cached_property
from typing import ClassVar

from sliplab.protocols.adapter import Adapter
from sliplab.protocols.errors import InputError
from sliplab.protocols.factors import Level
from sliplab.protocols.hashing import hash_data, hash_integer
from sliplab.protocols.plan import PlannedTrial

_SCALE = float(1 << 63)


@dataclass(frozen=True)
class TrialProperties:
    """Properties of a trial that the split needs.

    Attributes:
        condition: levels by factor as text with unit: ``{"speed": "0.6 mm/s"}``.
        fields: everything that file names and tables state about it, by name.
        label: the class by which it is spread over the split; None for a trial of slip.
        seconds: length of its recording.
        classes: all classes that it shows.
    """

    id: str
    condition: Mapping[str, str]
    fields: Mapping[str, str]
    label: str | None
    seconds: float
    classes: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordedPlan:
    """Trials that were recorded elsewhere, in natural order of their ids.

    Attributes:
        file: the adapter, for messages.
    """

    adapter: Adapter
    file: str
    recorded: tuple[TrialProperties, ...] = field(repr=False)

    @property
    def name(self) -> str:
        """The adapter's name."""
        return self.adapter.name

    seed: ClassVar[None] = None
    """Nothing was drawn."""

    def __len__(self) -> int:
        return len(self.recorded)

    def __iter__(self) -> Iterator[PlannedTrial]:
        return iter(self.trials)

    @cached_property
    def trials(self) -> tuple[PlannedTrial, ...]:
        """The trials, each with its part of the split.

        Raises:
            InputError: the adapter's split names a field that a trial does not have, or a part that
                is none.
        """
        ordered = sorted(self.recorded, key=lambda trial: natural(trial.id))
        parts = split_recorded(self.adapter, ordered, self.file)
        return tuple(
            PlannedTrial(
                index,
                trial.id,
                "measured",
                0,
                0,
                tuple((name, _level(text)) for name, text in trial.condition.items()),
                parts[trial.id],
                hash_integer("recorded", trial.id),
            )
            for index, trial in enumerate(ordered)
        )

    @cached_property
    def _by_id(self) -> dict[str, TrialProperties]:
        return {trial.id: trial for trial in self.recorded}

    def describe(self, trial: PlannedTrial) -> dict[str, str]:
        """The trial's condition as text with units, by factor."""
        return dict(self._by_id[trial.id].condition)

    def seconds(self, trial: PlannedTrial) -> float:
        """Recorded seconds of one trial."""
        return self._by_id[trial.id].seconds

    @cached_property
    def levels(self) -> dict[str, tuple[str, ...]]:
        """Levels of each factor as text, in natural order."""
        found: dict[str, set[str]] = {}
        for trial in self.recorded:
            for name, text in trial.condition.items():
                found.setdefault(name, set()).add(text)
        return {name: tuple(sorted(texts, key=natural)) for name, texts in found.items()}

    @cached_property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes: those of the adapter, or those that occur, in natural order.

        Raises:
            InputError: a trial is of a class that the adapter does not list.
        """
        there = {name for trial in self.recorded for name in trial.classes}
        listed = self.adapter.classes
        if listed and (other := sorted(there - set(listed), key=natural)):
            raise InputError(
                self.file, "classes", list(listed), f"does not list {other[0]}, which a trial is of"
            )
        return listed or tuple(sorted(there, key=natural))

    @cached_property
    def collection_hash(self) -> str:
        """Hash of all of the adapter that decides what the trials are."""
        return hash_data(self.adapter.of_the_trials())

    @cached_property
    def analysis_hash(self) -> str:
        """Hash of the adapter's analysis and split."""
        return hash_data(self.adapter.model_dump(mode="json", include={"analysis", "split"}))


def split_recorded(
    adapter: Adapter, trials: Sequence[TrialProperties], file: str
) -> dict[str, str]:
    """Return the part of each trial by id: ``train``, ``validation`` or ``test``.

    Trials are ranked by a hash inside their stratum: the class, or the condition. Trials that
    stay together by a field form one stratum. The place of rank r of n is (r + u) / n, with u a
    hash of the stratum, so that shares come out as stated.

    Raises:
        InputError: a field is missing, or its value is no part.
    """
    split = adapter.split
    result: dict[str, str] = {}
    open_trials = list(trials)
    shares = {"train": split.train, "validation": split.validation, "test": split.test}
    if split.given is not None:
        for trial in trials:
            value = _field(trial, split.given, "split.given", file)
            part = split.parts.get(value, value)
            if part not in shares:
                raise InputError(
                    file,
                    "split.given",
                    split.given,
                    f"of trial {trial.id} is {value}, which is neither train, validation nor test; "
                    "say below split.parts what it stands for",
                )
            result[trial.id] = part
        if "validation" in result.values():
            return result
        open_trials = [trial for trial in trials if result[trial.id] == "train"]
        rest = (split.train + split.validation) or 1.0
        shares = {"train": split.train / rest, "validation": split.validation / rest}
    groups: dict[str, dict[str, list[str]]] = {}
    for trial in open_trials:
        if split.together is not None:
            stratum, name = "", _field(trial, split.together, "split.together", file)
        else:
            texts = sorted(trial.condition.items())
            stratum = repr(texts) if trial.label is None else trial.label
            name = trial.id
        groups.setdefault(stratum, {}).setdefault(name, []).append(trial.id)
    for stratum, members in groups.items():
        u = hash_integer("split", stratum) / _SCALE
        ranked = sorted(members, key=lambda name: hash_integer("split", name))
        for rank, name in enumerate(ranked):
            place, bound = (rank + u) / len(ranked), 0.0
            part = list(shares)[-1]
            for each, share in shares.items():
                bound += share
                if place < bound:
                    part = each
                    break
            result |= dict.fromkeys(members[name], part)
    return result


def _field(trial: TrialProperties, name: str, key: str, file: str) -> str:
    found = trial.fields.get(name, trial.condition.get(name))
    if found is None:
        known = sorted({*trial.fields, *trial.condition})
        raise InputError(
            file, key, name, f"is no field of trial {trial.id}; it has {', '.join(known) or 'none'}"
        )
    return found


def _level(text: str) -> Level:
    number, _, unit = text.partition(" ")
    try:
        return Decimal(number) if unit else text
    except InvalidOperation:
        return text


def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """Key that sorts numbers in texts by value: ``sample_9`` before ``sample_10``."""
    return tuple(
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.split(r"(\d+)", text)
        if part
    )
