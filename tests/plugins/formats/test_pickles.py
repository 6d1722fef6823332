"""The reader of foreign pickles, held against Python's own, and against pickles that attack."""

from __future__ import annotations

import io
import pickle
import struct
import subprocess
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.plugins.formats.lab import pickle_child, pickles
from sliplab.plugins.formats.lab.pickles import parse_pickle, read_pickle
from sliplab.protocols.errors import InputError

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)
PLAIN = (
    st.none()
    | st.booleans()
    | st.integers(-(2**200), 2**200)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary()
)
VALUES = st.recursive(
    PLAIN,
    lambda inner: (
        st.lists(inner)
        | st.dictionaries(st.text() | st.integers(), inner)
        | st.lists(inner).map(tuple)
    ),
    max_leaves=20,
)


@given(VALUES, st.sampled_from(PROTOCOLS))
def test_plain_values_are_what_python_reads(value: Any, protocol: int) -> None:
    data = pickle.dumps(value, protocol)
    assert pickle.loads(pickle_child.answer(data)) == ("value", value)


def test_the_child_process_gives_what_the_reader_gives() -> None:
    value = {"a": [1, 2.5, "x", None, True], "b": (1, (2, 3)), "d": b"x", 3: []}
    assert parse_pickle(pickle.dumps(value), "x") == value


@pytest.mark.quick(11)
@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    "array",
    [
        np.arange(6, dtype="<i4").reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(4, dtype=">u2"),
        np.array([True, False]),
        np.float32([1.5, np.inf]),
        np.empty((0, 7)),
        np.float64(2.5),
        np.arange(10)[::3],
        np.array(3),
    ],
    ids=lambda array: f"{array.dtype}{array.shape}",
)
def test_arrays_of_numbers(array: Any, protocol: int) -> None:
    found = parse_pickle(pickle.dumps([array, array], protocol), "x")
    for one in found:
        np.testing.assert_array_equal(one, array)
        assert np.asarray(one).dtype == (
            float if array.shape == () and array == 2.5 else array.dtype
        )


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("order", ["C", "F"])
def test_the_labs_arrays_of_lists(order: Any, protocol: int) -> None:
    made = np.empty((3, 2), object, order=order)
    for index in np.ndindex(3, 2):
        made[index] = [float(10 * index[0] + index[1])] * (index[0] + 1)
    for core in ("core", "_core"):  # numpy 1 and 2
        data = pickle.dumps(made, protocol).replace(b"numpy._core", f"numpy.{core}".encode())
        if core == "core" and protocol >= 4:
            data = pickle.dumps(made, protocol)  # its frames have lengths
        found = parse_pickle(data, "x")
        assert found.dtype == object
        assert found.tolist() == made.tolist()


def test_numpy_1_wrote_other_names() -> None:
    data = pickle.dumps(np.arange(3), 2)
    older = data.replace(b"numpy._core", b"numpy.core")
    assert older != data
    assert parse_pickle(older, "x").tolist() == [0, 1, 2]


class _Runs:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path, how: Any = None) -> None:
        self.path, self.how = path, how

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


class _Stateful:
    def __setstate__(self, state: Any) -> None:
        raise AssertionError("was run")

    def __getstate__(self) -> Any:
        return {"a": 1}


def _global(module: bytes, name: bytes, rest: bytes) -> bytes:
    return b"c" + module + b"\n" + name + b"\n" + rest


def _nested(depth: int) -> bytes:
    return b"]" * depth + b"a" * (depth - 1) + b"."


def _with_shape(side: bytes) -> bytes:
    data = pickle.dumps(np.zeros(2), 2)
    assert data.count(b"K\x02\x85") == 1
    return data.replace(b"K\x02\x85", side + b"\x85")


