"""Inheritance of rig files: `extends: mock`, overridden by the file's own keys.

A rehearsal's rig file differs from the real rig's by a line or two; full copies would diverge. The
merged content, which is self-contained, is stored with the data.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import yaml

from sliplab.protocols.errors import InputError
from sliplab.protocols.shipped import find_shipped, neighbours, shipped_files
from sliplab.protocols.shown import did_you_mean
from sliplab.protocols.yaml_file import YamlDocument, parse_leniently, read_text

KEY = "extends"
_DEEPEST = 8


@dataclass(frozen=True)
class RigSource:
    """A rig file as read, with the files that it extends."""

    path: Path
    data: YamlDocument
    """Merged content."""
    text: str
    """The file's own text if it extends nothing, else the merged content as YAML."""
    parts: tuple[tuple[Path, YamlDocument], ...]
    """Each file with its own keys, the requested one first."""

    def blame(self, key: str) -> Path:
        """Return the file that sets `key`, the first one where none does."""
        path = _path(key)
        deepest = max(_depth(data, path) for _, data in self.parts)
        return next(file for file, data in self.parts if _depth(data, path) == deepest)

    def placed(self, fault: InputError) -> InputError:
        """Return a fault with its file: the one that was written last of the keys that it names."""
        files, blamed = [file for file, _ in self.parts], self.blame(fault.key)
        for name in re.findall(r"(\w[\w.]*) = ", fault.expected):
            for key in (name, f"{fault.key.rpartition('.')[0]}.{name}"):
                file, path = self.blame(key), _path(key)
                if _depth(self.data, path) == len(path) and files.index(file) < files.index(blamed):
                    value: Any = self.data
                    for part in path:
                        value = value[part]
                    text = f"contradicts {blamed}: {fault.key} = {fault.value}: {fault.expected}"
                    return InputError(file, key, value, text)
        return fault.replaced(file=str(blamed))


def shipped_rigs() -> dict[str, Path]:
    """The rig files that ship with the package, by name."""
    return shipped_files(Path(__file__).parent)


def rig_path(given: Path) -> Path:
    """Resolve a path, or the name of a shipped rig, to a file.

    Raises:
        InputError: neither exists.
    """
    if (found := find_shipped(given, known := shipped_rigs())) is not None:
        return found
    near = did_you_mean(given.name, [*known, *neighbours(given)])
    text = f"no such file, and not one of the shipped rigs: {', '.join(known)}{near}"
    raise InputError("--rig", "", str(given), text)


def read_rig(path: Path) -> RigSource:
    """Read a rig file and merge the files that it extends, without validation.

    Mappings are merged key by key; everything else is replaced as a whole, and so is a device's
    section that names another driver.

    Raises:
        InputError: a file cannot be read, extends itself, or has a chain of more than 8 files.
    """
    parts: list[tuple[Path, YamlDocument]] = []
    text, here = read_text(path, "rig file"), path
    own = text
    while True:
        data = parse_leniently(own, here)
        parent = data.pop(KEY, None)
        parts.append((here, data))
        if parent is None:
            break
        if not isinstance(parent, str) or "\0" in parent:
            raise InputError(here, KEY, parent, "must be the path of a rig file")
        there = _parent_file(here, parent)
        if not os.path.exists(there):  # pathlib raises for a name that is too long
            known = shipped_rigs()
            near = did_you_mean(there.stem, known) or did_you_mean(there.name, neighbours(there))
            text = f"no such file, nor a shipped rig ({', '.join(known)}){near}"
            raise InputError(here, KEY, parent, text)
        if any(_same(there, file) for file, _ in parts) or len(parts) == _DEEPEST:
            raise InputError(here, KEY, parent, "is circular, or a chain of more than 8 files")
        try:
            own = read_text(there, "rig file")
        except InputError as error:
            raise InputError(here, KEY, parent, error.expected) from None
        here = there
    merged: dict[str, Any] = {}
    for _, data in reversed(parts):
        merged = _merge(merged, data)
    faults = [fault for _, data in parts for fault in data.faults]
    if len(parts) > 1 and not faults:  # items left out in a list have no form
        names = " on ".join(file.name for file, _ in parts)
        text = f"# Merged: {names}\n" + rig_yaml(merged)
    written = {key: each for _, data in reversed(parts) for key, each in data.written.items()}
    return RigSource(path, YamlDocument(merged, written, faults), text, tuple(parts))


def _parent_file(here: Path, parent: str) -> Path:
    """Return the file that `extends` names: a path from the file's folder, or a shipped rig.

    Shipped rigs name each other as files, and so does a copy of one elsewhere.
    """
    there = here.parent / parent
    if os.path.exists(there) and not _same(there, here):
        return there
    return shipped_rigs().get(parent.removesuffix(".yaml").replace("-", "_"), there)


def rig_yaml(data: dict[str, Any]) -> str:
    """Serialise a rig file's content as YAML."""
    text: str = yaml.dump(dict(data), Dumper=_Dumper, sort_keys=False)
    return text


def _same(a: Path, b: Path) -> bool:
    return a.resolve() == b.resolve()


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        known = merged.get(key)
        if isinstance(known, dict) and isinstance(value, dict):
            # a section for another driver has other settings
            other = "driver" in value and value["driver"] != known.get("driver")
            merged[key] = value if other else _merge(known, value)
        else:
            merged[key] = value
    return merged


def _path(key: str) -> list[str]:
    """Return the parts of a key."""
    return re.findall(r"[^.\[\]]+", key)


def _depth(data: Any, path: list[str]) -> int:
    """Return the number of leading parts of a key that exist in `data`."""
    for depth, part in enumerate(path):
        if isinstance(data, dict) and part in data:
            data = data[part]
        elif isinstance(data, list) and part.isdigit() and int(part) < len(data):
            data = data[int(part)]
        else:
            return depth
    return len(path)


class _Dumper(yaml.SafeDumper):
    """A dumper that preserves the digits of numbers."""


def _number(dumper: _Dumper, value: Decimal) -> Any:
    if not value.is_finite():
        text = ".nan" if value.is_nan() else ".inf" if value > 0 else "-.inf"
    else:
        text = format(value, "f")
        text = text if "." in text else text + ".0"
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


_Dumper.add_representer(Decimal, _number)
