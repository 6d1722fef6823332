"""Objects on shared or object storage, reached through fsspec: ``s3://``, ``file://`` and others.

This module writes, reads back and lists objects; `storage.remote.manifest` defines their meaning.
Address and keys of a server are in the environment or in fsspec's own
configuration (docs/scale.md), never in a URL and never in a store. Failed requests are retried
by the underlying library, by its own settings.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any
from urllib.parse import urlsplit

from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import MASK, is_secret
from sliplab.storage.errors import NoStore, StoreError, masked
from sliplab.storage.files import (
    COMMITTED,
    is_temporary,
    json_text,
    make_folder,
    read_blocks,
    sweep_marked,
    write_blocks,
)
from sliplab.storage.interrupts import interruptible
from sliplab.storage.trials.checksums import Checksum

LAYOUT_FILE, LAYOUT = "sliplab.json", 1
SMALL_BYTES = 8_000_000
"""Limit of objects that are read at once."""
_BLOCK = 8_000_000
_URL = re.compile(r"([a-z][a-z0-9+.-]*)://.+")
_ADDRESSES = (
    "the address of shared or object storage: s3://BUCKET/FOLDER, file:///FOLDER, or another that "
    "fsspec can list, such as gs:// or sftp://"
)
_SECRET_VARIABLES = ("AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_ACCESS_KEY_ID")
_ANSWER_CHARACTERS = 200
"""Limit of what is passed on of a server's message."""

OnBytes = Callable[[int], None]


class RemoteError(StoreError):
    """Shared or object storage failed; the message names the object."""


class RemoteMissing(RemoteError):
    """An object does not exist."""


class RemoteDamaged(RemoteError):
    """An object does not match its checksum."""


class NoPushedStore(NoStore, RemoteMissing):
    """Nothing was ever pushed to the URL that was given."""


def is_url(place: str | os.PathLike[str]) -> bool:
    """Return whether `place` is a URL rather than a folder."""
    return _URL.fullmatch(os.fspath(place)) is not None


def check_url(url: str) -> str:
    """Return `url` without a slash at its end.

    Raises:
        InputError: it is not a URL, is of the web, is of a kind that chains others, or carries a
            secret.
    """
    if not is_url(url):
        raise InputError("URL", "", url, f"must be {_ADDRESSES}")
    parts = urlsplit(url)
    if parts.username or parts.password or parts.query or parts.fragment:
        shown = f"{parts.scheme}://.../{parts.path.lstrip('/')}"
        raise InputError(
            "URL",
            "",
            shown,
            "must not contain keys, passwords or options: put them into the "
            "environment or fsspec's configuration",
        )
    if parts.scheme in ("http", "https"):
        text = f"is a web page's address, whose files cannot be listed; give {_ADDRESSES}"
        raise InputError("URL", "", url, text)
    if "::" in url or ".." in parts.path.split("/"):
        raise InputError("URL", "", url, "must name one location, without '::' and '..'")
    return url.rstrip("/")


