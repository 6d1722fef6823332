"""Faults of a file by their keys: what pydantic finds, as a person reads it.

A fault names its key as it is written in the file, its value, and what would be right. A key that
is misspelt is said to be unknown, with the one that may be meant.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from sliplab.protocols.quantity import number_meant
from sliplab.protocols.shown import did_you_mean, foreign_character, nearest

MISSING, UNKNOWN = "is missing", "unknown key"


def faults_of(model: type[BaseModel], error: ValidationError) -> list[KeyedError]:
    """Return the faults of `error` for the user: key, value and what is right.

    Unknown keys come first: one that is misspelt is the cause of a missing one, which is left out.
    """
    found = faults_below(model, error)
    return [_placed(model, each.with_key(each.key.removeprefix("."))) for each in found]


def _placed(model: type[BaseModel], fault: KeyedError) -> KeyedError:
    """Return the fault of a key that is unknown where it is, with the place where it is known."""
    name = fault.key.rpartition(".")[2]
    if not str(fault).startswith(UNKNOWN) or (place := _place_of(name, model)) is None:
        return fault
    return KeyedError(fault.key, fault.value, f"{fault}; its place may be {place}")


def _place_of(name: str, model: type[BaseModel]) -> str | None:
    """Return the highest place at which a file may have a key; None without one."""
    level: dict[Any, str] = {model: ""}
    seen: set[Any] = set()
    while level:
        below: dict[Any, str] = {}
        for each, before in level.items():
            for key, field in each.model_fields.items():
                key = field.alias or key
                if key == name:
                    return f"{before}{key}" if before else f"the top level ({key})"
                for inner in _models_in(field.annotation):
                    below.setdefault(inner, f"{before}{key}.")
        seen |= level.keys()
        level = {each: before for each, before in below.items() if each not in seen}
    return None


def _models_in(annotation: Any) -> Iterator[Any]:
    if hasattr(annotation, "model_fields"):
        yield annotation
        return
    for part in get_args(annotation):
        yield from _models_in(part)


def faults_below(model: type[BaseModel], error: ValidationError) -> list[KeyedError]:
    """Return the faults of `error`, their keys below `model` as `KeyedError` has them."""
    items = sorted(_of_one_choice(error.errors()), key=lambda i: i["type"] != "extra_forbidden")
    items = [
        item
        for item in items
        if item["type"] != "default_factory_not_called"  # which follows from another fault
        and not _is_short_byfaults_below(item, items)
    ]
    meant = {_key((*item["loc"][:-1], close)) for item in items if (close := _close(model, item))}
    found: dict[str, KeyedError] = {}
    for item in items:
        if not (item["type"] == "missing" and _key(item["loc"]) in meant):
            for each in _fault(model, item).faults:
                found.setdefault(each.key, each)
    return list(found.values())


def _of_one_choice(items: Sequence[Any]) -> Iterator[Any]:
    """Leave out what pydantic says of the other types that a value may have."""
    first: dict[tuple[int | str, ...], int | str] = {}
    for item in items:
        loc = item["loc"]
        choices = [k for k, part in enumerate(loc) if _WAY_OF_UNION.fullmatch(str(part))]
        if all(first.setdefault(loc[:k], loc[k]) == loc[k] for k in choices):
            yield item


def _is_short_byfaults_below(item: Any, items: Sequence[Any]) -> bool:
    """Return whether a list is too short because pydantic leaves out its wrong items."""
    loc = item["loc"]
    return item["type"] == "too_short" and any(
        len(other["loc"]) > len(loc) and other["loc"][: len(loc)] == loc for other in items
    )


def _close(model: type[BaseModel], item: Any) -> str | None:
    """Return the known name that an unknown key is close to, if any."""
    if item["type"] != "extra_forbidden":
        return None
    return nearest(str(item["loc"][-1]), _fields_at(model, item["loc"][:-1]))


def _fault(model: type[BaseModel], item: Any) -> KeyedError:
    """Return one fault of pydantic's, with those that were found with it.

    A model that is chosen by its content (a device by its driver) is validated separately, and
    its faults continue from its key: `KeyedError` with a ``.`` before the key.
    """
    value: object | None = item.get("input")
    loc, kind, context = item["loc"], item["type"], item.get("ctx", {})
    key = f".{_key(loc)}" if loc else ""
    if loc and loc[-1] == "[key]":  # pydantic's placeholder for the name of an entry
        stated = re.sub("^Value error, |^[A-Z].* should", "", item["msg"]).strip()
        return KeyedError(f".{_key(loc[:-1])}", None, f"is no right name: {stated}")
    if kind == "value_error" and isinstance(context.get("error"), KeyedError):
        return KeyedError.joined(
            each.with_key(key + each.key) if each.below else each
            for each in context["error"].faults
        )
    if kind == "extra_forbidden":
        names = _fields_at(model, loc[:-1])
        hint = did_you_mean(str(loc[-1]), names)
        known = f" (known here: {', '.join(names)})" if names else ""
        foreign = foreign_character(str(loc[-1]))
        hint = (f" (holds {foreign})" if foreign else "") + hint
        return KeyedError(key, value, f"{UNKNOWN}{hint}{known}")
    if kind == "missing":
        return KeyedError(key, None, MISSING)
    if kind == "value_error":
        return KeyedError(key, value, str(context["error"]))
    if kind in {"union_tag_invalid", "union_tag_not_found"}:
        tags = str(context.get("expected_tags", "")).replace("'", "")
        tag = str(context.get("discriminator", "'kind'")).strip("'")
        tags = tags or _tags_at(model, loc, tag)
        found = value.get(tag) if isinstance(value, dict) else value
        if found is None and isinstance(value, dict) and (close := nearest(tag, map(str, value))):
            return KeyedError(f"{key}.{close}", value[close], f"{UNKNOWN}; did you mean '{tag}'?")
        hint = did_you_mean(str(found), tags.split(", ")) if found is not None else ""
        return KeyedError(f"{key}.{tag}", found, f"must be one of {tags}{hint}")
    message = re.sub("^[A-Z][a-z]+ should", "must", item["msg"])
    message = re.sub(" after validation, not [0-9]+$", "", message)
    expected = _EXPECTED.get(kind, message[0].lower() + message[1:])
    if value is None:
        return KeyedError(key, None, f"is empty; {expected}")
    if kind in _EXPECTED:
        if isinstance(value, str) and (meant := number_meant(value)):
            return KeyedError(key, value, meant)
        if kind == "string_type" and not isinstance(value, list | tuple | dict):
            reads = "a switch" if isinstance(value, bool) else "a day"
            reads = "a number" if isinstance(value, int | Decimal) and reads == "a day" else reads
            expected += f" and reads as {reads}: quote it"
    if kind == "literal_error" and isinstance(value, str):
        expected += did_you_mean(value, re.findall("'([^']*)'", expected))
    if context.get("ge") == -(2**63) or context.get("lt") == 2**63:
        expected = "must fit 64 bits"
    if context.get("pattern") == NAME_PATTERN:
        expected = f"must be {NAME_WORDS} (pattern {NAME_PATTERN})"
    return KeyedError(key, value, expected)


NAME_PATTERN = "^[a-z][a-z0-9_-]{0,47}$"
NAME_WORDS = "a small letter, then small letters, digits, '-' and '_', 48 characters at most"


_LIST, _MAPPING = "must be a list ([a, b], or lines that begin with -)", "must be a mapping"
_EXPECTED = {
    "string_type": "must be text",
    "tuple_type": _LIST,
    "list_type": _LIST,
    "model_type": f"{_MAPPING} (key: value)",
    "model_attributes_type": f"{_MAPPING} (key: value)",
    "dict_type": f"{_MAPPING} (key: value)",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "finite_number": "must be a finite number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
}
"""By pydantic's kinds of error."""


