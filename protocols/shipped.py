"""Files that ship with a package and are found by name: protocols here, rigs in their package."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path

from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import did_you_mean


def shipped_files(folder: Path) -> dict[str, Path]:
    """The YAML files of a folder, by name."""
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def find_shipped(given: Path, known: dict[str, Path]) -> Path | None:
    """Return the file named by the user: a path, or a bare name among `known`; None for neither.

    A hyphen in the name is an underscore in the file's.
    """
    # os.path: a name that is too long is no file, where pathlib raises an error
    if len(given.parts) != 1 or given.suffix or os.path.isfile(given):
        return given
    named = known.get(given.name.replace("-", "_"))
    return given if named is None and os.path.exists(given) else named  # reading fails on a folder


def shipped_protocols() -> dict[str, Path]:
    """The protocol files that ship with the package, by name."""
    return shipped_files(Path(__file__).parent)


def protocol_path(given: Path) -> Path:
    """Return the file named by the user: a path, or the name of a shipped protocol.

    Raises:
        InputError: a bare name that is neither.
    """
    if (found := find_shipped(given, known := shipped_protocols())) is not None:
        return found
    text = f"no such file, and no built-in protocol of this name; built-in: {', '.join(known)}"
    near = did_you_mean(given.name, [*known, *neighbours(given)])
    raise InputError(str(given), "", None, f"{text}{near}")


def neighbours(given: Path, most: int = 1000) -> list[str]:
    """Return up to `most` names in a path's folder, to suggest the nearest to a missing one."""
    try:
        with os.scandir(given.parent) as entries:
            return sorted(each.name for each in islice(entries, most))
    except OSError:
        return []
