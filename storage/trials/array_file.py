"""Named arrays in one memory-mapped file, so that a training set is read on demand.

A line of JSON lists the arrays and their offsets, multiples of 64 bytes. Nothing
is compressed and nothing is copied on reading.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.files import write_blocks

Arrays = dict[str, npt.NDArray[Any]]

_MAGIC = b"sliplab-arrays-1\n"
_ALIGNED = 64


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write the arrays: all of them or none, and the same bytes for the same arrays.

    Raises:
        TypeError: an array of objects.
    """
    header, at = {}, 0
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise TypeError(f"{name} holds objects; expected numbers")
        header[name] = {"dtype": array.dtype.str, "shape": list(array.shape), "at": at}
        at += _up(array.nbytes)
    write_blocks(path, _blocks(json.dumps(header, sort_keys=True).encode() + b"\n", arrays))


def map_arrays(path: Path) -> Arrays:
    """The arrays of a file, mapped.

    Raises:
        OSError: it does not exist, or it cannot be read.
        ValueError: it is no such file, or truncated.
    """
    with path.open("rb") as file:
        if file.readline(64) != _MAGIC:
            raise ValueError(f"{path}: is not an array file of this program")
        try:
            header = json.loads(file.readline())
            start = _up(file.tell())
            size = path.stat().st_size
            arrays = {}
            for name, item in header.items():
                dtype, shape = np.dtype(item["dtype"]), tuple(int(n) for n in item["shape"])
                count = math.prod(shape)
                if dtype.hasobject or min(shape, default=0) < 0 or item["at"] < 0:
                    raise ValueError(f"{name} cannot be read")
                at = start + int(item["at"])
                if at + count * dtype.itemsize > size:
                    raise ValueError(f"it ends before {name} does")
                # written to, a page would be copied: the file stays unchanged
                mapped = np.memmap(path, dtype, "c", at, shape) if count else np.empty(shape, dtype)
                arrays[name] = mapped.view(np.ndarray)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: a damaged file of arrays: {error}") from error
    return arrays


def _blocks(header: bytes, arrays: Arrays) -> Iterator[bytes]:
    yield _padded(_MAGIC + header)
    for array in arrays.values():
        yield _padded(np.ascontiguousarray(array).tobytes())


def _padded(data: bytes) -> bytes:
    return data + bytes(_up(len(data)) - len(data))


def _up(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
