"""Trials whose HDF5 file has something else in it; as a program, what reading each of them gives.

`python -m tests.storage.trials.foreign_hdf5 FOLDER` prints one JSON list a line: the name of the
case, and ``clean`` or the error of each way to read the trial, then the problems of `verify`.
"""

from __future__ import annotations

import io
import json
import resource
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, sha256
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.verify import verify_trial
from tests.storage.trial_files import campaign, commit

Change = Callable[[Any], Any]
HUGE = 1 << 60


def replaced(name: str, **how: Any) -> Change:
    """Put another dataset in the place of one."""

    def change(file: Any) -> None:
        del file[name]
        file.create_dataset(name, **how)

    return change


def linked(name: str, link: Any) -> Change:
    """Put a link in the place of a dataset or a group."""

    def change(file: Any) -> None:
        del file[name]
        file[name] = link

    return change


def attribute(name: str, value: Any) -> Change:
    """Another attribute of the file."""

    def change(file: Any) -> None:
        file.attrs.pop(name, None)
        file.attrs[name] = value

    return change


def virtual(file: Any) -> None:
    del file["events/x"]
    layout = h5py.VirtualLayout((1000,), "u2")
    layout[:] = h5py.VirtualSource("/dev/zero", "x", (1000,))
    file.create_virtual_dataset("events/x", layout)


def unknown_filter(file: Any) -> None:
    """A filter that no program has: its chunk is written as it is."""
    del file["events/x"]
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((1000,))
    plan.set_filter(40_000, h5py.h5z.FLAG_OPTIONAL, (1,))
    space = h5py.h5s.create_simple((1000,))
    data = h5py.h5d.create(file["events"].id, b"x", h5py.h5t.NATIVE_UINT16, space, plan)
    data.write_direct_chunk((0,), bytes(2000))


def packed(values: Any, filters: Any, mask: int = 0, rows: int = 1 << 24) -> Change:
    """Times in one chunk of many rows, which unpacks to some values only."""

    def change(file: Any) -> None:
        one = h5py.File(io.BytesIO(), "w")
        few = np.asarray(values, np.uint32)
        data = one.create_dataset("t", data=few, chunks=few.shape, **filters)
        stored = few.tobytes() if mask else data.id.read_direct_chunk((0,))[1]
        del file["events/t"]
        made = file.create_dataset("events/t", (rows,), "u4", chunks=(rows,), **filters)
        made.id.write_direct_chunk((0,), stored, mask)

    return change


def index(values: Any) -> Change:
    """Another index of the same type."""
    return replaced("ms_to_idx", data=np.asarray(values, np.int64))


def pixel(file: Any) -> None:
    file["events/x"][500] = 640


