"""Reading of a YAML file into a validated model, with exact error messages.

YAML has more features than an experiment needs, and some are dangerous: aliases that expand to
gigabytes, floats that lose their decimal text, keys given twice where the last silently wins.
This loader supports the subset that a protocol needs: mappings, lists, text, and numbers that keep
their decimal digits.
"""

from __future__ import annotations

import os
import re
import stat
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import date
from decimal import Decimal
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Self, TypeVar, get_args

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import (
    MISSING,
    KeyedError,
    faults_below,
    faults_of,
)
from sliplab.protocols.shipped import neighbours
from sliplab.protocols.shown import (
    MASK,
    did_you_mean,
    holds_secret,
    is_own_name,
    is_secret,
)

MAX_BYTES = 1 << 20
MAX_DEPTH = 32
_KINDS = ("protocol", "rig")
"""First keys of files that people take for each other."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
"""Beginning of a URL that was taken for a path, which has one of its two slashes."""


class StrictModel(BaseModel):
    """Base of every model read from a file: frozen, and an unknown key is an error.

    Numbers are finite, and neither switches nor days: ``yes`` is not 1, and 5 is not a day of 1970.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="wrap")
    @classmethod
    def _of_their_own_kind(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        found = list(_kind_faults(cls, data)) if isinstance(data, dict) else []
        if not found:
            return handler(data)
        known = {fault.key for fault in found}
        try:
            handler(data)
        except ValidationError as error:
            found += [each for each in faults_below(cls, error) if each.key not in known]
        raise KeyedError.joined(found)

    @model_validator(mode="after")
    def _obey_rules(self, info: ValidationInfo) -> Self:
        """Check the methods marked by `rule`, all of them.

        `validate` gets faults with a whole key in the context's list, so that what is outside of
        this model is checked, too.
        """
        try:
            raise_all(getattr(self, name) for name in _rules(type(self)))
        except KeyedError as error:
            if not isinstance(info.context, list):
                raise
            info.context.extend(fault for fault in error.faults if not fault.below)
            if below := [fault for fault in error.faults if fault.below]:
                raise KeyedError.joined(below) from None
        return self


_Rule = TypeVar("_Rule", bound=Callable[..., Any])


def rule(method: _Rule) -> _Rule:
    """Mark a method of a `StrictModel` that checks several keys together.

    It raises a ValueError (a `KeyedError` names the key), or yields one `KeyedError` a fault. A
    rule that fails does not keep the others of its model from being checked.
    """
    method.__dict__["is_rule"] = True
    return method


@cache
def _rules(model: type[BaseModel]) -> tuple[str, ...]:
    found: dict[str, None] = {}
    for each in reversed(model.__mro__):
        for name, method in vars(each).items():
            if getattr(method, "is_rule", False):
                found.setdefault(name)
    return tuple(found)


def raise_all(checks: Iterable[Callable[[], Any]]) -> None:
    """Make every check, and raise all the faults together that they raise or yield.

    Raises:
        KeyedError: the first fault, with the others.
        ValueError: the only one, where it names no key.
    """
    found: list[ValueError] = []
    for check in checks:
        try:
            made = check()
            for fault in made if isinstance(made, Iterator) else ():
                found.append(fault)  # one by one: those before an error count
        except ValueError as error:
            found.append(error)
        except Exception:
            if not found:  # a check may rely on those before it
                raise
    if len(found) == 1:
        raise found[0]
    if found:
        keyed = [e if isinstance(e, KeyedError) else KeyedError("", None, str(e)) for e in found]
        by_key: dict[str, KeyedError] = {}
        for each in KeyedError.joined(keyed).faults:
            by_key.setdefault(each.key, each)
        raise KeyedError.joined(by_key.values())


def _kind_faults(model: type[BaseModel], data: Mapping[Any, Any]) -> Iterator[KeyedError]:
    for name, value in data.items():
        leaves = _leaves(model).get(name, _NOTHING)
        if bool not in leaves and leaves & _NUMBERS:
            yield from _switches(value, f".{name}")
        if date in leaves and (isinstance(value, int | float | Decimal) or _is_number(value)):
            yield KeyedError(f".{name}", value, "must be a date, such as 2026-11-23")


_NOTHING: frozenset[Any] = frozenset()
_NUMBERS: frozenset[Any] = frozenset({int, float})  # decimals are read separately


@cache
def _leaves(model: type[BaseModel]) -> dict[str, frozenset[Any]]:
    """Plain types that each key may hold, inside lists too; a literal counts by its values."""
    kinds = {}
    for name, field in model.model_fields.items():
        found: set[Any] = set()
        todo: list[Any] = [field.annotation]
        while todo:
            part = todo.pop()
            inner = get_args(part)
            todo += inner
            if not inner:
                found.add(part if isinstance(part, type) else type(part))
        kinds[field.alias or name] = frozenset(found)
    return kinds


def _switches(value: Any, key: str) -> Iterator[KeyedError]:
    if isinstance(value, bool):
        yield KeyedError(key, value, "must be a number")
    if isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _switches(item, f"{key}[{index}]")


def _is_number(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"[+-]?[\d.]+", value.strip()) is not None


ModelT = TypeVar("ModelT", bound=BaseModel)


class YamlDocument(dict[str, Any]):
    """A YAML mapping as read, with the text of each scalar by its key.

    Attributes:
        written: such as ``{"collection.repetitions": "yes"}``, for messages.
        faults: of the text itself; the values of their keys are left out.
    """

    def __init__(
        self,
        data: Mapping[str, Any],
        written: Mapping[str, str],
        faults: Iterable[InputError] = (),
    ) -> None:
        super().__init__(data)
        self.written = dict(written)
        self.faults = tuple(faults)


_ALIAS, _TAG = "!alias", "tag:yaml.org,2002:"
_SPECIAL = {".inf": "Infinity", "+.inf": "Infinity", "-.inf": "-Infinity", ".nan": "NaN"}
_CUT_NUMBER = re.compile(r"[+-]?\d+")
_REST_OF_NUMBER = re.compile(r"\d+(\s*[^\W\d_][\w/%]*|\s*%)?")


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """PyYAML's safe loader as far as nodes; aliases are not followed."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            event = self.get_event()
            return yaml.ScalarNode(_ALIAS, f"*{event.anchor}", event.start_mark, event.end_mark)
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(
                problem=f"nested more than {MAX_DEPTH} deep",
                problem_mark=self.peek_event().start_mark,
            )
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


_LEFT_OUT = object()
"""In place of a value that cannot be read."""


@lru_cache(maxsize=32)
def _composed(text: str) -> Any:
    """Return the root node; the same file is read many times, by a plan, a campaign and a check."""
    loader = _Loader(text)
    try:
        return loader.get_single_node()
    finally:
        loader.dispose()


class _Builder:
    """Plain data from nodes, with the key of whatever is wrong."""

    def __init__(self, path: str | Path) -> None:
        self.written: dict[str, str] = {}
        self.faults: list[InputError] = []
        self._path, self._constructor = path, _Loader("")

    def build(self, node: Any, key: str) -> Any:
        """The data of a node; `key` is its location."""
        try:
            if isinstance(node, yaml.MappingNode) and node.tag == f"{_TAG}map":
                return self._mapping(node, key)
            if isinstance(node, yaml.SequenceNode) and node.tag == f"{_TAG}seq":
                return [self.build(item, f"{key}[{k}]") for k, item in enumerate(node.value)]
            if isinstance(node, yaml.ScalarNode):
                return self._scalar(node, key)
            raise self._wrong(node, key, None, _unread(node.tag))
        except InputError as error:
            self.faults.append(error)
            return _LEFT_OUT

    def _mapping(self, node: Any, key: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        before: Any = None
        for key_node, value_node in node.value:
            try:
                name = self._checked_name(key_node, value_node, key, before)
                inner = f"{key}.{name}" if key else name
                if name in found:
                    raise self._wrong(key_node, inner, None, "cannot be read: duplicate key")
            except InputError as error:
                self.faults.append(error)
                continue
            found[name] = self.build(value_node, inner)
            before = key_node, value_node
        return {name: value for name, value in found.items() if value is not _LEFT_OUT}

    def _checked_name(self, key_node: Any, value_node: Any, key: str, before: Any) -> str:
        if key_node.tag == f"{_TAG}merge":
            text = "cannot be read: merge keys ('<<') are not supported; write the keys out"
            raise self._wrong(key_node, f"{key}.<<" if key else "<<", None, text)
        if _is_rest(key_node, value_node, before):
            last, number = before[0].value, f"{before[1].value},{key_node.value}"
            text = f"has a decimal comma; write {number.replace(',', '.', 1)}"
            raise self._wrong(key_node, f"{key}.{last}" if key else last, number, text)
        return self._name(key_node, key)

    def _name(self, node: Any, key: str) -> str:
        is_text = isinstance(node, yaml.ScalarNode) and node.tag in {f"{_TAG}str", f"{_TAG}value"}
        name = node.value if is_text else None
        if name is None:
            text = "cannot be read: a key must be text; quote it if intended"
            if node.tag == _ALIAS or not node.tag.startswith(_TAG):
                text = _unread(node.tag)
            written = node.value if isinstance(node, yaml.ScalarNode) else None
            raise self._wrong(node, key, written, text)
        return str(name)

    def _scalar(self, node: Any, key: str) -> Any:
        text: str = node.value
        self.written[key] = text
        kind = node.tag.removeprefix(_TAG)
        try:
            if kind == "null":
                return None
            if kind in {"str", "value", "merge"}:
                return text
            if kind == "bool":
                return self._constructor.construct_yaml_bool(node)
            if kind == "int":
                return int(text.replace("_", ""), 10)
            if kind == "float" and ":" not in text:
                plain = text.replace("_", "").lower()
                return Decimal(_SPECIAL.get(plain, plain))
            if kind == "timestamp":
                return self._constructor.construct_yaml_timestamp(node)
        except (ValueError, ArithmeticError, LookupError, AttributeError):
            pass
        if kind == "timestamp":
            expected = "is not a valid date; write one like 2026-02-28"
        elif kind in {"int", "float"} and ":" in text:
            expected = "reads as a base-60 number; quote it or write it out"
        elif kind in {"int", "float", "bool"}:
            words = {"int": "a decimal number", "float": "a number", "bool": "true or false"}
            expected = f"is not {words[kind]}"
        else:
            expected = _unread(node.tag)
        raise self._wrong(node, key, text, expected)

    def _wrong(self, node: Any, key: str, value: object, expected: str) -> InputError:
        if holds_secret(key):
            value, expected = MASK, _SECRET
        return InputError(self._path, key, value, f"{expected} (line {node.start_mark.line + 1})")


_SECRET = "cannot be read as text; quote it"
"""Message about a secret; the parser's own message could contain it."""


def _unread(tag: str) -> str:
    if tag == _ALIAS:
        return "cannot be read: aliases are not supported; write the value out"
    return (
        f"cannot be read: the tag {tag.replace(_TAG, '!!')} is not supported; write the plain value"
    )


def _problem(error: yaml.MarkedYAMLError, text: str) -> str:
    lines = text.splitlines()
    line = "" if error.problem_mark is None else "".join(lines[error.problem_mark.line :][:1])
    return _SECRET if holds_secret(line.partition(":")[0]) else f"cannot be read: {error.problem}"


def _is_rest(key_node: Any, value_node: Any, before: Any) -> bool:
    """Return whether a key is what follows a decimal comma: ``{speed: 2,5 mm/s}``."""
    return (
        before is not None
        and isinstance(key_node, yaml.ScalarNode)
        and isinstance(before[1], yaml.ScalarNode)
        and value_node.value == ""
        and _REST_OF_NUMBER.fullmatch(key_node.value) is not None
        and _CUT_NUMBER.fullmatch(before[1].value) is not None
    )


def read_text(path: Path, what: str) -> str:
    """The text of a small UTF-8 file.

    Raises:
        InputError: missing, no plain file, unreadable, over 1 MiB, or not UTF-8.
    """
    of_one = f"give the path of {'an' if what[0] in 'aeiou' else 'a'} {what}"
    try:
        with open(path, "rb", opener=_at_once) as handle:
            if not stat.S_ISREG(os.fstat(handle.fileno()).st_mode):
                raise InputError(path, "", None, f"is not a regular file; {of_one}")
            data = handle.read(MAX_BYTES + 1)
    except FileNotFoundError:
        near = did_you_mean(path.name, neighbours(path))
        what = "is a URL, not a file" if _URL.match(str(path)) else "no such file"
        raise InputError(path, "", None, f"{what}; {of_one}{near}") from None
    except IsADirectoryError:
        raise InputError(path, "", None, f"is a folder; {of_one}") from None
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise InputError(
            path, "", None, f"is over {MAX_BYTES} bytes; a {what} normally has a few kB"
        )
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
    """Open a file without blocking, even if it is a pipe without a writer."""
    return os.open(path, flags | os.O_NONBLOCK)


def parse_yaml(text: str, path: str | Path) -> YamlDocument:
    """YAML text as a mapping, floats as decimals.

    Raises:
        InputError: not YAML, not a mapping, an alias, a tag, a key twice, nested too deep.
    """
    document = parse_leniently(text, path)
    if document.faults:
        raise InputError.joined(document.faults)
    return document


def parse_leniently(text: str, path: str | Path) -> YamlDocument:
    """YAML text as `parse_yaml` reads it, for `validate`: it raises the document's faults, too.

    Raises:
        InputError: not YAML, not a mapping, nested too deep.
    """
    builder = _Builder(path)
    try:
        node = _composed(text)
        data = None if node is None else builder.build(node, "")
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}"
        raise InputError(path, where, None, _problem(error, text)) from None
    except (yaml.YAMLError, RecursionError) as error:
        raise InputError(path, "", None, f"is not YAML: {error}") from None
    if not isinstance(data, dict):
        if builder.faults:
            raise InputError.joined(builder.faults)
        found = "nothing" if data is None else "a list" if isinstance(data, list) else "one value"
        raise InputError(
            path, "", None, f"holds {found}; it must hold lines of the form key: value"
        )
    return YamlDocument(data, builder.written, builder.faults)


