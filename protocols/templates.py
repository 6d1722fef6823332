"""Motion templates: motions written as data, with parameters in the place of numbers.

A template is a YAML file in `templates/`: the phases of a motion, with ``$name`` in place of a
parameter. A protocol names it and gives the parameters, each a quantity, a word or a factor:

    motion: {template: gravity, depth: 4 mm, distance: 4.2 mm, speed: $speed}

It expands to the motion with its phases written out, and nothing else: ids, hashes and programs are
those of that motion, and a campaign stores the expanded motion, so that no later template changes
what was collected.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.quantity import parse_or_ref
from sliplab.protocols.shipped import shipped_files
from sliplab.protocols.shown import one_of
from sliplab.protocols.yaml_file import StrictModel, load, parse_yaml

FOLDER = Path(__file__).parent / "templates"
KEY = "collection.motion"
_PHASE = re.compile(r"collection\.motion\[(\d+)\]((?:\.\w+)*)")


class TemplateParameter(StrictModel):
    """A parameter of a template: its unit (words have none), and its value if none is given."""

    unit: str | None = None
    default: str | None = None


class Template(StrictModel):
    """A motion with parameters."""

    template: Literal[1]
    parameters: dict[str, TemplateParameter]
    motion: tuple[dict[str, Any], ...]


@cache
def templates() -> dict[str, Template]:
    """Return the templates that ship with the package, by name."""
    return {name: load(Template, path, "template") for name, path in shipped_files(FOLDER).items()}


def expand(motion: Any) -> Any:
    """Return a motion with its phases written out; what names no template stays as it is.

    Raises:
        KeyedError: an unknown template or parameter, one that is missing, or one of another unit.
    """
    if not _uses_template(motion):
        return motion
    template, values = _template_of(motion), {}
    for name in motion:
        if name != "template" and name not in template.parameters:
            close = difflib.get_close_matches(name, template.parameters, n=1)
            hint = f"; did you mean '{close[0]}'?" if close else ""
            known = ", ".join(template.parameters)
            text = f"unknown parameter{hint} (known here: {known})"
            raise KeyedError(f"{KEY}.{name}", motion[name], text)
    for name, parameter in template.parameters.items():
        value = motion.get(name, parameter.default)
        if value is None:
            unit = "a word" if parameter.unit is None else f"in {parameter.unit}"
            text = f"is missing: the template {motion['template']} needs it, {unit}, or a $factor"
            raise KeyedError(f"{KEY}.{name}", None, text)
        if parameter.unit is not None:
            try:
                parse_or_ref(value, parameter.unit)
            except ValueError as error:
                raise KeyedError(f"{KEY}.{name}", value, str(error)) from None
        values[name] = value
    return [_filled(phase, values) for phase in template.motion]


def in_terms_of_template(error: InputError, document: Mapping[str, Any]) -> InputError:
    """Return an error about a phase of a template as one about the parameter used there."""
    collection = document.get("collection")
    motion = collection.get("motion") if isinstance(collection, dict) else None
    if not isinstance(motion, dict) or motion.get("template") not in templates():
        return error
    phases = _template_of(motion).motion

    def parameter(match: re.Match[str]) -> str:
        part: Any = phases[int(match[1])]
        for name in match[2].split(".")[1:]:
            part = part.get(name) if isinstance(part, dict) else None
        if isinstance(part, str) and part.startswith("$"):
            return f"{KEY}.{part[1:]}"
        return f"{KEY}.template"

    key, expected = (_PHASE.sub(parameter, text) for text in (error.key, error.expected))
    return InputError(error.file, key, error.value, expected)


def written_out(text: str, path: str | Path) -> str:
    """Return a protocol's text with the phases of its template in the template's place."""
    motion = parse_yaml(text, path)["collection"]["motion"]
    if not _uses_template(motion):
        return text
    node = _node(_node(yaml.compose(text, Loader=yaml.SafeLoader), "collection"), "motion")
    lines = [json.dumps(phase, ensure_ascii=False) for phase in expand(motion)]
    indent = " " * (node.start_mark.column if node.start_mark.column < 20 else 4)
    block = "[\n" + "".join(f"{indent}  {line},\n" for line in lines) + f"{indent}]"
    begin = node.start_mark.index
    end = begin + len(text[begin : node.end_mark.index].rstrip())
    return f"{text[:begin]}{block}{text[end:]}"


def _node(mapping: Any, key: str) -> Any:
    return next(value for name, value in mapping.value if name.value == key)


def _uses_template(motion: Any) -> bool:
    return isinstance(motion, dict) and "template" in motion


def _template_of(motion: Mapping[str, Any]) -> Template:
    name, known = motion["template"], templates()
    if not isinstance(name, str) or name not in known:
        raise KeyedError(
            f"{KEY}.template",
            name,
            one_of(name, known),
        )
    return known[name]


def _filled(part: Any, values: Mapping[str, Any]) -> Any:
    if isinstance(part, dict):
        return {key: _filled(value, values) for key, value in part.items()}
    return values[part[1:]] if isinstance(part, str) and part.startswith("$") else part
