"""Exclusive OS locks that are released with their holder and name it to other processes.

The kernel releases the lock when the holder ends, however it ends. The file's content names
the holder and is valid only while the lock is held. Where locks do not reach other machines,
the note of another machine's holder is believed until a person deletes it. A file system without
locks, or with non-exclusive locks, is refused (docs/decisions/trials-on-disk.md).
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sliplab.storage.errors import StoreError, disk_fault
from sliplab.storage.process import named, this_process
from sliplab.storage.streams import Json

STORE_LOCK = ".lock"
"""Name of a store's lock file."""
PATIENCE_S = 3.0
"""Longest wait for a holder that is done at once (`brief`), s."""
_LOOK_S = 0.05
_HOLDER_BYTES = 4000
MOUNTS = Path("/proc/self/mountinfo")
_ALONE = {"9p", "vboxsf", "prl_fs", "virtiofs", "fuse"}
"""Types of file systems with locks local to each machine; also all of `fuse.*`."""
_ALONE_OPTIONS = {"nobrl", "nolock", "local_lock=flock", "local_lock=all"}
"""Options of NFS and SMB mounts by which locks are not sent to the server."""


class NoLocks(StoreError):
    """The file system of a lock does not support file locks; the message gives the remedy."""


class Locked(RuntimeError):
    """Another process holds the lock; the message names it.

    Attributes:
        holder: the holder as `storage.process.this_process` describes it.
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
        what: name of the locked thing, for the message.
        brief: the block is over at once; others may wait for that.
        mode: of the file, if it is made. In a folder for all users (0666) any user may have put
            something else there: then it must be a plain file with no other name.
        about: further keys of the holder, such as its store.

    Raises:
        Locked: it is held. Only a brief holder is waited for, `PATIENCE_S` at most.
        NoLocks: the file system keeps no locks.
        OSError: the file cannot be made or opened.
    """
    handle = _open(path, mode)
    try:
        if mode & 0o002:
            _check_plain(handle, path)
        _acquire(handle, path, what)
        if os.fstat(handle).st_nlink == 0:  # the folder was cleaned up in between
            raise Locked(f"{what}: the lock file {path} was deleted meanwhile; try again")
        _check(handle, path, what)
        holder = {**this_process(), "brief": brief, **(about or {})}
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(holder).encode(), 0)
        try:
            yield
        finally:
            with suppress(OSError):  # a disk may be gone; what went wrong before counts
                os.ftruncate(handle, 0)
    finally:
        os.close(handle)  # frees the lock


def current_holder(path: Path) -> Json | None:
    """Return the holder of the lock file at `path`; None if it is free. Nothing is changed."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _holder(handle)
    except OSError:
        return None
    finally:
        os.close(handle)
    return None


def _open(path: Path, mode: int) -> int:
    """Open a lock file, making it if it is missing.

    In a world-writable folder, the system refuses to *create* a file that another user created.
    """
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


def _check_plain(handle: int, path: Path) -> None:
    """Refuse a file that is not a lock: its content would be overwritten."""
    found = os.fstat(handle)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
        raise OSError(errno.EINVAL, "is not a regular lock file", str(path))


def _acquire(handle: int, path: Path, what: str) -> None:
    waited = threading.Event()
    for _ in range(round(PATIENCE_S / _LOOK_S)):
        if _locks(handle, path):
            return
        holder = _holder(handle)
        if holder and not holder.get("brief"):
            break
        waited.wait(_LOOK_S)
    raise Locked(f"{what} is in use by another program ({named(holder)})", holder)


def _locks(handle: int, path: Path) -> bool:
    """Lock an open file, or return False because another has it.

    Raises:
        NoLocks: the file system cannot.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if disk_fault(error):
            raise
        raise _no_locks(path, os.strerror(error.errno or 0)) from error
    return True


def _no_locks(path: Path, why: str) -> NoLocks:
    return NoLocks(
        f"{path.parent}: its file system does not support file locks ({why}), so two programs "
        "could write at once: put the store on one that does, such as a local disk; "
        "`sliplab push` copies its trials to a shared folder"
    )


def _check(handle: int, path: Path, what: str) -> None:
    """Check that the lock that was just taken excludes others, on this machine and elsewhere.

    Raises:
        NoLocks: a second open file is not excluded.
        Locked: a program on another machine, which the lock does not reach, still holds it.
    """
    second = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        if os.path.sameopenfile(handle, second) and _locks(second, path):
            raise _no_locks(path, "what is locked can be locked again")
    finally:
        os.close(second)
    left, ours = _holder(handle), this_process()
    elsewhere = left.get("host") not in {None, ours["host"]} and left.get("boot") != ours["boot"]
    if elsewhere and (kind := _alone(handle)):
        raise Locked(
            f"{what} was last held by another machine ({named(left)}) and not released; locks on "
            f"{kind} do not reach other machines, so it may be in use there: make sure that it is "
            f"not, then delete {path}",
            left,
        )


def _alone(handle: int) -> str | None:
    """Return the type of an open file's file system if other machines do not see its locks."""
    device = os.fstat(handle).st_dev
    number = f"{os.major(device)}:{os.minor(device)}"
    try:
        mounts = MOUNTS.read_text().splitlines()
    except OSError:
        return None
    for mount in mounts:
        place, _, system = mount.partition(" - ")
        kind, _, options = system.partition(" ")
        if place.split()[2] == number and (
            kind in _ALONE
            or kind.startswith("fuse.")
            or (kind.startswith(("nfs", "cifs", "smb")) and _ALONE_OPTIONS & {*options.split(",")})
        ):
            return kind
    return None


def _holder(handle: int) -> Json:
    try:
        found = json.loads(os.pread(handle, _HOLDER_BYTES, 0))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
