"""Is what came out of a pickle a value that may be walked through? Found without recursion."""

from __future__ import annotations

from typing import Any

import numpy as np

from sliplab.storage.exchange.pickle_numpy import Refused

MAX_DEPTH = 32
PLAIN = (type(None), bool, int, float, str, bytes)
_KINDS = frozenset(PLAIN)


def check_depth(found: Any) -> None:
    """Refuse what holds itself, lies deeper than `MAX_DEPTH`, or is no value, without recursion."""
    heights: dict[int, int] = {}  # of what was looked through; -1 while it is
    leaves: set[int] = set()  # lists without containers; most are
    waiting = [found]
    while waiting:
        here = waiting[-1]
        inside = _inside(here, leaves)
        known = heights.get(id(here))
        if known is None:
            heights[id(here)] = -1
            fresh = [item for item in inside if id(item) not in heights]
            if any(heights.get(id(item)) == -1 for item in inside):
                raise Refused("a container that holds itself")
            waiting += fresh
            if fresh:
                continue
        waiting.pop()
        if known is None or known == -1:
            heights[id(here)] = height = 1 + max((heights[id(i)] for i in inside), default=0)
            if height > MAX_DEPTH:
                raise Refused(f"containers more than {MAX_DEPTH} deep")


def _inside(value: Any, leaves: set[int]) -> list[Any]:
    """The containers in a value that hold containers themselves, or may do so."""
    if isinstance(value, np.ndarray):
        items: Any = value.ravel().tolist() if value.dtype.hasobject else ()
    elif isinstance(value, dict):
        items = value.values()
    elif isinstance(value, list | tuple):
        items = value
    elif isinstance(value, PLAIN):
        return []
    else:
        raise Refused(f"something that is no value ({type(value).__name__})")
    found = []
    for item in items:
        kind = type(item)
        if kind in _KINDS or (kind is list and id(item) in leaves):
            continue
        if kind is list and _KINDS.issuperset(map(type, item)):
            leaves.add(id(item))
        else:
            found.append(item)
    return found
