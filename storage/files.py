"""Atomic file writes: after a crash each file is complete or absent.

Every write in the project goes through here: a temporary file in the target's folder is flushed to
the disk and renamed over the target, then the folder is flushed as well. In a folder that becomes
visible by its own rename, files are only flushed.

A killed program may leave a temporary file or folder. Its name contains the machine and the process
(`.NAME.sliplab-PLACE.PID.tmp`); the next program that writes into the same folder deletes it. On a
shared folder another machine's process cannot be seen: its files are left alone for a day, by the
clock that stamps them. Older versions wrote `.NAME.PID.tmp`, which are deleted in a store only, as
nothing else writes there.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import shutil
import socket
import stat
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from sliplab.storage.errors import StoreError
from sliplab.storage.interrupts import uninterrupted

MOST_BYTES = 1 << 30
"""Of a file that `read_plain` reads: far more than any model has."""
COMMITTED = 0o444
"""Mode of a committed trial's files: other programs open them to read only."""
_BLOCK = 1 << 20
_TEMPORARY = re.compile(r"\.(?P<name>.*?)(?:\.sliplab-(?P<place>[0-9a-f]{8}))?\.(?P<pid>\d+)\.tmp")
_STALE_S = 86_400.0
"""Age of what another machine left: a program that still writes changes it more often."""
_SWEPT: set[Path] = set()
"""Folders that this process has swept before its first write there."""
_NAME_BYTES = 200
"""Bytes of a target's name in that of its temporary file; a file's name has at most 255."""
_MOST_NAME = 251
_SAFE = re.compile(rf"[A-Za-z0-9][A-Za-z0-9=,._+-]{{0,{_MOST_NAME - 1}}}")


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_file(path: Path) -> None:
    """Flush a file that other code wrote."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def protect(path: Path) -> None:
    """Remove the write permission of a file, which its user can still move and delete.

    Nothing happens on a file system without such rights.
    """
    with suppress(OSError):
        path.chmod(COMMITTED)


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents, and flush each one's entry to the disk."""
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
    temporary = temporary_path(path)
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


def read_plain(path: Path, most: int = MOST_BYTES) -> bytes:
    """Return the bytes of a regular file; devices and pipes, which have no end, are refused.

    Args:
        most: bytes; a larger file is refused before it is read.

    Raises:
        OSError: it is missing, no regular file, too large, or cannot be read.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(path))
        if about.st_size > most:
            raise OSError(errno.EFBIG, f"it is over {most >> 20} MiB", str(path))
        return file.read(most)


def write_new_json(path: Path, data: Any) -> bool:
    """Write JSON under a name that is free, as `write_new_bytes`.

    Raises:
        ValueError: as `write_json`.
    """
    return write_new_bytes(path, _utf_8(json_text(data)))


@uninterrupted
def write_new_bytes(path: Path, data: bytes) -> bool:
    """Write a file, complete and flushed, under a name that is free.

    Returns:
        False if the name was taken; nothing was changed then.
    """
    temporary = temporary_path(path, f".{threading.get_ident()}")
    try:
        _write_aside(temporary, data)
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


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path that becomes `path`, flushed, when the block ends without an error.

    The block writes a file or makes a folder there; a folder does not replace anything.
    """
    sweep_marked(path.parent)
    temporary = temporary_path(path)
    _delete(temporary)  # of an earlier process with this number
    try:
        yield temporary
        inside = sorted(temporary.rglob("*")) if temporary.is_dir() else []
        for made in (*inside, temporary):
            (sync_folder if made.is_dir() else sync_file)(made)
        os.replace(temporary, path)
    finally:
        _delete(temporary)
    sync_folder(path.parent)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a new folder among the system's temporary files, deleted when the block ends."""
    base = Path(tempfile.gettempdir())
    sweep_marked(base)
    made = Path(tempfile.mkdtemp(_mark(), ".scratch.", base))
    try:
        yield made
    finally:
        _delete(made)


def temporary_path(path: Path, more: str = "") -> Path:
    """Return the path under which `path` is written until it is complete.

    What killed programs left in its folder is deleted when this process first writes there.

    Args:
        more: added to the name, where several threads write one file.
    """
    if path.parent not in _SWEPT:
        _SWEPT.add(path.parent)
        sweep_marked(path.parent)
    name = os.fsencode(path.name)[:_NAME_BYTES].decode(errors="ignore")
    return path.with_name(f".{name}{more}{_mark()}")


def _mark() -> str:
    return f".sliplab-{_place()}.{os.getpid()}.tmp"