def _withheld(section: str, key: str, of_mapping: bool) -> bool:
    """Return whether a key's value stays out of copies: a secret, or addresses with secrets."""
    own = of_mapping and is_own_name(section, key)
    return (is_secret(key) and not own) or key == "alerts"


def mask_secrets(text: str) -> str:
    """YAML text with the values of secret keys masked, at any depth; the rest stays unchanged."""
    found = sorted(_secret_values(_composed(text)), key=lambda node: -node.start_mark.index)
    for node in found:
        begin, end = node.start_mark.index, node.end_mark.index
        line_end = "\n" if text[begin:end].endswith("\n") else ""
        text = f'{text[:begin]}"{MASK}"{line_end}{text[end:]}'
    return text


def _secret_values(node: Any, section: str = "") -> Iterator[Any]:
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    for key, value in pairs:
        name = key.value if isinstance(key.value, str) else ""
        if _withheld(section, name, isinstance(value, yaml.MappingNode)):
            if value.value not in ("", MASK):
                yield value
        else:
            yield from _secret_values(value, name)
    for item in node.value if isinstance(node, yaml.SequenceNode) else []:
        yield from _secret_values(item)


def without_secrets(data: Any, section: str = "") -> Any:
    """Plain data without the keys that hold secrets, at any depth."""
    if isinstance(data, dict):
        return {
            key: without_secrets(part, key)
            for key, part in data.items()
            if not _withheld(section, key, isinstance(part, dict))
        }
    return [without_secrets(part) for part in data] if isinstance(data, list) else data


