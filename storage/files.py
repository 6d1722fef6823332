"""Writing files so that after a crash each one is whole or absent.

Every write in the project goes through here: a temporary file beside the target, flushed to the
disk, then renamed over it, then the folder flushed too. In a folder that is still aside and becomes
visible by a rename of its own, files are only flushed.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from functools import cache
from pathlib import Path
from typing import Any

_BLOCK = 1 << 20


def disk_full(error: BaseException | None) -> bool:
    """Whether `error`, or what caused it, is a disk or a quota without room."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT}:
            return True
        error = error.__cause__
    return False


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_file(path: Path) -> None:
    """Flush a file that somebody else wrote to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `path` atomically; its folder must exist."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with temporary.open("wb") as handle:
            handle.write(data)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically, keys sorted, one a line.

    Raises:
        ValueError: a NaN or an infinity, which JSON has no word for.
    """
    write_text(path, _json_text(data))


def write_json_aside(path: Path, data: Any) -> None:
    """Write JSON in a folder that nobody looks into yet: flushed, neither atomic nor its entry.

    Whoever makes the folder visible flushes its entries before.

    Raises:
        ValueError: as `write_json`.
    """
    with path.open("wb") as handle:
        handle.write(_json_text(data).encode())
        handle.flush()
        os.fsync(handle.fileno())


def _json_text(data: Any) -> str:
    return _indented(data, 0) + "\n"


def _indented(data: Any, depth: int) -> str:
    """JSON with one space a level: `json` itself does without its fast encoder where it indents."""
    if not isinstance(data, dict | list | tuple) or not data:
        return _encoder(depth).encode(data)
    parts = data.values() if isinstance(data, dict) else data
    margin = "\n" + " " * depth
    if not any(isinstance(part, dict | list | tuple) for part in parts):
        text = _encoder(depth + 1).encode(data)
        return f"{text[0]}{margin} {text[1:-1]}{margin}{text[-1]}"
    if isinstance(data, dict):
        # what a key looks like is for `json` to say: it may be a number
        items = (
            f"{_encoder(0).encode({key: 0})[1:-1].removesuffix('0')}{_indented(part, depth + 1)}"
            for key, part in sorted(data.items())
        )
        return "{" + margin + " " + f",{margin} ".join(items) + margin + "}"
    inside = f",{margin} ".join(_indented(part, depth + 1) for part in data)
    return f"[{margin} {inside}{margin}]"


@cache
def _encoder(depth: int) -> json.JSONEncoder:
    """Of what holds nothing nested."""
    return json.JSONEncoder(
        sort_keys=True, allow_nan=False, ensure_ascii=False,
        separators=(",\n" + " " * depth, ": "),
    )  # fmt: skip


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        ValueError: not JSON, or not an object; the message names the file.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: is not JSON: {error}") from None
    if not isinstance(data, dict):
        raise ValueError(f"{path}: holds no JSON object")
    return data


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, 64 hex digits."""
    digest = hashlib.sha256()
    with path.open("rb") as handle:
        while block := handle.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()
