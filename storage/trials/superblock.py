"""Superblock of an HDF5 file: whether a program that had the file open for writing closed it.

A program that opens a file for writing sets a flag in the superblock, and clears it when it closes
the file. Where it died, the flag stays, HDF5 refuses the file, and its checksum no longer fits,
although no data changed (HDF5 File Format Specification 3.0, II.A).
"""

from __future__ import annotations

import os
import struct
import threading
from itertools import chain
from pathlib import Path

from sliplab.storage.files import read_blocks, sha256, sha256_of, write_blocks

SIGNATURE = b"\x89HDF\r\n\x1a\n"
HEAD_BYTES = 48
"""Length of a superblock of version 2 or 3 with offsets of 8 bytes."""
_VERSIONS = (2, 3)
_FLAGS, _END, _SUM = 11, 28, 44
"""Places of the flags, of the file's end, and of the superblock's own checksum."""
_MENDING = threading.Lock()
_MASK = 0xFFFFFFFF


def closed(head: bytes, size: int | None = None) -> bytes | None:
    """Return a superblock as it is once the file is closed.

    Args:
        head: the file's first `HEAD_BYTES` bytes.
        size: of the file of a program that was killed: where the superblock says that it ends is
            written last, and HDF5 reads nothing behind that.

    Returns:
        None if it is closed already, or is no superblock of these versions.
    """
    if len(head) != HEAD_BYTES or not head.startswith(SIGNATURE):
        return None
    if head[8] not in _VERSIONS or head[9] != 8 or not head[_FLAGS]:
        return None
    plain = head[:_FLAGS] + b"\0" + head[_FLAGS + 1 : _SUM]
    if size is not None:
        plain = plain[:_END] + struct.pack("<Q", size) + plain[_END + 8 :]
    return plain + struct.pack("<I", lookup3(plain))


def mend(path: Path, digest: str) -> bool:
    """Close a file that a program left open, if that makes it the one with this SHA-256.

    The file is replaced in one step; a program that still has it open keeps the old one.

    Returns:
        True if the file has this SHA-256 now; otherwise nothing was changed.

    Raises:
        OSError: it cannot be read or written.
    """
    with _MENDING:
        with path.open("rb") as file:
            head = closed(file.read(HEAD_BYTES))
            mode = os.fstat(file.fileno()).st_mode & 0o777
        if head is None:  # or another program has just closed it
            return sha256(path) == digest
        if sha256_of(_with_head(path, head)) != digest:
            return False
        write_blocks(path, _with_head(path, head), mode)
        return True


def left_open(path: Path) -> bool:
    """Return whether a file says that a program has it open for writing."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return closed(file.read(HEAD_BYTES)) is not None
    except OSError:
        return False


def _with_head(path: Path, head: bytes) -> chain[bytes]:
    """Return the blocks of a file with another superblock."""
    blocks = read_blocks(path)
    return chain((head, next(blocks)[HEAD_BYTES:]), blocks)


def lookup3(data: bytes) -> int:
    """Return Jenkins' hash `hashlittle` of some bytes, 32 bits: HDF5's checksum of metadata."""
    a = b = c = (0xDEADBEEF + len(data)) & _MASK
    blocks = max(0, len(data) - 1) // 12
    for x, y, z in struct.iter_unpack("<III", data[: blocks * 12]):
        a, b, c = (a + x) & _MASK, (b + y) & _MASK, (c + z) & _MASK
        a = (a - c & _MASK) ^ _turned(c, 4)
        c = (c + b) & _MASK
        b = (b - a & _MASK) ^ _turned(a, 6)
        a = (a + c) & _MASK
        c = (c - b & _MASK) ^ _turned(b, 8)
        b = (b + a) & _MASK
        a = (a - c & _MASK) ^ _turned(c, 16)
        c = (c + b) & _MASK
        b = (b - a & _MASK) ^ _turned(a, 19)
        a = (a + c) & _MASK
        c = (c - b & _MASK) ^ _turned(b, 4)
        b = (b + a) & _MASK
    if not data:
        return c
    x, y, z = struct.unpack("<III", data[blocks * 12 :].ljust(12, b"\0"))
    a, b, c = (a + x) & _MASK, (b + y) & _MASK, (c + z) & _MASK
    c = ((c ^ b) - _turned(b, 14)) & _MASK
    a = ((a ^ c) - _turned(c, 11)) & _MASK
    b = ((b ^ a) - _turned(a, 25)) & _MASK
    c = ((c ^ b) - _turned(b, 16)) & _MASK
    a = ((a ^ c) - _turned(c, 4)) & _MASK
    b = ((b ^ a) - _turned(a, 14)) & _MASK
    return int((c ^ b) - _turned(b, 24)) & _MASK


def _turned(value: int, bits: int) -> int:
    return (value << bits | value >> (32 - bits)) & _MASK
