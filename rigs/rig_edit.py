"""Writes measurements into a rig file: comments are preserved, and the old file is backed up.

The new text is validated as a rig file before it replaces the old one atomically.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import parse_yaml, read_text, validate
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.rig_inheritance import KEY, read_rig, shipped_rigs
from sliplab.storage.files import write_bytes, write_text

_WIDEST = 1 << 20
"""Line width, so large that no line is folded."""


@dataclass(frozen=True)
class Written:
    """The written file, and the copy of the previous one."""

    path: Path
    retained: Path | None


def writable_target(rig: Path, out: Path | None) -> Path:
    """Return the file to write an entry to: `out`, or the rig file itself.

    Raises:
        InputError: that file ships with the package, `out` is not a YAML file or lies in a store,
            or its folder does not exist.
    """
    target = out or rig
    if any(path.resolve() == target.resolve() for path in shipped_rigs().values()):
        raise InputError(
            "--out",
            "",
            None if out is None else str(out),
            f"is needed: {target.name} ships with SlipLab and is never overwritten; "
            "write to a file of your own",
        )
    if target.suffix.lower() not in {".yaml", ".yml"}:
        raise InputError("--out" if out else rig, "", str(target), "must end in .yaml")
    if not target.parent.is_dir():
        raise InputError("--out", "", str(target), "its folder does not exist")
    if target.exists() and target.resolve() != rig.resolve():
        raise InputError("--out", "", str(target), "exists: give it as --rig, or use another name")
    if out is not None:
        from sliplab.storage.trials.catalogue import refuse_store_file

        refuse_store_file(out, "--out")
    return target.resolve()


def write_entries(
    rig: Path,
    target: Path,
    changes: Mapping[str, Any],
    *,
    today: date,
    remove: Sequence[str] = (),
    expected: str | None = None,
) -> Written:
    """Set keys of a rig file.

    Args:
        rig: the file to start from.
        target: the file to write; see `writable_target`.
        changes: values by dotted key, such as ``calibration.lens``; mappings replace the old ones.
        today: the day in the name of the old file's copy.
        remove: keys to remove where present.
        expected: the rig's content as it was read before measuring (`load_rig_file`).

    Raises:
        InputError: the rig file has changed since, or the result would not be a valid rig file.
    """
    source = read_rig(rig)
    if expected is not None and source.text != expected:
        raise InputError(rig, "", None, "was changed while measuring; nothing was written")
    text = read_text(rig, "rig file")
    own, changes = parse_yaml(text, rig), dict(changes)
    for key in remove:
        if _has_key(source.data, key) and not _has_key(own, key):
            changes[key] = None  # the key comes from a file that this one extends
    if rig.parent.resolve() != target.parent.resolve() and KEY in own:
        text = source.text  # in another folder, `extends` would not find its file
    new = edited(text, changes, remove)
    _check(rig, target, new)
    retained = keep_old(target, today)
    write_text(target, new)
    return Written(target, retained)


def edited(text: str, changes: Mapping[str, Any], remove: Sequence[str] = ()) -> str:
    """Set or remove keys in YAML text; comments and everything else are preserved.

    Lists of numbers and strings are written on one line.
    """
    yaml = _yaml()
    data = yaml.load(text)
    for key in remove:
        *parents, last = key.split(".")
        found: Any = data
        for part in parents:
            found = found.get(part) if isinstance(found, CommentedMap) else None
        if isinstance(found, CommentedMap) and last in found:
            del found[last]
    for key, value in changes.items():
        *parents, last = key.split(".")
        here = data
        for part in parents:
            if not isinstance(here.get(part), CommentedMap):
                here[part] = CommentedMap()
            here = here[part]
        _put(here, last, value)
    stream = io.StringIO()
    yaml.dump(data, stream)
    return stream.getvalue()


def _has_key(data: Any, key: str) -> bool:
    for part in key.split("."):
        if not isinstance(data, dict) or data.get(part) is None:
            return False
        data = data[part]
    return True


def _put(here: CommentedMap, key: str, value: Any) -> None:
    """Set one key; an existing mapping keeps its position and its comments.

    A new key goes before the last one: a comment or an empty line after a mapping belongs to its
    last key, and would end up in the middle.
    """
    there = here.get(key)
    if isinstance(value, Mapping) and isinstance(there, CommentedMap):
        for old in [name for name in there if name not in value]:
            del there[old]
        for name, item in value.items():
            _put(there, name, item)
    elif key in here or not here:
        here[key] = _plain(value)
    else:
        here.insert(len(here) - 1, key, _plain(value))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        result = CommentedMap()
        for key, item in value.items():
            result[key] = _plain(item)
        return result
    if isinstance(value, list | tuple):
        items = CommentedSeq([_plain(item) for item in value])
        items.fa.set_flow_style()
        return items
    if isinstance(value, float):
        return round(value, 6)
    return value


def _check(rig: Path, target: Path, text: str) -> None:
    """Check that `text` would be a valid rig file at `target`."""
    draft = target.with_name(f".{target.name}.new")
    write_text(draft, text)
    try:
        validate(RigFile, read_rig(draft).data, draft)
    except InputError as error:
        raise InputError(
            target, error.key, error.value, f"{error.expected}; {rig} is unchanged"
        ) from None
    finally:
        draft.unlink(missing_ok=True)


def keep_old(path: Path, today: date) -> Path | None:
    """Copy `path`, if it exists, to a file next to it that is named after the day; return that."""
    if not path.exists():
        return None
    number, data = 1, path.read_bytes()
    while True:
        more = f"-{number}" if number > 1 else ""
        copy = path.with_name(f"{path.stem}.before-{today.isoformat()}{more}{path.suffix}")
        if not copy.exists():
            break
        number += 1
    write_bytes(copy, data)
    return copy


def _yaml() -> YAML:
    yaml = YAML()
    yaml.representer.add_representer(
        type(None), lambda dumper, _: dumper.represent_scalar("tag:yaml.org,2002:null", "null")
    )
    yaml.preserve_quotes = True
    yaml.width = _WIDEST
    yaml.indent(mapping=2, sequence=4, offset=2)
    return yaml