class Remote:
    """A folder on shared or object storage. Keys are paths below it, with slashes."""

    def __init__(self, url: str) -> None:
        """
        Raises:
            InputError: not a URL that can be used, or the package for it is missing.
            RemoteError: the place cannot be reached.
        """
        import fsspec

        self.url = check_url(url)
        try:
            # what another program put there in the meantime must be seen
            self._fs, root = fsspec.url_to_fs(
                self.url, use_listings_cache=False, skip_instance_cache=True
            )
        except ImportError as error:
            kind = urlsplit(self.url).scheme
            raise InputError(
                "URL",
                "",
                self.url,
                f"needs a package that is not installed ({error}); for s3: "
                "`pip install 'sliplab[s3]'`"
                if kind == "s3"
                else f"cannot be used: {error}",
            ) from None
        except ValueError as error:
            raise InputError("URL", "", self.url, f"cannot be used: {error}") from None
        except OSError as error:
            raise RemoteError(f"{self.url}: cannot be reached: {error}") from None
        self._root = str(root).rstrip("/")
        kinds = self._fs.protocol
        self._local = "file" in ((kinds,) if isinstance(kinds, str) else kinds)

    def where(self, key: str) -> str:
        """Return the full URL of an object, for messages."""
        return f"{self.url}/{key}"

    def begin(self) -> None:
        """Make an empty place one of ours.

        Raises:
            InputError: it is a folder of a store.
            RemoteError: it contains other files, or is of a newer version.
        """
        from sliplab.storage.trials.catalogue import refuse_store_file

        try:
            self.check()
        except RemoteMissing:
            if self._local:
                refuse_store_file(Path(self._root), "URL")
            listed = [str(entry["name"]).rpartition("/")[2] for entry in self._list("")]
            if not all(map(is_temporary, listed)):  # a first push that was killed
                raise RemoteError(
                    f"{self.url}: contains other files; give an empty location or one "
                    "created by `sliplab push`"
                ) from None
            self.put(LAYOUT_FILE, json_text({"layout": LAYOUT}).encode())

    def check(self) -> None:
        """Check that a store was pushed here.

        Raises:
            NoPushedStore: nothing was ever pushed here.
            RemoteError: it is of a newer version, or damaged.
        """
        try:
            data = self.read(LAYOUT_FILE)
        except RemoteMissing:
            why = f"does not contain a pushed store (no {LAYOUT_FILE}); `sliplab push` creates one"
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
        """Return the bytes of each object right below `folder`, by its name."""
        return {
            str(entry["name"]).rpartition("/")[2]: int(entry["size"] or 0)
            for entry in self._list(folder)
            if entry["type"] == "file"
        }

    def folders(self, folder: str) -> list[str]:
        """Return the names of the folders right below `folder`."""
        found = (entry for entry in self._list(folder) if entry["type"] == "directory")
        return sorted(str(entry["name"]).rstrip("/").rpartition("/")[2] for entry in found)

    def campaigns(self) -> list[str]:
        """Return the names of the pushed campaigns.

        Raises:
            RemoteMissing: there is none; an empty or missing list says nothing about campaigns.
        """
        found = self.folders("campaigns")
        if not found:
            raise RemoteMissing(
                f"{self.where('campaigns')}: is empty or missing: no campaign was pushed, or the "
                "folder cannot be read at the moment; nothing was changed"
            )
        return found

    def sweep(self, *folders: str) -> None:
        """Delete temporary objects that killed programs left in some folders.

        Only a folder has them: other storages write an object in one step, or clean up themselves.
        """
        if self._local:
            for folder in folders:
                sweep_marked(Path(self._path(folder) if folder else self._root))

    def size(self, key: str) -> int:
        """Return the bytes of an object.

        Raises:
            RemoteMissing: it does not exist.
        """
        with self._errors_translated(key, "read"):
            return int(self._fs.info(self._path(key))["size"])

    def read(self, key: str) -> bytes:
        """Read a small object.

        Raises:
            RemoteMissing: it does not exist.
            RemoteError: it cannot be read, or has more than `SMALL_BYTES`.
        """
        data = b"".join(self._blocks(key, SMALL_BYTES + 1))
        if len(data) > SMALL_BYTES:
            raise RemoteError(f"{self.where(key)}: has more than {SMALL_BYTES} bytes")
        return data

    def read_many(self, keys: Sequence[str]) -> dict[str, bytes | RemoteError]:
        """Read small objects, side by side where the storage can; an error represents a bad one."""
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

    def matches(self, key: str, known: Checksum, on_bytes: OnBytes | None = None) -> bool:
        """Read all of an object and return whether it matches its checksum.

        Raises:
            RemoteMissing: it does not exist.
        """
        try:
            for block in self._checked(key, known):
                if on_bytes is not None:
                    on_bytes(len(block))
        except RemoteDamaged:
            return False
        return True

    def get(self, key: str, path: Path, known: Checksum, stop: Event | None = None) -> None:
        """Fetch an object into `path`, which appears once all of it matches its checksum.

        It is read-only, as a committed file is. Once `stop` is set, it is left.

        Raises:
            RemoteMissing: it does not exist.
            RemoteError: it cannot be read, or does not match its checksum.
            OSError: `path` cannot be written.
        """
        write_blocks(path, self._checked(key, known, stop), COMMITTED)

    def put(self, key: str, source: bytes | Path) -> None:
        """Write an object from bytes or a file, in one step as far as the storage can."""
        path = self._path(key)
        with self._errors_translated(key, "written"):
            if self._local:  # fsspec neither flushes to the disk nor renames into place
                make_folder(Path(path).parent)
                blocks = (source,) if isinstance(source, bytes) else read_blocks(source)
                write_blocks(Path(path), blocks)
            elif isinstance(source, bytes):
                self._fs.pipe_file(path, source)
            else:
                self._fs.put_file(str(source), path)

    def remove(self, key: str) -> None:
        """Remove an object; nothing happens if it does not exist."""
        try:
            with self._errors_translated(key, "removed"):
                self._fs.rm_file(self._path(key))
        except RemoteMissing:
            pass

    @interruptible
    def _checked(self, key: str, known: Checksum, stop: Event | None = None) -> Iterator[bytes]:
        """Yield an object's bytes, and raise `RemoteDamaged` at their end if they do not match."""
        digest, size = hashlib.sha256(), 0
        for block in self._blocks(key, known.bytes and known.bytes + 1):
            if stop is not None and stop.is_set():
                raise RemoteError(f"{self.where(key)}: was stopped")
            digest.update(block)
            size += len(block)
            yield block
        if size != known.bytes or digest.hexdigest() != known.sha256:
            raise RemoteDamaged(f"{self.where(key)}: does not match its checksum")

    def _blocks(self, key: str, most: int) -> Iterator[bytes]:
        """Yield an object's first `most` bytes; 0 asks for its size and yields all of them."""
        path = self._path(key)
        most = most or self.size(key)
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
        """Translate errors to one line without secrets."""
        try:
            yield
        except StoreError:
            raise
        except FileNotFoundError:
            raise RemoteMissing(f"{self.where(key)}: is not there") from None
        except Exception as error:  # each storage has its own kinds
            what = self._without_secrets(" ".join(str(error).split()) or type(error).__name__)
            raise RemoteError(
                f"{self.where(key)}: cannot be {done}: {what[:_ANSWER_CHARACTERS]}; fix this, "
                "then run the same command to resume"
            ) from None

    def _without_secrets(self, text: str) -> str:
        options = self._fs.storage_options.items()
        known = [value for name, value in options if isinstance(value, str) and is_secret(name)]
        known += [os.environ.get(name, "") for name in _SECRET_VARIABLES]
        for value in filter(None, known):
            text = text.replace(value, MASK)
        return masked(text)
