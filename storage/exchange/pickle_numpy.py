"""What a foreign pickle may ask numpy for, done without numpy's own unpickling.

numpy's functions for this take sizes and types on trust: a state of a few bytes can ask for an
array of any size or one of pointers. Here each request is checked against the bytes that came.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

_TYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|O8?|\?)")
_MOST_AXES = 8


class Refused(ValueError):
    """Something that a file of numbers has no use for; the message says what."""


class Pending:
    """An object that a pickle names first and describes later; `value` is None until then."""

    def __init__(self, kind: str, value: Any = None) -> None:
        self.kind = kind
        self.value = value


def make_type(*arguments: Any) -> Pending:
    """``numpy.dtype(text, align, copy)``: plain numbers, truth values and objects only."""
    text = arguments[0] if arguments else None
    if not isinstance(text, str) or not _TYPE.fullmatch(text) or len(arguments) > 3:
        raise Refused("an array of another type than plain numbers")
    return Pending("dtype", np.dtype(text))


def build_type(pending: Pending, state: Any) -> np.dtype[Any]:
    """The order of a type's bytes, which is all that its state may say."""
    if not isinstance(state, tuple) or len(state) < 5 or state[2:5] != (None, None, None):
        raise Refused("an array of records")
    order = _text(state[1])
    if order not in {"<", ">", "|", "="}:
        raise Refused("a type with an unknown order of bytes")
    pending.value = found = pending.value.newbyteorder(order)
    return found  # type: ignore[no-any-return]


def make_array(*arguments: Any) -> Pending:
    """``_reconstruct(ndarray, (0,), b"b")``: an array that is described later."""
    if len(arguments) != 3 or arguments[0] != "ndarray":
        raise Refused("an array of another class than numpy's own")
    return Pending("ndarray")


def build_array(pending: Pending, state: Any) -> np.ndarray[Any, Any]:
    """An array from (version, shape, type, Fortran order, bytes or list of objects)."""
    if not isinstance(state, tuple) or len(state) != 5 or pending.value is not None:
        raise Refused("an array that is described in another way than numpy's")
    _, shape, dtype, fortran, content = state
    pending.value = found = _array(content, dtype, shape, "F" if fortran is True else "C")
    return found


def from_buffer(*arguments: Any) -> np.ndarray[Any, Any]:
    """``_frombuffer(bytes, type, shape, order)``."""
    if len(arguments) != 4 or arguments[3] not in {"C", "F"}:
        raise Refused("an array that is described in another way than numpy's")
    content, dtype, shape, order = arguments
    return _array(content, dtype, shape, order)


def scalar(*arguments: Any) -> bool | int | float:
    """``scalar(type, bytes)`` as Python's own number."""
    if len(arguments) != 2:
        raise Refused("a number that is described in another way than numpy's")
    found: bool | int | float = _array(arguments[1], arguments[0], (), "C").item()
    return found


def encode(*arguments: Any) -> bytes:
    """``_codecs.encode(text, "latin1")``: how protocol 2 spells bytes."""
    if len(arguments) != 2 or arguments[1] != "latin1" or not isinstance(arguments[0], str):
        raise Refused("text in another encoding than latin1")
    return arguments[0].encode("latin1")


def no_bytes(*arguments: Any) -> bytes:
    """``bytes()``: how protocol 2 spells empty ones."""
    if arguments:
        raise Refused("bytes made of something")
    return b""


def _array(content: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray[Any, Any]:
    kind = dtype.value if isinstance(dtype, Pending) else dtype
    if not isinstance(kind, np.dtype):
        raise Refused("an array without a type")
    if (
        not isinstance(shape, tuple)
        or len(shape) > _MOST_AXES
        or not all(type(side) is int and 0 <= side < 2**31 for side in shape)
    ):
        raise Refused("an array of an impossible shape")
    count = math.prod(shape)
    if kind.hasobject:
        if type(content) is not list or len(content) != count:
            raise Refused(f"an array of {count} objects with another number of them")
        objects = np.empty(count, object)
        for index, item in enumerate(content):  # a slice would look into lists of equal length
            objects[index] = item
        return objects.reshape(shape)  # numpy lists objects in C order, whatever the array's is
    data = content.encode("latin1") if isinstance(content, str) else content
    if not isinstance(data, bytes | bytearray) or len(data) != count * kind.itemsize:
        raise Refused(f"an array of {count} numbers with another number of bytes")
    return np.frombuffer(bytes(data), kind).reshape(shape, order=order)


def _text(value: Any) -> Any:
    return value.decode("latin1") if isinstance(value, bytes) else value


ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): make_type,
    ("_codecs", "encode"): encode,
    ("__builtin__", "bytes"): no_bytes,
    **{
        (f"numpy.{core}.{module}", name): found
        for core in ("core", "_core")
        for module, name, found in (
            ("multiarray", "_reconstruct", make_array),
            ("multiarray", "scalar", scalar),
            ("numeric", "_frombuffer", from_buffer),
        )
    },
}
"""All that a pickle may name, and what is done instead of importing it."""
BUILDERS = {"dtype": build_type, "ndarray": build_array}
