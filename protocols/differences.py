"""Differences between two versions of plain data, key by key, as text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sliplab.protocols.plan import Plan
from sliplab.protocols.shown import shown

MOST_CHANGES = 12
_MISSING = object()


def comparable_collection(plan: Plan) -> dict[str, Any]:
    """Return the `collection:` section as JSON data, with the enabled levels of each factor.

    Levels compare equal however the file writes them.
    """
    data = plan.collection_data
    for name, factor in (*data["factors"].items(), *data.get("context", {}).items()):
        for key in ("values", "range", "optional"):
            factor.pop(key)
        factor["levels"] = [str(level) for level in plan.enabled[name]]
    return data


def differences(old: Any, new: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield key, old and new value of everything that differs, in the order of the keys."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*old, *(name for name in new if name not in old)]:
            inner = f"{key}.{name}" if key else str(name)
            yield from differences(old.get(name, _MISSING), new.get(name, _MISSING), inner)
    elif isinstance(old, list) and isinstance(new, list) and _of_mappings(old, new):
        for index in range(max(len(old), len(new))):
            before, after = (part[index] if index < len(part) else _MISSING for part in (old, new))
            yield from differences(before, after, f"{key}[{index}]")
    elif old != new:
        yield key, _shown_value(old, key), _shown_value(new, key)


def format_differences(old: Any, new: Any, key: str = "") -> str:
    """Format differences, one a line, indented, at most `MOST_CHANGES`; empty if there are none."""
    found = list(differences(old, new, key))
    lines = [f"\n  {name}: {before} -> {after}" for name, before, after in found[:MOST_CHANGES]]
    if len(found) > MOST_CHANGES:
        lines.append(f"\n  and {len(found) - MOST_CHANGES} more")
    return "".join(lines)


def _of_mappings(*lists: list[Any]) -> bool:
    return any(isinstance(item, dict) for part in lists for item in part)


def _shown_value(value: Any, key: str) -> str:
    if value is _MISSING:
        return "not there"
    return "null" if value is None else shown(value, key)
