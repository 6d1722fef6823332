"""Lines between the sync box and the host; docs/sync-box.md has the protocol.

The driver and the fake on a pty share this file; the firmware has it in C (firmware/line.c).
"""

from __future__ import annotations

import zlib

NAME = "sliplab-sync-box 2"
"""Answer of the box to `ID?`; the number is the protocol's."""
BAUD = 500_000
"""An exact divisor of the box's 16 MHz (115,200 is 2 % off), known to every operating system."""
LEAST_HZ, MOST_HZ = 1.0, 1000.0
ALL_TO_HZ = 200.0
"""Up to here the box reports every tick; above only those with a code bit 1."""
_DIGITS = 15
LONGEST_LINE = 80
"""Bytes; what goes on for longer without an end is no line."""


def seal(body: str) -> bytes:
    """A line ready to send: `body`, `*`, the low byte of its CRC-32 in hex, a line feed."""
    text = body.encode("ascii")
    return b"%s*%02X\n" % (text, zlib.crc32(text) & 0xFF)


def unseal(line: bytes) -> str | None:
    """The body of a line without its line feed; None if the checksum is wrong or missing."""
    text, star, check = line.rpartition(b"*")
    if not star or check != b"%02X" % (zlib.crc32(text) & 0xFF):
        return None
    try:
        return text.decode("ascii")
    except UnicodeDecodeError:
        return None


def whole(word: str) -> int:
    """The number that a word of a line writes in digits alone, as the box does.

    Raises:
        ValueError: it writes none, or one beyond 200 years in microseconds.
    """
    if not (word.isdecimal() and len(word) <= _DIGITS):
        raise ValueError(f"{word!r} is no number")
    return int(word)


class LineReader:
    """Cuts what comes in, piece by piece, into lines."""

    def __init__(self) -> None:
        self._rest = b""
        self.wrong = 0
        """Lines with a wrong checksum, and what was too long to be one."""

    def bodies(self, data: bytes) -> list[str]:
        """The bodies of the lines that `data` completed."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        bodies = [unseal(line) for line in lines]
        if len(self._rest) > LONGEST_LINE:
            self._rest = b""
            self.wrong += 1
        right = [body for body in bodies if body is not None]
        self.wrong += len(bodies) - len(right)
        return right
