"""A machine for the instructions of pickles that data need, without import and call.

It knows what numbers, text, lists, tuples, dictionaries and numpy's arrays need (`pickle_numpy`);
whatever else a file asks for ends the reading. It takes time and memory in proportion to the file.
"""

from __future__ import annotations

import pickletools
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from sliplab.storage.exchange.pickle_depth import PLAIN
from sliplab.storage.exchange.pickle_numpy import ALLOWED, BUILDERS, Pending, Refused

MAX_CONTAINERS = 1_000_000
"""The lab's files have a list a pixel: 307,200."""
_LONGEST_INTEGER = 64
_FEW = 16
_FLOATS = re.compile(rb"\]\x94(?:\(((?:G.{8})++)e|(G.{8})a)?", re.DOTALL)
"""`EMPTY_LIST MEMOIZE`, then `MARK BINFLOAT ... APPENDS` or `BINFLOAT APPEND` or neither."""
_FLOAT = np.dtype([("code", "u1"), ("value", ">f8")])
_NAMES = {ord(code.code): code.name for code in pickletools.opcodes}


class Machine:
    """A stack, a memo and a place in the bytes."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = self.begun = 0
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._containers = 0

    def run(self) -> Any:
        """Carry out instructions to the end of the pickle."""
        data, stack, steps = self._data, self._stack, _STEPS
        while True:
            self.begun = at = self._at
            code = data[at]
            if code == 0x5D and self._list_of_floats():
                continue
            self._at = at + 1
            if code == 0x2E:
                if len(stack) != 1 or self._marks:
                    raise ValueError("it ends in the middle")
                if self._at != len(data):
                    raise Refused("something behind its end")
                return self._value(stack[0])
            step = steps.get(code)
            if step is None:
                if code not in _NAMES:
                    raise ValueError(f"it has the byte {code:#04x} where an instruction belongs")
                raise Refused(f"the instruction {_NAMES[code]}")
            step(self)

    def _list_of_floats(self) -> bool:
        """What such files are made of, carried out at once: a list, noted and filled."""
        found = _FLOATS.match(self._data, self._at)
        if found is None:
            return False
        self._at = found.end()
        content = found[1] or found[2] or b""
        count = len(content) // 9
        if count > _FEW:
            values = np.frombuffer(content, _FLOAT)["value"].tolist()
        else:
            values = list(struct.unpack(">" + "xd" * count, content))
        self._container(values)
        self._memo[len(self._memo)] = values
        return True

    def _take(self, count: int) -> bytes:
        found = self._data[self._at : self._at + count]
        if len(found) != count:
            raise ValueError("it is cut short")
        self._at += count
        return found

    def _line(self) -> bytes:
        end = self._data.index(b"\n", self._at)
        found = self._data[self._at : end]
        self._at = end + 1
        return found

    def _number(self, size: int, signed: bool = False) -> int:
        return int.from_bytes(self._take(size), "little", signed=signed)

    def _pop(self) -> Any:
        if self._marks and len(self._stack) <= self._marks[-1]:
            raise ValueError("it takes what is not there")
        return self._stack.pop()

    def _popped(self) -> list[Any]:
        """Everything above the last mark."""
        mark = self._marks.pop()
        found = self._stack[mark:]
        del self._stack[mark:]
        return found

    def _container(self, made: Any) -> None:
        self._containers += 1
        if self._containers > MAX_CONTAINERS:
            raise Refused(f"more than {MAX_CONTAINERS:,} containers")
        self._stack.append(made)

    def _top(self, kind: type) -> Any:
        if self._marks and len(self._stack) <= self._marks[-1]:
            raise ValueError("it fills what is not there")
        found = self._stack[-1]
        if type(found) is not kind:
            raise Refused(f"something to be filled that is no {kind.__name__}")
        return found

    def _value(self, found: Any) -> Any:
        if isinstance(found, Pending):
            if found.kind != "dtype" and found.value is None:
                raise ValueError("an array is used before it is described")
            return found if found.kind == "dtype" else found.value
        return found

    # one step an instruction, named as in `pickletools`

    def proto(self) -> None:
        if self._take(1)[0] > 5:
            raise Refused("a newer protocol than 5")

    def frame(self) -> None:
        self._take(8)

    def mark(self) -> None:
        self._marks.append(len(self._stack))

    def pop(self) -> None:
        if self._marks and len(self._stack) == self._marks[-1]:
            self._marks.pop()
        else:
            self._pop()

    def pop_mark(self) -> None:
        self._popped()

    def dup(self) -> None:
        self._stack.append(self._stack[-1])

    def int_text(self) -> None:
        line = self._line()
        known = {b"00": False, b"01": True}
        self._stack.append(known[line] if line in known else self._digits(line))

    def long_text(self) -> None:
        self._stack.append(self._digits(self._line().removesuffix(b"L")))

    def _digits(self, line: bytes) -> int:
        if len(line) > 2 * _LONGEST_INTEGER:
            raise Refused("an integer that is no measured number")
        return int(line)

    def float_text(self) -> None:
        self._stack.append(float(self._line()))

    def long(self, width: int) -> None:
        size = self._number(width)
        if size > _LONGEST_INTEGER:
            raise Refused("an integer that is no measured number")
        self._stack.append(self._number(size, signed=True))

    def string_text(self) -> None:
        line = self._line()
        if len(line) < 2 or line[:1] != line[-1:] or line[:1] not in {b"'", b'"'}:
            raise ValueError("text without its quotes")
        if b"\\" in line:
            raise Refused("text as only Python 2 wrote it")
        self._stack.append(str(line[1:-1], "latin1"))

    def unicode_text(self) -> None:
        self._stack.append(str(self._line(), "raw-unicode-escape"))

    def text(self, width: int, encoding: str) -> None:
        errors = "surrogatepass" if encoding == "utf-8" else "strict"
        self._stack.append(str(self._take(self._number(width)), encoding, errors))

    def raw(self, width: int) -> None:
        self._stack.append(self._take(self._number(width)))

    def list_(self) -> None:
        self._container(self._popped())

    def append(self) -> None:
        item = self._value(self._pop())
        self._top(list).append(item)

    def appends(self) -> None:
        items = [self._value(item) for item in self._popped()]
        self._top(list).extend(items)

    def tuple_(self, count: int) -> None:
        items = [self._pop() for _ in range(count)][::-1]
        self._container(tuple(map(self._value, items)))

    def tuple_mark(self) -> None:
        self._container(tuple(map(self._value, self._popped())))

    def dict_(self) -> None:
        items = self._popped()
        self._container({})
        self._set(items)

    def setitem(self) -> None:
        value = self._pop()
        self._set([self._pop(), value])

    def setitems(self) -> None:
        self._set(self._popped())

    def _set(self, items: list[Any]) -> None:
        if len(items) % 2:
            raise ValueError("a key without its value")
        target = self._top(dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            if type(key) not in PLAIN:  # a tuple of tuples of tuples takes for ever to hash
                raise Refused(f"a key that is a {type(key).__name__}")
            target[key] = self._value(value)

    def put(self, index: int) -> None:
        self._memo[index] = self._stack[-1]

    def get(self, index: int) -> None:
        self._stack.append(self._memo[index])

    def named(self, module: Any, name: Any) -> None:
        found = None
        if isinstance(module, str) and isinstance(name, str):
            found = ALLOWED.get((module, name))
        if found is None:
            raise Refused(f"the name {f'{module}.{name}'!r:.60}")
        self._stack.append(found)

    def reduce(self) -> None:
        arguments, function = self._pop(), self._pop()
        if type(arguments) is not tuple or not callable(function):
            raise Refused("a call of something that is no function")
        self._container(function(*arguments))

    def build(self) -> None:
        state, target = self._pop(), self._pop()
        if not isinstance(target, Pending):
            raise Refused("a state for something that takes none")
        built = BUILDERS[target.kind](target, state)
        self._stack.append(target if target.kind == "dtype" else built)


_float = struct.Struct(">d").unpack


def _push(value: Any) -> Callable[[Machine], None]:
    return lambda machine: machine._stack.append(value)


_STEPS: dict[int, Callable[[Machine], None]] = {
    0x80: Machine.proto,
    0x95: Machine.frame,
    ord("("): Machine.mark,
    ord("0"): Machine.pop,
    ord("1"): Machine.pop_mark,
    ord("2"): Machine.dup,
    ord("N"): _push(None),
    0x88: _push(True),
    0x89: _push(False),
    ord("I"): Machine.int_text,
    ord("L"): Machine.long_text,
    ord("F"): Machine.float_text,
    ord("G"): lambda m: m._stack.append(_float(m._take(8))[0]),
    ord("K"): lambda m: m._stack.append(m._number(1)),
    ord("M"): lambda m: m._stack.append(m._number(2)),
    ord("J"): lambda m: m._stack.append(m._number(4, signed=True)),
    0x8A: lambda m: m.long(1),
    0x8B: lambda m: m.long(4),
    ord("S"): Machine.string_text,
    ord("V"): Machine.unicode_text,
    ord("T"): lambda m: m.text(4, "latin1"),
    ord("U"): lambda m: m.text(1, "latin1"),
    ord("X"): lambda m: m.text(4, "utf-8"),
    0x8C: lambda m: m.text(1, "utf-8"),
    0x8D: lambda m: m.text(8, "utf-8"),
    ord("B"): lambda m: m.raw(4),
    ord("C"): lambda m: m.raw(1),
    0x8E: lambda m: m.raw(8),
    0x96: lambda m: m.raw(8),
    ord("]"): lambda m: m._container([]),
    ord("l"): Machine.list_,
    ord("a"): Machine.append,
    ord("e"): Machine.appends,
    ord(")"): _push(()),
    ord("t"): Machine.tuple_mark,
    0x85: lambda m: m.tuple_(1),
    0x86: lambda m: m.tuple_(2),
    0x87: lambda m: m.tuple_(3),
    ord("}"): lambda m: m._container({}),
    ord("d"): Machine.dict_,
    ord("s"): Machine.setitem,
    ord("u"): Machine.setitems,
    ord("p"): lambda m: m.put(int(m._line())),
    ord("q"): lambda m: m.put(m._number(1)),
    ord("r"): lambda m: m.put(m._number(4)),
    0x94: lambda m: m.put(len(m._memo)),
    ord("g"): lambda m: m.get(int(m._line())),
    ord("h"): lambda m: m.get(m._number(1)),
    ord("j"): lambda m: m.get(m._number(4)),
    ord("c"): lambda m: m.named(m._line().decode(), m._line().decode()),
    0x93: lambda m: m.named(*[m._pop() for _ in range(2)][::-1]),
    ord("R"): Machine.reduce,
    ord("b"): Machine.build,
}
