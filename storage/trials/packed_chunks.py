"""Length of an HDF5 chunk once it is unpacked, by the chunk itself.

HDF5 copies a whole chunk from what its filters return, without a look at its length: of a shorter
one it reads foreign memory, up to a crash.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

Filter = tuple[int, tuple[int, ...]]
"""Number and options of a filter, as HDF5 registers them."""
_DEFLATE, _SHUFFLE, _FLETCHER32, _SZIP = 1, 2, 3, 4
_LZF, _BLOSC, _LZ4, _BITSHUFFLE, _ZSTD = 32000, 32001, 32004, 32008, 32015
_SUM_BYTES = 4
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def unpacked_bytes(filters: Sequence[Filter], mask: int, data: bytes, most: int) -> int | None:
    """Return the bytes that the filters of a dataset make of a chunk.

    Args:
        filters: in the order in which they pack.
        mask: a bit for each filter that the chunk went past.
        data: the chunk as it is in the file.
        most: it is not counted further than this.

    Returns:
        None where a filter is unknown here.
    """
    packers = []
    for number, (kind, options) in enumerate(filters):
        if mask >> number & 1 or kind == _SHUFFLE:
            continue
        if kind == _BITSHUFFLE and not any(options[4:5]):
            continue  # it compresses nothing
        if kind == _FLETCHER32:
            data = data[:-_SUM_BYTES]
        else:
            packers.append((kind, options))
    if not packers:
        return len(data)
    if len(packers) > 1:
        return 0  # of the inner one nothing is known
    kind, options = packers[0]
    if kind == _DEFLATE:
        try:
            return len(zlib.decompressobj().decompress(data, most))
        except zlib.error:
            return 0
    if kind == _LZF:
        return options[2] if len(options) > 2 else 0
    if kind == _ZSTD:
        return _zstd_bytes(data)
    if kind in {_LZ4, _BITSHUFFLE}:
        return int.from_bytes(data[:8], "big")
    if kind == _BLOSC:
        return int.from_bytes(data[4:8], "little")
    if kind == _SZIP:
        return int.from_bytes(data[:4], "little")
    return None


def _zstd_bytes(data: bytes) -> int:
    """Return the size in the header of a Zstandard frame (RFC 8878, 3.1.1.1); 0 without one."""
    if len(data) < 5 or not data.startswith(_ZSTD_MAGIC):
        return 0
    flags = data[4]
    single = flags >> 5 & 1
    at = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    width = (single, 2, 4, 8)[flags >> 6]
    return int.from_bytes(data[at : at + width], "little") + (256 if width == 2 else 0)
