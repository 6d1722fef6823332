"""Pickles of foreign origin read as data: no import, no call of what they name.

A pickle is a program. Python's own machine for it, held back by a list of allowed names, still
allocates what a length or a memo's index says before a byte of it was seen, and hashes keys that
take longer than the universe. So there is a machine of our own (`pickle_machine`).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from sliplab.protocols.errors import InputError
from sliplab.storage.exchange.pickle_depth import check_depth
from sliplab.storage.exchange.pickle_machine import Machine
from sliplab.storage.exchange.pickle_numpy import Refused

MAX_BYTES = 1 << 29
_KINDS = "numbers, text, plain containers and numpy arrays"


def read_pickle(path: Path) -> Any:
    """The value of a pickle: numbers, text, bytes, lists, tuples, dictionaries, numpy arrays.

    Raises:
        InputError: it cannot be read, is damaged, or holds something else; nothing was run.
    """
    return parse_pickle(read_bounded(path), path)


def read_bounded(path: Path) -> bytes:
    """All bytes of a file of at most `MAX_BYTES`.

    Raises:
        InputError: it cannot be read, or is larger.
    """
    try:
        with path.open("rb") as handle:
            data = handle.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise InputError(path, "", None, f"is over {MAX_BYTES >> 20} MiB")
    return data


def parse_pickle(data: bytes, path: str | Path, before: int = 0) -> Any:
    """As `read_pickle`, of bytes that came from `path`, where so many stand `before` them."""
    machine = Machine(data)
    try:
        found = machine.run()
        check_depth(found)
    except Refused as error:
        raise InputError(
            path, f"byte {before + machine.begun}", None,
            f"holds {error}; only {_KINDS} are read from a pickle, nothing was run",
        ) from None  # fmt: skip
    except (ValueError, IndexError, KeyError, TypeError, struct.error, OverflowError) as error:
        raise InputError(
            path, f"byte {before + machine.begun}", None,
            f"is no whole pickle: {_in_words(error, data, machine.begun)}; a file as Python's "
            f"pickle.dump writes it is read, with {_KINDS} in it",
        ) from None  # fmt: skip
    return found


def _in_words(error: Exception, data: bytes, at: int) -> str:
    """The fault of a damaged pickle, for people."""
    if not data:
        return "the file is empty"
    if at >= len(data):
        return f"it ends after {len(data)} bytes without its last instruction, as a copy cut short"
    if isinstance(error, KeyError):
        return f"it asks for value {error} of its memo, which was never stored"
    if isinstance(error, IndexError):
        return "it takes a value from its stack, which is empty"
    if isinstance(error, UnicodeError):
        return "it has text that is not in its encoding"
    return str(error)