@cache
def _place() -> str:
    """Return a hash of what numbers this process: the machine since its start, and a container."""
    found = []
    for about in ("/proc/sys/kernel/random/boot_id", "/proc/self/ns/pid"):
        with suppress(OSError):
            found.append(os.readlink(about) if "ns" in about else Path(about).read_text())
    return hashlib.sha256("".join(found or [socket.gethostname()]).encode()).hexdigest()[:8]


def temporary_files(folder: Path) -> Iterator[tuple[Path, bool]]:
    """Yield temporary files and folders, each with whether its program may still run."""
    if not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        found = _TEMPORARY.fullmatch(path.name)
        if found and not path.is_symlink() and (path.is_file() or found["place"]):
            yield path, _may_run(path, int(found["pid"]), found["place"])


def is_temporary(name: str) -> bool:
    """Return whether a name is that of a temporary file or folder of this project."""
    return _TEMPORARY.fullmatch(name) is not None


def sweep_temporary(folder: Path) -> int:
    """Delete what killed programs left in a folder of a store; return the number of files."""
    left = [path for path, runs in temporary_files(folder) if not runs]
    for path in left:
        _delete(path)
    return len(left)


def sweep_marked(folder: Path) -> None:
    """Delete leftovers of killed programs in any folder, if they are marked as this project's."""
    with suppress(OSError):
        for path, runs in temporary_files(folder):
            marked = _TEMPORARY.fullmatch(path.name)
            if marked and marked["place"] and not runs and path.lstat().st_uid == os.getuid():
                _delete(path)


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _may_run(path: Path, pid: int, place: str | None) -> bool:
    if place not in {None, _place()}:  # another machine's, or of before this one's start
        try:
            return _now_in(path.parent) - path.lstat().st_mtime < _STALE_S
        except OSError:
            return True
    if pid == os.getpid():
        # without a place it is of another process with this number: asked between two writes
        return place is not None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _now_in(folder: Path) -> float:
    """Return the time by the clock that stamps the files of a folder, perhaps a server's, s."""
    with tempfile.TemporaryFile(dir=folder) as file:
        os.write(file.fileno(), b"0")
        return os.fstat(file.fileno()).st_mtime


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, _utf_8(text))


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically, keys sorted, one a line.

    Raises:
        ValueError: a NaN or an infinity, which JSON has no word for.
    """
    write_text(path, json_text(data))


def write_json_aside(path: Path, data: Any) -> None:
    """Write JSON, flushed but not atomic, in a folder that is not visible yet.

    The caller that makes the folder visible flushes its entries first.

    Raises:
        ValueError: as `write_json`.
    """
    _write_aside(path, _utf_8(json_text(data)))


def _write_aside(path: Path, data: bytes) -> None:
    with path.open("wb") as handle:
        handle.write(data)
        handle.flush()
        os.fsync(handle.fileno())


def _utf_8(text: str) -> bytes:
    r"""Encode text as UTF-8.

    In a file name, and in an argument of the command line, Python keeps a byte that it cannot
    decode as a lone surrogate. These bytes are restored where the text is UTF-8 with them, because
    the locale was none of UTF-8; else each is written as its JSON escape, such as ``\udcff``, from
    which JSON makes the same surrogate.
    """
    with suppress(UnicodeError):
        data = text.encode(errors="surrogateescape")
        data.decode()
        return data
    return text.encode(errors="backslashreplace")


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
        sort_keys=True,
        allow_nan=False,
        ensure_ascii=False,
        separators=(",\n" + " " * depth, ": "),
    )


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        OSError: as `read_plain`.
        ValueError: not JSON, or not an object; the message names the file.
    """
    try:
        text = read_plain(path).decode("utf-8")
        data = json.loads(text, parse_constant=_no_number, parse_float=_finite)
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
    return sha256_of(read_blocks(path))


def sha256_of(blocks: Iterable[bytes]) -> str:
    """Return the SHA-256 of some blocks of bytes, 64 hex digits."""
    digest = hashlib.sha256()
    for block in blocks:
        digest.update(block)
    return digest.hexdigest()


def safe_name(name: str) -> str:
    """Return `name` if it is a plain file name.

    Raises:
        StoreError: it could lead out of its folder.
    """
    if not _SAFE.fullmatch(name) or ".." in name:
        shown = name if len(name) <= _MOST_NAME else f"{name[:40]}... ({len(name)} characters)"
        raise StoreError(
            f"'{shown}' cannot be the name of a folder in a store: possible are up to "
            f"{_MOST_NAME} letters, digits and . _ - = , + without two points in a row, of which "
            "a letter or digit is the first"
        )
    return name


def inside(path: Path, store: Path) -> Path:
    """Return `path`, if no link on the way to it leads out of the store's folder.

    Raises:
        StoreError: one does.
    """
    if not path.resolve().is_relative_to(store.resolve()):
        raise StoreError(f"{path}: a link points out of the store; replace it by a real folder")
    return path
