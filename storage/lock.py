"""One holder at a time: an OS lock that dies with its holder, and names it to whoever is refused.

The kernel frees the lock when the holder ends, however it ends. What stands in the file only says
who holds it; it is believed only while the lock is held.
"""

from __future__ import annotations

import fcntl
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from storage.process import named, this_process
from storage.streams import Json

STORE_LOCK = ".lock"
"""Of a store, in its folder."""
PATIENCE_S = 3.0
"""How long a holder that is done at once (`brief`) is waited for."""
_LOOK_S = 0.05
_HOLDER_BYTES = 4000


class Locked(RuntimeError):
    """Somebody else holds the lock; the message says who.

    Attributes:
        holder: what the holder said of itself, as `storage.process.this_process`.
    """

    def __init__(self, message: str, holder: Json | None = None) -> None:
        super().__init__(message)
        self.holder = holder or {}


@contextmanager
def exclusive(
    path: Path, what: str, *, brief: bool = False, mode: int = 0o644, about: Json | None = None
) -> Iterator[None]:
    """Hold the lock file at `path` while the block runs.

    Args:
        what: what is locked, for the message.
        brief: the block is over at once; others may wait for that.
        mode: of the file, if it is made.
        about: what else is said of the holder, such as its store.

    Raises:
        Locked: it is held. Only a brief holder is waited for, `PATIENCE_S` at most.
        OSError: the file cannot be made or opened.
    """
    handle = _open(path, mode)
    try:
        _acquire(handle, what)
        if os.fstat(handle).st_nlink == 0:  # somebody cleaned the folder up in between
            raise Locked(f"{what}: the lock file {path} was deleted meanwhile; try again")
        told = {**this_process(), "brief": brief, **(about or {})}
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(told).encode(), 0)
        try:
            yield
        finally:
            with suppress(OSError):  # a disk may be gone; what went wrong before counts
                os.ftruncate(handle, 0)
    finally:
        os.close(handle)  # frees the lock


def _open(path: Path, mode: int) -> int:
    """In a folder that all may write to, the system refuses to *make* what somebody else made."""
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        return os.open(path, flags)
    except FileNotFoundError:
        pass
    try:
        handle = os.open(path, flags | os.O_CREAT | os.O_EXCL, mode)
    except FileExistsError:
        return os.open(path, flags)
    os.fchmod(handle, mode)  # whatever the user's mask takes away
    return handle


def _acquire(handle: int, what: str) -> None:
    waited = threading.Event()
    for _ in range(round(PATIENCE_S / _LOOK_S)):
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            holder = _holder(handle)
        if holder and not holder.get("brief"):
            break
        waited.wait(_LOOK_S)
    raise Locked(f"{what} is in use by another program ({named(holder)})", holder)


def _holder(handle: int) -> Json:
    try:
        found = json.loads(os.pread(handle, _HOLDER_BYTES, 0))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