def validate(
    model: type[ModelT],
    data: dict[str, Any],
    path: str | Path,
    check: Callable[[ModelT], None] | None = None,
) -> ModelT:
    """`data` as a `model`.

    Args:
        check: what else must hold for the model; raises KeyedError.

    Raises:
        InputError: all that is wrong with it.
    """
    document = data if isinstance(data, YamlDocument) else YamlDocument(data, {})
    if (other := _other_kind(model, data)) is not None:
        wanted = next(iter(model.model_fields))
        raise InputError(path, other, data[other], f"begins a {other} file; give a {wanted} file")
    unread = [fault.key for fault in document.faults]
    found: list[KeyedError] = []
    checked: Sequence[KeyedError] = ()
    made: ModelT | None = None
    try:
        made = model.model_validate(data, context=found)
        if check is not None:
            check(made)
    except ValidationError as error:
        found = [*faults_of(model, error), *found]
    except KeyedError as error:
        checked = error.faults
    except Exception:
        if not found:  # a check may rely on the model's rules
            raise
    by_key: dict[str, InputError] = {fault.key: fault for fault in document.faults}
    for each, value in (
        *((fault, _as_written(document, fault)) for fault in found),
        *((fault, fault.value) for fault in checked),
    ):
        if not any(_due_to(each, key) for key in unread):
            by_key.setdefault(each.key, InputError(path, each.key, value, str(each)))
    if by_key:
        raise InputError.joined(by_key.values())
    assert made is not None
    return made