SHAPES: dict[str, Change] = {
    **{f"{n} integers": attribute("format", np.full(n, 1 << 62)) for n in (2, 100, 8000, 100_000)},
    "an empty attribute": attribute("format", h5py.Empty("i8")),
    "text": attribute("format", "2"),
    "text of fixed length": attribute("format", np.bytes_(b"2" * 5000)),
    "an array type": attribute("format", np.zeros(1, np.dtype("8000i8,i8"))),
    "a compound": attribute("format", np.zeros((), np.dtype([("a", "i8"), ("b", "S5000")]))),
    "a reference": attribute("format", h5py.RegionReference()),
    "a fraction": attribute("format", 2.5),
    "an offset of many": replaced("t_offset", data=np.arange(8000)),
    "an offset without a value": replaced("t_offset", data=h5py.Empty("i8")),
    "an offset of text": replaced("t_offset", data="5"),
    "times of 2**60 rows": replaced("events/t", shape=(HUGE,), dtype="u4", chunks=(1 << 16,)),
    "times of 2**34 rows": replaced("events/t", shape=(1 << 34,), dtype="u4", chunks=(1 << 16,)),
    "one large chunk": replaced("events/t", shape=(1 << 28,), dtype="u4", chunks=(1 << 28,)),
    "columns of pixels": replaced("events/x", data=np.zeros((1000, 3), "u2")),
    "a pixel as a float": replaced("events/x", data=np.full(1000, 1e300)),
    "a pixel that is negative": replaced("events/x", data=np.full(1000, -1, "i2")),
    "a pixel of 64 bits": replaced("events/y", data=np.full(1000, 1 << 40)),
    "fewer pixels than times": replaced("events/x", data=np.zeros(3, "u2")),
    "more pixels than times": replaced("events/x", data=np.zeros(3000, "u2")),
    "times as text": replaced("events/t", data=np.full(1000, b"x" * 32)),
    "times as text of any length": replaced("events/t", data=["x"] * 9, dtype=h5py.string_dtype()),
    "times as records": replaced("events/t", data=np.zeros(1000, "i4,S400")),
    "times of 128 bits": replaced("events/t", data=np.zeros(1000, np.longdouble)),
    "times in a row": replaced("events/t", data=np.zeros((1, 1000), "u4")),
    "a single time": replaced("events/t", data=np.uint32(7)),
    "no times": lambda file: file["events"].__delitem__("t"),
    "times in a group": linked("events/t", h5py.SoftLink("/poses")),
    "a group as a column": lambda file: (
        file["events"].__delitem__("t"),
        file.create_group("events/t/t"),
    ),
    "a column as a group": replaced("events", data=np.zeros(3)),
    "a soft link": linked("events/t", h5py.SoftLink("/events/p")),
    "a soft link to nothing": linked("events/t", h5py.SoftLink("/events/none")),
    "an external link": linked("events/t", h5py.ExternalLink("/dev/stdin", "/t")),
    "an external link to a group": linked("events", h5py.ExternalLink("/dev/stdin", "/events")),
    "virtual data": virtual,
    "external data": replaced(
        "events/x", shape=(1000,), dtype="u2", external=[("/dev/zero", 0, 2000)]
    ),
    "an unknown filter": unknown_filter,
    "a small column in a large chunk": replaced(
        "events/t", shape=(10,), maxshape=(None,), dtype="u4", chunks=(1 << 29,)
    ),
    "a compression of nothing": replaced(
        "events/t", shape=(1 << 33,), dtype="u4", chunks=(1 << 20,), **hdf5plugin.Zstd()
    ),
    **{
        f"a short chunk, {name}": packed(np.zeros(200), filters)
        for name, filters in {
            "gzip": {"compression": "gzip"},
            "gzip with a sum": {"compression": "gzip", "shuffle": True, "fletcher32": True},
            "gzip in zstd": {"compression": "gzip", **hdf5plugin.Zstd()},
            "lzf": {"compression": 32000, "compression_opts": (4, 261, 800)},
            "zstd": hdf5plugin.Zstd(),
            "lz4": hdf5plugin.LZ4(),
            "blosc": hdf5plugin.Blosc(),
            "bitshuffle": hdf5plugin.Bitshuffle(nelems=64),
        }.items()
    },
    "a short chunk that is not packed": packed(np.zeros(200), hdf5plugin.Zstd(), mask=1),
    "an offset beyond all times": replaced("t_offset", data=np.uint64((1 << 64) - 1)),
    "an index that ends beyond": index([0, HUGE, HUGE, HUGE]),
    "an index that runs backwards": index(np.arange(100)[::-1] * 10),
    "a negative index": index([-HUGE, -5, -1, -1]),
    "an index of text": replaced("ms_to_idx", data=np.full(9, b"x")),
    "a pixel outside of the camera": pixel,
    "poses of different lengths": replaced("poses/xyz", data=np.zeros((3, 3))),
    "poses in the plane": replaced("poses/xyz", data=np.zeros((10, 2))),
}
BYTES = 4 << 30
LOOKS: dict[str, Callable[[Any], Any]] = {
    "event_times": lambda reader: reader.event_times(),
    "events": lambda reader: reader.events(),
    "window": lambda reader: reader.events(5_000_000, 5_030_000),
    "late": lambda reader: reader.events(5_090_000, 5_120_000),
    "poses": lambda reader: reader.poses(),
    "counts": lambda reader: reader.counts(),
    "streams": lambda reader: reader.streams(),
}
"""Ways to read a trial; any error but a `StoreError` ends the program."""


def committed(folder: Path) -> Path:
    """A committed trial in a new store."""
    return commit(campaign(folder), "t", geometry={"event_px": [640, 480]})


def changed(trial: Path, change: Change) -> None:
    """Change the trial's data, and its checksum with them."""
    path = trial / "data.h5"
    path.chmod(0o644)
    with h5py.File(path, "r+") as file:
        change(file)
    sums = read_json(trial / "checksums.json")
    sums["data.h5"] = {"sha256": sha256(path), "bytes": path.stat().st_size}
    (trial / "checksums.json").unlink()
    (trial / "checksums.json").write_text(json.dumps(sums))


def look(trial: Path) -> list[str]:
    """What each way to read a trial gives: ``clean`` or its error."""
    found = []
    for way in LOOKS.values():
        try:
            with Recording(trial).open() as reader:
                way(reader)
            found.append("clean")
        except StoreError as error:
            found.append(str(error))
    return found


def main(folder: Path) -> None:
    """Read every case."""
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    trial = committed(folder / "store")
    for name, change in SHAPES.items():
        copy = folder / "copy" / "campaigns" / "c" / "trials" / "t"
        shutil.copytree(trial, copy)
        changed(copy, change)
        print(
            json.dumps([name, look(copy), [item.what for item in verify_trial(copy)]]), flush=True
        )
        shutil.rmtree(folder / "copy")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
