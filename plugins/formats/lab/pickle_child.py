"""Child process that reads one foreign pickle with Python's `Unpickler`, names restricted.

`pickles.in_child` runs it as a script: the pickle comes on standard input, the value or the
fault goes to standard output. It limits its own memory and processor time first, so that no length
or memo index in the file can exhaust the machine. It imports the standard library only and starts
in about 20 ms; arrays stay bytes with a type here, and become numpy's in the parent.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import pickletools
import re
import resource
import struct
import sys
from collections.abc import Callable
from typing import Any

MAX_DEPTH = 32
MAX_CONTAINERS = 1_000_000
"""The lab's files have a list for each pixel: 307,200."""
_MAX_AXES = 8
_MAX_BITS = 512
_PLAIN = frozenset({type(None), bool, int, float, str, bytes, bytearray})
_TYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|O8?|\?)")
_STRUCT = {
    "b1": "?",
    "?": "?",
    "i1": "b",
    "u1": "B",
    "i2": "h",
    "u2": "H",
    "i4": "i",
    "u4": "I",
    "i8": "q",
    "u8": "Q",
    "f2": "e",
    "f4": "f",
    "f8": "d",
}
"""numpy's types by their codes in `struct`; objects have none."""


class Refused(ValueError):
    """Content that a file of numbers has no use for; the message names it."""


def array(*arguments: Any) -> Any:
    """Name under which an array is returned: only the name is pickled, the parent makes arrays."""
    raise AssertionError("this name is for the parent")


class Name:
    """Stand-in for a name that a pickle may call. It is not a class and takes no state."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __call__(self, *arguments: Any) -> Any:
        return self._make(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise Refused("a state for something that takes none")


class Type:
    """Stand-in for ``numpy.dtype(text, align, copy)``: numbers, truth values and objects only."""

    __slots__ = ("kind", "order")

    def __init__(self, *arguments: Any) -> None:
        found = _TYPE.fullmatch(arguments[0]) if arguments and _is_text(arguments[0]) else None
        if found is None or len(arguments) > 3:
            raise Refused("an array of another type than plain numbers")
        self.kind = "O" if found[1].startswith("O") else found[1]
        self.order = "="

    def __setstate__(self, state: Any) -> None:
        if type(state) is not tuple or len(state) < 5 or state[2:5] != (None, None, None):
            raise Refused("an array of records")
        if state[1] not in {"<", ">", "|", "="}:
            raise Refused("a type with an unknown order of bytes")
        self.order = state[1]

    def __reduce__(self) -> Any:
        raise Refused("a type without an array")


class Array:
    """Stand-in for an array, whose pickle names it first and describes it later."""

    __slots__ = ("described",)

    def __init__(self) -> None:
        self.described: tuple[Any, ...] | None = None

    def __setstate__(self, state: Any) -> None:
        """Take (version, shape, type, Fortran order, bytes or list of objects)."""
        if type(state) is not tuple or len(state) != 5 or self.described is not None:
            raise Refused("an array that is described in another way than numpy's")
        _, shape, dtype, fortran, content = state
        self.describe(content, dtype, shape, "F" if fortran is True else "C")

    def describe(self, content: Any, dtype: Any, shape: Any, order: str) -> None:
        """Accept a description whose shape and type account for every byte that came."""
        if type(dtype) is not Type:
            raise Refused("an array without a type")
        if (
            type(shape) is not tuple
            or len(shape) > _MAX_AXES
            or not all(type(side) is int and 0 <= side < 2**31 for side in shape)
        ):
            raise Refused("an array of an impossible shape")
        count = math.prod(shape)
        if dtype.kind == "O":
            if type(content) is not list or len(content) != count:
                raise Refused(f"an array of {count} objects with another number of them")
        else:
            content = content.encode("latin1") if _is_text(content) else content
            size = count * struct.calcsize("=" + _STRUCT[dtype.kind])
            if type(content) not in {bytes, bytearray} or len(content) != size:
                raise Refused(f"an array of {count} numbers with another number of bytes")
        self.described = dtype.kind, dtype.order, shape, order, content

    def items(self) -> list[Any]:
        """Return the objects of an array of objects; an array of numbers has none."""
        if self.described is None:
            raise Refused("an array that is used before it is described")
        content = self.described[-1]
        return content if type(content) is list else []

    def __reduce__(self) -> Any:
        return array, self.described


def _is_text(value: Any) -> bool:
    return type(value) is str


def _reconstruct(*arguments: Any) -> Array:
    """``_reconstruct(ndarray, (0,), b"b")``: an array that is described later."""
    if len(arguments) != 3 or arguments[0] is not NDARRAY:
        raise Refused("an array of another class than numpy's own")
    return Array()


def _frombuffer(*arguments: Any) -> Array:
    """``_frombuffer(bytes, type, shape, order)``."""
    if len(arguments) != 4 or arguments[3] not in ("C", "F"):
        raise Refused("an array that is described in another way than numpy's")
    found = Array()
    found.describe(*arguments)
    return found


def _scalar(*arguments: Any) -> Any:
    """``scalar(type, bytes)`` as Python's own number."""
    if len(arguments) != 2 or type(arguments[0]) is not Type or arguments[0].kind == "O":
        raise Refused("a number that is described in another way than numpy's")
    found = Array()
    found.describe(arguments[1], arguments[0], (), "C")
    kind, order, *_, content = found.described or ()
    return struct.unpack((order if order in "<>" else "=") + _STRUCT[kind], content)[0]


