"""Recordings of formats that are known and not read: what each is, and what converts it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from sliplab.storage.formats.foreign import read_head
from sliplab.storage.trials.superblock import SIGNATURE

_AEDAT = re.compile(rb"#!AER-DAT(\d+\.\d+)")
_READ_AEDAT = b"4.0"
_MATLAB = re.compile(rb"MATLAB (\d+\.\d+) MAT-file")
_COLUMNS = "write its events as the columns events/x, y, p and t (us) of an HDF5 file"
_EVENT_BYTES = 5
_LEAST = 20
"""Events needed to distinguish a file without a header from other bytes."""


def unread(file: Path) -> str | None:
    """Return what a file is, and what converts it, if its format is known and not read.

    Returns:
        A text that continues after the file's name; None for any other file.

    Raises:
        InputError: it cannot be read at all.
    """
    if not file.is_file():
        return None
    head = read_head(file)
    suffix = file.suffix.lower()
    if (found := _AEDAT.match(head)) and found[1] != _READ_AEDAT:
        return _is_aedat(found[1].decode())
    if suffix == ".aedat" and not found:
        return _is_aedat("1.0")  # the one version without a header
    found = _MATLAB.match(head)
    if found or (suffix == ".mat" and not head.startswith(SIGNATURE)):
        version = found[1].decode() if found else "4"  # the one without a text in its header
        loads = "h5py" if version.startswith("7") else "scipy.io.loadmat"
        return (
            f"is a MATLAB file of format {version}, which does not say what its variables are: "
            f"load it by {loads}, and {_COLUMNS}"
        )
    if suffix == ".bin" and _is_n_mnist(head, file.stat().st_size):
        return (
            "has the form of a file of N-MNIST, 5 bytes an event and no header, which is not "
            f"read: load it by tonic.io.read_mnist_file, and {_COLUMNS}"
        )
    return None


def _is_aedat(version: str) -> str:
    return f"is an AEDAT {version} file; read is AEDAT 4.0, to which iniVation's DV converts it"


def _is_n_mnist(head: bytes, size: int) -> bool:
    """Return whether bytes are column, row, and polarity with 23 bits of time that only grow."""
    count = min(len(head), size) // _EVENT_BYTES
    if size % _EVENT_BYTES or count < _LEAST:
        return False
    rows = np.frombuffer(head, np.uint8, count * _EVENT_BYTES).reshape(-1, _EVENT_BYTES)
    high, middle, low = (rows[:, part].astype(np.int64) for part in (2, 3, 4))
    times = (high & 0x7F) << 16 | middle << 8 | low
    return bool(np.all(np.diff(times) >= 0) and times[-1] > times[0])
