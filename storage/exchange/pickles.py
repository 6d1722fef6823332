"""Pickles of foreign origin read as data: no import, no call of what they name.

A pickle is a program. Python's own machine for it, held back by a list of allowed names, still
allocates what a length or a memo's index says before a byte of it was seen, and hashes keys that
take longer than the universe. So there is a machine of our own (`pickle_machine`).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from protocols.errors import InputError
from storage.exchange.pickle_depth import check_depth
from storage.exchange.pickle_machine import Machine
from storage.exchange.pickle_numpy import Refused

MAX_BYTES = 1 << 29


def read_pickle(path: Path) -> Any:
    """What a pickle holds: numbers, text, bytes, lists, tuples, dictionaries, numpy arrays.

    Raises:
        InputError: it cannot be read, is damaged, or holds something else; nothing was run.
    """
    try:
        with path.open("rb") as handle:
            data = handle.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise InputError(path, "", None, f"is over {MAX_BYTES >> 20} MiB")
    return parse_pickle(data, path)


def parse_pickle(data: bytes, path: str | Path) -> Any:
    """As `read_pickle`, of bytes that came from `path`."""
    machine = Machine(data)
    try:
        found = machine.run()
        check_depth(found)
    except Refused as error:
        raise InputError(
            path, f"byte {machine.begun}", None,
            f"holds {error}; only numbers, text, plain containers and numpy arrays are read from "
            "a pickle, nothing was run",
        ) from None  # fmt: skip
    except (ValueError, IndexError, KeyError, TypeError, struct.error, OverflowError) as error:
        raise InputError(
            path, f"byte {machine.begun}", None, f"is no pickle, or a damaged one ({error!r:.80})"
        ) from None
    return found
