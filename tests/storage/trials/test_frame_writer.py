"""The spool writes what it gets, in order, and says when it could not."""

from __future__ import annotations

import errno
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.storage.trials import frame_writer as spooling
from sliplab.storage.trials.frame_writer import Spool


def frames(count: int, begin: int = 0) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.arange(begin, begin + count, dtype=np.uint8)[:, None, None] * np.ones(
        (1, 4, 6), np.uint8
    )


def test_what_goes_in_is_in_the_file(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "raw")
    spool.write(frames(3))
    spool.write(frames(0))
    spool.write(frames(8, 3)[::2])  # not in one piece
    spool.close()
    spool.close()
    read = np.fromfile(tmp_path / "raw", np.uint8).reshape(-1, 4, 6)
    assert np.array_equal(read, np.concatenate([frames(3), frames(8, 3)[::2]]))


class Disk:
    """A file that fails, or waits until it is told to go on."""

    def __init__(self, file: Any, error: OSError | None = None) -> None:
        self.file, self.error, self.go = file, error, threading.Event()

    def write(self, data: memoryview) -> int:
        self.go.wait(30.0)
        if self.error is not None:
            raise self.error
        written: int = self.file.write(data[:5])  # as a disk may
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


def test_a_full_disk_is_raised_to_whoever_writes_or_closes(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "raw")
    disk: Any = Disk(spool._file, OSError(errno.ENOSPC, "full"))
    spool._file = disk
    spool.write(frames(1))
    disk.go.set()
    with pytest.raises(OSError, match="full"):
        spool.close()
    with pytest.raises(OSError, match="full"):
        spool.write(frames(1))


def test_a_slow_disk_is_waited_for_only_when_memory_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spooling, "QUEUE_BYTES", 40)
    spool = Spool(tmp_path / "raw")
    disk: Any = Disk(spool._file)
    spool._file = disk
    spool.write(frames(1))
    spool.write(frames(1, 1))  # 48 bytes wait now
    third = threading.Thread(target=spool.write, args=(frames(1, 2),), daemon=True)
    third.start()
    assert third.is_alive()
    disk.go.set()
    third.join(30.0)
    spool.close()
    assert np.array_equal(np.fromfile(tmp_path / "raw", np.uint8), frames(3).ravel())


def test_a_disk_that_stands_still_is_an_error_in_the_end(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(spooling, "QUEUE_BYTES", 10)
    monkeypatch.setattr(spooling, "WAIT_S", 0.05)
    spool = Spool(tmp_path / "raw")
    disk: Any = Disk(spool._file)
    spool._file = disk
    spool.write(frames(1))
    with pytest.raises(OSError, match="has hung"):
        spool.write(frames(1))
    with pytest.raises(OSError, match="has hung"):
        spool.close()
    monkeypatch.undo()
    disk.go.set()
    spool.close()
