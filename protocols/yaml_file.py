"""Reading one YAML file into a checked model, or saying exactly what is wrong with it.

YAML has more in it than an experiment needs and some of it is dangerous: aliases that expand to
gigabytes, floats that lose their decimal text, keys given twice where the last silently wins.
This loader takes the part that a protocol needs: mappings, lists, text, and numbers that keep
their decimal digits.
"""

from __future__ import annotations

import difflib
import os
import stat
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from protocols.errors import InputError

MAX_BYTES = 1 << 20
MAX_DEPTH = 32


class StrictModel(BaseModel):
    """Base of every model read from a file: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


ModelT = TypeVar("ModelT", bound=BaseModel)


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """PyYAML's safe loader without aliases, with decimals for floats and unique keys."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            event = self.peek_event()
            raise yaml.MarkedYAMLError(
                problem=f"the alias '*{event.anchor}'; aliases are not read here, write it out",
                problem_mark=event.start_mark,
            )
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(
                problem=f"nested more than {MAX_DEPTH} deep",
                problem_mark=self.peek_event().start_mark,
            )
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.MarkedYAMLError(
                    problem=f"the key {key!r} is not text", problem_mark=key_node.start_mark
                )
            if key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"the key '{key}' stands twice", problem_mark=key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def _decimal(loader: _Loader, node: Any) -> Decimal:
    text = node.value.replace("_", "").lower()
    special = {".inf": "Infinity", "+.inf": "Infinity", "-.inf": "-Infinity", ".nan": "NaN"}
    if text in special:
        return Decimal(special[text])
    if ":" in text:
        raise yaml.MarkedYAMLError(
            problem=f"'{node.value}' reads as a base-60 number; quote it or write it out",
            problem_mark=node.start_mark,
        )
    return Decimal(text)


def _integer(loader: _Loader, node: Any) -> int:
    text = node.value.replace("_", "")
    try:
        return int(text, 10)
    except ValueError:
        raise yaml.MarkedYAMLError(
            problem=f"'{node.value}' is not a decimal number", problem_mark=node.start_mark
        ) from None


_Loader.add_constructor("tag:yaml.org,2002:float", _decimal)
_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def read_text(path: Path, what: str) -> str:
    """The text of a small UTF-8 file.

    Raises:
        InputError: missing, no plain file, unreadable, over 1 MiB, or not UTF-8.
    """
    try:
        with open(path, "rb", opener=_at_once) as handle:
            if not stat.S_ISREG(os.fstat(handle.fileno()).st_mode):
                raise InputError(path, "", None, f"is no plain file; give the path of a {what}")
            data = handle.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError(path, "", None, f"no such file; give the path of a {what}") from None
    except IsADirectoryError:
        raise InputError(path, "", None, f"is a folder; give the path of a {what}") from None
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise InputError(path, "", None, f"is over {MAX_BYTES} bytes; a {what} is a few kB")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            path,
            f"byte {error.start}",
            data[error.start : error.start + 1].hex(),
            "is not UTF-8; save the file as UTF-8 text",
        ) from None


def _at_once(path: str, flags: int) -> int:
    """Open without waiting for whoever writes into a pipe."""
    return os.open(path, flags | os.O_NONBLOCK)


def parse_yaml(text: str, path: str | Path) -> dict[str, Any]:
    """YAML text as a mapping.

    Raises:
        InputError: not YAML, not a mapping, an alias, a key twice, nested too deep.
    """
    try:
        data = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}"
        raise InputError(path, where, None, f"cannot be read: {error.problem}") from None
    except (yaml.YAMLError, ValueError, ArithmeticError, RecursionError) as error:
        raise InputError(path, "", None, f"is not YAML: {error}") from None
    if not isinstance(data, dict):
        found = "nothing" if data is None else f"a {type(data).__name__}"
        raise InputError(path, "", None, f"holds {found} where a mapping (key: value) belongs")
    return data


def validate(model: type[ModelT], data: dict[str, Any], path: str | Path) -> ModelT:
    """`data` as a `model`; the first fault found is raised as an `InputError`."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _explain(model, error, path) from None


def load(model: type[ModelT], path: Path, what: str) -> ModelT:
    """The file at `path` read, parsed and checked as a `model`."""
    return validate(model, parse_yaml(read_text(path, what), path), path)


def _explain(model: type[BaseModel], error: ValidationError, path: str | Path) -> InputError:
    # An unknown key is most often the cause of a missing one beside it: say it first.
    first = min(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
    loc = first["loc"]
    value: object | None = first.get("input")
    kind, context = first["type"], first.get("ctx", {})
    if kind == "value_error" and isinstance(context.get("error"), KeyedError):
        keyed = context["error"]
        return InputError(path, keyed.key, keyed.value, str(keyed))
    key = _key(loc)
    if kind == "extra_forbidden":
        names = _fields_at(model, loc[:-1])
        close = difflib.get_close_matches(str(loc[-1]), names, n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        known = f" (known here: {', '.join(names)})" if names else ""
        return InputError(path, key, value, f"unknown key{hint}{known}")
    if kind == "missing":
        return InputError(path, key, None, "is missing")
    if kind == "value_error":
        return InputError(path, key, value, str(context["error"]))
    if kind in {"union_tag_invalid", "union_tag_not_found"}:
        tags = str(context.get("expected_tags", "")).replace("'", "")
        tag = str(context.get("discriminator", "'kind'")).strip("'")
        found = value.get(tag) if isinstance(value, dict) else value
        return InputError(path, f"{key}.{tag}", found, f"must be one of {tags}")
    message = first["msg"]
    return InputError(path, key, value, message[0].lower() + message[1:])


class KeyedError(ValueError):
    """A fault found by looking at several keys together, blamed on one of them."""

    def __init__(self, key: str, value: object, expected: str) -> None:
        super().__init__(expected)
        self.key = key
        self.value = value


def _key(loc: tuple[int | str, ...]) -> str:
    text, before = "", ""
    for part in loc:
        if isinstance(part, int):
            text += f"[{part}]"
        elif not (text.endswith("]") and part in _TAGS) and part not in _TAGS_OF.get(before, ()):
            text += f".{part}" if text else part
        before = str(part)
    return text


# pydantic puts the tag of a union into the location; a person does not write it there
_TAGS: set[str] = set()
_TAGS_OF: dict[str, tuple[str, ...]] = {}


def register_tags(*names: str) -> None:
    """Tell the error messages which location parts are tags of a union and not keys."""
    _TAGS.update(names)


def register_tags_of(key: str, *names: str) -> None:
    """The same for a union that is no list: its tags stand behind its key."""
    _TAGS_OF[key] = names


def _fields_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
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
            return []
        current = field.annotation
        current = _inner(current)
    fields = getattr(current, "model_fields", {})
    return [field.alias or name for name, field in fields.items()]


def _inner(annotation: Any) -> Any:
    """The model inside ``list[...]``, ``X | None`` and the like; unions of phases stay whole."""
    from typing import get_args

    if hasattr(annotation, "model_fields"):
        return annotation
    models = [part for part in map(_inner, get_args(annotation)) if part is not None]
    return models[-1] if len(models) == 1 else (models or None)


def _tagged(candidates: Any, tag: str) -> Any:
    for candidate in candidates if isinstance(candidates, list) else [candidates]:
        for group in candidate if isinstance(candidate, list) else [candidate]:
            for field in getattr(group, "model_fields", {}).values():
                if field.default == tag or tag in getattr(field.annotation, "__args__", ()):
                    return group
    return None
