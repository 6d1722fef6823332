"""Documents with a value made nonsense, for schemas and the readers that they describe."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft7Validator

from sliplab.flows.planning.json_schemas import document_model, file_schema
from sliplab.storage.files import read_json
from sliplab.storage.schema.document import DocumentError

SOME = 100
"""Values of a document that take turns: each makes the whole of it be checked."""


@cache
def checker(kind: str) -> Draft7Validator:
    """The published schema of a kind of file or document."""
    return Draft7Validator(file_schema(kind))


def check_refusals(kind: str, path: Path, *, every: bool = False) -> int:
    """Make every value nonsense, one at a time: the reader refuses what the schema does.

    Args:
        every: each value by all of `JUNK`; by default some `SOME` of them by one that takes turns.

    Returns:
        how many were refused.
    """
    data, refused = short(read_json(path)), 0
    model, _ = document_model(kind)
    assert checker(kind).is_valid(data)
    assert model.parse(data, path).to_json() == data
    # of a list the first entry stands for all
    places = [at for at in leaves(data) if not any(isinstance(key, int) and key for key in at)]
    step = 1 if every else max(1, len(places) // SOME)
    for at, junks in nonsense(places[::step], every):
        for junk in junks:
            wrong = changed_at(data, at, junk)
            if checker(kind).is_valid(wrong):
                continue
            refused += 1
            with pytest.raises(DocumentError, match=path.name):
                model.parse(wrong, path)
    return refused


def nonsense(
    places: Iterable[tuple[Any, ...]], every: bool
) -> Iterator[tuple[tuple[Any, ...], tuple[Any, ...]]]:
    """Yield each place with what is put there: all of `JUNK`, or one that takes turns."""
    for number, at in enumerate(places):
        yield at, JUNK if every else JUNK[number % len(JUNK) :][:1]


def short(part: Any) -> Any:
    """The same with one of the mappings in each list: all of them are looked at every time."""
    if isinstance(part, dict):
        return {key: short(value) for key, value in part.items()}
    if isinstance(part, list):
        rows = all(isinstance(item, dict) for item in part)
        return [short(item) for item in (part[:1] if rows else part)]
    return part


def leaves(part: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the place of every value, those of containers too."""
    items = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from leaves(value, (*at, key))
        yield (*at, key)


def changed_at(data: Any, at: tuple[Any, ...], value: Any) -> Any:
    """Return a copy with another value at a place; it shares what is not on the way there."""
    part = changed = copy.copy(data)
    for key in at[:-1]:
        part[key] = copy.copy(part[key])
        part = part[key]
    part[at[-1]] = value
    return changed


JUNK: tuple[Any, ...] = ("no such thing", -1.5, None, {"no_such_key": 1})
