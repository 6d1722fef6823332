"""PNG of images that are nearly all black, from their other pixels alone.

A general encoder reads a million zeros to store a hundred counts of events. Here the runs of zeros
are written as such: one deflate block of fixed Huffman codes (RFC 1951, 3.2.6), in which a match of
distance 1 repeats the zero before it up to 258 times.
"""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sliplab.storage.kernels import njit

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LENGTHS = np.array(
    [3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131,
     163, 195, 227, 258],
    np.int64,
)  # fmt: skip
"""Shortest match of each length code from 257 on."""
_EXTRA = np.array([0] * 8 + [k for k in range(1, 6) for _ in range(4)] + [0], np.int64)
_WHOLE = 0b10100011
"""A match of 258 at distance 1, its bits in the order of the stream, the first one lowest."""
_ADLER = 65_521


def sparse_pngs(places: I64, values: U8, edges: I64, height: int, width: int) -> list[bytes]:
    """Return the PNGs of RGB images.

    Args:
        places: (n,) indices into the flat (height, width, 3) image, ascending in each.
        values: (n,) levels there; all others are 0.
        edges: (images + 1,) the first place of each image, and n.
    """
    row = 3 * width
    raw = places + places // row + 1  # a byte for the filter before each row
    header = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    begin, end, size = _SIGNATURE + header, _chunk(b"IEND", b""), height * (row + 1)
    made = []
    for low, high in pairwise(edges.tolist()):
        packed = _deflated(raw[low:high], values[low:high], size, _LENGTHS, _EXTRA)
        made.append(begin + _chunk(b"IDAT", packed.tobytes()) + end)
    return made


def _chunk(name: bytes, data: bytes) -> bytes:
    named = name + data
    return struct.pack(">I", len(data)) + named + struct.pack(">I", zlib.crc32(named))


@njit(cache=True, nogil=True)
def _deflated(places: I64, values: U8, size: int, lengths: I64, extra: I64) -> U8:
    """Return a zlib stream of `size` bytes that are 0 but at some places."""
    # a literal takes 9 bits at most, a match 18, a run of zeros a literal and two matches more
    out = np.zeros(16 + 2 * size // 258 * 2 + 16 * (places.size + 1), np.uint8)
    out[0], out[1] = 0x78, 0x01
    at = 16  # bits
    at = _put(out, at, 0b011, 3)
    a, b, done = 1, 0, 0
    black = False
    for k in range(places.size + 1):
        end = places[k] if k < places.size else size
        run = end - done
        b = (b + run * a) % _ADLER
        if run and not black:
            at = _literal(out, at, 0)
            run -= 1
            black = True
        while run > 0:
            if run >= 258:  # most of the image: both codes in one go, 13 bits
                word = _WHOLE << (at & 7)
                out[at >> 3] |= word & 255
                out[(at >> 3) + 1] |= word >> 8
                at += 13
                run -= 258
                continue
            if run < 3:
                at = _literal(out, at, 0)
                run -= 1
                continue
            length = run
            code = np.searchsorted(lengths, length, side="right") - 1
            short = code < 23
            at = _code(out, at, code + 1 if short else 0b11000000 + code - 23, 7 if short else 8)
            at = _put(out, at, length - lengths[code], extra[code])
            at = _put(out, at, 0, 5)  # distance 1
            run -= length
        done = end
        if k < places.size:
            at = _literal(out, at, values[k])
            black = values[k] == 0
            a = (a + values[k]) % _ADLER
            b = (b + a) % _ADLER
            done += 1
    at = _put(out, at, 0, 7)  # end of block
    last = (at + 7) // 8
    for k, value in enumerate((b >> 8, b & 255, a >> 8, a & 255)):
        out[last + k] = value
    return out[: last + 4]


@njit(cache=True, nogil=True)
def _literal(out: U8, at: int, value: int) -> int:
    if value < 144:
        return _code(out, at, 0b00110000 + value, 8)
    return _code(out, at, 0b110010000 + value - 144, 9)


@njit(cache=True, nogil=True)
def _code(out: U8, at: int, code: int, bits: int) -> int:
    """Append a Huffman code, its highest bit first."""
    for k in range(bits - 1, -1, -1):
        out[at >> 3] |= ((code >> k) & 1) << (at & 7)
        at += 1
    return at


@njit(cache=True, nogil=True)
def _put(out: U8, at: int, value: int, bits: int) -> int:
    """Append a number, its lowest bit first."""
    for k in range(bits):
        out[at >> 3] |= ((value >> k) & 1) << (at & 7)
        at += 1
    return at
