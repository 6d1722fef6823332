"""Checksums of a folder's files, and their verification.

A quick check compares sizes; a full check reads every byte.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from sliplab.storage.errors import own_fault
from sliplab.storage.files import read_json, sha256, write_json
from sliplab.storage.streams import Json
from sliplab.storage.trials.superblock import mend

DATA, FRAMES, RECORD = "data.h5", "frames.mkv", "record.json"
SPOOL = "frames.raw"
STREAM_FILE = re.compile(r"stream-(?P<stream>[a-z][a-z0-9_]{0,31})\.(?P<suffix>h5|mkv|raw)")
"""Names of the files of a further camera: its data, its video, its raw frames until encoded."""
CHECKSUMS, PROVENANCE = "checksums.json", "provenance.json"
ELSEWHERE = "elsewhere.json"
"""Marks a trial of a mirror: files that it lacks are fetched when they are read."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def stream_file(name: str, suffix: str = "h5") -> str:
    """Return the name of a file of a further camera's stream, in its trial's folder."""
    return f"stream-{name}.{suffix}"


def is_stream_file(name: str) -> bool:
    """Return whether a file's name is that of a further camera's data or video."""
    found = STREAM_FILE.fullmatch(name)
    return found is not None and found["suffix"] != "raw"


class Checksum(NamedTuple):
    """A file's SHA-256, 64 hex digits, and its size in bytes."""

    sha256: str
    bytes: int

    @staticmethod
    def of(path: Path) -> Checksum:
        """Read a file and return its checksum."""
        return Checksum(sha256(path), path.stat().st_size)

    @staticmethod
    def parse(data: Any) -> Checksum | None:
        """Return the checksum that plain data hold; None if they hold none."""
        if (
            isinstance(data, dict)
            and isinstance(data.get("sha256"), str)
            and type(data.get("bytes")) is int
        ):
            return Checksum(data["sha256"], data["bytes"])
        return None

    def size_problem(self, path: str | Path) -> str | None:
        """Return the fault of a file without reading it; None if it has all its bytes.

        Raises:
            OSError: this program has no more memory or open files; nothing is known of the file.
        """
        try:
            found = os.lstat(path)
        except OSError as error:
            if own_fault(error):
                raise
            return "is missing"
        if not stat.S_ISREG(found.st_mode):
            return "is not a regular file"
        if found.st_size != self.bytes:
            return f"has {found.st_size} bytes, not {self.bytes}"
        return None

    def problem(self, path: Path) -> str | None:
        """Read a file and return its fault; None if it is unchanged.

        An HDF5 file that a program left open, and that is otherwise as it was written, is closed.

        Raises:
            OSError: as `size_problem`.
        """
        if (problem := self.size_problem(path)) is not None:
            return problem
        try:
            if sha256(path) == self.sha256:
                return None
            why = ""
            try:
                if mend(path, self.sha256):
                    return None
            except OSError as error:
                if own_fault(error):
                    raise
                why = f": was left open by another program, and cannot be closed: {error.strerror}"
            return f"does not match its checksum{why}"
        except OSError as error:
            if own_fault(error):
                raise
            return f"cannot be read: {error.strerror}"


Checksums = dict[str, Checksum]
"""Checksums of the files of one folder, by name."""
Fetch = Callable[[Path, Checksum], None]
"""Brings a missing file of a mirrored trial, checked against its checksum."""


def read_sums(folder: Path, needed: Iterable[str] = (DATA, RECORD)) -> Checksums:
    """Read the checksums of a folder's files.

    Raises:
        ValueError: missing, damaged, or without one of the files that are `needed`; the message
            names the file.
        OSError: as `Checksum.size_problem`.
    """
    path = folder / CHECKSUMS
    try:
        data = read_json(path)
    except OSError as error:
        if own_fault(error):
            raise
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    sums = {}
    for name, item in data.items():
        found = Checksum.parse(item)
        if found is None or not _NAME.fullmatch(name):
            raise ValueError(f"{path}: is not a list of checksums")
        sums[name] = found
    for name in needed:
        if name not in sums:
            raise ValueError(f"{path}: has no checksum of {name}")
    return sums


def as_json(sums: Checksums) -> Json:
    """Return checksums as plain data, as they are in files."""
    return {name: known._asdict() for name, known in sums.items()}


def write_sums(folder: Path, names: Iterable[str]) -> None:
    """Write the checksums of some files of a folder, atomically, unless they are there already."""
    sums = as_json({name: Checksum.of(folder / name) for name in names})
    try:
        if read_json(folder / CHECKSUMS) == sums:
            return
    except (OSError, ValueError):
        pass
    write_json(folder / CHECKSUMS, sums)


def incomplete(folder: Path, sums: Checksums | None = None) -> str | None:
    """Return why a trial's folder is incomplete, by the sizes of its files; None if complete.

    Bytes that changed in place are found by `storage.trials.verify` only.

    Args:
        sums: its checksums, where they were read before.
    """
    try:
        sums = read_sums(folder) if sums is None else sums
    except ValueError as error:
        return str(error)
    for name, known in sums.items():
        problem = known.size_problem(os.path.join(folder, name))  # no Path: asked of every trial
        if problem is not None and not to_fetch(folder / name):
            return f"{folder / name}: {problem}"
    return None


def to_fetch(path: Path) -> bool:
    """Return whether a trial's file is missing here because this store is a mirror."""
    return not os.path.lexists(path) and (path.parent / ELSEWHERE).is_file()
