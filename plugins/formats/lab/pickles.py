"""Safe reading of foreign pickles: nothing that they name is imported or called.

A pickle is a program. Python's own `Unpickler` executes it with the names restricted to
placeholders. Since it still allocates any requested length and hashes any key, it runs in a
child process with limited memory and time (`pickle_child`).
"""

from __future__ import annotations

import io
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile

MAX_BYTES = 1 << 29
MEMORY = 4 << 30
"""Address space of the child, bytes."""
_CHILD = Path(__file__).with_name("pickle_child.py")
_SECONDS, _BYTES_PER_SECOND = 3, 500_000
"""Processor time that a file may take: ten times that of the lab's files."""
_KINDS = "numbers, text, plain containers and numpy arrays"


def read_pickle(path: Path) -> Any:
    """Return the value of a pickle: numbers, text, bytes, containers and numpy arrays.

    Raises:
        InputError: it cannot be read, is damaged, or holds something else; nothing was run.
    """
    return parse_pickle(read_bounded(path), path)


def read_bounded(path: Path) -> bytes:
    """Return all bytes of a file of at most `MAX_BYTES`.

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
    """Return the value of a pickle in memory, as `read_pickle` does.

    Args:
        path: where it came from, for messages.
        before: bytes that precede it there.
    """
    answer = in_child(data, _SECONDS + len(data) // _BYTES_PER_SECOND)
    kind, *found = _Answer(io.BytesIO(answer)).load()
    if kind == "value":
        return found[0]
    at, text = found
    if kind == "refused":
        raise InputError(
            path,
            f"byte {before + at}",
            None,
            f"holds {text}; only {_KINDS} are read from a pickle, nothing was run",
        )
    fault = DamagedFile if at or not data else InputError
    raise fault(
        path,
        f"byte {before + at}",
        None,
        f"is no whole pickle: {text}; a file as Python's pickle.dump writes it is read, with "
        f"{_KINDS} in it",
    )


def in_child(data: bytes, seconds: int) -> bytes:
    """Return `pickle_child.answer` from a child process; one that died refused the file."""
    command = [sys.executable, "-I", "-S", "-B", str(_CHILD), str(MEMORY), str(seconds)]
    try:
        # a busy machine gives a process a part of its time
        done = subprocess.run(
            command, input=data, capture_output=True, timeout=60 + 20 * seconds, check=False
        )
    except subprocess.TimeoutExpired:
        ended = "did not end"
    else:
        if done.returncode == 0:
            return done.stdout
        ended = f"ended with code {done.returncode}"
    limits = f"{seconds} s or {MEMORY >> 30} GiB"
    text = f"content that takes more than {limits} to read (its process {ended})"
    return pickle.dumps(("refused", 0, text))


class _Answer(pickle.Unpickler):
    """The child's answer, in which arrays are the only name."""

    def find_class(self, module: str, name: str) -> Any:
        if name != "array":
            raise pickle.UnpicklingError(f"{module}.{name}")
        return _array


def _array(kind: str, byte_order: Any, shape: tuple[int, ...], order: Any, content: Any) -> Any:
    """Return an array that the child described; it checked that the sizes agree."""
    if kind == "O":
        objects = np.empty(len(content), object)
        for index, item in enumerate(content):  # a slice would look into lists of equal length
            objects[index] = item
        return objects.reshape(shape)  # numpy lists objects in C order, whatever the array's is
    dtype: np.dtype[Any] = np.dtype(kind).newbyteorder(byte_order)
    return np.frombuffer(bytes(content), dtype).reshape(shape, order=order)