class KeyedError(ValueError):
    """A fault found by looking at several keys together, blamed on one of them.

    Its key is a whole one, or begins with ``.`` or ``[`` and continues from the model or field that
    raises it.

    Attributes:
        more: further faults that were found together with this one.
    """

    def __init__(
        self, key: str, value: object, expected: str, more: Iterable[KeyedError] = ()
    ) -> None:
        super().__init__(expected)
        self.key = key
        self.value = value
        self.more = tuple(more)

    @classmethod
    def joined(cls, faults: Iterable[KeyedError]) -> KeyedError:
        """Return the first of some faults, with all others as those found with it."""
        first, *others = (each for fault in faults for each in fault.faults)
        return KeyedError(first.key, first.value, str(first), others)

    @property
    def faults(self) -> tuple[KeyedError, ...]:
        """Return this fault without the others, then each of the others."""
        return KeyedError(self.key, self.value, str(self)), *self.more

    @property
    def below(self) -> bool:
        """True if the key continues from the model or field that raises it."""
        return self.key == "" or self.key[0] in ".["

    def with_key(self, key: str) -> KeyedError:
        """Return the same fault of another key."""
        return KeyedError(key, self.value, str(self))


def _key(loc: tuple[int | str, ...]) -> str:
    text, before = "", ""
    for part in loc:
        if isinstance(part, int):
            text += f"[{part}]"
        elif not (
            (text.endswith("]") and part in _TAGS)
            or part in _TAGS_OF.get(before, ())
            or _WAY_OF_UNION.fullmatch(part)
        ):
            text += f".{part}" if text else part
        before = str(part)
    return text


