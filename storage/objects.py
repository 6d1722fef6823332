"""A place for stores on shared or object storage, reached through fsspec: ``s3://``, ``file://``...

Objects are put whole, read back and listed here, and nothing else; their meaning is in
`storage.remote.manifest`. Where a server is, and by which keys it lets one in, stands in the
environment or in fsspec's own configuration (docs/scale.md), never in a URL and never in a store.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import is_secret
from sliplab.storage.errors import NoStore, StoreError
from sliplab.storage.files import json_text, make_folder, read_blocks, write_blocks
from sliplab.storage.streams import Json
from sliplab.storage.urls import check_url

LAYOUT_FILE, LAYOUT = "sliplab.json", 1
SMALL_BYTES = 8_000_000
"""Objects up to this are fetched in one request."""
_BLOCK = 8_000_000
_SECRET_VARIABLES = ("AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_ACCESS_KEY_ID")
_ANSWERS = 200
"""Characters that are passed on of what a server said."""

OnBytes = Callable[[int], None]


class RemoteError(StoreError):
    """Shared or object storage did not do what it was asked; the message names the object."""


class RemoteMissing(RemoteError):
    """An object is not there."""


class NoPushedStore(NoStore, RemoteMissing):
    """Nothing was ever pushed to the URL that was given."""


class Remote:
    """A folder on shared or object storage. Keys are paths below it, with slashes."""

    def __init__(self, url: str) -> None:
        """
        Raises:
            InputError: not a URL that can be used, or the package that speaks it is missing.
            RemoteError: the place cannot be reached.
        """
        import fsspec

        self.url = check_url(url)
        try:
            # what another program put there meanwhile must be seen
            self._fs, self._root = fsspec.url_to_fs(
                self.url, use_listings_cache=False, skip_instance_cache=True
            )
        except ImportError as error:
            kind = urlsplit(self.url).scheme
            raise InputError(
                "URL", "", self.url, f"needs a package that is not installed ({error}); for s3: "
                "`pip install 'sliplab[s3]'`" if kind == "s3" else f"cannot be used: {error}",
            ) from None  # fmt: skip
        except ValueError as error:
            raise InputError("URL", "", self.url, f"cannot be used: {error}") from None
        self._root = str(self._root).rstrip("/")
        kinds = self._fs.protocol
        self.local = "file" in ((kinds,) if isinstance(kinds, str) else kinds)

    def where(self, key: str) -> str:
        """The full URL of an object, for messages."""
        return f"{self.url}/{key}"

    def begin(self) -> None:
        """Make the place one of ours if it is empty.

        Raises:
            RemoteError: it holds other things, or is of a newer version.
        """
        try:
            self.check()
        except RemoteMissing:
            if self._list(""):
                raise RemoteError(
                    f"{self.url}: holds other things; give an empty place, or one that "
                    "`sliplab push` made"
                ) from None
            self.put_bytes(LAYOUT_FILE, json_text({"layout": LAYOUT}).encode())

    def check(self) -> None:
        """
        Raises:
            NoPushedStore: nothing was ever pushed there.
            RemoteError: it is of a newer version, or damaged.
        """
        try:
            data = self.read(LAYOUT_FILE)
        except RemoteMissing:
            why = f"holds no pushed store (no {LAYOUT_FILE}); `sliplab push` makes one"
            raise NoPushedStore(self.url, why) from None
        try:
            layout = json.loads(data)["layout"]
        except (ValueError, KeyError, TypeError):
            layout = None
        if not isinstance(layout, int) or layout < 1:
            raise RemoteError(f"{self.where(LAYOUT_FILE)}: is damaged: push the store again")
        if layout > LAYOUT:
            raise RemoteError(
                f"{self.url}: layout = {layout}: was pushed by a newer version of SlipLab; this "
                f"one reads layouts up to {LAYOUT}: update it"
            )

    def sizes(self, folder: str) -> dict[str, int]:
        """Bytes of each object right below `folder`, by its name."""
        return {
            str(entry["name"]).rpartition("/")[2]: int(entry["size"] or 0)
            for entry in self._list(folder)
            if entry["type"] == "file"
        }

    def folders(self, folder: str) -> list[str]:
        """Names of the folders right below `folder`."""
        found = (entry for entry in self._list(folder) if entry["type"] == "directory")
        return sorted(str(entry["name"]).rstrip("/").rpartition("/")[2] for entry in found)

    def read(self, key: str, most: int = SMALL_BYTES) -> bytes:
        """A small object.

        Raises:
            RemoteMissing: it is not there.
            RemoteError: it cannot be read, or has more than `most` bytes.
        """
        data = b""
        for block in self._blocks(key, most + 1):
            data += block
        if len(data) > most:
            raise RemoteError(f"{self.where(key)}: has more than {most} bytes")
        return data

    def read_many(self, keys: Sequence[str]) -> dict[str, bytes | RemoteError]:
        """Small objects, side by side where the storage can; an error in place of one it lacks."""
        if not keys:
            return {}
        paths = {self._path(key): key for key in keys}
        with self._errors_translated(keys[0], "read"):
            found = self._fs.cat(list(paths), on_error="return")
        if not isinstance(found, dict):  # of a single path
            found = {next(iter(paths)): found}
        read: dict[str, bytes | RemoteError] = {}
        for path, data in found.items():
            key = paths.get(path) or paths[f"/{path.lstrip('/')}"]
            try:
                with self._errors_translated(key, "read"):
                    if isinstance(data, Exception):
                        raise data
                    read[key] = data
            except RemoteError as error:
                read[key] = error
        return read

    def matches(self, key: str, said: Json, on_bytes: OnBytes | None = None) -> bool:
        """Whether an object has the ``bytes`` and the ``sha256`` of `said`; all of it is read.

        Raises:
            RemoteMissing: it is not there.
        """
        digest, size = hashlib.sha256(), 0
        for block in self._blocks(key, said["bytes"] and said["bytes"] + 1):
            digest.update(block)
            size += len(block)
            if on_bytes is not None:
                on_bytes(len(block))
        return bool(size == said["bytes"] and digest.hexdigest() == said["sha256"])

    def size(self, key: str) -> int:
        """Bytes of an object.

        Raises:
            RemoteMissing: it is not there.
        """
        with self._errors_translated(key, "read"):
            return int(self._fs.info(self._path(key))["size"])

    def put_bytes(self, key: str, data: bytes) -> None:
        """Put a small object, in one step as far as the storage can."""
        self._put(key, lambda: (data,), lambda: self._fs.pipe_file(self._path(key), data))

    def put_file(self, key: str, path: Path) -> None:
        """Put a file."""
        self._put(
            key, lambda: read_blocks(path), lambda: self._fs.put_file(str(path), self._path(key))
        )

    def get_file(self, key: str, path: Path, said: Json) -> None:
        """Fetch an object into `path`, which appears once all of it is there and as it should be.

        Args:
            said: its ``bytes`` and ``sha256``.

        Raises:
            RemoteMissing: it is not there.
            RemoteError: it cannot be read, or does not match its checksum.
            OSError: `path` cannot be written.
        """

        def checked() -> Iterator[bytes]:
            digest, size = hashlib.sha256(), 0
            for block in self._blocks(key, said["bytes"] and said["bytes"] + 1):
                digest.update(block)
                size += len(block)
                yield block
            if size != said["bytes"] or digest.hexdigest() != said["sha256"]:
                raise RemoteError(f"{self.where(key)}: does not match its checksum")

        write_blocks(path, checked())

    def remove(self, key: str) -> None:
        """Take an object away; nothing happens if it is gone."""
        try:
            with self._errors_translated(key, "removed"):
                self._fs.rm_file(self._path(key))
        except RemoteMissing:
            pass

    def _put(self, key: str, blocks: Callable[[], Iterable[bytes]], put: Callable[[], Any]) -> None:
        with self._errors_translated(key, "written"):
            if self.local:  # fsspec neither flushes to the disk nor writes aside
                path = Path(self._path(key))
                make_folder(path.parent)
                write_blocks(path, blocks())
            else:
                put()

    def _blocks(self, key: str, most: int | None = None) -> Iterator[bytes]:
        """An object's bytes, the first `most` of them; who knows how many saves asking for it."""
        path = self._path(key)
        if not most:
            most = self.size(key)
        for start in range(0, most, _BLOCK):
            end = min(most, start + _BLOCK)
            with self._errors_translated(key, "read"):
                block = self._fs.cat_file(path, start=start, end=end)
            yield block
            if len(block) < end - start:
                return

    def _list(self, folder: str) -> list[dict[str, Any]]:
        path = self._path(folder) if folder else self._root
        try:
            with self._errors_translated(folder, "listed"):
                self._fs.invalidate_cache()
                found = self._fs.ls(path, detail=True)
        except RemoteMissing:
            return []
        # some storages list a folder in itself
        return [entry for entry in found if str(entry["name"]).strip("/") != path.strip("/")]

    def _path(self, key: str) -> str:
        return f"{self._root}/{key}"

    @contextmanager
    def _errors_translated(self, key: str, done: str) -> Iterator[None]:
        """Translate errors to one line, without anything that is secret."""
        try:
            yield
        except StoreError:
            raise
        except FileNotFoundError:
            raise RemoteMissing(f"{self.where(key)}: is not there") from None
        except Exception as error:  # each storage has its own kinds
            what = self._without_secrets(" ".join(str(error).split()) or type(error).__name__)
            raise RemoteError(
                f"{self.where(key)}: cannot be {done}: {what[:_ANSWERS]}; see to that, then run "
                "the same command to go on"
            ) from None

    def _without_secrets(self, text: str) -> str:
        options = self._fs.storage_options
        known = [
            str(value)
            for name, value in options.items()
            if isinstance(value, str) and is_secret(name)
        ]
        known += [os.environ.get(name, "") for name in _SECRET_VARIABLES]
        for value in known:
            text = text.replace(value, "***") if value else text
        return text
