"""Line format of the protocol between sync box and host; see docs/sync-box.md.

Driver and fake share this module; the firmware has it in C (firmware/line.c).
"""

from __future__ import annotations

import zlib

NAME = "sliplab-sync-box 2"
"""Answer of the box to `ID?`; the number is the protocol version."""
BAUD = 500_000
"""An exact divisor of the box's 16 MHz clock (115,200 is 2 % off), supported everywhere."""
LEAST_HZ, MOST_HZ = 1.0, 1000.0
ALL_TO_HZ = 200.0
"""Rate up to which the box reports every tick; above it, only ticks with a code bit 1."""
_BEGUN = f"B {NAME}".encode("ascii")
_DIGITS = 15
LONGEST_LINE = 80
"""Longest line, bytes; longer data without an end are discarded."""


def seal(body: str) -> bytes:
    """Build a line: `body`, `*`, the low byte of its CRC-32 in hex, a line feed."""
    text = body.encode("ascii")
    return b"%s*%02X\n" % (text, zlib.crc32(text) & 0xFF)


def unseal(line: bytes) -> str | None:
    """Return the body of a line without line feed; None if the checksum is wrong or missing."""
    text, star, check = line.rpartition(b"*")
    if not star or check != b"%02X" % (zlib.crc32(text) & 0xFF):
        return None
    try:
        return text.decode("ascii")
    except UnicodeDecodeError:
        return None


def whole(word: str) -> int:
    """Parse a number that consists of digits only, as the box sends it.

    Raises:
        ValueError: it is not a number, or beyond 200 years in microseconds.
    """
    if not (word.isdecimal() and len(word) <= _DIGITS):
        raise ValueError(f"{word!r} is not a number")
    return int(word)


class LineReader:
    """Splits received data into lines."""

    def __init__(self) -> None:
        self._rest = b""
        self.wrong = 0
        """Number of lines with a wrong checksum or excessive length."""

    def bodies(self, data: bytes) -> list[str]:
        """Return the bodies of the lines that `data` completes."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        # a reset cuts a line, and the report of the restart follows without a line feed
        bodies = [unseal(line[max(line.find(_BEGUN), 0) :]) for line in lines]
        if len(self._rest) > LONGEST_LINE:
            self._rest = b""
            self.wrong += 1
        right = [body for body in bodies if body is not None]
        self.wrong += len(bodies) - len(right)
        return right