ATTACKS = {
    "system": _global(b"os", b"system", b"(S'true'\ntR."),
    "eval": _global(b"builtins", b"eval", b"(S'1'\ntR."),
    "dotted": b"\x8c\x05numpy\x8c\x0b__loader__.x\x93.",
    "numpy load": _global(b"numpy", b"load", b"(S'x'\ntR."),
    "runstring": _global(b"numpy.testing._private.utils", b"runstring", b"(S'1'\ntR."),
    "dtype of objects from bytes": pickle.dumps(np.zeros(2), 2).replace(b"f8", b"O8"),
    "dtype of records": pickle.dumps(np.zeros(2, "i4,i4"), 2),
    "dtype call with text": b"cnumpy\ndtype\n(V(1000000,1000000)f8\ntR.",
    "subclass": pickle.dumps(np.ma.masked_array([1]), 2),
    "instance": pickle.dumps(_Stateful(), 0),
    "new object": pickle.dumps(_Stateful(), 2),
    "old instance": b"(ios\nsystem\n.",
    "object": b"(cos\nsystem\nS'true'\no.",
    "extension": b"\x82\x01.",
    "extension 4": b"\x84\x01\x02\x03\x04.",
    "persistent id": b"Pabc\n.",
    "persistent id 1": b"Nq\x00Q.",
    "next buffer": b"\x97.",
    "read-only buffer": b"N\x98.",
    "set": pickle.dumps({1, 2}, 4),
    "frozen set": pickle.dumps(frozenset({1}), 4),
    "ordered": pickle.dumps(OrderedDict(a=1), 4),
    "complex": pickle.dumps(1j, 4),
    "bytes of 1 TB": b"\x8e" + struct.pack("<Q", 1 << 40) + b"abc.",
    "bytearray of 1 TB": b"\x96" + struct.pack("<Q", 1 << 40) + b"abc.",
    "text of 1 TB": b"\x8d" + struct.pack("<Q", 1 << 40) + b"abc.",
    "integer of 2 GB": b"\x8b" + struct.pack("<I", (1 << 31) - 1) + b"abc.",
    "integer of 2000 bytes": pickle.dumps(1 << 16000, 2),
    "integer as text": b"L" + b"9" * 100_000 + b"L\n.",
    "array of 8 GB": _with_shape(b"J\x00\x00\x00\x40"),
    "negative shape": _with_shape(b"J\xff\xff\xff\xff"),
    "itself": b"]q\x00h\x00a.",
    "itself through a dictionary": b"}q\x00]q\x01h\x00aK\x01h\x01s.",
    "1,000 deep": _nested(1_000),
    "100,000 deep": _nested(100_000),
    "key of tuples": b"}" + b")" + b"2\x86" * 60 + b"Ns.",
    "key of a list": b"}]Ns.",
    "memo of a function": _global(b"numpy", b"dtype", b"q\x00."),
    "array never described": _global(
        b"numpy._core.multiarray", b"_reconstruct", b"cnumpy\nndarray\nK\x00\x85C\x01b\x87R."
    ),
    "state for a list": b"]}b.",
    "state for a function": b"cnumpy\ndtype\n}b.",
    "call of a list": b"])R.",
    "append to a tuple": b")Na.",
    "append below a mark": b"](Na.",
    "pop of nothing": b"0.",
    "memo of nothing": b"h\x05.",
    "memo of 34 GB": b"Nr\xff\xff\xff\xffj\xff\xff\xff\xff\x86.",
    "key of 100,000 tuples": b"})" + b"\x85" * 100_000 + b"Ns.",
    "state with the code of a function": b"cnumpy\ndtype\nN}S'__code__'\nNs\x86b.",
    "new object of a stand-in": b"cnumpy\ndtype\n)\x81.",
    "instance of a stand-in": b"(inumpy\ndtype\n.",
    "state for a dictionary": b"}}S'a'\nNsb.",
    "persistent id of the answer": b"carray\narray\n)R.",
    "behind the end": b"N.N.",
    "nothing": b"",
    "no end": b"N",
    "newer": b"\x80\x06N.",
    "no pickle": b"hello",
    "unknown instruction": b"\xff.",
    "not UTF-8": b"\x8c\x01\xff.",
    "half a float": b"G\x00\x00.",
}


