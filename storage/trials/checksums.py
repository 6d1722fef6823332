"""Is a folder what its `checksums.json` says? At a glance, or byte for byte."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from sliplab.storage.errors import own_fault
from sliplab.storage.files import read_json, sha256, write_json
from sliplab.storage.streams import Json
from sliplab.storage.trials.writer import CHECKSUMS, DATA, RECORD

ELSEWHERE = "elsewhere.json"
"""Marks a trial of a mirror: files that it lacks are fetched when they are read."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""Of a file that stands beside its checksums."""


def read_sums(folder: Path, needed: tuple[str, ...] = (DATA, RECORD)) -> Json:
    """The checksums of a folder: by file name, ``sha256`` and ``bytes``.

    Raises:
        ValueError: missing, damaged, or without one of the files that are `needed`; the message
            names the file.
        OSError: this program has no more memory or open files; nothing is known of the file.
    """
    path = folder / CHECKSUMS
    try:
        sums = read_json(path)
    except OSError as error:
        if own_fault(error):
            raise
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    for name, said in sums.items():
        plain = (
            isinstance(said, dict)
            and isinstance(said.get("sha256"), str)
            and type(said.get("bytes")) is int
        )
        if not plain or not _NAME.fullmatch(name):
            raise ValueError(f"{path}: is no list of checksums")
    for name in needed:
        if name not in sums:
            raise ValueError(f"{path}: has no checksum of {name}")
    return sums


def size_problem(path: Path, said: Json) -> str | None:
    """What is wrong with a file without reading it; None when it is there with all its bytes."""
    try:
        found = path.lstat()
    except OSError as error:
        if own_fault(error):
            raise
        return "is missing"
    if not stat.S_ISREG(found.st_mode):
        return "is no plain file"
    if found.st_size != said["bytes"]:
        return f"has {found.st_size} bytes, not {said['bytes']}"
    return None


def byte_problem(path: Path, said: Json) -> str | None:
    """What is wrong with a file, all of it read; None when it is as it was written."""
    problem = size_problem(path, said)
    if problem is None:
        try:
            return None if sha256(path) == said["sha256"] else "does not match its checksum"
        except OSError as error:
            if own_fault(error):
                raise
            return f"cannot be read: {error.strerror}"
    return problem


def partial(folder: Path) -> str | None:
    """Why a trial's folder is not whole, by the sizes of its files; None when it is.

    Bytes that changed in place are found by `storage.trials.verify` only.
    """
    try:
        sums = read_sums(folder)
    except ValueError as error:
        return str(error)
    for name, said in sums.items():
        problem = size_problem(folder / name, said)
        if problem is not None and not to_fetch(folder / name):
            return f"{folder / name}: {problem}"
    return None


def to_fetch(path: Path) -> bool:
    """Whether a file of a trial is not here, but where this store is a mirror of."""
    return not os.path.lexists(path) and (path.parent / ELSEWHERE).is_file()


def write_sums(folder: Path, names: tuple[str, ...]) -> None:
    """Write the checksums of some files of a folder, atomically, if they are not there already."""
    sums = {
        name: {"sha256": sha256(folder / name), "bytes": (folder / name).stat().st_size}
        for name in names
    }
    try:
        if read_json(folder / CHECKSUMS) == sums:
            return
    except (OSError, ValueError):
        pass
    write_json(folder / CHECKSUMS, sums)
