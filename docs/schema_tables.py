"""The keys of a file or document as tables, made from its JSON Schema."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Schema = dict[str, Any]


def tables(root: Schema, models: dict[str, Schema]) -> str:
    """One section a model, in the order in which a file has them.

    Args:
        root: the model of the whole file; models: all others, by name.
    """
    lines: list[str] = []
    for path, model in _sections("", root, models):
        title = path or "The file"
        lines += [f"## {title} {{ #{_anchor(path)} }}", "", model.get("description", ""), ""]
        lines += ["| key | value | default | meaning |", "| --- | --- | --- | --- |"]
        needed = model.get("required", [])
        for key, field in model.get("properties", {}).items():
            default = "needed" if key in needed else _default(field)
            cells = (
                f"`{key}`",
                _value(field, f"{path}.{key}", models),
                default,
                _meaning(field, models),
            )
            lines.append("| " + " | ".join(_cell(cell) for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def _sections(path: str, model: Schema, models: dict[str, Schema]) -> Iterator[tuple[str, Schema]]:
    yield path, model
    for key, field in model.get("properties", {}).items():
        below = f"{path}.{key}".lstrip(".")
        for place, inner in _models_in(field, below, models):
            yield from _sections(place, inner, models)


def _models_in(part: Schema, path: str, models: dict[str, Schema]) -> Iterator[tuple[str, Schema]]:
    """The models that stand in a field, each with the place it has in the file."""
    if "$ref" in part:
        yield path, models[part["$ref"].rsplit("/", 1)[1]]
    arms = [arm for word in ("anyOf", "oneOf", "allOf") for arm in part.get(word, [])]
    several = sum("$ref" in arm for arm in arms) > 1
    for arm in arms:
        for place, model in _models_in(arm, path, models):
            yield (f"{place} {_tag(model)}" if several else place), model
    if isinstance(part.get("items"), dict):
        yield from _models_in(part["items"], f"{path}[]", models)
    if isinstance(part.get("additionalProperties"), dict):
        yield from _models_in(part["additionalProperties"], f"{path}.NAME", models)


def _tag(model: Schema) -> str:
    """The value that selects this model in a file: ``slide``, ``basler``; else its title."""
    tags = (str(field["const"]) for field in model["properties"].values() if "const" in field)
    return next(tags, str(model.get("title", "")))


def _anchor(path: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in path).lower() or "file"


def _value(part: Schema, path: str, models: dict[str, Schema]) -> str:
    path = path.lstrip(".")
    below = list(_models_in(part, path, models))
    if below:
        links = [f"[{_short(place)}](#{_anchor(place)})" for place, _ in below]
        kinds = {"array": "list of ", "object": "by name: "}
        empty = " or `null`" if _may_be_null(part) else ""
        return kinds.get(part.get("type", ""), "") + ", ".join(links) + empty
    if "const" in part:
        return f"`{part['const']}`"
    if "enum" in part:
        return ", ".join(f"`{_yaml(item)}`" for item in part["enum"])
    if "anyOf" in part:
        return " or ".join(dict.fromkeys(_value(arm, path, models) for arm in part["anyOf"]))
    kind = part.get("type", "")
    if kind == "array" and isinstance(part.get("items"), list):
        inner = " or ".join(dict.fromkeys(_value(item, path, models) for item in part["items"]))
        return f"list of {len(part['items'])}: {inner}"
    if kind == "array":
        return f"list of: {_value(part.get('items', {}), path, models)}"
    if kind == "object":
        inner = part.get("additionalProperties")
        return f"by name: {_value(inner, path, models)}" if isinstance(inner, dict) else "mapping"
    if kind in {"integer", "number"}:
        return {"integer": "whole number", "number": "number"}[kind] + _bounds(part)
    if kind == "string" and part.get("pattern", "").startswith("^\\$"):
        return "`$factor`"
    if part.get("format") == "date":
        return "date, as `2026-11-30`"
    if kind == "string" and "examples" in part:
        return f"as `{part['examples'][0]}`"
    return {"boolean": "`true`, `false`", "null": "`null`", "string": "text"}.get(kind, "")


def _may_be_null(part: Schema) -> bool:
    return any(arm.get("type") == "null" for arm in part.get("anyOf", []))


def _bounds(part: Schema) -> str:
    words = {"minimum": "from", "exclusiveMinimum": "above"}
    words |= {"maximum": "to", "exclusiveMaximum": "below"}
    said = [
        f"{word} {part[key]:,}"
        for key, word in words.items()
        if key in part and abs(part[key]) < 2**63  # else it only says that it has 64 bits
    ]
    return f", {' '.join(said)}" if said else ""


def _default(field: Schema) -> str:
    return f"`{_yaml(field['default'])}`" if "default" in field else ""


def _yaml(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, list):
        return "[" + ", ".join(_yaml(item) for item in value) + "]"
    return str(value) if value != "" else "''"


def _meaning(field: Schema, models: dict[str, Schema]) -> str:
    text = str(field.get("description", ""))
    below = list(_models_in(field, "", models))
    if not text and len(below) == 1:
        text = str(below[0][1].get("description", ""))
    return text


def _short(path: str) -> str:
    return path.rsplit(".", 1)[-1]


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