def _other_kind(model: type[BaseModel], data: dict[str, Any]) -> str | None:
    """Return the kind of a file that was given instead of another one."""
    first = next(iter(data), None)
    return first if first in _KINDS and first not in model.model_fields else None


def _as_written(document: YamlDocument, fault: KeyedError) -> object:
    return fault.value if fault.value is None else document.written.get(fault.key) or fault.value


def _due_to(fault: KeyedError, unread: str) -> bool:
    """Return whether a fault may come from the value at `unread`, which was left out."""
    key, merged = fault.key, unread.removesuffix("<<")
    if merged != unread and str(fault) == MISSING:
        return key.startswith(merged)  # it may be among the merged keys
    return f"{unread}.".startswith(f"{key}.") or f"{unread}[".startswith(f"{key}[")


def load(model: type[ModelT], path: Path, what: str) -> ModelT:
    """The file at `path` read, parsed and checked as a `model`."""
    return validate(model, parse_leniently(read_text(path, what), path), path)


def input_error(file: str | Path, fault: KeyedError) -> InputError:
    """Return a fault, and those that were found with it, as an error of a file."""
    return InputError.joined(
        InputError(file, each.key, each.value, str(each)) for each in fault.faults
    )


class ChosenModel(ABC):
    """Annotation of a field with one of several models, chosen by what is in the value."""

    @abstractmethod
    def choose(self, value: dict[str, Any]) -> type[BaseModel]:
        """Return the model for a mapping. Raises KeyedError, its key below the field's."""

    def read(self, value: Any, info: ValidationInfo) -> BaseModel:
        """Return the settings in `value`. Raises KeyedError."""
        if isinstance(value, BaseModel):
            return value
        if not isinstance(value, dict):
            raise ValueError("must be a mapping (key: value)")
        model = self.choose(value)
        try:
            return model.model_validate(value, context=info.context)
        except ValidationError as error:
            found = faults_below(model, error)
        raise KeyedError.joined(found)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: Callable[[Any], CoreSchema]
    ) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self.read,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda model: model.model_dump(mode="json")
            ),
        )