def _encode(*arguments: Any) -> bytes:
    """``_codecs.encode(text, "latin1")``: bytes in protocol 2."""
    if len(arguments) != 2 or arguments[1] != "latin1" or not _is_text(arguments[0]):
        raise Refused("text in another encoding than latin1")
    return bytes(arguments[0], "latin1")


def _no_bytes(*arguments: Any) -> bytes:
    """``bytes()``: empty ones in protocol 2."""
    if arguments:
        raise Refused("bytes made of something")
    return b""


NDARRAY = Name(_reconstruct)
_NAMES = {
    ("numpy", "ndarray"): NDARRAY,
    ("numpy", "dtype"): Name(Type),
    ("_codecs", "encode"): Name(_encode),
    ("builtins", "bytes"): Name(_no_bytes),
    ("__builtin__", "bytes"): Name(_no_bytes),
    **{
        (f"numpy.{core}.{module}", name): Name(make)
        for core in ("core", "_core")
        for module, name, make in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _frombuffer),
        )
    },
}
"""All that a pickle may name, and the placeholders that it gets. Nothing is imported."""


class _Restricted(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        found = _NAMES.get((module, name))
        if found is None:
            raise Refused(f"the name {f'{module}.{name}'!r:.60}")
        return found


def read(file: io.BytesIO) -> Any:
    """Return the value of a pickle, arrays as `Array`.

    Raises:
        Refused: it holds something else than numbers, text, plain containers and arrays.
        Exception: it is damaged; the kinds are those of `pickle`.
    """
    found = _Restricted(file, encoding="latin1").load()
    if file.read(1):
        raise Refused("something behind its end")
    check(found)
    return found


def check(found: Any) -> None:
    """Refuse cycles, depth and everything that is not a value, level by level."""
    level: dict[int, Any] = {0: [found]}
    count = 0
    for _ in range(MAX_DEPTH + 1):
        level = {id(item): item for here in level.values() for item in _inside(here)}
        count += len(level)
        if count > MAX_CONTAINERS:
            raise Refused(f"more than {MAX_CONTAINERS:,} containers")
        if not level:
            return
    raise Refused(f"containers more than {MAX_DEPTH} deep, or one that holds itself")


def _inside(value: Any) -> list[Any]:
    """Return the containers and arrays in a container."""
    items: Any
    if type(value) is Array:
        items = value.items()
    elif type(value) is dict:
        items = value.values()
        for key in value:
            if type(key) not in _PLAIN:
                raise Refused(f"a key that is a {type(key).__name__}")
    elif type(value) in {list, tuple}:
        items = value
    else:
        raise Refused(f"something that is no value ({type(value).__name__})")
    kinds = set(map(type, items))
    if int in kinds and any(type(item) is int and item.bit_length() > _MAX_BITS for item in items):
        raise Refused("an integer that is no measured number")
    return [] if kinds <= _PLAIN else [item for item in items if type(item) not in _PLAIN]


def answer(data: bytes) -> bytes:
    """Return a pickle of ("value", value), ("refused", byte, content) or ("damaged", byte, fault).

    A byte is where the last instruction begins that was read, or the frame's last one.
    """
    file = io.BytesIO(data)
    try:
        return pickle.dumps(("value", read(file)), protocol=5)
    except Refused as error:
        kind, text = "refused", str(error)
    except MemoryError:
        kind, text = "refused", "more than the memory that it may take"
    except Exception as error:  # each instruction has its own kinds
        kind, text = "damaged", _fault(error, data)
    return pickle.dumps((kind, _last_instruction(data, file.tell()), text), protocol=5)


def _fault(error: Exception, data: bytes) -> str:
    if not data:
        return "the file is empty"
    if isinstance(error, EOFError) or "truncated" in str(error) or "exhausted" in str(error):
        return f"it ends after {len(data)} bytes without its last instruction, as a copy cut short"
    if isinstance(error, UnicodeError):
        return "it has text that is not in its encoding"
    return " ".join(str(error).split())[:200]


def _last_instruction(data: bytes, read_bytes: int) -> int:
    """Return where the last instruction begins of so many bytes that were read."""
    begun = 0
    try:
        for _, _, place in pickletools.genops(data):
            if place is None or place >= read_bytes:
                break
            begun = place
    except Exception:  # damaged behind it
        pass
    return begun


def main() -> None:
    """Answer the pickle on standard input. Arguments: memory in bytes, processor time in s."""
    memory, seconds = map(int, sys.argv[1:3])
    for kind, most in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))
    sys.stdout.buffer.write(answer(sys.stdin.buffer.read()))
    sys.stdout.buffer.flush()
    os._exit(0)  # what was read need not be freed object by object


if __name__ == "__main__":
    main()
