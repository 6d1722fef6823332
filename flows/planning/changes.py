"""What differs between two versions of a protocol or a rig file, for people: key, old, new."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sliplab.protocols.shown import shown

MOST = 12
_MISSING = object()


def differences(old: Any, new: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Key, old and new value of everything that differs, in the order of the keys."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*old, *(name for name in new if name not in old)]:
            inner = f"{key}.{name}" if key else str(name)
            yield from differences(old.get(name, _MISSING), new.get(name, _MISSING), inner)
    elif isinstance(old, list) and isinstance(new, list) and _of_mappings(old, new):
        for index in range(max(len(old), len(new))):
            before, after = (part[index] if index < len(part) else _MISSING for part in (old, new))
            yield from differences(before, after, f"{key}[{index}]")
    elif old != new:
        yield key, _text(old, key), _text(new, key)


def format_differences(old: Any, new: Any, key: str = "") -> str:
    """Format differences, one a line, indented, at most `MOST`; empty if there are none."""
    found = list(differences(old, new, key))
    lines = [f"\n  {name}: {before} -> {after}" for name, before, after in found[:MOST]]
    if len(found) > MOST:
        lines.append(f"\n  and {len(found) - MOST} more")
    return "".join(lines)


def _of_mappings(*lists: list[Any]) -> bool:
    return any(isinstance(item, dict) for part in lists for item in part)


def _text(value: Any, key: str) -> str:
    return "not there" if value is _MISSING or value is None else shown(value, key)
