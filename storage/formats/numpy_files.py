"""Arrays of numpy's files: checked against the bytes that are there, and never unpickled."""

from __future__ import annotations

import io
import math
import mmap
import shutil
import warnings
from pathlib import Path
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import Any
from zipfile import ZipFile, ZipInfo

import numpy as np

from sliplab.storage.formats.foreign import FormatError

MAGIC = np.lib.format.MAGIC_PREFIX
ZIP_MAGIC = b"PK\x03\x04"
_HEAD_BYTES = 1 << 16
_FEW_BYTES = 1 << 20
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_FAULTS = (
    ValueError,
    KeyError,
    TypeError,
    SyntaxError,
    TokenError,
    RecursionError,
    MemoryError,
)


def read_header(file: Any) -> tuple[tuple[int, ...], bool, Any]:
    """Return shape, order (True: columns first) and type of the array that follows in a file.

    Raises:
        FormatError: the header is damaged.
    """
    try:
        version = np.lib.format.read_magic(file)
        with warnings.catch_warnings():
            # headers of Python 2 are read as well, only slower
            warnings.simplefilter("ignore", UserWarning)
            return _HEADERS[version](file)
    except _FAULTS as error:
        raise FormatError(f"has a damaged numpy header ({' '.join(str(error).split())})") from None


def array_of(data: Any) -> Any:
    """Return the array in the bytes of a ``.npy`` file, without a copy.

    Raises:
        FormatError: it is no such file, is damaged, or holds objects instead of numbers.
    """
    head = io.BytesIO(bytes(data[:_HEAD_BYTES]))
    if head.getvalue()[: len(MAGIC)] != MAGIC:
        raise FormatError("is no array of numpy (.npy)")
    shape, fortran, dtype = read_header(head)
    if dtype.hasobject:
        raise FormatError("holds Python objects, which are not read; save numbers")
    there, wanted = len(data) - head.tell(), math.prod(shape) * dtype.itemsize
    if there != wanted:
        raise FormatError(f"holds {there} bytes for an array of shape {shape}, not {wanted}")
    if not wanted:
        return np.empty(shape, dtype)
    numbers = np.frombuffer(data, dtype, offset=head.tell())
    return numbers.reshape(shape, order="F" if fortran else "C")


def arrays_of(path: Path, most_bytes: int) -> dict[str, Any]:
    """Return the arrays of an ``.npz`` file by name.

    Raises:
        FormatError: as `array_of`, or they are larger than `most_bytes` together.
    """
    try:
        with ZipFile(path) as packed:
            items = [item for item in packed.infolist() if item.filename.endswith(".npy")]
            if sum(item.file_size for item in items) > most_bytes:
                raise FormatError(f"holds more than {most_bytes >> 20} MiB")
            return {item.filename[:-4]: array_of(unpacked(packed, item)) for item in items}
    except FormatError:
        raise
    except Exception as error:  # zlib and lzma have their own errors
        raise FormatError(f"is a damaged .npz file ({error})") from None


def unpacked(packed: ZipFile, item: ZipInfo) -> Any:
    """Return the bytes of a file in a zip, mapped from a temporary file if there are many.

    Raises:
        Exception: it is damaged; the libraries of its compressions have their own errors.
    """
    with packed.open(item) as source:
        if item.file_size <= _FEW_BYTES:
            return source.read(item.file_size)
        with TemporaryFile() as file:
            shutil.copyfileobj(source, file, _FEW_BYTES)
            file.flush()
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def release(data: Any) -> None:
    """Take what was read of a mapped file, or of an array in it, out of the memory."""
    while isinstance(data, np.ndarray):
        data = data.base
    mapped = data.obj if isinstance(data, memoryview) else None
    if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)
