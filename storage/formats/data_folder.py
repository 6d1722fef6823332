"""The files of a foreign data set: below a folder, or inside a ``.zip`` that is read in place.

Nothing outside of it is ever read: names that lead out are left out, and links are not followed.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile, ZipInfo

from sliplab.protocols.errors import InputError
from sliplab.protocols.file_pattern import FilePattern
from sliplab.protocols.recorded import natural
from sliplab.storage.files import scratch_folder
from sliplab.storage.formats.foreign import Skipped
from sliplab.storage.formats.numpy_files import unpacked

MOST_FILES = 2_000_000
MOST_BYTES = 1 << 31
"""The most that is unpacked of one file in a zip."""


class DataFolder:
    """Files by their paths with ``/``, in natural order.

    Attributes:
        path: the folder, ``.zip`` or single file.
        names: paths of the files.
        skipped: links, hidden files, and entries that are no files.
    """

    def __init__(self, path: Path) -> None:
        """List the files. Raises InputError: there is nothing, or a zip that cannot be read."""
        self.path = path
        self.skipped: list[Skipped] = []
        self._zip: ZipFile | None = None
        self._items: dict[str, ZipInfo] = {}
        self._folder = path
        try:
            if path.is_dir():
                found = list(self._walk(""))
            elif not path.is_file():
                raise InputError(path, "", None, "no such file or folder")
            elif path.suffix.lower() == ".zip":
                found = self._unzipped()
            else:
                self._folder, found = path.parent, [path.name]
        except OSError as error:
            raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
        self.names = tuple(sorted(found, key=natural))
        self._there = frozenset(found)

    @cached_property
    def root(self) -> str:
        """The folder's own name, or the zip's."""
        return (self._folder.resolve() if self._zip is None else self.path).name

    def _walk(self, below: str) -> Iterator[str]:
        todo = [below]
        count = 0
        while todo:
            folder = todo.pop()
            with os.scandir(self._folder / folder) as entries:
                for entry in entries:
                    name = f"{folder}/{entry.name}" if folder else entry.name
                    count += 1
                    if count > MOST_FILES:
                        raise InputError(self.path, "", None, f"holds more than {MOST_FILES} files")
                    if reason := self._unwanted(name, entry):
                        self.skipped.append(Skipped(name, reason))
                    elif entry.is_dir(follow_symlinks=False):
                        todo.append(name)
                    else:
                        yield name

    def _unwanted(self, name: str, entry: os.DirEntry[str]) -> str:
        if entry.is_symlink():
            return "is a link"
        if entry.name.startswith("."):
            return "is hidden"
        regular = entry.is_file(follow_symlinks=False) or entry.is_dir(follow_symlinks=False)
        return "" if regular else "is no regular file"

    def _unzipped(self) -> list[str]:
        try:
            self._zip = ZipFile(self.path)
        except (BadZipFile, ValueError, NotImplementedError) as error:
            raise InputError(self.path, "", None, f"is no zip: {error}") from None
        for item in self._zip.infolist():
            parts = item.filename.split("/")
            if item.is_dir():
                continue
            if any(part.startswith(".") or part == "__MACOSX" for part in parts):
                self.skipped.append(Skipped(item.filename, "is hidden, or leads out of the zip"))
            elif "" in parts or "\\" in item.filename or item.filename in self._items:
                self.skipped.append(Skipped(item.filename, "has no separate name in the zip"))
            else:
                self._items[item.filename] = item
        return list(self._items)

    def __contains__(self, name: str) -> bool:
        return name in self._there

    def close(self) -> None:
        """Close a zip."""
        if self._zip is not None:
            self._zip.close()

    def match(self, pattern: FilePattern, name: str) -> dict[str, str] | None:
        """Return what a pattern catches in a file's path, by itself or from the folder's own name.

        With the second one, the pattern ``{part}/*.npy`` fits files of a folder ``train`` also
        where that is imported by itself.
        """
        found = pattern.match(name)
        return pattern.match(f"{self.root}/{name}") if found is None else found

    def place(self, name: str) -> str:
        """Return where a file is, for messages."""
        return f"{self.path if self._zip is not None else self._folder}/{name}"

    def read(self, name: str) -> Any:
        """Return the bytes of a file: mapped into memory, or unpacked.

        Raises:
            InputError: it cannot be read, or is too large.
        """
        if self._zip is not None:
            return self._unpack(self._items[name])
        path = self._folder / name
        try:
            with open(path, "rb", opener=_no_link) as file:
                if os.fstat(file.fileno()).st_size == 0:
                    return b""
                return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        except (OSError, ValueError) as error:
            raise InputError(path, "", None, f"cannot be read: {error}") from None

    def _unpack(self, item: ZipInfo) -> Any:
        assert self._zip is not None
        where = self.place(item.filename)
        if item.file_size > MOST_BYTES:
            raise InputError(
                where, "", None, f"holds more than {MOST_BYTES >> 20} MiB; unpack the zip first"
            )
        try:
            return unpacked(self._zip, item)
        except Exception as error:  # zlib and lzma have their own errors
            raise InputError(where, "", None, f"cannot be unpacked: {error}") from None

    @contextmanager
    def local(self, *names: str) -> Iterator[list[Path]]:
        """Yield files as paths on the disk: unpacked into a temporary folder where needed."""
        if self._zip is None:
            yield [self._folder / name for name in names]
            return
        with scratch_folder() as folder:
            paths = []
            for name in names:
                paths.append(folder / Path(name).name)
                paths[-1].write_bytes(self._unpack(self._items[name]))
            yield paths


def _no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW)
