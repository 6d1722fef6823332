"""The protocol files that ship with the package, by name."""

from __future__ import annotations

from pathlib import Path

from sliplab.protocols.errors import InputError


def shipped_protocols() -> dict[str, Path]:
    """The protocol files that ship with the package, by name."""
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.yaml"))}


def protocol_path(given: Path) -> Path:
    """The file that a person means: a path, or the name of a shipped protocol.

    Raises:
        InputError: a bare name that is neither.
    """
    if len(given.parts) != 1 or given.suffix or given.exists():
        return given
    known = shipped_protocols()
    if (name := given.name.replace("-", "_")) in known:
        return known[name]
    names = ", ".join(known)
    text = f"no such file, nor a protocol that ships with SlipLab: {names}"
    raise InputError(str(given), "", None, text)
