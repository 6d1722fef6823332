"""Atomic file writes: after a crash each file is complete or absent.

Every write in the project goes through here: a temporary file in the target's folder is flushed to
the disk and renamed over the target, then the folder is flushed as well. In a folder that becomes
visible by its own rename, files are only flushed.

A killed program may leave a temporary file. Its name contains the process (`.NAME.PID.tmp`), so
that `sweep_temporary` can delete the files of dead processes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import threading
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from sliplab.storage.errors import StoreError
from sliplab.storage.interrupts import uninterrupted

_BLOCK = 1 << 20
_TEMPORARY = re.compile(r"\..*\.(\d+)\.tmp")
_NAME_BYTES = 200
"""Bytes of a target's name in that of its temporary file; a file's name has at most 255."""
_SAFE = re.compile(r"[A-Za-z0-9][A-Za-z0-9=,._+-]{0,250}")


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


def make_folder(folder: Path) -> None:
    """Make a folder and what is missing above it, and flush each one's entry to the disk."""
    missing = [folder]
    while not missing[-1].parent.is_dir():
        missing.append(missing[-1].parent)
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)


def write_bytes(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Write `path` atomically; its folder must exist.

    Args:
        mode: of the file from its first moment on, less what the user's mask takes away.
    """
    write_blocks(path, (data,), mode)


@uninterrupted
def write_blocks(path: Path, blocks: Iterable[bytes], mode: int = 0o666) -> None:
    """Write the `blocks` to `path` atomically; its folder must exist.

    An error of `blocks` leaves `path` as it was. Where they take long, their generator is
    `interrupts.interruptible`.

    Args:
        mode: as `write_bytes`.
    """
    name = os.fsencode(path.name)[:_NAME_BYTES].decode(errors="ignore")
    temporary = path.with_name(f".{name}.{os.getpid()}.tmp")
    try:
        temporary.unlink(missing_ok=True)  # of another mode, or a link
        with open(temporary, "xb", opener=lambda name, how: os.open(name, how, mode)) as handle:
            for block in blocks:
                handle.write(block)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def read_blocks(path: Path) -> Iterator[bytes]:
    """Yield a file's bytes, a megabyte at a time."""
    with path.open("rb") as handle:
        while block := handle.read(_BLOCK):
            yield block


@uninterrupted
def write_new_json(path: Path, data: Any) -> bool:
    """Write JSON, complete and flushed, under a name that is free.

    Returns:
        False if the name was taken; nothing was changed then.

    Raises:
        ValueError: as `write_json`.
    """
    temporary = path.with_name(f".{path.name}.{threading.get_ident()}.{os.getpid()}.tmp")
    try:
        write_json_aside(temporary, data)
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError:  # a file system without hard links
            if path.exists():
                return False
            os.rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)
    return True


def temporary_files(folder: Path) -> Iterator[tuple[Path, bool]]:
    """Yield temporary files in a folder, each with whether its program still runs."""
    if not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        if (found := _TEMPORARY.fullmatch(path.name)) and path.is_file():
            yield path, _runs(int(found[1]))


def sweep_temporary(folder: Path) -> int:
    """Delete temporary files that a killed program left in a folder; return their number."""
    left = [path for path, runs in temporary_files(folder) if not runs]
    for path in left:
        path.unlink(missing_ok=True)
    return len(left)


def _runs(pid: int) -> bool:
    if pid == os.getpid():
        return False  # asked between two writes of ours: it is of another with this number
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically, keys sorted, one a line.

    Raises:
        ValueError: a NaN or an infinity, which JSON has no word for.
    """
    write_text(path, json_text(data))


def write_json_aside(path: Path, data: Any) -> None:
    """Write JSON, flushed but not atomic, in a folder that is not visible yet.

    Whoever makes the folder visible flushes its entries before.

    Raises:
        ValueError: as `write_json`.
    """
    with path.open("wb") as handle:
        handle.write(json_text(data).encode())
        handle.flush()
        os.fsync(handle.fileno())


def json_text(data: Any) -> str:
    """Format JSON as it is written: keys sorted, one a line.

    Raises:
        ValueError: as `write_json`.
    """
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
    """Return the encoder of values without nested ones."""
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
        data = json.loads(
            path.read_text(encoding="utf-8"), parse_constant=_no_number, parse_float=_finite
        )
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not JSON: {error}") from None
    if not isinstance(data, dict):
        raise ValueError(f"{path}: does not contain a JSON object")
    return data


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not a JSON number")


def _finite(text: str) -> float:
    """Digits that are beyond every float would become an infinity, which no JSON file may hold."""
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"{text} is out of range for a number")
    return value


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, 64 hex digits."""
    digest = hashlib.sha256()
    for block in read_blocks(path):
        digest.update(block)
    return digest.hexdigest()


def safe_name(name: str) -> str:
    """Return `name` if it is a plain file name.

    Raises:
        StoreError: it could lead out of its folder.
    """
    if not _SAFE.fullmatch(name) or ".." in name:
        raise StoreError(f"'{name}' cannot be the name of a folder in a store")
    return name


def inside(path: Path, store: Path) -> Path:
    """Return `path`, if no link on the way to it leads out of the store's folder.

    Raises:
        StoreError: one does.
    """
    if not path.resolve().is_relative_to(store.resolve()):
        raise StoreError(f"{path}: a link points out of the store; replace it by a real folder")
    return path