RUNS_ON = "key of tuples"


@pytest.mark.quick(20)
@pytest.mark.parametrize("name", [it for it in ATTACKS if it != RUNS_ON])
def test_a_hostile_or_damaged_file_is_refused_at_once(name: str) -> None:
    begun = time.process_time()
    with pytest.raises(InputError) as caught:
        parse_pickle(ATTACKS[name], "them.pickle")
    assert caught.value.file == "them.pickle"
    assert caught.value.key.startswith("byte ")
    assert time.process_time() - begun < 5


@pytest.mark.parametrize("name", ["memo of 34 GB", "bytearray of 1 TB"])
def test_memory_is_limited(name: str) -> None:
    with pytest.raises(InputError, match="more than the memory"):
        parse_pickle(ATTACKS[name], "x")


@pytest.mark.long
def test_memory_is_limited_for_what_is_small_in_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickles, "MEMORY", 100 << 20)
    with pytest.raises(InputError, match="more than the memory"):
        parse_pickle(b"(" + b"]" * 2_000_000 + b"l.", "x")


@pytest.mark.long
def test_a_reader_that_runs_on_is_ended() -> None:
    with pytest.raises(InputError, match=r"byte 0: .*more than 3 s or 4 GiB .*ended with code -\d"):
        parse_pickle(ATTACKS[RUNS_ON], "x")


def test_a_reader_that_crashes_harms_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    child = tmp_path / "child.py"
    child.write_text("import os; os.abort()")
    monkeypatch.setattr(pickles, "_CHILD", child)
    with pytest.raises(InputError, match=r"byte 0: .*ended with code -6"):
        parse_pickle(pickle.dumps(1), "x")


def test_a_reader_that_sleeps_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*_: Any, timeout: float, **__: Any) -> Any:
        raise subprocess.TimeoutExpired("x", timeout)

    monkeypatch.setattr(pickles.subprocess, "run", hang)
    with pytest.raises(InputError, match="its process did not end"):
        parse_pickle(pickle.dumps(1), "x")


def test_names_get_stand_ins_that_are_no_classes_and_keep_no_state() -> None:
    for name in cast(dict[Any, Any], pickle_child._NAMES).values():
        assert not isinstance(name, type)
        assert not hasattr(name, "__dict__")
        with pytest.raises(pickle_child.Refused):
            name.__setstate__((None, {"_make": None}))


def test_the_refused_name_has_its_place() -> None:
    with pytest.raises(InputError, match=r"byte 2: holds the name 'os\.system'; only numbers"):
        parse_pickle(b"N0" + ATTACKS["system"], "x")
    with pytest.raises(InputError, match=r"byte 12: holds"):
        parse_pickle(b"N0" + ATTACKS["system"], "x", before=10)


def test_nothing_is_run(tmp_path: Path) -> None:
    made = tmp_path / "made"
    (tmp_path / "bad.pickle").write_bytes(pickle.dumps({"a": [1, _Runs(made)]}))
    with pytest.raises(InputError, match=r"bad\.pickle.*nothing was run"):
        read_pickle(tmp_path / "bad.pickle")
    assert not made.exists()


def test_a_second_value_is_left_as_python_leaves_it() -> None:
    assert parse_pickle(b"NK\x01.", "x") == pickle.loads(b"NK\x01.") == 1


def test_what_is_told_twice_stays_one_thing() -> None:
    found = parse_pickle(b"]q\x000" + b"(h\x00h\x00lq\x000" * 25 + b"h\x00\x85.", "x")
    assert isinstance(found, tuple)
    assert found[0][0] is found[0][1]


def test_too_many_containers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickle_child, "MAX_CONTAINERS", 1000)
    with pytest.raises(pickle_child.Refused, match="more than 1,000 containers"):
        pickle_child.read(io.BytesIO(b"(" + b"]" * 1001 + b"l."))


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.pickle"):
        read_pickle(tmp_path / "gone.pickle")
    with pytest.raises(InputError, match="cannot be read"):
        read_pickle(tmp_path)
