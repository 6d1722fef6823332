"""Several arguments that share a line of a docstring are one entry of the reference.

``x, y: columns and rows`` would be read as an argument named ``x,`` of the type ``y``.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

_GROUP = re.compile(r"^(\s+)(\w+(?:, \w+)+):(?=\s)", re.MULTILINE)


class GroupedArguments(Extension):
    """Joins their names by spaces that do not end a name."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite the docstring of whatever has one."""
        if obj.docstring is not None:
            obj.docstring.value = _GROUP.sub(_joined, obj.docstring.value)


def _joined(match: re.Match[str]) -> str:
    return f"{match[1]}{match[2].replace(', ', ',' + chr(0xA0))}:"