_WAY_OF_UNION = re.compile(r"constrained-\w+|(?:function-\w+|tuple|list)\[.*\]")
"""A part that pydantic adds for one of several types that a value may have."""

# pydantic puts the tag of a union into the location; a person does not write it there
_TAGS: set[str] = set()
_TAGS_OF: dict[str, tuple[str, ...]] = {}


def register_tags(*names: str) -> None:
    """Register location parts that are tags of a union, so that error messages leave them out."""
    _TAGS.update(names)


def register_tags_of(key: str, *names: str) -> None:
    """The same for a union that is not a list: its tags follow its key."""
    _TAGS_OF[key] = names


def _fields_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    fields = getattr(_model_at(model, loc), "model_fields", {})
    return [field.alias or name for name, field in fields.items()]


def _model_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> Any:
    """Return the model at a place, the several that a union has there, or None."""
    current: Any = model
    before = ""
    for part in loc:
        tag = part in _TAGS or part in _TAGS_OF.get(before, ())
        before = str(part)
        if isinstance(part, int) or tag:
            if tag:
                current = _tagged(current, str(part))
            continue
        field = getattr(current, "model_fields", {}).get(part)
        if field is None:
            return None
        current = field.annotation
        current = _inner(current)
    return current


def _tags_at(model: type[BaseModel], loc: tuple[int | str, ...], tag: str) -> str:
    """Return the values that a key may have which chooses one of several models."""
    found = _model_at(model, loc)
    fields = [each.model_fields.get(tag) for each in found] if isinstance(found, list) else []
    every = [get_args(field.annotation) for field in fields if field is not None]
    return ", ".join(str(value) for values in every for value in values)


def _inner(annotation: Any) -> Any:
    """The model inside ``list[...]``, ``X | None`` and the like; unions of phases stay whole."""
    if hasattr(annotation, "model_fields"):
        return annotation
    models = [part for part in map(_inner, get_args(annotation)) if part is not None]
    return models[-1] if len(models) == 1 else (models or None)


def _tagged(candidates: Any, tag: str) -> Any:
    """Return the model that a tag chooses: of several that may hold the word, the first field's."""
    every = [
        group
        for candidate in (candidates if isinstance(candidates, list) else [candidates])
        for group in (candidate if isinstance(candidate, list) else [candidate])
    ]
    fields = [(group, list(getattr(group, "model_fields", {}).values())) for group in every]
    for depth in (1, None):
        for group, known in fields:
            for field in known[:depth]:
                if field.default == tag or tag in getattr(field.annotation, "__args__", ()):
                    return group
    return None
