"""Damage to bytes and to structure; every choice comes from the random numbers it is given."""

from __future__ import annotations

import copy
import io
import json
import math
import random
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  (registers the filters)
import numpy as np
import yaml

TOKENS = [
    *b"\x00 \xff\xfe \xef\xbb\xbf ../../canary /etc/passwd /dev/zero".split(b" "),
    b"!!python/object/apply:os.system ['touch canary']",
    *b"!!python/name:os.system|!!binary ''|&a [*a]|*a|<<: *a|? [a]|---\n|...\n".split(b"|"),
    b"%YAML 9.9\n",
    *b"NaN Infinity 1e999999999 -1e999999999 1e-999999999".split(),
    *(b"9" * 400, b"9" * 5000),
    *b"0x1f 0b1 0o7 1:2:3 2020-01-01 2020-99-99 ~".split(),
    *(b"{" * 5000, b"[" * 50000, b"- " * 3000, b'{"a":' * 3000),
    *b"\\u0000 \\ud800".split(),
    "\u202e\u0000\U0001f600".encode(),
    b"\x85\xe2\x80\xa8",
    b"cos\nsystem\n(S'touch canary'\ntR.",
    *b"\x8c\x02os\x8c\x06system\x93 \x96\xff\xff\xff\xff\xff r\xff\xff\xff\xff".split(b" "),
    *(b"\x94" * 50, b"]" * 3000),
    *(bytes([letter]) for letter in b"=|>\t'\"#"),
]
LAUGHS = b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
    b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n" % ((new, new) + (old,) * 8)
    for old, new in zip(b"abcdefgh", b"bcdefghi", strict=True)
)
VALUES: list[Any] = [
    *(None, True, False, 0, 1, -1, 2**31, 2**63, 2**64, -(2**63), 10**40, 10**400),
    *(0.5, -0.0, 1e-300, 1e308, float("nan"), float("inf")),
    *("", " ", "\x00", "a\x00b", "a" * 100_000),
    *["../../canary", "/etc/passwd", "/dev/zero", "C:\\canary", "..", ".", "a/b"],
    *("\u202e\u2028", "\u00fc", "e\u0301", "nan", "inf", "1e999999999"),
    *["1e400 mm", "1e-999999 mm", "2.4 mm", "-2.4 mm", "0 mm", "9e8 mm"],
    *["1 s", "1e9 s", "0.000001 s"],
    *["$depth", "$nothing", "$", "__class__", "{0.__class__}", "%s%n", "1 parsec"],
    *["2020-01-01", "2026-13-45T99:99:99Z", "yes", "{}"],
    *([], {}, [[]], [{}], {"a": {}}, [1] * 1000, [None] * 3, {"": ""}, {"__proto__": 1}),
    [[[[[[[[[[[[1]]]]]]]]]]]],
    *(1_000_001, 999_999),
]
Tree = Any


