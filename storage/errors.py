"""What is said when a store, or the disk that it is on, cannot be used."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sliplab.protocols.errors import InputError
from sliplab.storage.files import disk_fault, disk_full


class StoreError(RuntimeError):
    """A store cannot be used as asked; the message begins with the path and says what to do."""


class NoStore(InputError, StoreError):
    """The path or URL of a store was given, and no store can be there: wrong input.

    Args:
        place: as it was given.
        why: what is there instead, and what to do.
    """

    def __init__(self, place: Path | str, why: str) -> None:
        super().__init__(place, "", None, why)

    def __reduce__(self) -> tuple[type[NoStore], tuple[str, ...]]:
        """Its own arguments: it may come from another process."""
        return type(self), (str(self.file), self.expected)


def disk_error(folder: Path, error: BaseException) -> StoreError | None:
    """What to say of an error that came from the disk under `folder`; None for any other."""
    fault = disk_fault(error)
    if fault is None:
        return None
    todo = "see to that"
    if disk_full(error):
        there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        fault += f" ({shutil.disk_usage(there).free / 1e9:.1f} GB free)"
        todo = "make room"
    return StoreError(
        f"{folder}: its disk {fault}: {todo}, then run the same command to go on; every "
        "committed trial is kept"
    )


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
