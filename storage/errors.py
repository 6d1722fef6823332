"""Errors of a store and of its disk, with secrets masked in their messages."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import MASK, is_secret, password_in, without_passwords
from sliplab.storage.causes import causes

_FAULTS = {
    errno.ENOSPC: "is full",
    errno.EDQUOT: "has no space left for this user (quota)",
    errno.EFBIG: "does not allow a larger file (see ulimit -f)",
    errno.EROFS: "is read-only",
    errno.EACCES: "is not writable for this user",
    errno.EPERM: "is not writable for this user",
    errno.EIO: "reports errors; it may be failing",
    errno.ENXIO: "is gone",
    errno.ENODEV: "is gone",
    errno.ESTALE: "is gone",
}
_OWN_FAULTS = {errno.EMFILE, errno.ENFILE, errno.ENOMEM}
_IN_WORDS = re.compile(r"errno = (\d+)")
_SHORTEST = 8
"""A shorter value is a switch, or part of many words."""


class StoreError(RuntimeError):
    """A store cannot be used as asked; the message begins with the path and says what to do."""


class DamagedFile(InputError):
    """A recording is truncated or damaged; it was named rightly, so that the command has failed."""


class NoStore(InputError, StoreError):
    """The path or URL of a store was given, and no store can be there: wrong input.

    Args:
        place: as given by the user.
        why: the fault, and the remedy.
    """

    def __init__(self, place: Path | str, why: str) -> None:
        super().__init__(place, "", None, why)

    def __reduce__(self) -> tuple[type[NoStore], tuple[str, ...]]:
        """Pickle its own arguments: it may come from another process."""
        return type(self), (str(self.file), self.expected)


class NoTrial(InputError, StoreError):
    """A trial was named that a store lacks, or that several of its campaigns have: wrong input."""

    def __init__(self, trial: str, why: str) -> None:
        super().__init__("TRIAL", "", trial, why)

    def __reduce__(self) -> tuple[type[NoTrial], tuple[str, ...]]:
        """Pickle its own arguments, as `NoStore` does."""
        return type(self), (str(self.value), self.expected)


def disk_fault(error: BaseException | None) -> str | None:
    """Return the fault of the disk that `error` or its cause states, such as ``is full``.

    HDF5 states some of them as text only.
    """
    for each in causes(error):
        number = each.errno if isinstance(each, OSError) else None
        if number is None and (stated := _IN_WORDS.search(str(each))):
            number = int(stated[1])
        if number in _FAULTS:
            return _FAULTS[number]
    return None


def disk_full(error: BaseException | None) -> bool:
    """Return whether `error` or its cause is a disk or a quota without room."""
    return disk_fault(error) in {_FAULTS[errno.ENOSPC], _FAULTS[errno.EDQUOT]}


def own_fault(error: Exception) -> bool:
    """Return whether memory or open files ran out: the file that was read is not damaged."""
    return isinstance(error, OSError) and error.errno in _OWN_FAULTS


_GO_ON = "run the same command to resume; every committed trial is kept"


def disk_error(folder: Path, error: BaseException, then: str = _GO_ON) -> StoreError | None:
    """Translate an error that came from the disk under `folder`; None for any other error.

    Args:
        then: what is to be done once the fault is gone.
    """
    fault = disk_fault(error)
    if fault is None:
        return None
    todo = "fix this"
    if disk_full(error):
        there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        fault += f" ({shutil.disk_usage(there).free / 1e9:.1f} GB free)"
        todo = "make room"
    return StoreError(f"{folder}: its disk {fault}: {todo}, then {then}")


def named_disk_error(error: OSError) -> StoreError | None:
    """Translate an error of a disk that names a file; None for any other error."""
    # of a copy the second file is the one that is written
    name = error.filename2 or error.filename
    return disk_error(Path(os.fsdecode(name)), error) if name else None


@contextmanager
def translated_disk_errors(folder: Path, *others: type[BaseException]) -> Iterator[None]:
    """Turn a disk's errors inside the block into one `StoreError` that says what to do.

    Args:
        folder: where the block writes.
        others: errors that are passed on, because they speak of another device.

    Raises:
        StoreError: instead of what the disk raised.
    """
    passed_on: tuple[type[BaseException], ...] = (StoreError, *others)
    try:
        yield
    except passed_on:
        raise
    except (OSError, RuntimeError) as error:  # HDF5's are RuntimeErrors, too
        said = disk_error(folder, error)
        if said is None:
            raise
        raise said from error


def masked(text: str) -> str:
    """Return `text` with every secret replaced by ``****``.

    Secrets are the passwords of addresses (``scheme://user:password@host``), wherever they come
    from, and the values of environment variables that are named as one. Errors of other libraries
    quote addresses with their credentials, and locks record command lines: such text is masked
    before it is stored or printed. Data are not masked: a condition must not change because it
    looks like a key.
    """
    for secret in _secrets():
        if secret in text:
            text = text.replace(secret, MASK)
    return without_passwords(text)


def _secrets() -> list[str]:
    """Return all secrets, longest first: one may be part of another."""
    found = set()
    for name, value in os.environ.items():
        if len(value) < _SHORTEST:
            continue
        if is_secret(name) and not value.startswith("/"):
            found.add(value)
        elif (password := password_in(value)) and len(password) >= _SHORTEST:
            found.add(password)
    return sorted(found, key=len, reverse=True)
