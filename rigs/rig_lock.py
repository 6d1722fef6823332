"""One program at a time at a real rig: an OS lock for each device that must not be shared.

The locks apply to the whole machine, across users and sessions, because two programs that drive one
arm are dangerous even if different users run them. The lock files are therefore in one shared
folder. A lock ends with its holder's process. It does not exclude another machine that can reach
the same arm; the arm's controller must do that.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials.lock import NoLocks, exclusive

ENVIRONMENT = "SLIPLAB_RUNTIME"
_FOLDER = Path("/tmp/sliplab-rigs")


def lock_names(file: RigFile) -> dict[str, str]:
    """Return descriptions of the locked devices by lock file name; empty for simulated rigs.

    Each simulated rig has its own devices or fakes.
    """
    if file.simulated:
        return {}
    return {
        lock_file(name): f"{what} (rig {file.name})"
        for _, driver, settings in file.drivers()
        for name, what in driver.locks(settings).items()
    }


@contextmanager
def held(file: RigFile, store: Path | None = None) -> Iterator[None]:
    """Lock a rig for this program while the block runs; see `locked`."""
    with locked(lock_names(file), store):
        yield


@contextmanager
def locked(devices: Mapping[str, str], store: Path | None = None) -> Iterator[None]:
    """Lock devices for this program while the block runs.

    Args:
        devices: their descriptions by lock file name.
        store: the store that is written, shown to other programs that are refused.

    Raises:
        Locked: another program has the lock; the message names it, its user and its start time.
        RigError: the lock files cannot be created.
    """
    with ExitStack() as locks:
        if devices:
            about = {} if store is None else {"store": str(store.absolute())}
            try:
                folder = _folder(locks)
                for name, what in devices.items():
                    locks.enter_context(exclusive(folder / name, what, mode=0o666, about=about))
            except (OSError, NoLocks) as error:
                raise RigError(
                    "rig",
                    f"cannot be locked against other programs: {error}; set {ENVIRONMENT} to a "
                    "folder that all its users can write to",
                ) from None
        yield


def _folder(locks: ExitStack) -> Path:
    folder = Path(os.environ.get(ENVIRONMENT) or _FOLDER)
    try:
        folder.mkdir()
        folder.chmod(0o1777)
    except FileExistsError:
        pass
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    locks.callback(os.close, handle)
    mode = os.fstat(handle).st_mode
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        text = "every user may delete the locks in it (chmod +t prevents that)"
        raise OSError(errno.EPERM, text, str(folder))
    fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)  # keeps the system from cleaning it up
    return folder


def lock_file(name: str) -> str:
    """Return the name of a device's lock file."""
    return f"{_plain(name)}.lock"


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "-", name).strip("-")