def flip(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """A few bits."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if found:
            found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


def cut(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """The end, the beginning or the middle is missing."""
    low, high = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return rng.choice((data[:low], data[high:], data[:low] + data[high:]))


def insert(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Something foreign in between."""
    at = rng.randrange(len(data) + 1)
    what = rng.choice((rng.choice(TOKENS), rng.randbytes(rng.choice((1, 4, 100)))))
    return data[:at] + what + data[at:]


def replace_line(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """A line goes, comes twice, moves, or ends in something else."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    before, colon, _ = lines[at].partition(b":")
    lines[at : at + 1] = rng.choice(
        ([], [lines[at]] * 2, [b"  " + lines[at]], [before + colon + b" " + rng.choice(TOKENS)])
    )
    return b"\n".join(lines)


def splice(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """The beginning of one file and the end of another."""
    other = rng.choice(others)
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def repeat(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """A piece comes many times."""
    low = rng.randrange(len(data) + 1)
    piece = data[low : low + rng.choice((1, 2, 8, 64))]
    return data[:low] + piece * rng.choice((2, 10, 1000)) + data[low:]


def laugh(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """A billion laughs."""
    return rng.choice((LAUGHS, LAUGHS + data, data + b"\n" + LAUGHS))


BYTES: tuple[Callable[[bytes, random.Random, list[bytes]], bytes], ...] = (
    *(flip, flip, cut, insert, insert),
    *(replace_line, splice, repeat, laugh),
)


def change_tree(tree: Tree, rng: random.Random) -> Tree:
    """One place of a tree holds something else; the tree itself is changed."""
    places = list(_places(tree))
    if not places:
        return _value(rng)
    parent, key = rng.choice(places)
    how = rng.randrange(8)
    if how < 4:
        parent[key] = _value(rng)
    elif how == 4:
        del parent[key]
    elif how == 5:
        other, at = rng.choice(places)
        parent[key] = json.loads(json.dumps(other[at], default=str)) if at in _keys(other) else None
    elif how == 6:
        for _ in range(rng.choice((2, 30, 60))):
            parent[key] = rng.choice(([parent[key]], {"a": parent[key]}))
    elif isinstance(parent, dict):
        value = parent.pop(key)
        parent[rng.choice(("", "unknown", "../canary", f"{key} ", str(key).upper()))] = value
    else:
        parent.insert(key, _value(rng))
    return tree


def _value(rng: random.Random) -> Tree:
    return copy.deepcopy(rng.choice(VALUES))


def _keys(parent: Tree) -> Any:
    return parent.keys() if isinstance(parent, dict) else range(len(parent))


def _places(tree: Tree) -> Any:
    for key in list(_keys(tree)) if isinstance(tree, dict | list) else ():
        yield tree, key
        yield from _places(tree[key])


def change_yaml(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """A tree of YAML with some places changed."""
    tree = copy.deepcopy(_tree(data))
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        tree = change_tree(tree, rng)
    return yaml.dump(tree, Dumper=_Plain, sort_keys=False, allow_unicode=rng.random() < 0.5).encode(
        "utf-8", "surrogatepass"
    )


def change_json(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """A tree of JSON with some places changed."""
    tree = json.loads(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        tree = change_tree(tree, rng)
    return json.dumps(tree, ensure_ascii=rng.random() < 0.5).encode("utf-8", "surrogatepass")


@cache
def _tree(data: bytes) -> Tree:
    return yaml.safe_load(data)


class _Plain(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        return True


def change_hdf5(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """An HDF5 file with some attributes or datasets of another shape, type, size or place."""
    made = io.BytesIO(data)
    with h5py.File(made, "r+") as file:
        for _ in range(rng.choice((1, 1, 2, 4))):
            places: list[str] = []
            file.visit(places.append)
            with suppress(OSError, KeyError, ValueError, TypeError):  # not every change fits
                _change_object(file, rng.choice(places or ["x"]), rng)
    return made.getvalue()


def _change_object(file: Any, name: str, rng: random.Random) -> None:
    how = rng.randrange(9)
    if how < 3:  # an attribute: one that is read, or another
        of = file if rng.random() < 0.6 else file[name]
        key = rng.choice((*of.attrs, "format", "kind", "simulated", "sensor_resolution", "unit"))
        of.attrs.pop(key, None)
        of.attrs[key] = _numbers(rng) if rng.random() < 0.7 else rng.choice(HDF5_VALUES)
        return
    old = file.get(name)
    shape = getattr(old, "shape", None) or (3,)
    del file[name]
    if how == 3:
        file[name] = h5py.SoftLink(rng.choice(("/", "/none", name, "/events/x", "/events")))
    elif how == 4:
        file[name] = h5py.ExternalLink(rng.choice(("/dev/stdin", "../canary", "")), "/events/x")
    elif how == 5:
        layout = h5py.VirtualLayout(shape, "u2")
        layout[...] = h5py.VirtualSource("/dev/zero", "x", shape)
        file.create_virtual_dataset(name, layout)
    elif how == 6:  # claimed, and never written
        shape = (rng.choice((0, 1, 1 << 20, 1 << 34, 1 << 60)), *shape[1:])
        file.create_dataset(name, shape, rng.choice(HDF5_TYPES[:6]), chunks=True)
    elif how == 7:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk(shape)
        plan.set_filter(40_000, h5py.h5z.FLAG_OPTIONAL, (1,))
        space = h5py.h5s.create_simple(shape)
        data = h5py.h5d.create(file.id, name.encode(), h5py.h5t.NATIVE_UINT16, space, plan)
        data.write_direct_chunk((0,) * len(shape), bytes(2 * math.prod(shape)))
    else:
        file.create_dataset(name, data=_numbers(rng, shape))


def _numbers(rng: random.Random, shape: tuple[int, ...] = ()) -> Any:
    """Values of some type and shape."""
    shape = rng.choice((shape, shape[:1], (*shape, 3), (), (8000,), (2, 2), (1,)))
    return np.full(shape, rng.choice((0, 1, -1, 700, 1 << 62)), np.int64).astype(
        rng.choice(HDF5_TYPES)
    )


HDF5_TYPES = ["i8", "u2", "u8", ">i4", "f4", "f8", "i1", "S1", "S300", "?", "g", "c16"]
HDF5_VALUES: list[Any] = [
    "text",
    b"x" * 5000,
    h5py.Empty("i8"),
    np.zeros((), np.dtype([("a", "i8"), ("b", "S500")])),
    h5py.Reference(),
    np.zeros(3, h5py.string_dtype()),
    np.zeros(1, np.dtype("800i8,i8")),
]


def mutate(kind: str, data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """One damaged file, of at most some MB.

    Args:
        kind: ``yaml``, ``json``, ``hdf5`` or ``bytes``: the structure that can be changed.
        others: files to splice with.
    """
    found = data
    if kind == "hdf5":
        return change_hdf5(data, rng, others)
    structured = {"yaml": change_yaml, "json": change_json}.get(kind)
    if structured is not None and rng.random() < 0.6:
        try:
            found = structured(found, rng, others)
        except RecursionError:  # nested deeper than can be written
            return b"a: " + b"[" * 2000 if kind == "yaml" else b'{"a":' * 50_000
        if rng.random() < 0.9:
            return found
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        found = rng.choice(BYTES)(found, rng, others)
    return found[: 4 << 20]
